# The published files, one rule per format.

PUBLISHED = [
    "city.gpkg",
    "city.city.json",
    "city.city.jsonl",
    "points.txt",
    "heights.tif",
    "labels.tif",
    "preview.png",
    "run.json",
]


def published(p):
    """All published files of a scene."""
    names = PUBLISHED + (["evaluation.json"] if p.truth else [])
    return [f"results/{p.name}/{f}" for f in names]


rule geopackage:
    """city.gpkg: buildings, footprints, roof sections, corners, blocks."""
    input:
        scene=ancient("results/{scene}/scene.json"),
        sections=ancient("results/{scene}/buildings.parquet"),
        solids=blocks("solids.parquet"),
        corners=blocks("filed_corners.parquet"),
    output:
        "results/{scene}/city.gpkg",
    log:
        "results/{scene}/logs/geopackage.log",
    conda:
        RUN
    params:
        signature=signature("solids"),
        tiling=lambda w: plan(w).tiling,
    shell:
        "python -m kibs_steps.publish.geopackage --scene {input.scene:q} --tile {params.tiling.tile}"
        " --margin {params.tiling.margin} --block {params.tiling.block} --sections {input.sections:q}"
        " --solids {input.solids:q} --corners {input.corners:q} --out {output:q} > {log:q} 2>&1"


rule cityjson:
    """city.city.json and city.city.jsonl."""
    input:
        scene=ancient("results/{scene}/scene.json"),
        solids=blocks("solids.city.jsonl"),
    output:
        city="results/{scene}/city.city.json",
        sequence="results/{scene}/city.city.jsonl",
    log:
        "results/{scene}/logs/cityjson.log",
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.cityjson --scene {input.scene:q} --solids {input.solids:q}"
        " --out {output.city:q} --seq {output.sequence:q} > {log:q} 2>&1"


rule points:
    """points.txt: one line per section corner."""
    input:
        ancient("results/{scene}/buildings.parquet"),
    output:
        "results/{scene}/points.txt",
    log:
        "results/{scene}/logs/points.log",
    conda:
        RUN
    params:
        signature=signature("buildings"),
    shell:
        "python -m kibs_steps.publish.points --sections {input:q} --out {output:q} > {log:q} 2>&1"


rule rasters:
    """heights.tif and labels.tif in the image frame."""
    input:
        scene=ancient("results/{scene}/scene.json"),
        dtm=ancient("results/{scene}/dtm.tif"),
        sections=ancient("results/{scene}/buildings.parquet"),
    output:
        labels="results/{scene}/labels.tif",
        heights="results/{scene}/heights.tif",
    log:
        "results/{scene}/logs/rasters.log",
    conda:
        RUN
    params:
        signature=signature("buildings"),
        tiling=lambda w: plan(w).tiling,
    shell:
        "python -m kibs_steps.publish.rasters --scene {input.scene:q} --tile {params.tiling.tile}"
        " --margin {params.tiling.margin} --block {params.tiling.block} --sections {input.sections:q}"
        " --labels {output.labels:q} --heights {output.heights:q} > {log:q} 2>&1"


rule preview:
    """preview.png: the raster with the roof sections found."""
    input:
        scene=ancient("results/{scene}/scene.json"),
        raster=lambda w: ancient(plan(w).raster),
        sections=ancient("results/{scene}/buildings.parquet"),
    output:
        "results/{scene}/preview.png",
    log:
        "results/{scene}/logs/preview.log",
    conda:
        RUN
    params:
        signature=signature("buildings"),
    shell:
        "python -m kibs_steps.publish.preview --scene {input.scene:q} --sections {input.sections:q}"
        " --out {output:q} > {log:q} 2>&1"
