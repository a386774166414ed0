# From the raster and the terrain to facts checked once, and the image of every block on the models' grid.


rule simulated:
    """Make a scene with exact truth at the configured view and sun."""
    output:
        raster="results/{scene}/simulated/scene.tif",
        dtm="results/{scene}/simulated/dtm.tif",
        truth="results/{scene}/simulated/truth.gpkg",
    log:
        "results/{scene}/logs/simulated.log",
    benchmark:
        "results/{scene}/benchmarks/simulated.tsv"
    retries: 0
    conda:
        RUN
    params:
        signature=signature("source"),
        options=options(
            "view_azimuth", "view_elevation", "sun_azimuth", "sun_elevation"
        ),
        simulate=lambda w: [
            f"--{k.replace('_', '-')}={v}"
            for k, v in plan(w).settings["simulate"].items()
        ],
    shell:
        "python -m kibs_steps.simulate.scene {params.simulate:q} {params.options:q}"
        " --out $(dirname {output.raster:q}) > {log:q} 2>&1"


given = inputs("scene", "results/{scene}/scene.json", "results/{scene}/dtm.tif")


rule scene:
    """Check the raster and the terrain once, and write what every later step needs to know."""
    input:
        raster=given(lambda w: sources.files(plan(w).raster)),
        dtm=given(lambda w: plan(w).terrain_files),
    output:
        scene="results/{scene}/scene.json",
        dtm="results/{scene}/dtm.tif",
    log:
        "results/{scene}/logs/scene.log",
    benchmark:
        "results/{scene}/benchmarks/scene.tsv"
    retries: 0
    conda:
        RUN
    params:
        signature=signature("scene"),
        gsd=lambda w: plan(w).models["sections"].contract["gsd"],
        raster=lambda w: plan(w).raster,
        dtm=lambda w: plan(w).dtm,
        options=options(
            "view_azimuth",
            "view_elevation",
            "sun_azimuth",
            "sun_elevation",
            "projection_height",
            "bands",
            "aoi",
            "vertical_crs",
            "regions",
        ),
    shell:
        "python -m kibs_steps.scene --name {wildcards.scene:q} --raster {params.raster:q} --dtm={params.dtm:q}"
        " --gsd {params.gsd} {params.options:q} --out {output.scene:q} > {log:q} 2>&1"


rule tiled:
    """A tiled copy of a raster whose own layout would make every block decode most of it."""
    input:
        lambda w: sources.files(plan(w).raster),
    output:
        temp("results/{scene}/tiled.tif"),
    log:
        "results/{scene}/logs/tiled.log",
    benchmark:
        "results/{scene}/benchmarks/tiled.tsv"
    conda:
        RUN
    params:
        signature=signature("image"),
        raster=lambda w: plan(w).raster,
    shell:
        "python -m kibs_steps.tiled --raster {params.raster:q} --out {output:q} > {log:q} 2>&1"


given = inputs("tiles", "results/{scene}/blocks/{block}/tiles.tif")


rule tiles:
    """The image of one block on the models' grid, margins included."""
    input:
        scene=given("results/{scene}/scene.json"),
        raster=given(lambda w: sources.files(blocks_read(w))),
    output:
        "results/{scene}/blocks/{block}/tiles.tif",
    log:
        "results/{scene}/logs/tiles/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/tiles/{block}.tsv"
    conda:
        RUN
    params:
        signature=signature("tiles"),
        tiling=lambda w: plan(w).tiling,
        raster=blocks_read,
    shell:
        "python -m kibs_steps.tiles --scene {input.scene:q} --raster {params.raster:q} --name {wildcards.block}"
        " --tile {params.tiling.tile} --margin {params.tiling.margin} --block {params.tiling.block} --out {output:q} > {log:q} 2>&1"


given = inputs("model_{task}", "results/{scene}/models/{task}.json")


rule model:
    """Check a model's contract, and write it down with the file's hash."""
    input:
        # Wholly named: a set called like the one that `train` makes is no output of it here.
        given(lambda w: os.path.abspath(plan(w).models[w.task].path)),
    output:
        "results/{scene}/models/{task}.json",
    log:
        "results/{scene}/logs/model_{task}.log",
    benchmark:
        "results/{scene}/benchmarks/model_{task}.tsv"
    retries: 0
    localrule: True
    conda:
        RUN
    params:
        signature=signature("model_{task}"),
        model=lambda w: str(plan(w).models[w.task].path),
    shell:
        "python -m kibs_steps.models.contract {params.model:q} --task {wildcards.task} --out {output:q} > {log:q} 2>&1"
