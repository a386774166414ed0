"""A trained checkpoint to an ONNX file that carries its contract.

In: `checkpoint.pt` of `learn.training`. Out: `{task}.onnx`, opset 17, one tile (1, 3, s, s) a call, with the averaged weights and
`metadata_props["kibs"]` (models/contract.schema.json).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from kibs_steps import cli, store
from kibs_steps.learn import dataset, examples, losses, maskrcnn, sources, training
from kibs_steps.learn.architectures import OUTPUTS
from kibs_steps.learn.samples import Sample
from kibs_steps.models import contract as contracts

if TYPE_CHECKING:
    import onnx

TILE, MARGIN = 512, 32  # px at dataset.GSD
THRESHOLDS = {
    "sections": {"roof": 0.5, "prominence": 0.2, "min_area": 12, "sure": 0.6},
    "corners": {"corner": 0.3, "corner_radius": 7.5},
}
THRESHOLDS["both"] = THRESHOLDS["sections"] | THRESHOLDS["corners"]
BRIEF = 1024  # numbers of a tensor from which it is worth keeping in half precision
BY_SIZE = {"min_area": 2, "corner_radius": 1}  # thresholds in px² and px, for dataset.GSD
BEFORE = "before that: "
FRESH = ("none", training.IMAGENET)  # what a run starts from that adds no data of its own


def tiling(gsd: float) -> tuple[int, int]:
    """Tile and margin (px) that show about as much ground at any GSD; whole cells of stride 32 at half zooms too."""
    share = dataset.GSD / gsd
    return 64 * max(1, round(TILE * share / 64)), 16 * max(1, round(MARGIN * share / 16))


def zoom_at(gsd: float, settings: training.Settings) -> float:
    """The zoom with which a network sees the ground at `gsd` as large as in training; a tile stays whole cells of stride 32."""
    if gsd == settings.gsd:
        return settings.zoom
    tile = tiling(gsd)[0]
    return 32 * round(settings.zoom * gsd / settings.gsd * tile / 32) / tile


def thresholds_of(task: str, gsd: float) -> dict[str, float]:
    """THRESHOLDS of a task; what is meant in metres in px of another GSD."""
    share = dataset.GSD / gsd
    return {
        name: round(value * share ** BY_SIZE[name], 1) if name in BY_SIZE else value
        for name, value in THRESHOLDS[task].items()
    }


def contract_of(
    task: str,
    heights: tuple[float, float] | None = None,
    family: str = "dense",
    gsd: float = dataset.GSD,
    **facts: Any,
) -> dict[str, Any]:
    """The contract of a network trained here.

    `heights` are mean and standard deviation (m) of the training set's corners; `facts` replace or add fields of the
    contract: `thresholds` (merged), `metrics`, `score`, `join`, `walls`, and `seed`, `commit`, `about` (what the run was
    trained on).
    """
    tile, margin = tiling(gsd)
    contract: dict[str, Any] = {
        "contract": 1,
        "task": task,
        "head": "dense",
        "gsd": gsd,
        "tile": tile,
        "margin": margin,
        "input": {"channels": "RGB", "scale": 1.0, "mean": [127.0] * 3, "std": [128.0] * 3},
        "geometry_input": True,
        "upright": True,
        "mirrored": True,
        "flips": 8,  # where nothing leans, or nobody knows how
        "thresholds": {**thresholds_of(task, gsd), **facts.get("thresholds", {})},
        "trained_on": {
            "view_elevation": [45, 90],
            "view_azimuth": [0, 360],
            "sun_elevation": [20, 70],
            "sun_azimuth": [0, 360],
            "data": [
                "simulated scenes",
                "roof-graph photographs (Ren et al. 2021), pasted",
                "chips with building masks",
            ],
            "licence": sources.NON_COMMERCIAL,
        },
    }
    trained = {**contract["trained_on"], **facts.get("about", {})}
    contract["trained_on"] = {key: value for key, value in trained.items() if value is not None}
    contract["trained_on"].update({k: facts[k] for k in ("seed", "commit") if k in facts})
    if family == "maskrcnn":
        for term in ("geometry_input", "upright", "mirrored", "flips"):
            del contract[term]
        contract.update(maskrcnn.contract_terms(task, heights or (6.0, 4.0)))
        contract["thresholds"].update(facts.get("thresholds", {}))
    elif task == "corners":
        contract["blend"] = examples.BLEND
    if task != "sections" and family == "dense":
        mean, sigma = heights or (6.0, 4.0)
        contract["heights"] = {
            "edges": losses.EDGES.tolist(),
            "centres": losses.CENTRES.tolist(),
            "fallback": round(mean, 2),
            "fallback_sigma": round(sigma, 2),
        }
    contract.update({k: facts[k] for k in ("metrics", "score", "join", "walls") if k in facts})
    return contracts.validate(contract, "the new contract")


def inherited(about: dict[str, Any], before: dict[str, Any] | None) -> dict[str, Any]:
    """What a contract says of a run's training, with data and licence of the weights it started from.

    `before` is `trained_on` of the model those were taken from; None if no such model is known.
    """
    if before is None:
        if about.get("init", "none") in FRESH or "licence" not in about:
            return about
        return {**about, "licence": f"{about['licence']}; and as the weights it started from ({about['init']}) allow"}
    licence = sources.together(before["licence"], about.get("licence", before["licence"]))
    data = list(about.get("data", []))
    earlier = (what.removeprefix(BEFORE) for what in before["data"])
    data += [BEFORE + what for what in dict.fromkeys(earlier) if what not in data]
    return {**about, "data": data, "licence": licence}


def corner_height_moments(pool: Path, most: int = 300) -> tuple[float, float] | None:
    """Mean and standard deviation (m) of the corners' heights in the first kept tiles of a pool; None without any."""
    heights = [Sample.load(path).corner_heights for path in sorted(pool.glob("[!.]*.npz"))[:most]]
    known = np.concatenate([*heights, np.zeros(0, np.float32)])
    known = known[np.isfinite(known)]
    return (float(known.mean()), float(known.std())) if len(known) else None


