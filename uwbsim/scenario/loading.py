"""Reading and validation of scenarios, from files or shipped with the package, and of the files that they name.

Errors are one line with file and key. The contents of antenna tables, trajectories and plans replace their names, which
are relative to the scenario's folder and must lead to regular files in it or below, links resolved: an untrusted
scenario opens no other file.
"""

from __future__ import annotations

import csv
import difflib
import math
import os
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from itertools import islice, product, takewhile
from pathlib import Path
from typing import Any, Final, TypeVar, cast, get_args

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from uwblink.errors import UwblinkError, raising, restating
from uwblink.output import made_folder, whole
from uwblink.recording.file import Recording
from uwblink.recording.schema import SUFFIX
from uwblink.text_files import number_in, read_text
from uwbsim.errors import ParameterError, ScenarioError, UnknownKeyError
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
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.toml"))}


def _folder() -> Path:
    """Return the folder beside the package's modules, where a wheel puts it, or at the top of a checkout."""
    inside = Path(__file__).parents[1] / "scenarios"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "scenarios"


def listed(names: Iterable[str] = ()) -> dict[str, str]:
    """Return titles of shipped scenarios by name; raises the errors of `copy_scenarios` for `names`.

    A title is the first sentence of the comment at the head of the file.
    """
    found = {}
    for name, path in _chosen(list(names)).items():
        lines = path.read_text(encoding="utf-8").splitlines()
        head = " ".join(line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), lines))
        found[name] = re.split(r"(?<=[.:])\s", head)[0].rstrip(".:")
    return found


def copy_scenarios(names: Iterable[str], folder: Path, *, force: bool = False) -> list[Path]:
    """Copy shipped scenarios, and the files that they name, into a folder, in the places where they lie beside another.

    `names` are those of `shipped_scenarios`, or of their folders; none are all. Returns what was written. Raises
    `ScenarioError` for a name that is not there, with nothing written, and what `whole` raises.
    """
    top, files = _folder(), dict[Path, None]()
    for path in _chosen(list(names)).values():
        linked = re.findall(r'file\s*=\s*"([^"\n]+)"', path.read_text(encoding="utf-8"))
        files |= dict.fromkeys([path, *(path.parent / name for name in linked)])
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
        some = {other: path for other, path in known.items() if f"{other}/".startswith(f"{plain}/")}
        if not some:
            raise ScenarioError(f"{name}: no such scenario; known are {', '.join(known)}")
        chosen |= some
    return chosen if names else known


Source = str | os.PathLike[str] | Mapping[str, Any]
"""A scenario that is not validated yet: a file, TOML text (more than one line), or nested tables."""

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
        raise ParameterError(
            f"found {type(source).__name__}, expected a path, a name, TOML text, tables or a Scenario",
            parameter="source",
        )
    path, known = Path(source), shipped_scenarios()
    what, plain = "scenario file (.toml) or name", path.as_posix().removesuffix(".toml")
    if not os.path.lexists(path) and not path.is_absolute():  # an existing file takes precedence over a name
        near = [name for name in known if plain in name.split("/")] or difflib.get_close_matches(plain, known, 2)
        what += f", did you mean {' or '.join(near)}?" if near else ""
        path = known.get(plain, path)
    return parse_toml(read_text(path, ScenarioError, f"{what} (see uwbsim scenarios)"), path), path


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Return the tables of a TOML text; raises `ScenarioError` that names its file."""
    with restating(ScenarioError, tomllib.TOMLDecodeError, RecursionError, where=f"{path}: not valid TOML: "):
        return dict(tomllib.loads(text))


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
    node, place = cast("Any", {"": table}), cast("Any", "")
    for k, step in enumerate(keys):
        node = node.setdefault(place, {}) if isinstance(node, dict) else node[place]
        if isinstance(node, list):
            if not (step.isdecimal() and len(step) < 9 and int(step) < len(node)):
                ids = [str(one.get("id")) for one in node if isinstance(one, dict)]
                meant = f"; id {step} has index {ids.index(step)}" if step in ids else ""
                raise UnknownKeyError(f"{key}: found {step!r}, expected an index 0 to {len(node) - 1}{meant}")
        elif not isinstance(node, dict):
            raise UnknownKeyError(f"{key}: {keys[k - 1]} is not a table")
        place = int(step) if isinstance(node, list) else step
    node[place] = value


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], table: Mapping[str, Any], path: str | Path) -> Model:
    """Return a table of a file as its model; raises `ScenarioError`, one line that names the file and the key path."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        # Of alternatives that are tables the one with the fewest mistakes is meant, of words and tables the table. An
        # unknown key explains a missing one better than the other way round.
        errors = error.errors()
        among = Counter(one["loc"][:-1] for one in errors)

        def rank(one: ErrorDetails) -> tuple[bool, int, bool]:
            kind, table = one["type"], isinstance(one["input"], dict)
            word = table and kind in ("string_type", "literal_error")
            return word, among[one["loc"][:-1]], kind != "extra_forbidden"

        first = min(errors, key=rank)
        where, known = _key_path(model, first["loc"], first["type"] == "extra_forbidden")
        if first["type"] == "extra_forbidden":
            near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise UnknownKeyError(f"{path}: {where}: unknown key; {hint}") from error
        raise ScenarioError(f"{path}: {_explain(where, first)}") from error


