# Sections and corners of every block, by the models or from the truth, and their union over the seams.


given = inputs("supposed", "results/{scene}/supposed.json")


rule supposed:
    """Say from where a scene without angles looks to be seen and lit."""
    input:
        scene=given("results/{scene}/scene.json"),
        raster=given(lambda w: sources.files(blocks_read(w))),
        model=given("results/{scene}/models/sections.json"),
    output:
        "results/{scene}/supposed.json",
    log:
        "results/{scene}/logs/supposed.log",
    benchmark:
        "results/{scene}/benchmarks/supposed.tsv"
    conda:
        RUN
    threads: lambda w: plan(w).settings["threads"]
    resources:
        gpu=lambda w: int(plan(w).settings["provider"] == "cuda"),
    params:
        signature=signature("supposed"),
        tiling=lambda w: plan(w).tiling,
        raster=blocks_read,
        options=options("provider", "threads", "looks"),
    shell:
        "python -m kibs_steps.supposed --scene {input.scene:q} --raster {params.raster:q} --model {input.model:q}"
        " --margin {params.tiling.margin} --block {params.tiling.block} {params.options:q} --out {output:q} > {log:q} 2>&1"


given = inputs(
    "sections",
    "results/{scene}/blocks/{block}/sections.tif",
    "results/{scene}/blocks/{block}/detected/pieces.parquet",
    "results/{scene}/blocks/{block}/detected/links.parquet",
    "results/{scene}/blocks/{block}/detected/seams.npz",
)


rule sections:
    """Find the roof sections of one block with the 2D model."""
    input:
        scene=given("results/{scene}/scene.json"),
        tiles=given("results/{scene}/blocks/{block}/tiles.tif"),
        model=given("results/{scene}/models/sections.json"),
        supposed=given(supposed),
    output:
        labels="results/{scene}/blocks/{block}/sections.tif",
        pieces="results/{scene}/blocks/{block}/detected/pieces.parquet",
        links="results/{scene}/blocks/{block}/detected/links.parquet",
        seams="results/{scene}/blocks/{block}/detected/seams.npz",
    log:
        "results/{scene}/logs/sections/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/sections/{block}.tsv"
    wildcard_constraints:
        scene=using("two_stage"),
    conda:
        RUN
    threads: lambda w: plan(w).settings["threads"]
    resources:
        gpu=lambda w: int(plan(w).settings["provider"] == "cuda"),
    params:
        signature=signature("sections"),
        supposed=lambda w: [f"--supposed={f}" for f in supposed(w)],
        tiling=lambda w: plan(w).tiling,
        options=options("provider", "threads", "looks"),
        seams=lambda w: plan(w).seam_rule,
    shell:
        "python -m kibs_steps.sections --scene {input.scene:q} --tiles {input.tiles:q} --model {input.model:q}"
        " --name {wildcards.block} --margin {params.tiling.margin} --block {params.tiling.block} {params.supposed:q} {params.options:q}"
        " --seam-rule {params.seams} --labels {output.labels:q} --pieces {output.pieces:q}"
        " --links {output.links:q} --seams {output.seams:q} > {log:q} 2>&1"


given = inputs("blend", "results/{scene}/blocks/{block}/blended.tif")


rule blend:
    """Paint the sections into the image, as the 3D model's contract says."""
    input:
        scene=ancient("results/{scene}/scene.json"),  # for the grid, which changes with the tiles
        tiles=given("results/{scene}/blocks/{block}/tiles.tif"),
        labels=given("results/{scene}/blocks/{block}/sections.tif"),
        model=given("results/{scene}/models/corners.json"),
    output:
        temp("results/{scene}/blocks/{block}/blended.tif"),
    log:
        "results/{scene}/logs/blend/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/blend/{block}.tsv"
    conda:
        RUN
    params:
        signature=signature("blend"),
        tiling=lambda w: plan(w).tiling,
    shell:
        "python -m kibs_steps.blend --scene {input.scene:q} --tiles {input.tiles:q} --labels {input.labels:q}"
        " --model {input.model:q} --name {wildcards.block} --margin {params.tiling.margin}"
        " --block {params.tiling.block} --out {output:q} > {log:q} 2>&1"


