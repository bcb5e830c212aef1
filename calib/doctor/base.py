"""A recording as the doctor sees it, and what the doctor says of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Arrangement, Fault, Poses, Tag
from uwblink.twr import Exchanges

PLAUSIBLE_M: Final = 1000.0


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault: its name, what shows it, what to do, and how likely sound data would show as much.

    `p_value` is 0 where no chance is involved: numbers that contradict each other, or a design that leaves unknowns.
    """

    fault: str
    evidence: str
    remedy: str
    p_value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingView:
    """A recording as the examinations see it; `truth_m` (n,) is NaN where nothing says it.

    Each exchange is there once; `reported_twice` were reported by both ends, and `contradictions` say how two reports
    of one differ; `doubled` rows repeated another one. It is `posed` where true distances come from poses.
    `arrangements` are those that it marks.
    """

    name: str
    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    raw_m: Floats
    truth_m: Floats
    reported_twice: int = 0
    contradictions: tuple[str, ...] = ()
    doubled: int = 0
    posed: bool = False
    arrangements: tuple[Arrangement, ...] = ()

    @property
    def standing(self) -> bool:
        """Whether this was recorded to be surveyed: arrangements of boards, and nothing that says where they were."""
        return bool(self.arrangements) and not len(self.poses) and not np.isfinite(self.truth_m).any()

    @property
    def error_m(self) -> Floats:
        """Range less truth, shape (n,)."""
        return self.raw_m - self.truth_m


def chosen(view: RecordingView, rows: Bools) -> RecordingView:
    """Return a view of some exchanges."""
    return replace(view, exchanges=view.exchanges[rows], raw_m=view.raw_m[rows], truth_m=view.truth_m[rows])


def spread_m(view: RecordingView, truth_m: Floats | None = None, raw_m: Floats | None = None) -> float:
    """Robust spread of errors after each pair's own median, metres; infinity where nothing is known."""
    error = (view.raw_m if raw_m is None else raw_m) - (view.truth_m if truth_m is None else truth_m)
    left = less_pairs(view, error)
    good = np.isfinite(left)
    return robust_spread(left[good], 0.0) if good.any() else float("inf")


def less_pairs(view: RecordingView, error_m: Floats) -> Floats:
    """Return errors (n,) less the median of their pair, NaN for pairs with ten or fewer."""
    pair = pair_ids(view.exchanges)
    left = np.full(len(error_m), np.nan)
    good = np.isfinite(error_m)
    for p in np.unique(pair[good]):
        rows = good & (pair == p)
        if np.count_nonzero(rows) > 10:
            left[rows] = error_m[rows] - np.median(error_m[rows])
    return left


def pair_ids(e: Exchanges) -> Ints:
    """Return one number for each pair of tags, whoever initiated, shape (n,)."""
    return np.asarray(np.minimum(e.initiator, e.target) * 65_536 + np.maximum(e.initiator, e.target))


def plausible_share(raw_m: Floats) -> float:
    """Return the share of ranges (n,) that a radio of this kind could measure."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.abs(raw_m) < PLAUSIBLE_M))
