# KIBS: one off-nadir raster and a terrain model to a LOD2 city. Start with `snakemake --cores 2`; see README.md.
import json
from pathlib import Path

import yaml
from snakemake.exceptions import WorkflowError
from snakemake.io import IOFile

from kibs_steps import plan as plans
from kibs_steps.errors import KibsError

if Path("config.yaml").is_file():

    configfile: "config.yaml"


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


wildcard_constraints:
    scene="[^/]+",
    block=r"r\d+c\d+",
    task="sections|corners",


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
    """How a rule with that step's signature and these outputs takes its inputs: `given = inputs(...); given(path)`.

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


include: "workflow/rules/scene.smk"
include: "workflow/rules/detect.smk"
include: "workflow/rules/reconstruct.smk"
include: "workflow/rules/publish.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/learn.smk"


rule all:
    """Build every scene."""
    default_target: True
    input:
        [f for p in PLANS.values() for f in published(p) + kept(p)],


rule detect:
    """Find sections and corners of every scene, no further."""
    input:
        [
            f"results/{p.name}/blocks/{b.name}/stitched_sections.parquet"
            for p in PLANS.values()
            for b in p.blocks
        ],


rule evaluate:
    """Compare every scene that has truth with it."""
    input:
        [f"results/{p.name}/evaluation.json" for p in PLANS.values() if p.truth],


rule simulate:
    """Make the simulated scenes, no further."""
    input:
        [p.raster for p in PLANS.values() if p.settings.get("simulate")],