def _explain(where: str, first: Mapping[str, Any]) -> str:
    if first["type"] == "missing":
        return f"{where}: missing; this key is required"
    message, found = str(first["msg"]).removeprefix("Value error, "), repr(first["input"])
    if first["type"] == "value_error":
        # A table's own check begins with the key it is about; that of a single value begins with what was found.
        joint = ": " if message.startswith("found") else "."
        return f"{where}{joint}{message}" if where else message
    found = found if len(found) <= 60 else found[:57] + "..."
    return f"{where}: found {found}, {message[0].lower()}{message[1:]}"


def _key_path(root: type[BaseModel], parts: Sequence[str | int], unknown: bool) -> tuple[str, list[str]]:
    """Return the path of a mistake as a user writes it, and the keys that are known beside the last one.

    Pydantic's path also has the names of the alternatives that a value was compared with; `unknown` says that its last
    part is an unknown key.
    """
    path, models, known = "", [root], list[str]()
    for k, part in enumerate(parts):
        nested = [field.annotation for m in models if (field := m.model_fields.get(str(part)))]
        if isinstance(part, int):
            path += f"[{part}]"
        elif nested or (unknown and k == len(parts) - 1):
            path += f".{part}"
        else:
            # The name of a table, or the value of its key `model`, is that of one of several tables.
            kinds = [get_args(getattr(m.model_fields.get("model"), "annotation", None)) for m in models]
            models = [m for m, kind in zip(models, kinds, strict=True) if part in (m.__name__, *kind)] or models
        known = sorted({name for m in models for name in m.model_fields})
        models = [m for annotation in nested for m in _models_in(annotation)] or models
    return path.lstrip("."), known


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for a in get_args(annotation) for m in _models_in(a)]


MOST_POSES: Final = 200_000
"""Over half an hour at 100 Hz."""

MOST_ROWS: Final = 1_000_000
"""Nearly three hours of slots at 100 Hz; in memory they take 0.2 GB."""

Folders = Iterable[str | os.PathLike[str]]


def fill_in(table: dict[str, Any], scenario: Path, folders: Folders = ()) -> None:
    """Read the files that a scenario's tables name, in place; raises `ScenarioError`. Other values are left alone.

    Files lie in the scenario's folder, in one of `folders`, or below one of these.
    """
    sections: dict[str, Any] = {name: table.get(name) for name in ("radio", "ranging")}
    for name in ("bodies", "tags"):
        rows = table.get(name)
        sections |= {f"{name}[{k}]": row for k, row in enumerate(rows if isinstance(rows, list) else ())}
    for place, section in sections.items():
        for key, (model, read) in READERS_OF_FILES.items():
            named = section.get(key) if isinstance(section, dict) else None
            if isinstance(named, dict) and "file" in named and named.get("model") == model:
                where = f"{scenario}: {place}.{key}.file"
                if not isinstance(named["file"], str):
                    raise ScenarioError(f"{where}: found {named['file']!r}, expected the name of a file")
                path = scenario.parent / named["file"]
                check_linked(path, f"{where}: found {named['file']!r}", scenario.parent, tuple(folders))
                # A table of antenna gains has no key of its own for its file.
                section[key] = ({} if key == "antenna" else named) | read(path, key, named)


