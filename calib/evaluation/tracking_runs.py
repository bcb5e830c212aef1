"""What filters of several bodies are given, side by side, so that all run at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.evaluation.range_updates import RangeErrors
from calib.evaluation.tracking import Settings
from calib.evaluation.tracking_problem import Noise, Problem, velocity_spread
from uwblink.arrays import Floats, Ints


@dataclass(frozen=True, slots=True)
class FilterRanges:
    """What a filter measures (n,), its standard deviation (n,), and what errors are made of if it reckons with it."""

    measured_m: Floats
    std_m: Floats
    errors: RangeErrors | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """A body, what some filters measure of it, by name, and the noises that each is run with."""

    problem: Problem
    ranges: Mapping[str, FilterRanges]
    noises: Sequence[Noise]


@dataclass(frozen=True, slots=True, kw_only=True)
class Beside:
    """What several runs are given, side by side: times (n,) first, then filters, then a column a body and noise.

    Runs that end before the longest one stand still then, and go on measuring what they measured last.
    """

    body: Ints
    """Which body each column is of."""

    measured_m: Floats
    variance_m2: Floats
    moves: Floats
    spread_m2: Floats
    place: Floats
    arm: Floats
    other: Floats
    errors: list[RangeErrors | None]
    """Of each filter, `share` and `detour_m` by time and body."""

    @classmethod
    def of(cls, runs: Sequence[Run], settings: Settings) -> Beside:
        """Put runs side by side."""
        noises = [noise for run in runs for noise in run.noises]
        each = [len(run.noises) for run in runs]
        ranges = [list(run.ranges.values()) for run in runs]
        count = max(len(run.problem.rows) for run in runs)
        measured = _filled([np.array([one.measured_m for one in own]).T for own in ranges], count)
        std = _filled([np.array([one.std_m for one in own]).T for own in ranges], count)
        return cls(
            body=np.repeat(np.arange(len(runs)), each),
            measured_m=measured,
            variance_m2=std**2,
            moves=_filled([np.concatenate([noise.moves, np.zeros((1, 3))]) for noise in noises], count + 1),
            spread_m2=_filled([np.append(velocity_spread(run.problem, settings), 0.0) for run in runs], count + 1),
            place=_filled([run.problem.place for run in runs], count),
            arm=_filled([run.problem.arm for run in runs], count),
            other=_filled([run.problem.other for run in runs], count),
            errors=[_errors([one.errors for one in own], count) for own in zip(*ranges, strict=True)],
        )


def _filled(parts: Sequence[Floats], count: int) -> Floats:
    """Return arrays (some, ...) side by side (count, parts, ...), each with its last row where it has none."""
    return np.stack([part[np.minimum(np.arange(count), len(part) - 1)] for part in parts], axis=1)


def _errors(parts: Sequence[RangeErrors | None], count: int) -> RangeErrors | None:
    known = [part for part in parts if part is not None]
    if not known:
        return None
    share = _filled([np.asarray(part.share) for part in known], count)
    return replace(known[0], share=share, detour_m=_filled([np.asarray(part.detour_m) for part in known], count))
