"""Powers that say nothing beside distances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.data.ranges import measured_powers
from calib.doctor.base import RecordingView, pair_ids
from calib.doctor.checks import Seen
from uwblink.arrays import Floats, Ints

CONFOUNDED: Final = "power confounded with distance"
EXPLAINED: Final = 0.8
"""Share of the power's variance that distance may explain: beyond, what is fitted over power has more than five times
the variance that it would have alone (variance inflation, Marquardt 1970)."""

MOSTLY: Final = 0.5
"""Share of the readings' variance, noise and all, below which it is not distance that powers are made of."""

SHORTEST_M: Final = 0.5
"""Distances that vary less than this cannot explain a power."""

FEWEST: Final = 300
ENOUGH: Final = 5000
"""Of more ranges, only every so many are looked at."""

GROUPS: Final = 40


def unpowered(view: RecordingView) -> Iterator[Seen]:
    """Exchanges without a first-path power at either end, of which no curve can be fitted."""
    e = view.exchanges
    known = float(np.mean(np.isfinite(measured_powers(e.fpp1_dbm)) | np.isfinite(measured_powers(e.fpp2_dbm))))
    if known < 0.5:
        yield Seen("no powers", f"{100 * known:.0f} % of the exchanges have a first-path power")


def confounded(view: RecordingView) -> Iterator[Seen]:
    """Power that is a function of distance and nothing else lets the curve learn distance.

    What readings scatter is no power that varies, and is taken off; so is what groups of distances explain by chance,
    as powers of a pair within `TURNED_S` are nearly one (adjusted share).
    """
    e = view.exchanges
    lifted = lifted_power(e.fpp1_dbm, e.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    rows = np.flatnonzero(np.isfinite(lifted) & np.isfinite(view.truth_m) & (view.truth_m > 0))
    rows = rows[np.argsort(e.time_ns[rows], kind="stable")]
    if len(rows) < FEWEST or np.ptp(view.truth_m[rows]) < SHORTEST_M:
        return
    every, shares = rows[:: max(len(rows) // ENOUGH, 1)], []
    seconds = e.time_ns[rows] // round(TURNED_S * 1e9)
    alone = len(np.unique(np.column_stack([pair_ids(e)[rows], seconds]), axis=0))
    # Lifted powers near the antennas outweigh all others, their decibels do not; either way is too much.
    for power in (lifted, np.log(lifted)):
        noise = _noise(view, power, rows)
        share = _explained(power[every], view.truth_m[every], noise)
        if _explained(power[every], view.truth_m[every], 0.0) > MOSTLY:
            shares.append(1 - (1 - share) * (alone - 1) / max(alone - GROUPS, 1))
    if max(shares, default=0.0) > EXPLAINED:
        yield Seen(CONFOUNDED, f"distance explains {100 * max(shares):.0f} % of the power's variance")


def _explained(power: Floats, truth_m: Floats, noise: float) -> float:
    """Return the share of the variance of powers (n,), without that of their noise, between groups of one distance."""
    groups = np.array_split(power[np.argsort(truth_m, kind="stable")], GROUPS)
    within = float(np.mean([np.var(group) for group in groups]))
    between = float(np.var([np.mean(group) for group in groups]))
    return between / max(between + max(within - noise, 0.0), 1e-300)


def _noise(view: RecordingView, power: Floats, rows: Ints) -> float:
    """Return the variance of readings' noise in powers (n,), from readings of a pair that follow each other at once."""
    e = view.exchanges[rows]
    pair, time_s = pair_ids(e), e.time_ns * 1e-9
    order = np.lexsort((time_s, pair))
    together = (np.diff(pair[order]) == 0) & (np.diff(time_s[order]) < AT_ONCE_S)
    if np.count_nonzero(together) < FEWEST // 3:
        return 0.0
    return float(np.mean(np.diff(power[rows][order])[together] ** 2)) / 2


TURNED_S: Final = 2.0
"""In which a robot turns, and its antenna has another gain."""

AT_ONCE_S: Final = 0.2
"""In which a robot turns its antenna by a few degrees."""
