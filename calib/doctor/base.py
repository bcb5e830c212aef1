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
    """A fault: its name, what shows it, what to do, and how sure the doctor is (0 to 1)."""

    fault: str
    evidence: str
    remedy: str
    confidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingView:
    """A recording as the examinations see it; `truth_m` (n,) is NaN where nothing says it.

    Each exchange is there once; `reported_twice` were reported by both ends, and `contradictions` say how two reports
    of one differ. `arrangements` are those that the recording marks.
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
    pair = pair_ids(view.exchanges)
    good = np.isfinite(error)
    parts = [v - np.median(v) for p in np.unique(pair[good]) if len(v := error[good & (pair == p)]) > 10]
    return robust_spread(np.concatenate(parts), 0.0) if parts else float("inf")


def pair_ids(e: Exchanges) -> Ints:
    """Return one number for each pair of tags, whoever initiated, shape (n,)."""
    return np.asarray(np.minimum(e.initiator, e.target) * 65_536 + np.maximum(e.initiator, e.target))


def plausible_share(raw_m: Floats) -> float:
    """Return the share of ranges (n,) that a radio of this kind could measure."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.abs(raw_m) < PLAUSIBLE_M))
