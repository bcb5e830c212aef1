"""What can be wrong with stamps, ids and reported ranges."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.doctor.base import PLAUSIBLE_M, RecordingView
from calib.doctor.checks import Seen, more_often
from calib.doctor.protocols import sound_clocks
from uwblink.arrays import Bools
from uwblink.protocols.table import single_sided
from uwblink.ticks import SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import board_range, intervals

FARTHEST_M: Final = 50.0
CONTRADICTS_M: Final = 0.01
LEAST_CORRUPT: Final = 0.001
"""Share of damaged rows of a sound recording."""

MOST_CORRUPT: Final = 0.5
VACUUM_OVER_AIR: Final = 299_792_458.0 / SPEED_OF_LIGHT


def ticks(view: RecordingView) -> Iterator[Seen]:
    """Stamps in nanoseconds taken for ticks make every duration 64 times too short."""
    spans, third = intervals(view.exchanges), view.exchanges.tx3 != 0
    legs = [float(np.median(spans.dt41)), float(np.median(spans.dt53[third])) if third.any() else 0.0]
    longest = max(legs) / TICKS_PER_SECOND
    per_ns = TICKS_PER_SECOND * 1e-9
    if longest < 60e-6 and longest * per_ns > 150e-6 and len(np.unique(view.exchanges.tx1 % 512)) > 8:
        yield Seen(
            "unit slip",
            f"the longest leg of an exchange lasts {longest * 1e6:.1f} µs, too short for a frame; "
            f"read as nanoseconds it would be {longest * per_ns * 1e6:.0f} µs",
        )


def single_as_double(view: RecordingView) -> Iterator[Seen]:
    """Double-sided exchanges without a third message."""
    e = view.exchanges
    empty = ~np.isin(e.protocol, single_sided()) & (e.tx3 == 0) & (e.rx3 == 0)
    if empty.mean() > 0.5:
        yield Seen(
            "single-sided data taken for double-sided",
            f"{100 * empty.mean():.0f} % of the double-sided exchanges have no third message",
        )


def impossible(view: RecordingView) -> Bools:
    """Return which exchanges are impossible, or contradict their reported range or the clocks of their pair (n,)."""
    e = view.exchanges
    with np.errstate(all="ignore"):
        said = np.abs(board_range(e) - e.range_m)
        bad = ~(np.abs(view.raw_m) < PLAUSIBLE_M) | ~sound_clocks(e) | (e.initiator == e.target)
        away = np.abs(view.error_m) > FARTHEST_M
    if not _is_scaled(view):
        bad |= np.isfinite(said) & (said > CONTRADICTS_M)
    # Where most are far off, something else is wrong with all of them.
    return np.asarray(bad | away if np.mean(away) < MOST_CORRUPT else bad)


def with_itself(view: RecordingView) -> Iterator[Seen]:
    """Exchanges of a tag with itself, which no radio makes."""
    e = view.exchanges
    same = e.initiator == e.target
    if same.any():
        tags = ", ".join(map(str, np.unique(e.initiator[same])[:6].tolist()))
        told = f"{np.count_nonzero(same)} of {len(e)} exchanges have one tag at both ends ({tags})"
        yield Seen("a tag with itself", told)


def doubled(view: RecordingView) -> Iterator[Seen]:
    """Rows that repeat another one: two robots log an exchange, and both logs were imported."""
    if view.doubled:
        told = f"{view.doubled} of {view.doubled + len(view.exchanges)} rows repeat another one"
        yield Seen("doubled exchanges", told)


def corrupted(view: RecordingView) -> Iterator[Seen]:
    """Exchanges that are impossible, or contradict themselves; the other examinations do without them."""
    bad = impossible(view)
    count = int(np.count_nonzero(bad))
    if count < MOST_CORRUPT * len(bad):
        yield Seen(
            "corrupted exchanges",
            f"{count} of {len(bad)} exchanges have impossible stamps, or stamps that contradict the "
            "range reported with them or the clocks of their pair; what else is said here is said without them",
            more_often(count, len(bad), LEAST_CORRUPT),
        )


def _is_scaled(view: RecordingView) -> bool:
    ratio = view.exchanges.range_m / view.raw_m
    good = np.isfinite(ratio) & (np.abs(view.raw_m) > 1)
    return bool(good.any() and abs(np.median(ratio[good]) - 1) > 1e-4)


def speed_of_light(view: RecordingView) -> Iterator[Seen]:
    """Reported ranges that were computed with the speed of light in vacuum."""
    e = view.exchanges
    good = np.isfinite(e.range_m) & (np.abs(view.raw_m) > 1)
    if np.count_nonzero(good) < 100:
        return
    ratio = float(np.median(e.range_m[good] / view.raw_m[good]))
    if abs(ratio / VACUUM_OVER_AIR - 1) < 5e-5:
        told = f"reported ranges are {ratio:.5f} times those from the stamps: 299 792 458 m/s instead of 299 702 547"
        yield Seen("speed of light in vacuum", told)


def contradicting(view: RecordingView) -> Iterator[Seen]:
    """Initiator and target that report one exchange differently: they print the same numbers, so a line was damaged."""
    if view.contradictions:
        yield Seen(
            "contradicting reports",
            f"both ends reported {view.reported_twice} exchanges, {len(view.contradictions)} of them differently; "
            f"the first: {view.contradictions[0]}",
        )
