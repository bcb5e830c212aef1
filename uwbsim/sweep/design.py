"""What a sweep varies: a grid, a Latin hypercube or a list over any keys of a scenario, several seeds each."""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.protocols.table import PROTOCOLS
from uwblink.text_files import FileKey, read_text
from uwbsim.errors import ScenarioError, UnknownKeyError
from uwbsim.random_streams import stream
from uwbsim.scenario.linked_files import Folders, check_linked
from uwbsim.scenario.loading import SUFFIX, load, parse_toml, shipped_scenarios

MOST_RUNS: Final = 10_000_000
"""Runs of a sweep, seeds and values of a Latin hypercube at most: their numbers fit into memory."""

FILE_KEYS: Final = (
    FileKey("sweep.name", "text", "the name of the file", "What the sweep is called."),
    FileKey("sweep.scenario", "text", "needed", "The scenario that varies, from the folder of this file."),
    FileKey(
        "sweep.kind",
        '"compare" or "calibrate"',
        '"compare"',
        "What a run does: compare protocols, or simulate a flight, calibrate and judge.",
    ),
    FileKey("sweep.protocols", "list of protocols", 'all, or ["ds"] to calibrate', "The protocols of each run."),
    FileKey("sweep.ranges", "whole number, 1 to 10,000,000", "100000", "Ranges with each protocol in a run."),
    FileKey("sweep.seeds", "whole number, or list of them", "1", "How many seeds each point gets, or which."),
    FileKey(
        "sweep.design",
        '"grid", "latin-hypercube" or "list"',
        '"grid"',
        "Every combination of values; points spread over spans; or points one by one.",
    ),
    FileKey("sweep.samples", "whole number, 1 to 10,000,000", "16", "Points of a Latin hypercube."),
    FileKey(
        'vary."KEY"', "list of values", "none", "Of a grid: values of a key of the scenario, such as radio.tx_noise_ps."
    ),
    FileKey('vary."KEY".low', "number", "needed", "Of a Latin hypercube: the lower end of the span."),
    FileKey('vary."KEY".high', "number", "needed", "Of a Latin hypercube: the upper end of the span."),
    FileKey('vary."KEY".scale', '"linear" or "log"', '"linear"', "How points are spread over the span."),
    FileKey(
        'vary."KEY".whole', "true or false", "true where low and high are whole", "Whether values are whole numbers."
    ),
    FileKey('list[]."KEY"', "a value", "that of the scenario", "Of a list: the value of a key at one point."),
)
KEYS: Final = tuple(key.name.removeprefix("sweep.") for key in FILE_KEYS if key.name.startswith("sweep."))
"""Of the table [sweep]."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run: its number, the values of what varies, and the seed."""

    number: int
    values: dict[str, Any]
    seed: int

    def settings(self) -> list[str]:
        """Return the values as `--set` would have them."""
        return [f"{key}={toml_value(value)}" for key, value in self.values.items()]


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepDesign:
    """A sweep as its file has it, and where its runs come from: `axes` of a grid, or `rows` one by one."""

    path: Path
    name: str
    scenario: Path
    kind: str
    protocols: tuple[str, ...]
    ranges: int
    seeds: tuple[int, ...]
    axes: dict[str, list[Any]]
    rows: list[dict[str, Any]] | None
    fingerprint: str
    allow_files: tuple[str | os.PathLike[str], ...] = ()

    @property
    def points(self) -> int:
        """Return how many combinations of values there are."""
        return len(self.rows) if self.rows is not None else math.prod(len(v) for v in self.axes.values())

    @property
    def total(self) -> int:
        """Return how many runs there are."""
        return self.points * len(self.seeds)

    def run(self, number: int) -> Run:
        """Return a run by its number, 0 to `total` - 1; made when asked for, so that any number of runs fits."""
        point, seed = divmod(number, len(self.seeds))
        if self.rows is not None:
            return Run(number, self.rows[point], self.seeds[seed])
        places = np.unravel_index(point, [len(v) for v in self.axes.values()])
        values = {key: listed[int(k)] for (key, listed), k in zip(self.axes.items(), places, strict=True)}
        return Run(number, values, self.seeds[seed])


