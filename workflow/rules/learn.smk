# Training; needs the extra `learn` (torch). Checkpoints stay in runs/, so the same command goes on after a kill.

TRAIN = {
    "name": "mine",
    "data": None,
    "minutes": 90,
    "seed": 0,
    "tiles": 4000,
    **(config.get("train") or {}),
}


rule trained:
    """Train the network of one task within its time budget and export it as ONNX with its contract."""
    input:
        start=lambda w: "models/{name}/sections.onnx" if w.task == "corners" else [],
    output:
        "models/{name}/{task}.onnx",
    log:
        "runs/{name}/{task}.log",
    conda:
        LEARN
    params:
        data=TRAIN["data"],
        minutes=TRAIN["minutes"],
        options=[f"--seed={TRAIN['seed']}", f"--tiles={TRAIN['tiles']}"],
        init=lambda w: (
            [f"--init=runs/{w.name}/sections/checkpoint.pt"]
            if w.task == "corners"
            else []
        ),
    shell:
        "(python -m kibs_steps.learn.training --task {wildcards.task} --data {params.data:q}"
        " --minutes {params.minutes} {params.options:q} {params.init:q} --out runs/{wildcards.name:q}/{wildcards.task}"
        " && python -m kibs_steps.learn.export --checkpoint runs/{wildcards.name:q}/{wildcards.task}/checkpoint.pt"
        " --pool runs/{wildcards.name:q}/pool --out {output:q}) > {log:q} 2>&1"


rule train:
    """Train both networks of a model set (config key `train`: name, data, minutes, seed, tiles)."""
    input:
        expand(
            "models/{name}/{task}.onnx",
            name=TRAIN["name"],
            task=["sections", "corners"],
        ),
