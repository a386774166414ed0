# Comparison with truth, where a scene has it.


given = inputs(
    "evaluate", "results/{scene}/evaluation.json", "results/{scene}/evaluation.png"
)


rule evaluation:
    """Metrics of labels, heights and sections against the truth."""
    input:
        scene=given("results/{scene}/scene.json"),
        truth=given("results/{scene}/truth.parquet"),
        labels=given("results/{scene}/labels.tif"),
        heights=given("results/{scene}/heights.tif"),
        sections=given("results/{scene}/buildings.parquet"),
        corners=given(blocks("filed_corners.parquet")),
    output:
        evaluation="results/{scene}/evaluation.json",
        picture="results/{scene}/evaluation.png",
    log:
        "results/{scene}/logs/evaluation.log",
    benchmark:
        "results/{scene}/benchmarks/evaluation.tsv"
    conda:
        RUN
    params:
        signature=signature("evaluate"),
        fallback=lambda w: plan(w).models["corners"].contract["heights"]["fallback"],
        # A surface model gives points to fit planes to, no corners.
        corners=lambda w, input: (
            [] if plan(w).settings.get("dsm") else ["--corners", *input.corners]
        ),
    shell:
        "python -m kibs_steps.evaluate --scene {input.scene:q} --truth {input.truth:q} --labels {input.labels:q}"
        " --heights {input.heights:q} --sections {input.sections:q} {params.corners:q}"
        " --fallback-height {params.fallback}"
        " --out {output.evaluation:q} --picture {output.picture:q} > {log:q} 2>&1"
