"""Design of a sweep: a grid, a Latin hypercube or a list over any keys of a scenario, with several seeds."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from uwblink.protocols.table import PROTOCOLS
from uwblink.text_files import read_text
from uwbsim.errors import ScenarioError, UnknownKeyError
from uwbsim.random_streams import stream
from uwbsim.scenario.loading import Folders, check_linked, load, parse_toml, shipped_scenarios, validated
from uwbsim.scenario.ranging import ProtocolName

MOST_RUNS: Final = 10_000_000
"""Runs of a sweep, seeds and values of a Latin hypercube at most: their numbers fit into memory."""

EVALUATORS: Final = "uwbcal.evaluators"
"""Entry points: functions of a flight that return columns of results."""

Count = Annotated[int, Field(strict=True, ge=1, le=MOST_RUNS)]


def evaluators() -> dict[str, EntryPoint]:
    """Return the evaluations of flights that installed distributions offer, by the kind of sweep."""
    return {entry.name: entry for entry in entry_points(group=EVALUATORS)}


def _known_kind(kind: str) -> str:
    known = ["calibrate", "compare", *sorted(evaluators().keys() - {"calibrate"})]
    if kind not in known:
        raise ValueError(f"found {kind!r}, expected {', '.join(known)}, or a name in the entry points of {EVALUATORS}")
    return kind


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SweepSettings(_Table):
    """The table [sweep] of the file of a sweep."""

    name: str | None = Field(None, description="Name of the sweep; by default that of the file.")
    scenario: str = Field(
        description="The scenario to vary: a file relative to the folder of this one, or the name of a shipped one."
    )
    kind: Annotated[str, AfterValidator(_known_kind)] = Field(
        "compare",
        description="Task of a run: compare protocols; calibrate, which simulates a flight, calibrates and evaluates "
        "it; or the name of an evaluation of an installed distribution.",
    )
    protocols: Annotated[tuple[ProtocolName, ...], Field(min_length=1)] | None = Field(
        None, description='The protocols of each run; by default all, or ["ds"] to calibrate.'
    )
    ranges: Count = Field(100_000, description="Ranges per protocol and run.")
    seeds: Count | Annotated[tuple[Annotated[int, Field(strict=True, ge=0)], ...], Field(min_length=1)] = Field(
        1, description="Number of seeds per point, or a list of seeds."
    )
    design: Literal["grid", "latin-hypercube", "list"] = Field(
        "grid", description="All combinations of values; points spread over spans; or a list of points."
    )
    samples: Count = Field(16, description="Points of a Latin hypercube.")


class Span(_Table):
    """The span of a key in a Latin hypercube."""

    low: float = Field(strict=True, description="The lower end of the span.")
    high: float = Field(strict=True, description="The upper end of the span.")
    scale: Literal["linear", "log"] = Field("linear", description="Distribution of points over the span.")
    whole: bool | None = Field(None, description="Whether values are whole numbers; by default if low and high are.")


class SweepFile(_Table):
    """The file of a sweep."""

    sweep: SweepSettings = Field(description="Task of the runs, and their number.")
    vary: dict[str, Any] = Field(
        {},
        description='By key of the scenario, such as "radio.tx_noise_ps": a list of values of a grid, or the span of '
        "a Latin hypercube: a table of low, high, scale (linear or log) and whole (whether values are whole numbers).",
    )
    points: list[dict[str, Any]] = Field(
        [], alias="list", description="Of a list: a table a point, of values by key of the scenario."
    )


@dataclass(frozen=True, slots=True)
class Run:
    """One run: its number, the values of what varies, and the seed.

    Workers get it with the `scenario` as JSON, or with the `error` that these values gave.
    """

    number: int
    values: dict[str, Any]
    seed: int
    scenario: str = ""
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepDesign:
    """A sweep as in its file; its runs are all combinations of a choice from each of the `axes`.

    A choice is the values of some keys. A grid has an axis for each key; a list or a Latin hypercube is a single axis.
    """

    path: Path
    settings: SweepSettings
    protocols: tuple[str, ...]
    scenario: Path
    seeds: tuple[int, ...]
    axes: list[list[dict[str, Any]]]
    fingerprint: str
    allow_files: tuple[str | os.PathLike[str], ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the sweep."""
        return self.settings.name or self.path.stem

    @property
    def points(self) -> int:
        """Return how many combinations of values there are."""
        return math.prod(map(len, self.axes))

    @property
    def keys(self) -> list[str]:
        """Return the keys of the scenario that vary."""
        return list(dict.fromkeys(key for axis in self.axes for choice in axis for key in choice))

    @property
    def total(self) -> int:
        """Return how many runs there are."""
        return self.points * len(self.seeds)

    def run(self, number: int) -> Run:
        """Return a run by its number, 0 to `total` - 1; made when asked for, so that any number of runs fits."""
        point, seed = divmod(number, len(self.seeds))
        places = np.unravel_index(point, [len(axis) for axis in self.axes])
        choices = [axis[int(k)] for axis, k in zip(self.axes, places, strict=True)]
        return Run(number, {key: value for choice in choices for key, value in choice.items()}, self.seeds[seed])

    def loaded(self, number: int) -> Run:
        """Return a run with its scenario; one that cannot be is an error that travels with it."""
        run = self.run(number)
        try:
            scenario = load(self.scenario, run.values, run.seed, allow_files=self.allow_files)
        except ScenarioError as error:
            # Where the file lies is no part of a result.
            return replace(run, error=str(error).removeprefix(f"{self.scenario}: "))
        return replace(run, scenario=scenario.model_dump_json())


