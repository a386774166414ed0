# KIBS: one off-nadir raster and a terrain model to a LOD2 city. Start with `snakemake --cores 2`; see README.md.
from pathlib import Path

from kibs_steps import cli, settings

if Path("config.yaml").is_file():
    cli.or_exit(settings.read, "config.yaml")

    configfile: "config.yaml"


wildcard_constraints:
    scene="[^/]+",
    block=r"r\d+c\d+",
    task="sections|corners",


include: "workflow/rules/common.smk"
include: "workflow/rules/scene.smk"
include: "workflow/rules/detect.smk"
include: "workflow/rules/reconstruct.smk"
include: "workflow/rules/publish.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/learn.smk"


onstart:
    for line in sorted(
        {
            m.licence_line
            for p in PLANS.values()
            if p.settings["feed"] == "models"
            for m in p.models.values()
        }
    ):
        logger.info(line)
    for p in PLANS.values():
        for warning in p.warnings:
            logger.warning(f"{p.name}: {warning}")
    # Snakemake's default limit of 100 jobs a second makes it look at all ready jobs again a second after every look, and each look
    # starts another: after some hundred jobs that takes a core. Nothing here needs a limit; one that is asked for is kept.
    limit = workflow.scheduler.job_rate_limiter
    if limit and (limit.max_jobs, limit.timespan) == (100, 1):
        workflow.scheduler.job_rate_limiter = None


onsuccess:
    remove_temporary(workflow.dag, workflow.storage_settings.notemp)
    for p in PLANS.values():
        if not p.left_out:
            failures.settle(RESULTS / p.name)
        if old := left_behind(p):
            logger.warning(
                f"{p.name}: {', '.join(old)} of an earlier run, not made anew, may tell of another city than the rest"
            )


onerror:
    report_failures(workflow.scheduler.failed, workflow.scheduler._user_kill)


rule all:
    """Build every scene."""
    default_target: True
    input:
        everything,


rule detect:
    """Find sections and corners of every scene, no further."""
    input:
        [f"results/{p.name}/stitched/sections.parquet" for p in PLANS.values()],


rule evaluate:
    """Compare every scene that has truth with it."""
    input:
        evaluated,


rule simulate:
    """Make the simulated scenes, no further."""
    input:
        [p.raster for p in PLANS.values() if p.settings.get("simulate")],


rule report:
    """Write a page about every scene."""
    input:
        [f"results/{name}/report.html" for name in PLANS],


rule verify:
    """Compare all files of every scene with their checksums, and take away what must be made again."""
    log:
        "results/verify.log",
    retries: 0
    conda:
        RUN
    params:
        folders=[f"results/{name}" for name in PLANS],
        temporary=TEMPORARY,
    shell:
        "python -m kibs_steps.verify {params.folders:q} --temporary {params.temporary:q} 2>&1 | tee {log:q}"


rule check:
    """Say what a run would do, how long it would take, and what is doubtful about the inputs."""
    log:
        "results/check.log",
    retries: 0
    conda:
        RUN
    params:
        base=str(workflow.basedir),
        scenes=json.dumps({name: p.settings for name, p in PLANS.items()}),
        todo=lambda w: json.dumps({name: todo(p) for name, p in PLANS.items()}),
    shell:
        "python -m kibs_steps.check --base {params.base:q} --results results --scenes {params.scenes:q}"
        " --todo {params.todo:q} 2>&1 | tee {log:q}"
