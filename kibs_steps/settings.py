"""Settings: `config.yaml` and `--config` read and checked, every mistake told with what was probably meant.

In: a YAML file, the schema (`workflow/schemas/config.schema.yaml`). YAML is read by its safe loader: it can hold no code.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from kibs_steps.errors import KibsError

PAGE = "docs/running.md lists all keys"
TRAIN_PAGE = "docs/models.md lists them"


class BadConfig(KibsError):
    """The configuration cannot be used."""


def read(path: str | Path) -> dict[str, Any]:
    """A YAML file of settings; raises `BadConfig` with the place of a mistake in it."""
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise BadConfig(f"{path} is not UTF-8 text ({error.reason} at byte {error.start}): save it as UTF-8") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        what = getattr(error, "problem", None) or "not YAML"
        raise BadConfig(f"{path}{where}: {what}: write `key: value` lines, indented with spaces") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise BadConfig(f"{path} holds a {type(content).__name__}: write `key: value` lines")
    return content


def plain(config: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """A configuration whose `true` and `false` are what they mean: Snakemake leaves them text in `--config`, but for True and
    False."""
    switches = {k for k, of in schema["$defs"]["scene"]["properties"].items() if of.get("type") == "boolean"}
    said = {"true": True, "false": False}
    return {k: said.get(str(v).lower(), v) if k in switches and isinstance(v, str) else v for k, v in config.items()}


def check_name(config: dict[str, Any], words: Iterable[str]) -> None:
    """Raise `BadConfig` for a scene whose name on the command line (`words`) Snakemake took for a number that is written in
    another way."""
    name = config.get("scene")
    if isinstance(name, bool) or not isinstance(name, (int, float)):
        return
    said = [word.removeprefix("scene=") for word in words if word.startswith("scene=")]
    if said and str(name) not in said:
        raise BadConfig(
            f"scene={said[-1]}: Snakemake reads it as the number {name}: begin the scene's name with a letter"
        )


def check(config: dict[str, Any], schema: dict[str, Any]) -> None:
    """Raise `BadConfig` for the first unknown key or wrong value, naming its place and what is allowed there."""
    import jsonschema

    scene = set(schema["$defs"]["scene"]["properties"])
    _known(config, scene | set(schema["properties"]), "")
    scenes = config.get("scenes")
    for name, values in scenes.items() if isinstance(scenes, dict) else ():
        if isinstance(values, dict):
            _known(values, scene, f"scenes.{name}.")
    for place, part in (("train", config.get("train")), *_simulated(config)):
        if isinstance(part, dict):
            of = (
                schema["properties"]["train"]
                if place == "train"
                else schema["$defs"]["scene"]["properties"]["simulate"]
            )
            _known(part, of["properties"], f"{place}.")
            if place == "train":
                _train_known(part, of["properties"], scene)
    found = jsonschema.Draft202012Validator(schema).iter_errors(config)
    error = jsonschema.exceptions.best_match(e for e in found if e.validator != "unevaluatedProperties")
    if error is None:
        return
    while error.validator in ("oneOf", "anyOf") and error.context:
        nearest = [e for e in error.context if e.validator not in ("unevaluatedProperties", "type") or len(e.path)]
        if not nearest:
            break
        error = nearest[0]
    place = ".".join(map(str, error.absolute_path)) or "config"
    raise BadConfig(f"{place}: {_wanted(error)}")


def _simulated(config: dict[str, Any]) -> Iterable[tuple[str, Any]]:
    yield "simulate", config.get("simulate")
    scenes = config.get("scenes")
    for name, values in scenes.items() if isinstance(scenes, dict) else ():
        if isinstance(values, dict):
            yield f"scenes.{name}.simulate", values.get("simulate")


def _train_known(train: dict[str, Any], properties: dict[str, Any], scene: set[str]) -> None:
    """Refuse unknown keys one level below `train`; `scene` are the keys of a scene, which own data may have too."""
    for name in ("shares", "thresholds"):
        if isinstance(train.get(name), dict):
            _known(train[name], properties[name]["properties"], f"train.{name}.", TRAIN_PAGE)
    own = train.get("own")
    for i, item in enumerate(own if isinstance(own, list) else ()):
        if isinstance(item, dict):
            (of,) = (kind for kind in properties["own"]["items"]["oneOf"] if kind["type"] == "object")
            _known(item, scene | set(of["properties"]), f"train.own.{i}.", TRAIN_PAGE)


def _known(values: dict[str, Any], known: Iterable[str], place: str, page: str = PAGE) -> None:
    for key in values:
        if key not in known:
            raise BadConfig(f"{place}{key} is no setting{_meant(str(key), known)} ({page})")


def _meant(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(word.lower(), sorted(known), 1, 0.6)
    return f": did you mean {near[0]}?" if near else ""


def _wanted(error: Any) -> str:
    """What a value is and what it should be."""
    value, rule = error.instance, error.validator_value
    means = error.schema.get("description")
    hint = f" ({means})" if means else f" ({PAGE})"
    if error.validator == "enum":
        return f"{value!r} is none of {', '.join(map(str, rule))}{_meant(str(value), map(str, rule))}{hint}"
    if error.validator == "type":
        wanted = rule if isinstance(rule, str) else " or ".join(rule)
        return f"{value!r} is no {wanted}{hint}"
    if error.validator == "required":
        return f"{error.message}{hint}"
    return f"{error.message}{hint}"
