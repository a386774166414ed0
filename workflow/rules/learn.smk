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
    """Train the network within its time budget."""
    output:
        "runs/{name}/checkpoint.pt",
    log:
        "runs/{name}/training.log",
    conda:
        LEARN
    params:
        data=TRAIN["data"],
        minutes=TRAIN["minutes"],
        options=[f"--seed={TRAIN['seed']}", f"--tiles={TRAIN['tiles']}"],
    shell:
        "python -m kibs_steps.learn.training --data {params.data:q} --minutes {params.minutes} {params.options:q}"
        " --pool runs/{wildcards.name:q}/pool --out runs/{wildcards.name:q} > {log:q} 2>&1"


rule exported:
    """Export the trained network as the ONNX model of one task, with its contract."""
    input:
        "runs/{name}/checkpoint.pt",
    output:
        "models/{name}/{task}.onnx",
    log:
        "runs/{name}/export_{task}.log",
    conda:
        LEARN
    shell:
        "python -m kibs_steps.learn.export --checkpoint {input:q} --task {wildcards.task}"
        " --pool runs/{wildcards.name:q}/pool --out {output:q} > {log:q} 2>&1"


rule train:
    """Train a model set (config key `train`: name, data, minutes, seed, tiles)."""
    input:
        expand(
            "models/{name}/{task}.onnx",
            name=TRAIN["name"],
            task=["sections", "corners"],
        ),