def export(model: nn.Module, path: str | Path, contract: dict[str, Any]) -> None:
    """Write a network as ONNX with its contract; the input's side is the contract's tile.

    In a dense network constants are folded and padding becomes a part of its convolution: up to a tenth quicker to run. Its
    weights are kept in half precision (`brief_weights`).
    """
    import onnx
    import onnxslim

    tile = contract["tile"]
    model = model.eval().to(memory_format=torch.contiguous_format)
    with store.whole(path, summed=False) as temporary:
        if contract["head"] == "instances":
            maskrcnn.to_onnx(model, str(temporary), tile)
        else:
            torch.onnx.export(
                model,
                (torch.zeros(1, 3, tile, tile), torch.zeros(1, 6)),
                str(temporary),
                input_names=["image", "geometry"],
                output_names=list(OUTPUTS[model.task]),
                opset_version=17,
                dynamo=False,
            )
        proto = onnx.load(str(temporary))
        if contract["head"] == "dense":
            proto = brief_weights(onnxslim.slim(proto))
        onnx.helper.set_model_props(proto, {contracts.KEY: json.dumps(contract)})
        onnx.checker.check_model(proto)
        onnx.save(proto, str(temporary))


def brief_weights(proto: onnx.ModelProto) -> onnx.ModelProto:
    """Weights in half precision, made float32 where they enter the graph: half the file, and who loads it folds that away.

    Vectors of a few numbers (biases, factors) stay as they are, and what half precision cannot hold.
    """
    import onnx

    casts = []
    for tensor in proto.graph.initializer:
        value = onnx.numpy_helper.to_array(tensor)
        if value.dtype != np.float32 or value.size < BRIEF or np.abs(value).max() > np.finfo(np.float16).max:
            continue
        name, half = tensor.name, f"{tensor.name}_half"
        tensor.CopyFrom(onnx.numpy_helper.from_array(value.astype(np.float16), half))
        casts.append(onnx.helper.make_node("Cast", [half], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *proto.graph.node]
    del proto.graph.node[:]
    proto.graph.node.extend(nodes)
    return proto


def halved(average: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights in half precision; what that cannot hold (variances of wide features) stays as it is."""
    halves = {name: value.half() if value.is_floating_point() else value for name, value in average.items()}
    return {name: half if torch.isfinite(half).all() else average[name] for name, half in halves.items()}


def main(argv: list[str] | None = None) -> None:
    """Export the averaged weights of a run as the model of one task."""
    parser = argparse.ArgumentParser(prog="python -m kibs_steps.learn.export", description=main.__doc__)
    parser.add_argument("--checkpoint", required=True)
    parser.add_argument("--task", choices=list(OUTPUTS), required=True)
    parser.add_argument("--out", required=True, help="ONNX file")
    parser.add_argument(
        "--gsd",
        type=float,
        help="of the model, m per px, if not that of the run: it sees the ground as large as in training",
    )
    parser.add_argument("--weights", help="also write the weights here, for other runs to start from (training --init)")
    parser.add_argument("--pool", help="simulated tiles, for the mean corner height")
    parser.add_argument("--thresholds", type=json.loads, default={}, help="JSON, replaces thresholds of the contract")
    parser.add_argument(
        "--like", help="model whose weights the run started from: its thresholds, score, joins and licence hold on"
    )
    parser.add_argument("--metrics", help="report of learn.validation, kept in the contract")
    parser.add_argument(
        "--view-elevation",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="views the model is offered for (deg), if fewer than it was trained on: as one of a suite",
    )
    parser.add_argument("--commit", help="commit of the training code")
    args = parser.parse_args(argv)
    state = torch.load(args.checkpoint, weights_only=True, map_location="cpu")
    if "step" not in state:
        parser.error(f"--checkpoint {args.checkpoint}: weights alone, for training --init; give a run's checkpoint.pt")
    task, settings = args.task, training.Settings(**state["settings"])
    average = training.averaged(state)
    gsd = args.gsd or settings.gsd
    if gsd != settings.gsd and (task, settings.family) != ("sections", "dense"):
        parser.error(f"--gsd {gsd:g}: only a dense network for sections alone can be made into a model for another GSD")
    model = training.network(task, settings.family, zoom_at(gsd, settings), settings.blur * settings.gsd / gsd)
    model.load_state_dict(average)
    about = {**state.get("about", {}), "tiles_seen": state["step"] * settings.batch}
    about |= {"minutes": round(state["seconds"] / 60, 1), "converged": state.get("converged")}
    heights = about.pop("corner_heights", None)
    facts: dict[str, Any] = {"thresholds": args.thresholds, "seed": settings.seed, "about": about}
    like = contracts.load(args.like, task).contract if args.like else None
    facts["about"] = inherited(about, like and like["trained_on"])
    if like:
        kept = {k: v for k, v in like["thresholds"].items() if k not in BY_SIZE or like["gsd"] == gsd}
        facts["thresholds"] = {**kept, **args.thresholds}
        facts |= {key: like[key] for key in ("score", "join", "walls") if key in like}
    if args.view_elevation:
        facts["about"] = {**facts["about"], "view_elevation": args.view_elevation}
    if args.commit:
        facts["commit"] = args.commit
    if args.metrics:
        report = store.read_json(args.metrics)
        chosen = {k: v for k, v in report.pop("thresholds", {}).items() if k in THRESHOLDS[task]}
        facts["thresholds"] = {**chosen, **args.thresholds}
        if "score" in report and args.task != "corners":
            facts["score"] = report["score"]
        report.pop("score", None)
        facts["metrics"] = report
    if heights is None and args.pool and task != "sections":
        heights = corner_height_moments(Path(args.pool))
    export(model, args.out, contract_of(task, heights, settings.family, gsd, **facts))
    if args.weights:
        with store.whole(args.weights, summed=False) as temporary:
            torch.save({"average": halved(average), "settings": state["settings"]}, temporary)
    print(f"{args.out}: {state['step']} steps, {state['seconds'] / 60:.0f} min")


if __name__ == "__main__":
    cli.run(main)
