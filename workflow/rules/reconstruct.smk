# From sections and corners to planes, to where roofs stand, to buildings and solids.


given = inputs(
    "edited",
    "results/{scene}/edited/sections.parquet",
    "results/{scene}/edited/corners.parquet",
)


rule edited:
    """Take roof sections corrected by hand instead of those that were stitched."""
    input:
        scene=given("results/{scene}/scene.json"),
        layer=given(lambda w: plan(w).settings["sections"]),
        stitched=given("results/{scene}/stitched/sections.parquet"),
        found=given(found_corners),
    output:
        sections="results/{scene}/edited/sections.parquet",
        corners="results/{scene}/edited/corners.parquet",
    log:
        "results/{scene}/logs/edited.log",
    benchmark:
        "results/{scene}/benchmarks/edited.tsv"
    retries: 0
    conda:
        RUN
    params:
        signature=signature("edited"),
        tiling=lambda w: plan(w).tiling,
        reach=lambda w: plan(w).reach,
        left_out=lambda w: (
            ["--left-out", *plan(w).left_out] if plan(w).left_out else []
        ),
    shell:
        "python -m kibs_steps.edited --scene {input.scene:q} --layer {input.layer:q} --stitched {input.stitched:q}"
        " --found {input.found:q} --tile {params.tiling.tile} --margin {params.tiling.margin}"
        " --block {params.tiling.block} --reach {params.reach} {params.left_out:q} --sections {output.sections:q}"
        " --corners {output.corners:q} > {log:q} 2>&1"


given = inputs("surface", "results/{scene}/surface.tif")


rule surface:
    """Bring the user's surface model into the scene's CRS."""
    input:
        scene=given("results/{scene}/scene.json"),
        raster=given(lambda w: sources.files(plan(w).raster)),
        dsm=given(lambda w: plan(w).settings["dsm"]),
    output:
        "results/{scene}/surface.tif",
    log:
        "results/{scene}/logs/surface.log",
    benchmark:
        "results/{scene}/benchmarks/surface.tsv"
    retries: 0
    conda:
        RUN
    params:
        signature=signature("surface"),
    shell:
        "python -m kibs_steps.surface --scene {input.scene:q} --dsm {input.dsm:q} --out {output:q} > {log:q} 2>&1"


given = inputs(
    "planes",
    "results/{scene}/blocks/{block}/planes.parquet",
    "results/{scene}/blocks/{block}/filed_corners.parquet",
)


rule planes:
    """Fit a plane to every section of one block."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        sections=given(sectioned("sections.parquet")),
        corners=given(sectioned("corners.parquet")),
        surface=given(
            lambda w: (
                [f"results/{w.scene}/surface.tif"]
                if plan(w).settings.get("dsm")
                else []
            )
        ),
        model=given("results/{scene}/models/corners.json"),
    output:
        planes="results/{scene}/blocks/{block}/planes.parquet",
        filed="results/{scene}/blocks/{block}/filed_corners.parquet",
    log:
        "results/{scene}/logs/planes/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/planes/{block}.tsv"
    conda:
        RUN
    params:
        signature=signature("planes"),
        reach=lambda w: plan(w).reach,
        rule=lambda w: plan(w).settings["planes"],
        surface=lambda w, input: [f"--surface={f}" for f in input.surface],
    shell:
        "python -m kibs_steps.planes --scene {input.scene:q} --sections {input.sections:q} --corners {input.corners:q}"
        " --model {input.model:q} --name {wildcards.block} --reach {params.reach} --rule {params.rule}"
        " {params.surface:q}"
        " --planes {output.planes:q} --filed {output.filed:q} > {log:q} 2>&1"


given = inputs("planes", "results/{scene}/blocks/{block}/ground.parquet")


rule ground:
    """Move the sections of one block to where they stand."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        planes=given("results/{scene}/blocks/{block}/planes.parquet"),
    output:
        "results/{scene}/blocks/{block}/ground.parquet",
    log:
        "results/{scene}/logs/ground/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/ground/{block}.tsv"
    conda:
        RUN
    params:
        signature=signature("planes"),
    shell:
        "python -m kibs_steps.ground --scene {input.scene:q} --planes {input.planes:q} --out {output:q} > {log:q} 2>&1"


given = inputs("buildings", "results/{scene}/buildings.parquet")


rule buildings:
    """Group the sections of all blocks to buildings."""
    input:
        scene=given("results/{scene}/scene.json"),
        ground=given(blocks("ground.parquet")),
        footprints=given(
            lambda w: [f for f in [plan(w).settings.get("footprints")] if f]
        ),
    output:
        "results/{scene}/buildings.parquet",
    log:
        "results/{scene}/logs/buildings.log",
    benchmark:
        "results/{scene}/benchmarks/buildings.tsv"
    conda:
        RUN
    params:
        signature=signature("buildings"),
        tiling=lambda w: plan(w).tiling,
        options=options("footprints"),
    shell:
        "python -m kibs_steps.buildings --scene {input.scene:q} --tile {params.tiling.tile}"
        " --margin {params.tiling.margin} --block {params.tiling.block} {params.options:q}"
        " --ground {input.ground:q} --out {output:q} > {log:q} 2>&1"


given = inputs(
    "solids_of_block",
    "results/{scene}/blocks/{block}/solids.city.jsonl",
    "results/{scene}/blocks/{block}/solids.parquet",
    "results/{scene}/blocks/{block}/meshes.parquet",
)


rule solids:
    """Build valid solids of the buildings of one block."""
    input:
        scene=given("results/{scene}/scene.json"),
        dtm=given("results/{scene}/dtm.tif"),
        buildings=given("results/{scene}/buildings.parquet"),
    output:
        solids="results/{scene}/blocks/{block}/solids.city.jsonl",
        attributes="results/{scene}/blocks/{block}/solids.parquet",
        meshes="results/{scene}/blocks/{block}/meshes.parquet",
    log:
        "results/{scene}/logs/solids/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/solids/{block}.tsv"
    conda:
        RUN
    params:
        signature=signature("solids_of_block"),
        options=options("lod_label"),
    shell:
        "python -m kibs_steps.solids --scene {input.scene:q} --buildings {input.buildings:q} --name {wildcards.block}"
        " {params.options:q} --out {output.solids:q} --attributes {output.attributes:q}"
        " --meshes {output.meshes:q} > {log:q} 2>&1"
