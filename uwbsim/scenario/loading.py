"""Reading and validation of scenarios, from files or shipped with the package; errors are one line with the place."""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from uwblink.output import made_folder, whole
from uwblink.text_files import read_text
from uwbsim.errors import ParameterError, ScenarioError, UnknownKeyError
from uwbsim.scenario.linked_files import Folders, fill_in
from uwbsim.scenario.model import Scenario


def shipped_scenarios() -> Mapping[str, Path]:
    """Return the scenarios that come with the package: their files by name, in order of names.

    `load`, `preview`, `show` and all commands take the names, too.

    >>> import uwbsim
    >>> "icra2023/train" in uwbsim.shipped_scenarios()
    True
    >>> uwbsim.load("icra2023/train").run.duration_s
    240.0
    """
    folder = _folder()
    named = {path.relative_to(folder).with_suffix("").as_posix(): path for path in folder.rglob("*.toml")}
    return MappingProxyType(dict(sorted(named.items())))


def _folder() -> Path:
    """Return the folder beside the package's modules, where a wheel puts it, or at the top of a checkout."""
    package = Path(__file__).parents[1]
    inside = package / "scenarios"
    return inside if inside.is_dir() else package.parent / "scenarios"


def found(path: Path) -> Path:
    """Return the file of a shipped scenario by its name, as in icra2023/train; another path as it is.

    An existing file takes precedence over a name.
    """
    if os.path.exists(path) or path.is_absolute():  # False, where Path.exists raises: for want of permission
        return path
    return shipped_scenarios().get(path.as_posix().removesuffix(".toml"), path)


def nearest(path: Path) -> str:
    """Return `, did you mean ...?` with shipped scenarios of similar names; empty without any."""
    plain, known = path.as_posix().removesuffix(".toml"), list(shipped_scenarios())
    parts = [name for name in known if plain in name.split("/")]
    near = [] if os.path.lexists(path) else parts or difflib.get_close_matches(plain, known, 2)
    return f", did you mean {' or '.join(near)}?" if near else ""


def listed(names: Iterable[str] = ()) -> dict[str, str]:
    """Return titles of shipped scenarios by name; raises what `copy_scenarios` raises for `names`.

    A title is the first sentence of the comment at the head of the file, else the name of its run.
    """
    found = {}
    for name, path in _chosen(list(names)).items():
        text = path.read_text(encoding="utf-8")
        head = [line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), text.splitlines())]
        sentence = re.split(r"(?<=[.:])\s", " ".join(head))[0].rstrip(".:")
        found[name] = sentence or str(tomllib.loads(text)["run"].get("name", ""))
    return found


def copy_scenarios(names: Iterable[str], folder: Path, *, force: bool = False) -> list[Path]:
    """Copy shipped scenarios, and the files that they name, into a folder, in the places where they lie beside another.

    `names` are those of `shipped_scenarios`, or of their folders; none are all. Returns what was written. Raises
    `ScenarioError` for a name that is not there, with nothing written, and what `whole` raises.
    """
    top = _folder().resolve()
    chosen = _chosen(list(names)).values()
    files = dict.fromkeys(path.resolve() for path in chosen)
    for path in chosen:
        linked = re.findall(r'file\s*=\s*"([^"\n]+)"', path.read_text(encoding="utf-8"))
        files |= dict.fromkeys((path.parent / name).resolve() for name in linked)
    places = {path: folder / path.relative_to(top) for path in files}
    with ExitStack() as every:
        for path, place in places.items():
            every.enter_context(made_folder(place.parent))
            every.enter_context(whole(place, force=force)).write_bytes(path.read_bytes())
    return [*places.values()]


def _chosen(names: list[str]) -> Mapping[str, Path]:
    known = shipped_scenarios()
    chosen: dict[str, Path] = {}
    for name in names:
        plain = name.removesuffix(".toml").rstrip("/")
        some = {other: path for other, path in known.items() if other == plain or other.startswith(f"{plain}/")}
        if not some:
            raise ScenarioError(f"{name}: no such scenario; known are {', '.join(known)}")
        chosen |= some
    return chosen if names else known


Source = str | os.PathLike[str] | Mapping[str, Any]
"""A scenario before it is checked: a file, TOML text (more than one line), or the same as nested tables."""

Overrides = Sequence[str] | Mapping[str, Any]


