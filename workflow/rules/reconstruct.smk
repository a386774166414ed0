# From sections and corners to planes, to where roofs stand, to buildings and solids.


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
        sections=given("results/{scene}/stitched/sections.parquet"),
        corners=given("results/{scene}/stitched/corners.parquet"),
        model=given("results/{scene}/models/corners.json"),
    output:
        planes="results/{scene}/blocks/{block}/planes.parquet",
        filed="results/{scene}/blocks/{block}/filed_corners.parquet",
    log:
        "results/{scene}/logs/planes/{block}.log",
    retries: 1
    conda:
        RUN
    params:
        signature=signature("planes"),
        reach=lambda w: plan(w).reach,
        rule=lambda w: plan(w).settings["planes"],
    shell:
        "python -m kibs_steps.planes --scene {input.scene:q} --sections {input.sections:q} --corners {input.corners:q}"
        " --model {input.model:q} --name {wildcards.block} --reach {params.reach} --rule {params.rule}"
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
    retries: 1
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
    retries: 1
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
    log:
        "results/{scene}/logs/solids/{block}.log",
    retries: 1
    conda:
        RUN
    params:
        signature=signature("solids_of_block"),
        options=options("lod_label"),
    shell:
        "python -m kibs_steps.solids --scene {input.scene:q} --buildings {input.buildings:q} --name {wildcards.block}"
        " {params.options:q} --out {output.solids:q} --attributes {output.attributes:q} > {log:q} 2>&1"
