"""Reads a scenario file and turns every mistake into one line that says where it is."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from uwbsim.errors import ScenarioError
from uwbsim.scenario.linked_files import fill_in
from uwbsim.scenario.model import Scenario


def load(path: str | os.PathLike[str], overrides: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """Read and validate a scenario; `overrides` are `key.path=value` with a TOML value.

    Raises `ScenarioError`.
    """
    table = _parse(Path(path))
    for text in overrides:
        _override(table, text)
    if seed is not None:
        table.setdefault("run", {})["seed"] = seed
    fill_in(table, Path(path))
    try:
        return Scenario.model_validate(table)
    except ValidationError as error:
        raise ScenarioError(f"{path}: {_explain(error)}") from error


def _parse(path: Path) -> dict[str, Any]:
    if path.is_dir():
        raise ScenarioError(f"{path}: is a directory, expected a scenario file (.toml)")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ScenarioError(f"{path}: no such scenario file") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not a text file in UTF-8 (byte {error.start})") from error
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path}: not valid TOML: {error}") from error
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror})") from error


def _override(table: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    keys = [k.strip() for k in key.split(".")]
    if not equals or not all(keys):
        raise ScenarioError(f"--set {text}: expected key.path=value, as in ranging.rate_hz=50")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()  # a word without quotes is meant as text
    node: Any = table
    for step in keys[:-1]:
        node = _step(node, step, text)
    last: Any = keys[-1]
    if isinstance(node, list):
        last = _index(node, last, text)
    elif not isinstance(node, dict):
        raise ScenarioError(f"--set {text}: {keys[-2]} is not a table")
    node[last] = parsed


def _step(node: Any, step: str, text: str) -> Any:
    if isinstance(node, list):
        return node[_index(node, step, text)]
    if isinstance(node, dict):
        return node.setdefault(step, {})
    raise ScenarioError(f"--set {text}: nothing lies below {step!r}")


def _index(node: list[Any], step: str, text: str) -> int:
    if step.isdecimal() and int(step) < len(node):
        return int(step)
    raise ScenarioError(f"--set {text}: found {step!r}, expected an index 0 to {len(node) - 1}")


def _explain(error: ValidationError) -> str:
    # An unknown key explains a missing one better than the other way round.
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    where = _key_path(first["loc"])
    if first["type"] == "extra_forbidden":
        return f"{where}: unknown key{_suggestion(first['loc'])}"
    if first["type"] == "missing":
        return f"{where}: missing, and it must be given"
    message = str(first["msg"]).removeprefix("Value error, ")
    if first["type"] == "value_error":
        # A table's own check begins with the key it is about; that of a single value begins with what was found.
        joint = ": " if message.startswith("found") else "."
        return f"{where}{joint}{message}" if where else message
    found = repr(first["input"])
    found = found if len(found) <= 60 else found[:57] + "..."
    return f"{where}: found {found}, {message[0].lower()}{message[1:]}"


def _key_path(loc: Iterable[int | str]) -> str:
    path = ""
    for part in _real_keys(loc):
        path += f"[{part}]" if isinstance(part, int) else f".{part}"
    return path.lstrip(".")


def _real_keys(loc: Iterable[int | str]) -> list[int | str]:
    """Drop what pydantic adds to a path: the names of the members of a union."""
    keys: list[int | str] = []
    models: list[type[BaseModel]] = [Scenario]
    for part in loc:
        if isinstance(part, int):
            keys.append(part)
            continue
        children = [f.annotation for m in models if (f := m.model_fields.get(part))]
        if children:
            models = [m for child in children for m in _models_in(child)]
            keys.append(part)
        elif not _is_union_label(part, models):
            keys.append(part)
    return keys


def _is_union_label(part: str, models: list[type[BaseModel]]) -> bool:
    labels = {str(a) for m in models if (f := m.model_fields.get("model")) for a in get_args(f.annotation)}
    return part in labels or "[" in part


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) is None and not isinstance(annotation, UnionType):
        return []
    if get_origin(annotation) in (Union, UnionType, tuple) or get_args(annotation):
        return [m for a in get_args(annotation) for m in _models_in(a)]
    return []


def _suggestion(loc: tuple[int | str, ...]) -> str:
    models: list[type[BaseModel]] = [Scenario]
    for part in loc[:-1]:
        children = [f.annotation for m in models if (f := m.model_fields.get(str(part)))]
        models = [m for child in children for m in _models_in(child)] or models
    known = sorted({name for m in models for name in m.model_fields})
    near = difflib.get_close_matches(str(loc[-1]), known, n=1)
    return f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}"
