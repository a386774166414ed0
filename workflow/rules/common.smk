# What all rules share: the plan of every scene, and functions from wildcards to parameters and inputs.

import json
import re
from pathlib import Path

import yaml
from snakemake.exceptions import WorkflowError
from snakemake.io import IOFile

from kibs_steps import plan as plans
from kibs_steps import sources
from kibs_steps.errors import KibsError

RESULTS = Path("results")
RUN = f"{workflow.basedir}/envs/run.yaml"
LEARN = f"{workflow.basedir}/envs/learn.yaml"

try:
    schema = yaml.safe_load(
        Path(workflow.basedir, "workflow/schemas/config.schema.yaml").read_text()
    )
    PLANS = {
        name: plans.plan(name, settings, Path(workflow.basedir), RESULTS)
        for name, settings in plans.scenes(config, schema).items()
    }
except KibsError as error:
    raise WorkflowError(str(error)) from None


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


def inputs(step, *outputs):
    """How jobs with that step's signature and these outputs take their inputs (`given = inputs(…)`, then `given(path)`).

    While all outputs were made under the present signature, nothing that happens to their inputs concerns them (a
    neighbouring block made again gives the same bytes): inputs are `ancient` then, and those that are gone are not asked
    for. Otherwise they are plain inputs, and what makes them again makes the outputs again.
    """

    def made(path, wanted):
        return Path(path).exists() and wanted in (
            workflow.persistence.params(IOFile(path)) or []
        )

    def given(files):
        def choose(wildcards):
            found = files(wildcards) if callable(files) else files.format(**wildcards)
            wanted = repr(signature(step)(wildcards))
            if not all(made(output.format(**wildcards), wanted) for output in outputs):
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


def blocks(path):
    """A file of every block of the scene."""
    return lambda wildcards: [
        f"results/{wildcards.scene}/blocks/{b.name}/{path}"
        for b in plan(wildcards).blocks
    ]


def blocks_read(wildcards):
    """The raster that blocks read: the scene's own, or its tiled copy."""
    return plan(wildcards).blocks_read(f"results/{wildcards.scene}/tiled.tif")


def source(wildcards):
    """The folder of a block's detections: by the models, or fed from the truth."""
    return "fed" if plan(wildcards).settings["feed"] == "truth" else "detected"


def measured(p):
    """Whether heights come from a surface model, so that the 3D model has nothing to do."""
    two = p.settings["feed"] == "models" and p.settings["method"] == "two_stage"
    return two and bool(p.settings.get("dsm"))


def found_corners(wildcards):
    """The corners of every block; none where heights come from a surface model."""
    if measured(plan(wildcards)):
        return []
    return blocks(f"{source(wildcards)}/corners.parquet")(wildcards)


def detections(wildcards):
    """What `stitch` joins: four files of every block, or three without corners."""
    files = ("pieces.parquet", "links.parquet", "seams.npz")
    return [
        *(
            f
            for name in files
            for f in blocks(f"{source(wildcards)}/{name}")(wildcards)
        ),
        *found_corners(wildcards),
    ]


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
    names = PUBLISHED + (["evaluation.json"] if p.truth else [])
    names += ["paper.tif"] if p.settings["mode"] == "paper" else []
    return [f"results/{p.name}/{f}" for f in names]


def kept(p):
    """The files of every block that stay on disk: one that is missing is made again."""
    detected = (
        ["fed/corners.parquet"]
        if p.settings["feed"] == "truth"
        else [
            "tiles.tif",
            "sections.tif",
            "detected/pieces.parquet",
            *([] if measured(p) else ["detected/corners.parquet"]),
        ]
    )
    files = [
        *detected,
        "planes.parquet",
        "filed_corners.parquet",
        "ground.parquet",
        "solids.parquet",
        "solids.city.jsonl",
    ]
    return [f"results/{p.name}/blocks/{b.name}/{f}" for b in p.blocks for f in files]