given = inputs(
    "corners",
    "results/{scene}/blocks/{block}/detected/corners.parquet",
    "results/{scene}/blocks/{block}/detected/heights.parquet",
)


rule corners:
    """Find the roof corners of one block and their heights with the 3D model."""
    input:
        scene=given("results/{scene}/scene.json"),
        blended=given("results/{scene}/blocks/{block}/blended.tif"),
        labels=given("results/{scene}/blocks/{block}/sections.tif"),
        model=given("results/{scene}/models/corners.json"),
        supposed=given(supposed),
    output:
        corners="results/{scene}/blocks/{block}/detected/corners.parquet",
        heights="results/{scene}/blocks/{block}/detected/heights.parquet",
    log:
        "results/{scene}/logs/corners/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/corners/{block}.tsv"
    wildcard_constraints:
        scene=using("two_stage"),
    conda:
        RUN
    threads: lambda w: plan(w).settings["threads"]
    resources:
        gpu=lambda w: int(plan(w).settings["provider"] == "cuda"),
    params:
        signature=signature("corners"),
        supposed=lambda w: [f"--supposed={f}" for f in supposed(w)],
        tiling=lambda w: plan(w).tiling,
        options=options("provider", "threads", "looks"),
    shell:
        "python -m kibs_steps.corners --scene {input.scene:q} --blended {input.blended:q} --labels {input.labels:q}"
        " --model {input.model:q} --name {wildcards.block} --margin {params.tiling.margin} --block {params.tiling.block}"
        " {params.supposed:q} {params.options:q} --out {output.corners:q} --heights {output.heights:q} > {log:q} 2>&1"


given = inputs(
    "single",
    "results/{scene}/blocks/{block}/sections.tif",
    "results/{scene}/blocks/{block}/detected/pieces.parquet",
    "results/{scene}/blocks/{block}/detected/links.parquet",
    "results/{scene}/blocks/{block}/detected/seams.npz",
    "results/{scene}/blocks/{block}/detected/corners.parquet",
    "results/{scene}/blocks/{block}/detected/heights.parquet",
)


rule single:
    """Find the roof sections and corners of one block with one model."""
    input:
        scene=given("results/{scene}/scene.json"),
        tiles=given("results/{scene}/blocks/{block}/tiles.tif"),
        model=given("results/{scene}/models/sections.json"),
        supposed=given(supposed),
    output:
        labels="results/{scene}/blocks/{block}/sections.tif",
        pieces="results/{scene}/blocks/{block}/detected/pieces.parquet",
        links="results/{scene}/blocks/{block}/detected/links.parquet",
        seams="results/{scene}/blocks/{block}/detected/seams.npz",
        corners="results/{scene}/blocks/{block}/detected/corners.parquet",
        heights="results/{scene}/blocks/{block}/detected/heights.parquet",
    log:
        "results/{scene}/logs/single/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/single/{block}.tsv"
    wildcard_constraints:
        scene=using("single"),
    conda:
        RUN
    threads: lambda w: plan(w).settings["threads"]
    resources:
        gpu=lambda w: int(plan(w).settings["provider"] == "cuda"),
    params:
        signature=signature("single"),
        supposed=lambda w: [f"--supposed={f}" for f in supposed(w)],
        tiling=lambda w: plan(w).tiling,
        options=options("provider", "threads", "looks"),
        seams=lambda w: plan(w).seam_rule,
    shell:
        "python -m kibs_steps.single --scene {input.scene:q} --tiles {input.tiles:q} --model {input.model:q}"
        " --name {wildcards.block} --margin {params.tiling.margin} --block {params.tiling.block} {params.supposed:q} {params.options:q}"
        " --seam-rule {params.seams} --labels {output.labels:q} --pieces {output.pieces:q}"
        " --links {output.links:q} --seams {output.seams:q} --corners {output.corners:q} --heights {output.heights:q} > {log:q} 2>&1"


