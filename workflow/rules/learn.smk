# Training; needs the extra `learn` (torch). Checkpoints lie in runs/ and are no rule's output, which Snakemake would delete:
# the same command goes on after a kill.

from kibs_steps.learn import recipe as recipes
from kibs_steps.learn.samples import CORRECTED

RECIPE = cli.or_exit(
    recipes.of_run,
    config,
    Path(workflow.basedir),
    workflow.config_settings.config,
    sys.argv[1:],
)
TRAIN = {**recipes.DEFAULTS, **(config.get("train") or {})}


wildcard_constraints:
    name=re.escape(RECIPE.name),  # other sets are inputs, and nothing to make anew


rule own_samples:
    """Training, validation and testing tiles of a raster with its annotation."""
    input:
        lambda w: RECIPE.files(w.own),
    output:
        "runs/{name}/own/{own}/own.json",
    log:
        "runs/{name}/logs/own_{own}.log",
    retries: 0
    conda:
        LEARN
    params:
        options=lambda w: recipes.own_options(
            RECIPE.own[w.own], TRAIN["split"], TRAIN["seed"], TRAIN["gsd"]
        ),
    shell:
        "python -m kibs_steps.learn.own {params.options:q} --out $(dirname {output:q}) > {log:q} 2>&1"


rule look:
    """How the scene to fine-tune for looks: windows of its raster."""
    input:
        lambda w: RECIPE.seen(w.scene),
    output:
        "runs/{name}/look/{scene}.npy",
    log:
        "runs/{name}/logs/look_{scene}.log",
    retries: 0
    conda:
        LEARN
    params:
        options=lambda w: recipes.look_options(
            RECIPE.look[w.scene], TRAIN["seed"], TRAIN["gsd"]
        ),
    shell:
        "python -m kibs_steps.learn.look {params.options:q} --out {output:q} > {log:q} 2>&1"


rule trained:
    """Train one network within its time budget."""
    input:
        own=[f"runs/{RECIPE.name}/own/{own}/own.json" for own in RECIPE.own],
        look=[f"runs/{RECIPE.name}/look/{scene}.npy" for scene in RECIPE.look],
        init=lambda w: RECIPE.starts[w.network],
        cities=RECIPE.cities,
        corrected=[
            file
            for own in RECIPE.own
            if Path(file := f"runs/{RECIPE.name}/own/{own}/{CORRECTED}").exists()
        ],
    output:
        "runs/{name}/{network}/done.json",
    log:
        "runs/{name}/logs/training_{network}.log",
    retries: 0
    conda:
        LEARN
    threads: 64  # Snakemake lowers it to what there is
    params:
        options=lambda w: RECIPE.training[w.network],
        own=lambda w: [f"runs/{w.name}/own/{own}" for own in RECIPE.own],
        look=lambda w, input: ["--look", *input.look] if input.look else [],
        init=lambda w, input: ["--init", *input.init] if input.init else [],
    shell:
        "python -m kibs_steps.learn.training {params.options:q} {params.look:q} {params.init:q} --own {params.own:q} --threads {threads}"
        " --pool runs/{wildcards.name:q}/pool --out $(dirname {output:q}) > {log:q} 2>&1"


rule exported:
    """Export a trained network as the ONNX model of one task; teach it how basins are joined, or how walls lift sections."""
    input:
        done=lambda w: f"runs/{w.name}/{RECIPE.network_of[w.task]}/done.json",
        look=[f"runs/{RECIPE.name}/look/{scene}.npy" for scene in RECIPE.look],
        like=lambda w: RECIPE.like[w.task],
        cities=RECIPE.cities,
    output:
        "models/{name}/{task}.onnx",
    log:
        "runs/{name}/logs/export_{task}.log",
    wildcard_constraints:
        task="|".join(RECIPE.network_of),
    retries: 0
    conda:
        LEARN
    params:
        options=lambda w: RECIPE.export[w.task],
        like=lambda w, input: ["--like", *input.like] if input.like else [],
        joins=lambda w: RECIPE.joins[w.task],
        joined=lambda w: "yes" if RECIPE.joins[w.task] else "no",
        lifts=lambda w: RECIPE.lifts[w.task],
        lifted=lambda w: "yes" if RECIPE.lifts[w.task] else "no",
        pool=lambda w: ["--pool", f"runs/{w.name}/pool"] if TRAIN["tiles"] else [],
        look=lambda w, input: ["--look", *input.look] if input.look else [],
    shell:
        "python -m kibs_steps.learn.export {params.options:q} {params.like:q} --checkpoint $(dirname {input.done:q})/checkpoint.pt"
        " --task {wildcards.task} --pool runs/{wildcards.name:q}/pool --out {output:q} > {log:q} 2>&1"
        " && (test {params.joined} = no"
        " || python -m kibs_steps.learn.joins --model {output:q} {params.joins:q} {params.look:q} >> {log:q} 2>&1)"
        " && (test {params.lifted} = no"
        " || python -m kibs_steps.learn.lifting --model {output:q} {params.pool:q} {params.lifts:q} {params.look:q} >> {log:q} 2>&1)"


rule taken:
    """A model that a set trained in part keeps from the one it started from."""
    input:
        lambda w: RECIPE.taken[w.task],
    output:
        "models/{name}/{task}.onnx",
    log:
        "runs/{name}/logs/taken_{task}.log",
    wildcard_constraints:
        task="|".join(RECIPE.taken) or "none",
    retries: 0
    conda:
        LEARN
    params:
        source=lambda w: RECIPE.taken[w.task],
    shell:
        "cp {input:q} {output:q} > {log:q} 2>&1"


rule card:
    """The model card and the curves of a trained set."""
    input:
        models=lambda w: [
            f"models/{w.name}/{task}.onnx"
            for task in [*RECIPE.network_of, *RECIPE.taken]
        ],
        done=lambda w: [
            f"runs/{w.name}/{network}/done.json" for network in RECIPE.training
        ],
    output:
        card="models/{name}/README.md",
        curves="models/{name}/curves.png",
    log:
        "runs/{name}/logs/card.log",
    retries: 0
    conda:
        LEARN
    shell:
        "python -m kibs_steps.learn.card --models {input.models:q} --runs {input.done:q} --card {output.card:q}"
        " --curves {output.curves:q} > {log:q} 2>&1"


rule train:
    """Train a model set as the config key `train` says (docs/models.md)."""
    input:
        [
            f"models/{RECIPE.name}/{task}.onnx"
            for task in [*RECIPE.network_of, *RECIPE.taken]
        ],
        f"models/{RECIPE.name}/README.md",
