# The published files, one rule per format.


given = inputs("solids", "results/{scene}/city.gpkg")


rule geopackage:
    """city.gpkg: buildings, footprints, roof sections, corners, blocks."""
    input:
        scene=given("results/{scene}/scene.json"),
        sections=given("results/{scene}/buildings.parquet"),
        solids=given(blocks("solids.parquet")),
        corners=given(blocks("filed_corners.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/city.gpkg",
    log:
        "results/{scene}/logs/geopackage.log",
    benchmark:
        "results/{scene}/benchmarks/geopackage.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
        tiling=lambda w: plan(w).tiling,
        blocks=failed,
        reasons=why_failed,
    shell:
        "python -m kibs_steps.publish.geopackage --scene {input.scene:q} --tile {params.tiling.tile}"
        " --margin {params.tiling.margin} --block {params.tiling.block} --sections {input.sections:q}"
        " --solids {input.solids:q} --corners {input.corners:q} --models {input.models:q} {params.blocks:q}"
        " --out {output:q} > {log:q} 2>&1"


given = inputs(
    "solids", "results/{scene}/city.city.json", "results/{scene}/city.city.jsonl"
)


rule cityjson:
    """city.city.json and city.city.jsonl."""
    input:
        scene=given("results/{scene}/scene.json"),
        solids=given(blocks("solids.city.jsonl")),
        models=given(licensed),
    output:
        city="results/{scene}/city.city.json",
        sequence="results/{scene}/city.city.jsonl",
    log:
        "results/{scene}/logs/cityjson.log",
    benchmark:
        "results/{scene}/benchmarks/cityjson.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.cityjson --scene {input.scene:q} --solids {input.solids:q}"
        " --models {input.models:q} --out {output.city:q} --seq {output.sequence:q} > {log:q} 2>&1"


given = inputs("buildings", "results/{scene}/points.txt")


rule points:
    """points.txt: one line per section corner."""
    input:
        given("results/{scene}/buildings.parquet"),
    output:
        "results/{scene}/points.txt",
    log:
        "results/{scene}/logs/points.log",
    benchmark:
        "results/{scene}/benchmarks/points.tsv"
    conda:
        RUN
    params:
        signature=signature("buildings"),
    shell:
        "python -m kibs_steps.publish.points --sections {input:q} --out {output:q} > {log:q} 2>&1"


given = inputs("buildings", "results/{scene}/labels.tif", "results/{scene}/heights.tif")


rule rasters:
    """heights.tif and labels.tif in the image frame."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        sections=given("results/{scene}/buildings.parquet"),
        models=given(licensed),
    output:
        labels="results/{scene}/labels.tif",
        heights="results/{scene}/heights.tif",
    log:
        "results/{scene}/logs/rasters.log",
    benchmark:
        "results/{scene}/benchmarks/rasters.tsv"
    conda:
        RUN
    params:
        signature=signature("buildings"),
    shell:
        "python -m kibs_steps.publish.rasters --scene {input.scene:q} --sections {input.sections:q}"
        " --models {input.models:q} --labels {output.labels:q} --heights {output.heights:q} > {log:q} 2>&1"


given = inputs("buildings", "results/{scene}/preview.png")


rule preview:
    """preview.png: the raster with the roof sections found."""
    input:
        scene=given("results/{scene}/scene.json"),
        raster=given(lambda w: sources.files(plan(w).raster)),
        sections=given("results/{scene}/buildings.parquet"),
        models=given(licensed),
    output:
        "results/{scene}/preview.png",
    log:
        "results/{scene}/logs/preview.log",
    benchmark:
        "results/{scene}/benchmarks/preview.tsv"
    conda:
        RUN
    params:
        signature=signature("buildings"),
    shell:
        "python -m kibs_steps.publish.preview --scene {input.scene:q} --sections {input.sections:q}"
        " --models {input.models:q} --out {output:q} > {log:q} 2>&1"


given = inputs("glb", "results/{scene}/city.glb")


rule glb:
    """city.glb: the city for 3D viewers."""
    input:
        scene=given("results/{scene}/scene.json"),
        raster=given(lambda w: sources.files(plan(w).raster)),
        dtm=given("results/{scene}/dtm.tif"),
        meshes=given(blocks("meshes.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/city.glb",
    log:
        "results/{scene}/logs/glb.log",
    benchmark:
        "results/{scene}/benchmarks/glb.tsv"
    conda:
        RUN
    params:
        signature=signature("glb"),
        drape=lambda w: ["--drape"] if plan(w).settings["drape"] else [],
    shell:
        "python -m kibs_steps.publish.glb --scene {input.scene:q} --meshes {input.meshes:q}"
        " --models {input.models:q} {params.drape} --out {output:q} > {log:q} 2>&1"


given = inputs("solids", "results/{scene}/city.obj", "results/{scene}/city.mtl")


rule obj:
    """city.obj and its colours, city.mtl."""
    input:
        scene=given("results/{scene}/scene.json"),
        meshes=given(blocks("meshes.parquet")),
        models=given(licensed),
    output:
        city="results/{scene}/city.obj",
        materials="results/{scene}/city.mtl",
    log:
        "results/{scene}/logs/obj.log",
    benchmark:
        "results/{scene}/benchmarks/obj.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.obj --scene {input.scene:q} --meshes {input.meshes:q}"
        " --models {input.models:q} --out {output.city:q} --materials {output.materials:q} > {log:q} 2>&1"


given = inputs("solids", "results/{scene}/tiles3d/tileset.json")


rule tiles3d:
    """tiles3d/: the city on the globe."""
    input:
        scene=given("results/{scene}/scene.json"),
        meshes=given(blocks("meshes.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/tiles3d/tileset.json",
    log:
        "results/{scene}/logs/tiles3d.log",
    benchmark:
        "results/{scene}/benchmarks/tiles3d.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.tiles3d --scene {input.scene:q} --meshes {input.meshes:q}"
        " --models {input.models:q} --out {output:q} > {log:q} 2>&1"


given = inputs("solids", "results/{scene}/dsm.tif")


rule dsm:
    """dsm.tif: terrain and buildings."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        meshes=given(blocks("meshes.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/dsm.tif",
    log:
        "results/{scene}/logs/dsm.log",
    benchmark:
        "results/{scene}/benchmarks/dsm.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.dsm --scene {input.scene:q} --meshes {input.meshes:q}"
        " --models {input.models:q} --out {output:q} > {log:q} 2>&1"


given = inputs("solids", "results/{scene}/ksr/points.ply")


rule ksr:
    """ksr/points.ply: oriented points of roofs, walls and ground."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        meshes=given(blocks("meshes.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/ksr/points.ply",
    log:
        "results/{scene}/logs/ksr.log",
    benchmark:
        "results/{scene}/benchmarks/ksr.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.ksr --scene {input.scene:q} --meshes {input.meshes:q}"
        " --models {input.models:q} --out {output:q} > {log:q} 2>&1"


given = inputs("solids", "results/{scene}/viewer.html")


rule viewer:
    """viewer.html: the city in a browser."""
    input:
        scene=given("results/{scene}/scene.json"),
        raster=given(lambda w: sources.files(plan(w).raster)),
        dtm=given("results/{scene}/dtm.tif"),
        meshes=given(blocks("meshes.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/viewer.html",
    log:
        "results/{scene}/logs/viewer.log",
    benchmark:
        "results/{scene}/benchmarks/viewer.tsv"
    conda:
        RUN
    params:
        signature=signature("solids"),
    shell:
        "python -m kibs_steps.publish.viewer --scene {input.scene:q} --meshes {input.meshes:q}"
        " --models {input.models:q} --out {output:q} > {log:q} 2>&1"


given = inputs("buildings", "results/{scene}/paper.tif")


rule paper_picture:
    """paper.tif: sections and corners in the paper's colours (mode=paper)."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        sections=given("results/{scene}/buildings.parquet"),
        corners=given(blocks("filed_corners.parquet")),
        models=given(licensed),
    output:
        "results/{scene}/paper.tif",
    log:
        "results/{scene}/logs/paper_picture.log",
    benchmark:
        "results/{scene}/benchmarks/paper_picture.tsv"
    conda:
        RUN
    params:
        signature=signature("buildings"),
    shell:
        "python -m kibs_steps.publish.paper_picture --scene {input.scene:q} --sections {input.sections:q}"
        " --corners {input.corners:q} --models {input.models:q} --out {output:q} > {log:q} 2>&1"


given = inputs("run", "results/{scene}/run.json")


rule record:
    """run.json: versions, hashes, models and their licences, counts."""
    input:
        scene=given("results/{scene}/scene.json"),
        sources=given(
            lambda w: [
                *sources.files(plan(w).raster),
                *plan(w).terrain_files,
                *plan(w).named_files,
            ]
        ),
        models=given(licensed),
        sections=given("results/{scene}/buildings.parquet"),
        solids=given(blocks("solids.parquet")),
    output:
        "results/{scene}/run.json",
    log:
        "results/{scene}/logs/record.log",
    conda:
        RUN
    params:
        signature=signature("run"),
        settings=lambda w: json.dumps(plan(w).settings),
        remote=lambda w: plan(w).remote,
        tiling=lambda w: plan(w).tiling,
        blocks=failed,
        reasons=why_failed,
    shell:
        "python -m kibs_steps.publish.run --scene {input.scene:q} --inputs {input.sources:q} {params.remote:q} --models {input.models:q}"
        " --settings {params.settings:q} --sections {input.sections:q} --solids {input.solids:q}"
        " --tile {params.tiling.tile} --margin {params.tiling.margin} --block {params.tiling.block} {params.blocks:q}"
        " --benchmarks results/{wildcards.scene}/benchmarks --out {output:q} > {log:q} 2>&1"


rule scene_report:
    """report.html: one page about a scene."""
    input:
        record="results/{scene}/run.json",
        preview="results/{scene}/preview.png",
        evaluation=lambda w: (
            [f"results/{w.scene}/evaluation.json"] if plan(w).truth else []
        ),
    output:
        "results/{scene}/report.html",
    log:
        "results/{scene}/logs/report.log",
    conda:
        RUN
    params:
        signature=signature("run"),
        evaluation=lambda w, input: (
            ["--evaluation", input.evaluation] if plan(w).truth else []
        ),
    shell:
        "python -m kibs_steps.publish.report --run {input.record:q} {params.evaluation:q} --out {output:q} > {log:q} 2>&1"
