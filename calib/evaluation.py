"""How well a calibration does on ranges with known truth: tables by pair and overall."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Applied, Calibration
from calib.dataset import Ranges

Floats = NDArray[np.float64]

STAGES: Final = {"raw": "raw_m", "delays": "delays_m", "full": "full_m"}
CHI_SQUARE_95: Final = 3.841458820694124
"""95 % quantile of the chi-square distribution with one degree of freedom."""


@dataclass(frozen=True, slots=True)
class Stats:
    """Statistics of range errors in metres; `robust_std_m` is 1.4826 median absolute deviations."""

    n: int
    mean_m: float
    median_m: float
    std_m: float
    robust_std_m: float


@dataclass(frozen=True, slots=True)
class Group:
    """A pair, or all pairs: statistics in the three stages, and the chi-square test.

    `rejected` is the share of fully corrected errors whose square exceeds the 95 % quantile of
    chi-square times sigma squared, `accepted` the statistics of the others.
    """

    raw: Stats
    delays: Stats
    full: Stats
    rejected: float
    accepted: Stats
    clamped: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The outcome for all ranges and for each pair, named "smaller-larger"."""

    overall: Group
    pairs: dict[str, Group]

    def to_dict(self) -> dict[str, Any]:
        """Return what `calib evaluate --json` prints."""
        return {
            "overall": _plain(asdict(self.overall)),
            "pairs": {name: _plain(asdict(group)) for name, group in self.pairs.items()},
        }


def _plain(value: Any) -> Any:
    """JSON has no NaN: a figure of nothing is null."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and value != value else value


def evaluate(ranges: Ranges, calibration: Calibration) -> Evaluation:
    """Evaluate a calibration; raises what `Calibration.apply` raises."""
    applied = calibration.apply(ranges)
    everything = np.ones(len(ranges), dtype=bool)
    return Evaluation(
        _group(ranges, applied, everything),
        {name: _group(ranges, applied, rows) for name, rows in pair_rows(ranges).items()},
    )


def pair_rows(ranges: Ranges) -> dict[str, NDArray[np.bool_]]:
    """Return which ranges belong to each pair of tags, whoever initiated."""
    low = np.minimum(ranges.initiator, ranges.target)
    high = np.maximum(ranges.initiator, ranges.target)
    found = sorted(set(zip(low.tolist(), high.tolist(), strict=True)))
    return {f"{a}-{b}": (low == a) & (high == b) for a, b in found}


def statistics(error_m: Floats) -> Stats:
    """Return the statistics of range errors (n,); NaN where there are none."""
    if not len(error_m):
        return Stats(0, *[float("nan")] * 4)
    median = float(np.median(error_m))
    return Stats(
        len(error_m),
        float(np.mean(error_m)),
        median,
        float(np.std(error_m)),
        1.4826 * float(np.median(np.abs(error_m - median))),
    )


def _group(ranges: Ranges, applied: Applied, rows: NDArray[np.bool_]) -> Group:
    truth = ranges.truth_m[rows]
    errors = {name: getattr(applied, field)[rows] - truth for name, field in STAGES.items()}
    outside = (errors["full"] / applied.sigma_m[rows]) ** 2 > CHI_SQUARE_95
    return Group(
        **{name: statistics(error) for name, error in errors.items()},
        rejected=float(np.mean(outside)),
        accepted=statistics(errors["full"][~outside]),
        clamped=float(np.mean(applied.clamped[rows])),
    )
