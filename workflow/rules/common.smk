# What all rules share: the plan of every scene, and functions from wildcards to parameters and inputs.

import atexit
import json
import os
import re
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.io import IOFile, is_flagged

from kibs_steps import cli, failures, inputs as user_inputs, plan as plans, settings
from kibs_steps import sources
from kibs_steps.models import runtime

RESULTS = Path("results")
RUN = f"{workflow.basedir}/envs/run.yaml"
LEARN = f"{workflow.basedir}/envs/learn.yaml"
TEMPORARY = ["blended.tif", "tiled.tif"]  # files that Snakemake deletes after use


def planned():
    """The plan of every scene to build, its inputs checked."""
    user_inputs.writable(RESULTS)
    settings.check_name(config, sys.argv[1:])
    schema = settings.read(
        Path(workflow.basedir, "workflow/schemas/config.schema.yaml")
    )
    found = {
        name: plans.plan(name, values, Path(workflow.basedir), RESULTS)
        for name, values in plans.scenes(
            config, schema, told=workflow.config_settings.config
        ).items()
    }
    if not workflow.remote_exec:
        for p in found.values():
            own = (
                workflow.deployment_settings.deployment_method
            )  # then jobs bring an onnxruntime of their own
            if p.settings["feed"] == "models" and not own:
                runtime.available(p.settings["provider"])
            p.warnings.extend(user_inputs.check(p, RESULTS))
    return found


PLANS = cli.or_exit(planned)


PUBLISHED = [
    "city.gpkg",
    "city.city.json",
    "city.city.jsonl",
    "city.glb",
    "city.obj",
    "city.mtl",
    "tiles3d/tileset.json",
    "points.txt",
    "ksr/points.ply",
    "heights.tif",
    "labels.tif",
    "dsm.tif",
    "preview.png",
    "viewer.html",
    "run.json",
]


def plan(wildcards):
    """The plan of the scene a job belongs to."""
    return PLANS[wildcards.scene]


def signature(step):
    """A params function: the signature of a step in the job's scene."""
    return lambda wildcards: plan(wildcards).signature[step.format(**wildcards)]


def options(*keys):
    """A params function: `--key=value` for each of these settings that the scene has."""

    def tokens(wildcards):
        settings = plan(wildcards).settings
        values = {k: settings[k] for k in keys if settings.get(k) is not None}
        return [
            f"--{k.replace('_', '-')}={','.join(map(str, v)) if isinstance(v, list) else v}"
            for k, v in values.items()
        ]

    return tokens


def made(path, wanted):
    """Whether a file is there and was made under that signature."""
    return Path(path).exists() and repr(wanted) in (
        workflow.persistence.params(IOFile(path)) or []
    )


def inputs(step, *outputs):
    """How jobs with that step's signature and these outputs take their inputs (`given = inputs(…)`, then `given(path)`).

    While all outputs were made under the present signature, nothing that happens to their inputs concerns them (a
    neighbouring block made again gives the same bytes): inputs are `ancient` then, and those that are gone are not asked
    for. Otherwise they are plain inputs, and what makes them again makes the outputs again.
    """

    def given(files):
        def choose(wildcards):
            found = files(wildcards) if callable(files) else files.format(**wildcards)
            wanted = signature(step)(wildcards)
            forced = workflow.dag_settings.forceall or workflow.dag_settings.forcerun
            if forced or not all(
                made(output.format(**wildcards), wanted) for output in outputs
            ):
                return found
            return ancient(
                [
                    f
                    for f in ([found] if isinstance(found, str) else found)
                    if Path(f).exists()
                ]
            )

        return choose

    return given


def remove_temporary(dag, keep):
    """Delete the temporary files that stay where a run was killed after the last job that reads them; none with `keep`."""
    for job in [] if keep else dag.jobs:
        for path in job.output:
            if is_flagged(path, "temp") and job not in dag.targetjobs:
                Path(path).unlink(missing_ok=True)


def everything(wildcards):
    """All files of all scenes; refuses those that Snakemake has no record of, which it would take for made whatever the settings."""
    found = []
    for p in PLANS.values():
        files = published(p) + kept(p)
        facts = f"results/{p.name}/scene.json"
        recorded = workflow.persistence.params(IOFile(facts))
        if (
            Path(facts).exists()
            and not recorded
            and not workflow.dag_settings.forceall
            and any(map(os.path.exists, files))
        ):
            raise WorkflowError(
                f"results/{p.name} was not made here, or the folder .snakemake was deleted: nothing tells from what it was made. "
                "Start where .snakemake lies, or move it away and it is made again"
            )
        found += files
    return found


LAST_STEP = {"detected": "feed", "fed": "feed", "solids.parquet": "solids"}
LAST_STEP |= {"solids.city.jsonl": "solids", "meshes.parquet": "solids"}


def blocks(path):
    """A file of every block of the scene; blocks that are left out before it is made do not count."""
    step = LAST_STEP.get(Path(path).parts[0], "ground")
    return lambda wildcards: [
        f"results/{wildcards.scene}/blocks/{b.name}/{path}"
        for b in plan(wildcards).having(step)
    ]


def blocks_read(wildcards):
    """The raster that blocks read: the scene's own, or its tiled copy."""
    return plan(wildcards).blocks_read(f"results/{wildcards.scene}/tiled.tif")


def supposed(wildcards):
    """The file of the directions that networks are told where nobody told them: none where they are known, or not asked for."""
    return (
        [f"results/{wildcards.scene}/supposed.json"] if plan(wildcards).supposes else []
    )