def load_design(path: str | os.PathLike[str], *, allow_files: Folders = ()) -> SweepDesign:
    """Read the design of a sweep (.toml), without running it.

    Its scenario, unless it is a shipped one, lies in the folder of the file or below, and the files that the
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
    file = validated(SweepFile, parse_toml(text, path), path)
    settings = file.sweep
    scenario, shipped = path.parent / settings.scenario, shipped_scenarios()
    name = settings.scenario.removesuffix(".toml")
    if name in shipped and not scenario.exists():
        scenario = shipped[name]
    else:
        check_linked(scenario, f"{path}: sweep.scenario: found {settings.scenario!r}", path.parent, folders)
    known = read_text(scenario, ScenarioError, "scenario file (.toml)")
    seeds = settings.seeds
    plan = SweepDesign(
        path=path,
        settings=settings,
        protocols=settings.protocols or (tuple(PROTOCOLS) if settings.kind == "compare" else ("ds",)),
        scenario=scenario,
        seeds=tuple(range(1, seeds + 1)) if isinstance(seeds, int) else seeds,
        axes=_axes(path, file),
        # What a result depends on besides its number: the plan's text and the scenario's.
        fingerprint=hashlib.sha256(text.encode() + b"\0" + known.encode()).hexdigest(),
        allow_files=folders,
    )
    if plan.total > MOST_RUNS:
        raise ScenarioError(f"{path}: {plan.total} runs are too many, at most {MOST_RUNS}")
    _check_keys(plan)
    return plan


def _axes(path: Path, file: SweepFile) -> list[list[dict[str, Any]]]:
    if file.sweep.design == "list":
        if file.vary or not file.points:
            raise ScenarioError(f"{path}: a list needs tables [[list]], and no [vary]")
        return [file.points]
    if file.points:
        raise ScenarioError(f'{path}: list: can only be used with design = "list"')
    if file.sweep.design == "latin-hypercube":
        return [_hypercube(path, file)]
    for key, values in file.vary.items():
        if not isinstance(values, list) or not values:
            raise ScenarioError(f"{path}: vary: {key}: found {values!r}, expected a list of values")
    return [[{key: value} for value in values] for key, values in file.vary.items()]


def _hypercube(path: Path, file: SweepFile) -> list[dict[str, Any]]:
    """Return points of which every axis has one in each of its equal parts, in an order of its own."""
    samples = file.sweep.samples
    if samples * len(file.vary) > MOST_RUNS:
        raise ScenarioError(
            f"{path}: sweep.samples: {samples} of {len(file.vary)} keys, at most {MOST_RUNS} values are made"
        )
    columns: dict[str, list[Any]] = {}
    for key, table in file.vary.items():
        where = f"{path}: vary: {key}"
        if not isinstance(table, Mapping):
            raise ScenarioError(f'{where}: expected {{ low = ..., high = ..., scale = "log" }}')
        span = validated(Span, table, where)
        low, high = table["low"], table["high"]
        if not low < high or (span.scale == "log" and low <= 0):
            raise ScenarioError(f"{where}: expected low below high, both above zero where scale is log")
        # A stream a key: another key more changes nothing in this one's values.
        rng = stream(0, "latin hypercube", key)
        share = (rng.permutation(samples) + rng.random(samples)) / samples
        values = low * (high / low) ** share if span.scale == "log" else low + (high - low) * share
        whole = isinstance(low, int) and isinstance(high, int) if span.whole is None else span.whole
        columns[key] = [round(v) if whole else float(v) for v in values.tolist()]
    return [dict(zip(columns, point, strict=True)) for point in zip(*columns.values(), strict=True)] or [{}]


def _check_keys(plan: SweepDesign) -> None:
    """Load the scenario with one value of each key, so that a key which is not there is found before anything runs."""
    load(plan.scenario, allow_files=plan.allow_files)
    first = {key: value for axis in plan.axes for choice in reversed(axis) for key, value in choice.items()}
    for key, value in first.items():
        try:
            load(plan.scenario, {key: value}, allow_files=plan.allow_files)
        except UnknownKeyError as error:
            raise ScenarioError(f"{plan.path}: vary: {error}") from error
        except ScenarioError:
            # Its other values may be good: what this one does not allow is found when its run comes.
            continue
