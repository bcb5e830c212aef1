"""Units of poses, ranges and powers that contradict each other or physics, with the likely factor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.checks.geometry import MATERIAL
from calib.checks.recording_view import PLAUSIBLE_M, RecordingView
from calib.data.ranges import measured_powers
from calib.findings import Candidate
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.twr import without_stamps

LENGTHS: Final = {"mm": 1000.0, "cm": 100.0, "in": 1 / 0.0254, "ft": 1 / 0.3048}
"""How many of a unit are a metre, by the names that a map takes."""

POWERS: Final = {
    "the other sign": -1.0,
    "hundredths of a dBm": 0.01,
    "hundredths of a dBm, and the other sign": -0.01,
    "tenths of a dBm": 0.1,
    "256 steps a dBm": 1 / 256,
}
"""What makes dBm of powers that are none: firmwares print a loss, or integers."""

USUAL_DBM: Final = (-115.0, -55.0)
"""First-path powers of these radios, from their sensitivity to a metre apart."""

RANGES_OF_A_UNIT: Final = 20
POSES: Final = "unit of the poses"
TRUTH: Final = "unit of the true distances"
RANGES: Final = "unit of the ranges"
REPORTED: Final = "unit of the reported ranges"
POWER: Final = "unit of the powers"


def lengths(view: RecordingView) -> Iterator[Candidate]:
    """Ranges and true distances of which one is many times the other.

    The unit is the one that leaves the least between them; where the ranges have no stamps, and none that a radio can
    measure, theirs is wrong.
    """
    good = np.isfinite(view.raw_m) & np.isfinite(view.truth_m)
    bare = bool(without_stamps(view.exchanges).mean() > 0.5)
    far = bool(np.median(np.abs(view.raw_m[np.isfinite(view.raw_m)])) > PLAUSIBLE_M) if len(view.raw_m) else False
    if np.count_nonzero(good) < RANGES_OF_A_UNIT:
        if bare and far:
            told = f"half of the ranges are longer than {PLAUSIBLE_M:.0f} m, which no UWB radio measures"
            yield Candidate(RANGES, told, words={"unit": "mm"})
        return
    raw, truth = view.raw_m[good], view.truth_m[good]
    unit = _unit(raw, truth)
    short = None if unit or not bare else _unit(truth, raw)
    if unit is None and short is None:
        return
    if short is not None:
        told = f"ranges are in {short} if true distances are in m: half of them are longer than {np.median(raw):.0f}"
        yield Candidate(RANGES, told, words={"unit": short})
        return
    name = POSES if view.posed else TRUTH
    told = (
        f"true distances have a median of {np.median(truth):.6g}, ranges one of {np.median(raw):.6g} m: they agree if "
        f"{'poses' if view.posed else 'true distances'} are in {unit}"
    )
    yield Candidate(name, told, words={"unit": unit, "many": f"{LENGTHS[str(unit)]:g}"})


def _unit(metres: Floats, others: Floats) -> str | None:
    """Return the unit of others (n,) with which they agree best with metres (n,); None where metres are as good."""
    left = {name: robust_spread(metres - others / many) for name, many in LENGTHS.items()}
    best = min(left, key=lambda name: left[name])
    # Distances that say nothing are best when they are divided by most.
    if left[best] < SPREAD_BY_UNIT * min(robust_spread(metres - others), robust_spread(metres)):
        return best
    # Of one distance, the unit that makes both alike.
    if robust_spread(metres) > ONE_DISTANCE_M or np.median(others) < PLAUSIBLE_M:
        return None
    apart = {name: abs(float(np.median(metres - others / many))) for name, many in LENGTHS.items()}
    return min(apart, key=lambda name: apart[name])


SPREAD_BY_UNIT: Final = MATERIAL / 2
"""Feet taken for metres leave two thirds of the ranges' own spread, the right unit noise and delays."""

ONE_DISTANCE_M: Final = 0.5
"""Ranges that spread by less are of one distance."""


def reported(view: RecordingView) -> Iterator[Candidate]:
    """Reported ranges that are another unit than those from the stamps."""
    e = view.exchanges
    with np.errstate(all="ignore"):
        ratio = e.range_m / view.raw_m
    good = np.isfinite(ratio) & (np.abs(view.raw_m) > 1) & ~without_stamps(e)
    if np.count_nonzero(good) < RANGES_OF_A_UNIT:
        return
    found = float(np.median(ratio[good]))
    for unit, many in LENGTHS.items():
        if abs(found / many - 1) < UNIT_OFF:
            told = f"reported ranges are {found:.5g} times those from the stamps"
            yield Candidate(REPORTED, told, words={"unit": unit})


UNIT_OFF: Final = 0.05
"""By which delays of boards may change a range of some metres."""


def powers(view: RecordingView) -> Iterator[Candidate]:
    """Powers that cannot be dBm at an antenna."""
    e = view.exchanges
    every = np.concatenate([e.fpp1_dbm, e.fpp2_dbm])
    every = every[np.isfinite(every) & (every != 0)]
    if len(every) < RANGES_OF_A_UNIT or np.mean(np.isfinite(measured_powers(every))) > 0.5:
        return
    middle = float(np.median(every))
    near = [name for name, factor in POWERS.items() if USUAL_DBM[0] < factor * middle < USUAL_DBM[1]]
    guess = (
        f"they look like {near[0]}: times {POWERS[near[0]]:g} they would be {POWERS[near[0]] * middle:.0f} dBm"
        if near
        else "no usual factor makes them so"
    )
    told = f"the median power is {middle:+.5g} dBm, where these radios receive -115 to -55; {guess}"
    factor = f"multiply fpp1 and fpp2 by {POWERS[near[0]]:g}" if near else "give fpp1 and fpp2 in dBm"
    yield Candidate(POWER, told, words={"factor": factor})