def source(wildcards):
    """The folder of a block's detections: by the models, or fed from the truth."""
    return "fed" if plan(wildcards).settings["feed"] == "truth" else "detected"


def found_corners(wildcards):
    """The corners of every block; none where heights come from a surface model."""
    if plan(wildcards).measured:
        return []
    return blocks(f"{source(wildcards)}/corners.parquet")(wildcards)


def mapped(p):
    """Whether a 3D model gives heights all over the sections, besides corners."""
    return p.settings["feed"] == "models" and not p.measured


def detections(wildcards):
    """What `stitch` joins: files of every block, with corners and heights where models found them."""
    files = ["pieces.parquet", "links.parquet", "seams.npz"]
    files += ["heights.parquet"] if mapped(plan(wildcards)) else []
    return [
        *(
            f
            for name in files
            for f in blocks(f"{source(wildcards)}/{name}")(wildcards)
        ),
        *found_corners(wildcards),
    ]


def scored(wildcards):
    """The record of the model that tells how likely sections are right: none when the truth is fed in its place."""
    return licensed(wildcards)[:1]


def sectioned(name):
    """`sections.parquet` or `corners.parquet` of the scene: as stitched, or as edited by hand."""
    return lambda w: (
        f"results/{w.scene}/{'edited' if plan(w).settings.get('sections') else 'stitched'}/{name}"
    )


def licensed(wildcards):
    """The records of the models whose licence the results inherit: none when the truth is fed in their place."""
    tasks = (
        [] if plan(wildcards).settings["feed"] == "truth" else ["sections", "corners"]
    )
    return [f"results/{wildcards.scene}/models/{task}.json" for task in tasks]


def using(method):
    """A wildcard constraint: the names of the scenes made by a method, or nothing at all."""
    names = [
        re.escape(p.name) for p in PLANS.values() if p.settings["method"] == method
    ]
    return "|".join(names) or "(?!)"


def published(p):
    """All published files of a scene."""
    names = PUBLISHED + (["evaluation.json", "evaluation.png"] if p.truth else [])
    names += ["paper.tif"] if p.settings["mode"] == "paper" else []
    return [f"results/{p.name}/{f}" for f in names]


def left_behind(p):
    """Files about a scene that are older than its city, and that the present settings do not ask for."""
    asked, record = published(p), RESULTS / p.name / "run.json"
    about = ["evaluation.json", "evaluation.png", "paper.tif", "report.html"]
    there = [
        record.with_name(f)
        for f in about
        if f"results/{p.name}/{f}" not in asked and record.with_name(f).exists()
    ]
    made = record.stat().st_mtime if record.exists() else 0
    return [path.name for path in there if path.stat().st_mtime < made]


def kept(p):
    """The files of every block that stay on disk: one that is missing is made again."""
    detected = (
        ["fed/corners.parquet"]
        if p.settings["feed"] == "truth"
        else [
            "tiles.tif",
            "sections.tif",
            "detected/pieces.parquet",
            *([] if p.measured else ["detected/corners.parquet"]),
        ]
    )
    files = [
        *detected,
        "planes.parquet",
        "filed_corners.parquet",
        "ground.parquet",
        "solids.parquet",
        "solids.city.jsonl",
        "meshes.parquet",
    ]
    return [
        f"results/{p.name}/blocks/{b.name}/{f}"
        for b in p.having("solids")
        for f in files
    ]


BLOCK_FILES = {
    "tiles": "tiles.tif",
    "sections": "detected/pieces.parquet",
    "corners": "detected/corners.parquet",
    "feed": "fed/pieces.parquet",
    "planes": "planes.parquet",
    "ground": "ground.parquet",
    "solids": "solids.parquet",
}


def todo(p):
    """How many blocks of a scene each step is still to make, by step."""
    fed = p.settings["feed"] == "truth"
    skipped = ("tiles", "sections", "corners") if fed else ("feed",)
    single = p.settings["method"] == "single"
    skipped += ("corners",) if p.measured or single else ()
    signed = {step: step for step in BLOCK_FILES}
    signed |= {"ground": "planes", "solids": "solids_of_block"}
    if single:
        signed["sections"] = "single"
    return {
        step: sum(
            not made(
                f"results/{p.name}/blocks/{b.name}/{name}", p.signature[signed[step]]
            )
            for b in p.blocks
        )
        for step, name in BLOCK_FILES.items()
        if step not in skipped
    }


def failed(wildcards):
    """`--blocks FILE` where the city is made without some blocks: which, and why."""
    path = RESULTS / wildcards.scene / failures.RECORD
    return ["--blocks", str(path)] if plan(wildcards).left_out and path.exists() else []


def why_failed(wildcards):
    """What that file says: for other reasons the city is published anew."""
    path = RESULTS / wildcards.scene / failures.RECORD
    return path.read_text() if failed(wildcards) else ""


def report_failures(jobs, stopped):
    """After a run that failed: publish the rest of the city, and say at the very end what failed and what to do."""
    found = failures.of_jobs(jobs)
    nested = bool(config.get("leave_out"))
    given = workflow.config_settings.config or {}
    published = not stopped and failures.publish_rest(
        found, PLANS, sys.argv[1:], given, RESULTS
    )
    if not nested:
        text = failures.told(found, published, PLANS, RESULTS)
        atexit.register(print, text, file=sys.stderr, flush=True)


def evaluated(wildcards):
    """The comparisons of all scenes that have truth; without any there is nothing to compare."""
    found = [f"results/{p.name}/evaluation.json" for p in PLANS.values() if p.truth]
    if not found:
        raise WorkflowError("evaluate: no scene has truth: give truth=FILE")
    return found