given = inputs("truth", "results/{scene}/truth.parquet")


rule truth:
    """The truth layer in the image frame and the map frame."""
    input:
        scene=given("results/{scene}/scene.json"),
        truth=given(lambda w: plan(w).truth),
    output:
        "results/{scene}/truth.parquet",
    log:
        "results/{scene}/logs/truth.log",
    benchmark:
        "results/{scene}/benchmarks/truth.tsv"
    retries: 0
    conda:
        RUN
    params:
        signature=signature("truth"),
        frame=lambda w: plan(w).settings["truth_frame"],
        z=lambda w: plan(w).settings["truth_z"],
    shell:
        "python -m kibs_steps.truth --scene {input.scene:q} --truth {input.truth:q} --frame {params.frame}"
        " --z {params.z} --out {output:q} > {log:q} 2>&1"


given = inputs(
    "feed",
    "results/{scene}/blocks/{block}/fed/pieces.parquet",
    "results/{scene}/blocks/{block}/fed/links.parquet",
    "results/{scene}/blocks/{block}/fed/seams.npz",
    "results/{scene}/blocks/{block}/fed/corners.parquet",
)


rule feed:
    """The truth of one block in the place of both models."""
    input:
        scene=given("results/{scene}/scene.json"),
        truth=given("results/{scene}/truth.parquet"),
    output:
        pieces="results/{scene}/blocks/{block}/fed/pieces.parquet",
        links="results/{scene}/blocks/{block}/fed/links.parquet",
        seams="results/{scene}/blocks/{block}/fed/seams.npz",
        corners="results/{scene}/blocks/{block}/fed/corners.parquet",
    log:
        "results/{scene}/logs/feed/{block}.log",
    benchmark:
        "results/{scene}/benchmarks/feed/{block}.tsv"
    conda:
        RUN
    params:
        signature=signature("feed"),
        tiling=lambda w: plan(w).tiling,
    shell:
        "python -m kibs_steps.feed --scene {input.scene:q} --truth {input.truth:q} --tile {params.tiling.tile}"
        " --margin {params.tiling.margin} --name {wildcards.block} --block {params.tiling.block}"
        " --pieces {output.pieces:q} --links {output.links:q} --seams {output.seams:q}"
        " --corners {output.corners:q} > {log:q} 2>&1"


given = inputs(
    "stitch",
    "results/{scene}/stitched/sections.parquet",
    "results/{scene}/stitched/corners.parquet",
)


rule stitch:
    """Join the pieces of all blocks to sections."""
    input:
        scene=given("results/{scene}/scene.json"),
        detections=given(detections),
        model=given(scored),
    output:
        sections="results/{scene}/stitched/sections.parquet",
        corners="results/{scene}/stitched/corners.parquet",
    log:
        "results/{scene}/logs/stitch.log",
    benchmark:
        "results/{scene}/benchmarks/stitch.tsv"
    conda:
        RUN
    params:
        signature=signature("stitch"),
        tiling=lambda w: plan(w).tiling,
        tolerance=lambda w: plan(w).tolerance,
        reach=lambda w: plan(w).reach,
        seams=lambda w: plan(w).seam_rule,
        folders=lambda w: [
            f"results/{w.scene}/blocks/{b.name}/{source(w)}"
            for b in plan(w).having("feed")
        ],
        corners=lambda w: (["--without-corners"] if plan(w).measured else [])
        + (["--with-heights"] if mapped(plan(w)) else []),
        model=lambda w: [f"--model={f}" for f in scored(w)],
    shell:
        "python -m kibs_steps.stitch --scene {input.scene:q} --tile {params.tiling.tile}"
        " --margin {params.tiling.margin} --block {params.tiling.block} --tolerance {params.tolerance}"
        " --reach {params.reach} --seam-rule {params.seams} {params.corners} {params.model:q}"
        " --folders {params.folders:q} --sections {output.sections:q} --corners {output.corners:q} > {log:q} 2>&1"
