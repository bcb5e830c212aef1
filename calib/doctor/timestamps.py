"""What can be wrong with stamps, ids and reported ranges."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.doctor.base import PLAUSIBLE_M, Finding, RecordingView, pair_ids
from calib.doctor.protocols import sound_clocks
from uwblink.arrays import Bools
from uwblink.protocols.table import single_sided
from uwblink.ticks import SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import board_range, intervals

FARTHEST_M: Final = 50.0
CONTRADICTS_M: Final = 0.01
FEWEST_CORRUPT: Final = 3
LEAST_CORRUPT: Final = 0.002
MOST_CORRUPT: Final = 0.5
VACUUM_OVER_AIR: Final = 299_792_458.0 / SPEED_OF_LIGHT


def units(view: RecordingView) -> Iterator[Finding]:
    """Stamps in nanoseconds taken for ticks make every duration 64 times too short."""
    spans, third = intervals(view.exchanges), view.exchanges.tx3 != 0
    legs = [float(np.median(spans.dt41)), float(np.median(spans.dt53[third])) if third.any() else 0.0]
    longest = max(legs) / TICKS_PER_SECOND
    per_ns = TICKS_PER_SECOND * 1e-9
    if longest < 60e-6 and longest * per_ns > 150e-6 and len(np.unique(view.exchanges.tx1 % 512)) > 8:
        yield Finding(
            "unit slip",
            f"the longest leg of an exchange lasts {longest * 1e6:.1f} µs, too short for a frame; "
            f"read as nanoseconds it would be {longest * per_ns * 1e6:.0f} µs",
            'the stamps are nanoseconds, not ticks: import again with [units] stamps = "ns"',
            0.95,
        )


def single_as_double(view: RecordingView) -> Iterator[Finding]:
    """Double-sided exchanges without a third message."""
    e = view.exchanges
    empty = ~np.isin(e.protocol, single_sided()) & (e.tx3 == 0) & (e.rx3 == 0)
    if empty.mean() > 0.5:
        yield Finding(
            "single-sided data taken for double-sided",
            f"{100 * empty.mean():.0f} % of the double-sided exchanges have no third message",
            'import again with protocol = "ss"',
            0.98,
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


def with_itself(view: RecordingView) -> Iterator[Finding]:
    """Exchanges of a tag with itself, which no radio makes."""
    e = view.exchanges
    same = e.initiator == e.target
    if same.any():
        tags = ", ".join(map(str, np.unique(e.initiator[same])[:6].tolist()))
        yield Finding(
            "a tag with itself",
            f"{np.count_nonzero(same)} of {len(e)} exchanges have one tag at both ends ({tags})",
            "import again with other columns for from_id and to_id; a fit leaves these exchanges out",
            0.97,
        )


def corrupted(view: RecordingView, bad: Bools) -> Iterator[Finding]:
    """Exchanges that are impossible, or contradict themselves; the other examinations do without them."""
    share = float(np.mean(bad))
    if np.count_nonzero(bad) >= FEWEST_CORRUPT and LEAST_CORRUPT < share < MOST_CORRUPT:
        yield Finding(
            "corrupted exchanges",
            f"{np.count_nonzero(bad)} of {len(bad)} exchanges have impossible stamps, or stamps that contradict the "
            "range reported with them or the clocks of their pair; what else is said here is said without them",
            "a robust fit leaves them out; check cables and USB load, and decode the recording again if it has bytes",
            0.9,
        )


def _is_scaled(view: RecordingView) -> bool:
    ratio = view.exchanges.range_m / view.raw_m
    good = np.isfinite(ratio) & (np.abs(view.raw_m) > 1)
    return bool(good.any() and abs(np.median(ratio[good]) - 1) > 1e-4)


def speed_of_light(view: RecordingView) -> Iterator[Finding]:
    """Reported ranges that were computed with the speed of light in vacuum."""
    e = view.exchanges
    good = np.isfinite(e.range_m) & (np.abs(view.raw_m) > 1)
    if np.count_nonzero(good) < 100:
        return
    ratio = float(np.median(e.range_m[good] / view.raw_m[good]))
    if abs(ratio / VACUUM_OVER_AIR - 1) < 5e-5:
        yield Finding(
            "speed of light in vacuum",
            f"reported ranges are {ratio:.5f} times those from the stamps: 299 792 458 m/s instead of 299 702 547",
            "nothing for a fit, which uses the stamps; multiply reported ranges by 0.9997 before using them",
            0.95,
        )


def swapped_roles(view: RecordingView) -> Iterator[Finding]:
    """The target's clock against the initiator's: from the third leg, and as the carriers say."""
    e = view.exchanges
    double = (e.protocol == "ds") & (e.tx3 != 0) & np.isfinite(e.skew1_ppm)
    if np.count_nonzero(double) < 100:
        return
    spans = intervals(e[double])
    with np.errstate(all="ignore"):
        target_faster = (spans.dt53 / spans.dt64 - 1) * 1e6
    told = e.skew1_ppm[double]
    pairs = pair_ids(e[double])
    first = e.initiator[double] < e.target[double]
    signs = [
        (np.median(target_faster[rows]), np.median(told[rows]))
        for p in np.unique(pairs)
        for way in (True, False)
        if np.count_nonzero(rows := (pairs == p) & (first == way)) > 20
    ]
    clear = [(a, b) for a, b in signs if abs(a) > 1.0]
    if clear and np.mean([np.sign(a) != np.sign(b) for a, b in clear]) > 0.8:
        yield Finding(
            "swapped roles",
            "the carriers say that the targets' clocks are slower where the stamps say faster, and the other way round",
            "initiator and target (ids, powers and skews) are exchanged, or the readings have the other sign: change "
            "it on import",
            0.9,
        )


def contradicting(view: RecordingView) -> Iterator[Finding]:
    """Initiator and target that report one exchange differently: they print the same numbers, so a line was damaged."""
    if view.contradictions:
        yield Finding(
            "contradicting reports",
            f"both ends reported {view.reported_twice} exchanges, {len(view.contradictions)} of them differently; "
            f"the first: {view.contradictions[0]}",
            "look at the cables and ports of the two boards; what a damaged line says is not known",
            0.9,
        )
