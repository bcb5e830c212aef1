"""Checks of who ranges with whom, of motion, and of powers that say nothing beside distances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.checks.recording_view import RecordingView, pair_ids
from calib.data.ranges import measured_powers
from calib.estimator.identifiability import free_directions, square_of
from calib.findings import Candidate, more_often
from uwblink.arrays import Floats
from uwblink.recording.summary import failures_by_pair
from uwblink.twr import delay_weights

STATIC: Final = "static data"
STILL_M: Final = 0.1
"""Distances that change by less are one distance: two wavelengths, over which power hardly varies."""

MOSTLY: Final = 0.5
"""A tag that answers half of the time is at the edge of its range, and no worse."""


def pairs(view: RecordingView) -> Iterator[Candidate]:
    """Pairs that leave antenna delays undetermined."""
    e = view.exchanges
    with np.errstate(all="ignore"):
        first, second = delay_weights(e)
    good = np.isfinite(first) & np.isfinite(second)
    if not good.any():
        return
    tags = sorted({*e.initiator[good].tolist(), *e.target[good].tolist()})
    square, ends = square_of(tags, e.initiator[good], e.target[good], first[good], second[good])
    _, free = free_directions(square, tags, ends)
    if free:
        groups = "; ".join(", ".join(map(str, group)) for group in free)
        yield Candidate("too few pairs", f"the pairs do not determine the delays of tags {groups}")


def silent(view: RecordingView) -> Iterator[Candidate]:
    """A tag whose exchanges nearly all fail, where those of others do not."""
    e = view.exchanges
    failed = failures_by_pair(view.faults)
    tags = sorted({t.tag for t in view.tags})
    for tag in sorted(tags, key=lambda tag: -sum(n for pair, n in failed.items() if tag in pair)):
        bad = sum(n for pair, n in failed.items() if tag in pair)
        done = int(np.count_nonzero((e.initiator == tag) | (e.target == tag)))
        # What fails with a dead tag is no fault of the other one.
        failed = {pair: n for pair, n in failed.items() if tag not in pair or bad <= done}
        others, others_bad = len(e) - done, sum(n for pair, n in failed.items() if tag not in pair)
        if others + others_bad:
            usual = max(MOSTLY, others_bad / (others + others_bad))
            p_value = more_often(bad, bad + done, usual, tried=len(tags))
            evidence = f"tag {tag} took part in {done} exchanges, {bad} failed"
            yield Candidate("dead or deaf tag", evidence, p_value, {"tag": tag})


def standing_still(view: RecordingView) -> float | None:
    """Return the largest change of a pair's distance, metres, where none changes by more than `STILL_M`, else None."""
    pair = pair_ids(view.exchanges)
    good = np.isfinite(view.truth_m)
    spans = [float(np.ptp(view.truth_m[good & (pair == p)])) for p in np.unique(pair[good])]
    return max(spans) if spans and max(spans) < STILL_M else None


def still(view: RecordingView) -> Iterator[Candidate]:
    """Tags that keep their distances."""
    span = standing_still(view)
    if span is not None:
        yield Candidate(STATIC, f"no distance changes by more than {100 * span:.0f} cm")


CONFOUNDED: Final = "power confounded with distance"
EXPLAINED: Final = 0.9
"""Share of the power's variance that distance may explain: beyond, what is fitted over power has more than ten times
the variance that it would have alone, which is too much (variance inflation, Marquardt 1970)."""

FROM_DISTANCE: Final = 0.5
"""Share of the readings' variance, noise and all, below which it is not distance that powers are made of."""

SHORTEST_M: Final = 0.5
"""Distances that vary less than this cannot explain a power."""

RANGES_OF_A_SHARE: Final = 300
LOOKED_AT: Final = 5000
"""Of more ranges, only every so many are looked at."""

GROUPS: Final = 40


def missing(view: RecordingView) -> Iterator[Candidate]:
    """Exchanges without a first-path power at either end, of which no curve can be fitted, or without true distance."""
    powers = [np.isfinite(measured_powers(one)) for one in (view.exchanges.fpp1_dbm, view.exchanges.fpp2_dbm)]
    powered, true = (100 * float(np.mean(known)) for known in (np.any(powers, axis=0), np.isfinite(view.truth_m)))
    if powered < 50:
        yield Candidate("no powers", f"{powered:.0f} % of the exchanges have a first-path power")
    if true < 50 and not view.standing:
        evidence = f"{true:.0f} % of the exchanges have one: poses are missing or do not cover the recording"
        yield Candidate("no true distances", evidence)


def confounded(view: RecordingView) -> Iterator[Candidate]:
    """Power that is a function of distance and nothing else lets the curve learn distance.

    What readings scatter is no power that varies, and is taken off; so is what groups of distances explain by chance,
    as powers of a pair within `TURNED_S` are nearly one (adjusted share).
    """
    e = view.exchanges
    lifted = lifted_power(e.fpp1_dbm, e.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    rows = np.flatnonzero(np.isfinite(lifted) & np.isfinite(view.truth_m) & (view.truth_m > 0))
    rows = rows[np.argsort(e.time_ns[rows], kind="stable")]
    if len(rows) < RANGES_OF_A_SHARE or np.ptp(view.truth_m[rows]) < SHORTEST_M:
        return
    every, shares = rows[:: max(len(rows) // LOOKED_AT, 1)], [0.0]
    pair, time_ns = pair_ids(e)[rows], e.time_ns[rows]
    alone = len(np.unique(np.column_stack([pair, time_ns // round(TURNED_S * 1e9)]), axis=0))
    # Readings of a pair that follow each other at once differ by their noise.
    order = np.argsort(pair, kind="stable")
    together = (np.diff(pair[order]) == 0) & (np.diff(time_ns[order]) < AT_ONCE_S * 1e9)
    enough = np.count_nonzero(together) >= RANGES_OF_A_SHARE // 3
    # Lifted powers near the antennas outweigh all others, their decibels do not; either way is too much.
    for power in (lifted, np.log(lifted)):
        noise = float(np.mean(np.diff(power[rows][order])[together] ** 2)) / 2 if enough else 0.0
        share = share_by_distance(power[every], view.truth_m[every], noise)
        if share_by_distance(power[every], view.truth_m[every]) > FROM_DISTANCE:
            shares.append(1 - (1 - share) * (alone - 1) / max(alone - GROUPS, 1))
    if max(shares) > EXPLAINED:
        yield Candidate(CONFOUNDED, f"distance explains {100 * max(shares):.0f} % of the power's variance")


def share_by_distance(power: Floats, truth_m: Floats, noise: float = 0.0) -> float:
    """Return the share of the variance of powers (n,), without that of their noise, between groups of one distance."""
    groups = np.array_split(power[np.argsort(truth_m, kind="stable")], GROUPS)
    within = float(np.mean([np.var(group) for group in groups]))
    between = float(np.var([np.mean(group) for group in groups]))
    return between / max(between + max(within - noise, 0.0), 1e-300)


TURNED_S: Final = 2.0
"""In which a robot turns, and its antenna has another gain."""

AT_ONCE_S: Final = 0.2
"""In which a robot turns its antenna by a few degrees."""
