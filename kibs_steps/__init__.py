"""KIBS: LOD2 cities from one off-nadir satellite raster and a terrain model; one module per step."""