def load(source: Source, overrides: Overrides = (), seed: int | None = None, *, allow_files: Folders = ()) -> Scenario:
    """Read and validate a scenario from a file, from TOML text of more than one line, or from nested tables.

    A name of `shipped_scenarios`, as icra2023/train, does for a file where there is none of that name.

    `overrides` change single values: a mapping of key paths to values, or words `key.path=value` with TOML values;
    `seed` replaces `run.seed`. Files that a scenario names lie in the folder of its file or below, or in the
    working folder where it has none; `allow_files` are other folders in which they may lie. Raises `ScenarioError`, one
    line that says where, what was found and what is allowed.

    >>> import uwbsim
    >>> scenario = uwbsim.load(
    ...     '''
    ...     run = { duration_s = 1.0 }
    ...     ranging = { rate_hz = 50 }
    ...     bodies = [
    ...         { name = "mast", motion = { model = "static", position_m = [0.0, 0.0, 2.0] } },
    ...         { name = "drone", motion = { model = "static", position_m = [3.0, 0.0, 2.0] } },
    ...     ]
    ...     tags = [{ id = 1, body = "mast" }, { id = 2, body = "drone", delay_ns = -0.3 }]
    ...     ''',
    ...     {"ranging.protocol": "ss", "radio.rx_noise_ps": 0.0},
    ...     seed=3,
    ... )
    >>> scenario.run.seed, scenario.ranging.protocol, scenario.pairs()
    (3, 'ss', [(1, 2)])
    """
    table, where = _table(source)
    pairs = overrides.items() if isinstance(overrides, Mapping) else map(_split, overrides)
    for key, value in pairs:
        _override(table, key, deepcopy(value))
    if seed is not None:
        _override(table, "run.seed", seed)
    fill_in(table, where, allow_files)
    return validated(Scenario, table, where)


def as_scenario(source: Scenario | Source) -> Scenario:
    """Return a scenario as it is, or `load` it."""
    return source if isinstance(source, Scenario) else load(source)


def _table(source: Source) -> tuple[dict[str, Any], Path]:
    """Return a table of its own, and the file that it is of (for messages, and for what lies beside it)."""
    nowhere = Path("scenario")
    if isinstance(source, Mapping):
        return deepcopy(dict(source)), nowhere
    if isinstance(source, str) and "\n" in source:
        return parse_toml(source, nowhere), nowhere
    if not isinstance(source, str | os.PathLike):
        seen = type(source).__name__
        raise ParameterError(
            f"found {seen}, expected a path, a name, TOML text, tables or a Scenario", parameter="source"
        )
    path = found(Path(source))
    what = f"scenario file (.toml) or name{nearest(path)} (see uwbsim scenarios)"
    return parse_toml(read_text(path, ScenarioError, what), path), path


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Return the tables of a TOML text; raises `ScenarioError` that names its file."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ScenarioError(f"{path}: not valid TOML: {error}") from error


def _split(text: str) -> tuple[str, Any]:
    """Return key path and value of `key.path=value`."""
    key, equals, value = text.partition("=")
    if not equals:
        raise ParameterError(
            f"found {text!r}, expected key.path=value, as in ranging.rate_hz=50", parameter="overrides"
        )
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return key, value.strip()  # a word without quotes is meant as text


def _override(table: dict[str, Any], key: str, value: Any) -> None:
    """Set the value at a path of keys and indices, in place; tables that are not there are made."""
    keys = [k.strip() for k in key.split(".")]
    if not all(keys):
        raise ParameterError(
            f"found key {key!r}, expected key.path=value, as in ranging.rate_hz=50", parameter="overrides"
        )
    node: Any = table
    for k, step in enumerate(keys):
        place: Any = step
        if isinstance(node, list):
            if not (step.isdecimal() and len(step) < 9 and int(step) < len(node)):
                raise UnknownKeyError(f"{key}: found {step!r}, expected an index 0 to {len(node) - 1}")
            place = int(step)
        elif not isinstance(node, dict):
            raise UnknownKeyError(f"{key}: {keys[k - 1]} is not a table")
        elif k < len(keys) - 1:
            node.setdefault(step, {})
        if k == len(keys) - 1:
            node[place] = value
        else:
            node = node[place]


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], table: Mapping[str, Any], path: str | Path) -> Model:
    """Return a table of a file as its model; raises `ScenarioError`, one line that names the file and the key path."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        # An unknown key explains a missing one better than the other way round.
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        where, known = _key_path(model, first)
        if first["type"] == "extra_forbidden":
            near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise UnknownKeyError(f"{path}: {where}: unknown key; {hint}") from error
        raise ScenarioError(f"{path}: {_explain(where, first)}") from error


def _explain(where: str, first: Mapping[str, Any]) -> str:
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


def _key_path(root: type[BaseModel], first: Mapping[str, Any]) -> tuple[str, list[str]]:
    """Return the path of a mistake as a user writes it, without the names of union members that pydantic adds.

    With it come the keys that are known beside the last one.
    """
    path, unknown, known = "", first["type"] == "extra_forbidden", list[str]()
    models: list[type[BaseModel]] = [root]
    for k, part in enumerate(first["loc"]):
        known = sorted({name for m in models for name in m.model_fields})
        children = [f.annotation for m in models if (f := m.model_fields.get(str(part)))]
        models = [m for child in children for m in _models_in(child)] or models
        if isinstance(part, int):
            path += f"[{part}]"
        elif children or (unknown and k == len(first["loc"]) - 1):
            path += f".{part}"
    return path.lstrip("."), known


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for a in get_args(annotation) for m in _models_in(a)]