def check_linked(path: Path, where: str, beside: Path, folders: Folders) -> None:
    """Check a file that another file names; raises `ScenarioError`, which begins with `where`.

    It must be a regular file of text in the folder `beside` or one of `folders`, or below, or a recording there.
    """
    try:
        place = path.resolve()
        inside = any(place.is_relative_to(Path(folder).resolve()) for folder in (beside, *folders))
    except (OSError, RuntimeError, ValueError) as error:  # a circle of links, a NUL
        raise ScenarioError(f"{where}, but there is no such file beside the scenario") from error
    if not inside:
        # The message does not reveal whether the file exists.
        raise ScenarioError(
            f"{where}, which is not in the folder of the file that names it, nor below; allow other "
            f"folders with `allow_files`"
        )
    if not place.exists():
        raise ScenarioError(f"{where}, but there is no such file beside the scenario")
    if not place.is_file():
        raise ScenarioError(f"{where}, which is no regular file")
    # Twice what `MOST_POSES` take as text, at eight numbers of twenty digits.
    most = 64_000_000
    if place.suffix != SUFFIX and (size := place.stat().st_size) > most:
        raise ScenarioError(f"{where}, which has {size} bytes; at most {most} are read")


def _rows(path: Path, *columns: str) -> list[list[float]]:
    """Return the rows of a CSV file, with these columns; lines that begin with # are comments."""
    with (
        raising(ScenarioError, f"{path}: cannot be read as a table", OSError, UnicodeDecodeError, csv.Error),
        path.open(encoding="utf-8-sig", newline="") as file,
    ):
        reader = csv.DictReader(line for line in file if not line.startswith("#"))
        missing = [c for c in columns if c not in (reader.fieldnames or [])]
        if missing:
            raise ScenarioError(f"{path}: column {missing[0]!r} is missing; expected {', '.join(columns)}")
        some = islice(reader, MOST_ROWS + 1)
        rows = [[_number(path, reader.line_num, c, row[c]) for c in columns] for row in some]
    if not 0 < len(rows) <= MOST_ROWS:
        raise ScenarioError(f"{path}: found {'more' if rows else 'no'} rows, expected 1 to {MOST_ROWS}")
    return rows


def _number(path: Path, line: int, column: str, cell: str | None) -> float:
    if not math.isfinite(value := number_in(cell or "")):
        raise ScenarioError(f"{path}: row {line}: column {column!r}: found {cell!r}, expected a number")
    return value


def _grid(path: Path, name: str) -> dict[str, Any]:
    """Read rows of azimuth_deg, elevation_deg and a value into a full grid."""
    rows = _rows(path, "azimuth_deg", "elevation_deg", name)
    azimuth, elevation = (sorted({row[k] for row in rows}) for k in (0, 1))
    found = {(row[0], row[1]): row[2] for row in rows}
    if len(found) != len(rows):
        raise ScenarioError(f"{path}: two rows are for the same direction")
    for a, e in product(azimuth, elevation):
        if (a, e) not in found:
            raise ScenarioError(f"{path}: a hole in the table: no {name} at azimuth {a:g}, elevation {e:g} degrees")
    values = [[found[a, e] for e in elevation] for a in azimuth]
    return {"azimuth_deg": azimuth, "elevation_deg": elevation, name: values}


def _profile(path: Path, key: str, *_: Any) -> dict[str, Any]:
    times_s, values = zip(*_rows(path, "time_s", key), strict=True)
    return {"times_s": times_s, "values": values}


def _trajectory(path: Path, _key: str, named: Mapping[str, Any]) -> dict[str, Any]:
    # With it come all importers, which few scenarios need.
    from uwblink.importers.poses import read_poses

    body = named.get("body")
    with restating(ScenarioError, UwblinkError):
        if path.suffix == SUFFIX:
            with Recording.open(path) as recording:
                poses = recording.poses()
        else:
            poses = read_poses(path, body if path.suffix in (".tum", ".txt") else None)
    names = sorted(set(poses.body.tolist()))
    body = names[0] if body is None and len(names) == 1 else body
    if body not in names:
        raise ScenarioError(f"{path}: found body {body!r}, the file has {', '.join(names) or 'none'}")
    one = poses[np.flatnonzero(poses.body == body)[:MOST_POSES]]
    return {
        "times_s": ((one.time_ns - one.time_ns[0]) * 1e-9).tolist(),
        "positions_m": one.position_m.tolist(),
        "quaternions": one.quaternion.tolist(),
    }


READERS_OF_FILES: Final[dict[str, tuple[str | None, Callable[[Path, str, Mapping[str, Any]], dict[str, Any]]]]] = {
    "antenna": (None, lambda path, *_: _grid(path, "gain_db")),
    "plan": (None, lambda path, *_: {"slots": _rows(path, "time_s", "initiator", "target")}),
    "group_delay": ("table", lambda path, *_: _grid(path, "delay_cm")),
    "motion": ("recorded", _trajectory),
    "temperature_c": ("table", _profile),
    "supply_v": ("table", _profile),
}
"""Keys whose tables can name a file, of which model these tables are then, and what the file holds.

Readers are called with the file, the key and its table.
"""
