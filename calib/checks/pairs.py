"""Checks of who ranges with whom, of motion, and of powers that say nothing beside distances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.checks.recording_view import RecordingView
from calib.data.clocks import pair_ids
from calib.data.ranges import measured_powers
from calib.estimator.identifiability import free_directions, square_of
from calib.findings import Candidate, more_often
from uwblink.recording.summary import failures_by_pair
from uwblink.twr import delay_weights

STATIC: Final = "static data"


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
            # A tag that answers half of the time is at the edge of its range, and no worse.
            usual = max(0.5, others_bad / (others + others_bad))
            p_value = more_often(bad, bad + done, usual, tried=len(tags))
            evidence = f"tag {tag} took part in {done} exchanges, {bad} failed"
            yield Candidate("dead or deaf tag", evidence, p_value, {"tag": tag})


def still(view: RecordingView) -> Iterator[Candidate]:
    """Tags that keep their distances."""
    if view.standing_m is not None:
        yield Candidate(STATIC, f"no distance changes by more than {100 * view.standing_m:.0f} cm")


CONFOUNDED: Final = "power confounded with distance"

RANGES_OF_A_SHARE: Final = 300
GROUPS: Final = 40
"""Groups of one distance between and within which powers vary, and ranges from which that is told."""


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

    What readings scatter is no power that varies, and is taken off: readings of a pair within 0.2 s, in which a robot
    turns its antenna by a few degrees, differ by their noise. So is what groups of distances explain by chance, as
    powers of a pair within 2 s, in which it turns, are nearly one (adjusted share).
    """
    e = view.exchanges
    lifted = lifted_power(e.fpp1_dbm, e.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    rows = np.flatnonzero(np.isfinite(lifted) & np.isfinite(view.truth_m) & (view.truth_m > 0))
    if len(rows) < RANGES_OF_A_SHARE or np.ptp(view.truth_m[rows]) < 0.5:
        return
    rows = rows[np.lexsort((e.time_ns[rows], pair_ids(e)[rows]))]
    pair, time_ns, shares = pair_ids(e)[rows], e.time_ns[rows], [0.0]
    alone = len(np.unique(np.column_stack([pair, time_ns // 2_000_000_000]), axis=0))
    together = (np.diff(pair) == 0) & (np.diff(time_ns) < 200_000_000)
    enough = np.count_nonzero(together) >= RANGES_OF_A_SHARE // 3
    # Lifted powers near the antennas outweigh all others, their decibels do not; either way is too much.
    for power in (lifted[rows], np.log(lifted[rows])):
        noise = float(np.mean(np.diff(power)[together] ** 2)) / 2 if enough else 0.0
        groups = np.array_split(power[np.argsort(view.truth_m[rows], kind="stable")], GROUPS)
        within = float(np.mean([np.var(group) for group in groups]))
        between = max(float(np.var([np.mean(group) for group in groups])), 1e-300)
        if between > 0.5 * (between + within):
            share = between / (between + max(within - noise, 0.0))
            shares.append(1 - (1 - share) * (alone - 1) / max(alone - GROUPS, 1))
    # Beyond, what is fitted over power has ten times its own variance (variance inflation, Marquardt 1970).
    if max(shares) > 0.9:
        yield Candidate(CONFOUNDED, f"distance explains {100 * max(shares):.0f} % of the power's variance")