def load_design(path: str | os.PathLike[str], *, allow_files: Folders = ()) -> SweepDesign:
    """Read what a sweep varies (.toml); nothing is run yet, and runs are made when they are asked for by number.

    Its scenario, where it is none that comes along, lies in the folder of the file or below, and the files that the
    scenario names in that of the scenario; `allow_files` are other folders in which they may lie.

    Raises `ScenarioError` that says where, what, and the near key where one is misspelt.

    >>> from pathlib import Path
    >>> import uwbsim
    >>> _ = Path("two.toml").write_text(
    ...     "run = { duration_s = 2.0 }\\n"
    ...     "ranging = { rate_hz = 50.0 }\\n"
    ...     "tags = [{ id = 1, body = 'a' }, { id = 2, body = 'b' }]\\n"
    ...     "[[bodies]]\\nname = 'a'\\nmotion = { model = 'static', position_m = [0.0, 0.0, 2.0] }\\n"
    ...     "[[bodies]]\\nname = 'b'\\nmotion = { model = 'static', position_m = [5.0, 0.0, 2.0] }\\n"
    ... )
    >>> _ = Path("sweep.toml").write_text(
    ...     "sweep = { scenario = 'two.toml', protocols = ['ds'], ranges = 1000, seeds = 2 }\\n"
    ...     "[vary]\\n'radio.rx_noise_ps' = [50.0, 100.0, 200.0]\\n"
    ... )
    >>> design = uwbsim.load_design("sweep.toml")
    >>> design.total, design.run(5).values, design.run(5).seed
    (6, {'radio.rx_noise_ps': 200.0}, 2)
    """
    path, folders = Path(path), tuple(allow_files)
    text = read_text(path, ScenarioError, "file of a sweep (.toml)")
    table = parse_toml(text, path)
    unknown = sorted(set(table) - {"sweep", "vary", "list"})
    if unknown:
        raise ScenarioError(f"{path}: {unknown[0]}: unknown table; known are sweep, vary, list")
    head = table.get("sweep")
    if not isinstance(head, dict):
        raise ScenarioError(f"{path}: sweep: missing table [sweep]")
    for key in head:
        if key not in KEYS:
            near = difflib.get_close_matches(key, KEYS, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(KEYS)}"
            raise ScenarioError(f"{path}: sweep.{key}: unknown key; {hint}")
    scenario = _scenario(path, head, folders)
    design = _word(path, head, "design", ("grid", "latin-hypercube", "list"), "grid")
    kind = _word(path, head, "kind", ("compare", "calibrate"), "compare")
    protocols = head.get("protocols", list(PROTOCOLS) if kind == "compare" else ["ds"])
    named = isinstance(protocols, list) and all(isinstance(p, str) and p in PROTOCOLS for p in protocols)
    if not named or not protocols:
        raise ScenarioError(f"{path}: sweep.protocols: found {protocols!r}, allowed: {', '.join(PROTOCOLS)}")
    known = read_text(scenario, ScenarioError, "scenario file (.toml)")
    vary, listed = table.get("vary", {}), table.get("list", [])
    axes, rows = _points(path, head, design, vary, listed)
    plan = SweepDesign(
        path=path,
        name=str(head.get("name", path.stem)),
        scenario=scenario,
        kind=kind,
        protocols=tuple(protocols),
        ranges=_whole(path, head, "ranges", 100_000, 1, 10_000_000),
        seeds=_seeds(path, head),
        axes=axes,
        rows=rows,
        # What a result depends on besides its number: the plan's text and the scenario's.
        fingerprint=hashlib.sha256(text.encode() + b"\0" + known.encode()).hexdigest(),
        allow_files=folders,
    )
    if plan.total > MOST_RUNS:
        raise ScenarioError(f"{path}: {plan.total} runs are too many, at most {MOST_RUNS}")
    _check_keys(plan)
    return plan


def toml_value(value: Any) -> str:
    """Return a value as TOML has it."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def _scenario(path: Path, head: Mapping[str, Any], folders: Folders) -> Path:
    name = head.get("scenario")
    if not isinstance(name, str):
        raise ScenarioError(f"{path}: sweep.scenario: missing, expected a scenario file, relative to this one")
    beside = path.parent / name
    shipped = shipped_scenarios().get(name.removesuffix(SUFFIX))
    if shipped is not None and not beside.exists():
        return shipped
    return check_linked(beside, f"{path}: sweep.scenario: found {name!r}", path.parent, folders)


def _word(path: Path, head: Mapping[str, Any], key: str, allowed: Sequence[str], default: str) -> str:
    value = head.get(key, default)
    if value not in allowed:
        raise ScenarioError(f"{path}: sweep.{key}: found {value!r}, allowed: {', '.join(allowed)}")
    return str(value)


def _whole(path: Path, head: Mapping[str, Any], key: str, default: int, low: int, high: int) -> int:
    value = head.get(key, default)
    if type(value) is not int or not low <= value <= high:
        raise ScenarioError(f"{path}: sweep.{key}: found {value!r}, expected a whole number {low} to {high}")
    return value


def _seeds(path: Path, head: Mapping[str, Any]) -> tuple[int, ...]:
    value = head.get("seeds", 1)
    seeds = list(range(1, value + 1)) if type(value) is int and value <= MOST_RUNS else value
    if not isinstance(seeds, list) or not seeds or not all(type(s) is int and s >= 0 for s in seeds):
        raise ScenarioError(f"{path}: sweep.seeds: found {value!r}, expected a number of seeds or a list of them")
    return tuple(seeds)


def _points(
    path: Path, head: Mapping[str, Any], design: str, vary: Any, listed: Any
) -> tuple[dict[str, list[Any]], list[dict[str, Any]] | None]:
    if design == "list":
        if vary or not isinstance(listed, list) or not listed or not all(isinstance(r, dict) for r in listed):
            raise ScenarioError(f"{path}: a list needs tables [[list]], and no [vary]")
        return {}, listed
    if listed:
        raise ScenarioError(f'{path}: list: goes with design = "list"')
    if not isinstance(vary, dict):
        raise ScenarioError(f"{path}: vary: expected a table")
    if design == "grid":
        for key, values in vary.items():
            if not isinstance(values, list) or not values:
                raise ScenarioError(f"{path}: vary: {key}: found {values!r}, expected a list of values")
        return vary, None
    return {}, _hypercube(path, head, vary)


def _hypercube(path: Path, head: Mapping[str, Any], vary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return points of which every axis has one in each of its equal parts, in an order of its own."""
    samples = _whole(path, head, "samples", 16, 1, MOST_RUNS)
    if samples * len(vary) > MOST_RUNS:
        raise ScenarioError(
            f"{path}: sweep.samples: {samples} of {len(vary)} keys, at most {MOST_RUNS} values are made"
        )
    columns: dict[str, list[Any]] = {}
    for key, span in vary.items():
        if not isinstance(span, dict) or not {"low", "high"} <= set(span) <= {"low", "high", "scale", "whole"}:
            raise ScenarioError(f'{path}: vary: {key}: expected {{ low = ..., high = ..., scale = "log" }}')
        low, high, scale = span["low"], span["high"], span.get("scale", "linear")
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (low, high))
        if not numbers or not low < high or scale not in ("linear", "log") or (scale == "log" and low <= 0):
            raise ScenarioError(f"{path}: vary: {key}: expected low below high, both above zero where scale is log")
        # A stream a key: another key more changes nothing in this one's values.
        rng = stream(0, "latin hypercube", key)
        share = (rng.permutation(samples) + rng.random(samples)) / samples
        values = low * (high / low) ** share if scale == "log" else low + (high - low) * share
        whole = span.get("whole", isinstance(low, int) and isinstance(high, int))
        columns[key] = [round(v) if whole else float(v) for v in values.tolist()]
    return [dict(zip(columns, point, strict=True)) for point in zip(*columns.values(), strict=True)] or [{}]


def _check_keys(plan: SweepDesign) -> None:
    """Load the scenario with one value of each key, so that a key which is not there is found before anything runs."""
    load(plan.scenario, allow_files=plan.allow_files)
    first = {key: listed[0] for key, listed in plan.axes.items()}
    for row in reversed(plan.rows or []):
        first |= row
    for key, value in first.items():
        try:
            load(plan.scenario, [f"{key}={toml_value(value)}"], allow_files=plan.allow_files)
        except UnknownKeyError as error:
            raise ScenarioError(f"{plan.path}: vary: {error}") from error
        except ScenarioError:
            # Its other values may be good: what this one does not allow is found when its run comes.
            continue
