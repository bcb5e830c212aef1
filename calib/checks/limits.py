"""What a fit of a kind cannot know from the data that it had, said before anything else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, equal_bins, lifted_power
from calib.data.clocks import LeftSkew, corrected
from calib.data.ranges import NO_STAMPS, STATIC, Ranges
from calib.estimator.known_distances import KnownDistances
from calib.estimator.pairs import pairs_of
from uwblink.arrays import Floats
from uwblink.protocols.table import is_single_sided
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import names_in

RANGES_A_MEDIAN: Final = 20
"""Ranges at one power from which their median error is told."""

MANY_MISSING: Final = 0.05
MANY_OUTLIERS: Final = 0.4
SHORT_S: Final = 25.0
SPREAD: Final = (5, 95)
"""Percent of the powers between which errors are compared."""


def limits(found: KnownDistances, ranges: Ranges, residuals_m: Floats, fixed: Mapping[int, float]) -> Iterator[str]:
    """Yield what cannot be known, in sentences; `residuals_m` (n,) are fully corrected errors of the ranges."""
    model = found.model
    of_pairs = model.constants == "pair"
    bare = int(np.count_nonzero(ranges.protocol == NO_STAMPS))
    if bare:
        yield _without_stamps(bare, len(ranges), "constants" if of_pairs else "delays")
    if ranges.left_skew is not None:
        yield told(ranges.left_skew)
    elif any(is_single_sided(name) and not corrected(name) for name in names_in(ranges.protocol)):
        yield (
            "single-sided ranges without their reply times and carrier readings: what clock skew has left in them "
            "cannot be said, and looks like antenna delays"
        )
    if ranges.clocks_apart is not None:
        yield str(ranges.clocks_apart)
    if of_pairs:
        yield (
            f"{_pairs(len(model.pairs.ends))}: antenna delays stay unknown, other pairs cannot be corrected, and "
            "what else is constant in the ranges of a pair (an obstacle, a wrong lever arm) is in its constant"
        )
    if model.curve is None and model.looked_for_curve and model.powered.any():
        yield (
            f"the first-path power never changes ({_middle_dbm(ranges):.1f} dBm): the curve is flat, and delays hold "
            "at this power only"
        )
    elif model.curve is None:
        yield _without_curve(ranges, residuals_m)
    if fixed and set(model.tags) <= set(fixed):
        yield _pinned(ranges, residuals_m)


def _pairs(count: int) -> str:
    return "the constant of one pair" if count == 1 else f"constants of {count} pairs"


def told(left: LeftSkew) -> str:
    """Return as a sentence what clock skew may have left in single-sided ranges."""
    bound = (
        f"clocks that are 20 ppm off each leave up to {_length(left.bound_m)} "
        f"(c/2 x 40 ppm x {1e6 * left.reply_s:.0f} µs of reply)"
    )
    if not np.isfinite(left.told_m):
        return (
            f"single-sided ranges without carrier readings: {bound}, which looks like an antenna delay and changes its "
            "sign with who initiates"
        )
    return (
        f"single-sided ranges with clock skew in them: {bound}, and by the carriers' readings up to "
        f"{_length(left.told_m)}; read as protocol ss-cfo they are corrected with those"
    )


def _length(metres: float) -> str:
    if metres >= 1:
        return f"{metres:.1f} m"
    return f"{100 * metres:.0f} cm" if metres >= 0.01 else f"{1e3 * metres:.1f} mm"


def _without_stamps(bare: int, count: int, where: str) -> str:
    share = "" if bare == count else f"{bare} of {count} "
    return (
        f"{share}ranges without stamps: clock skew, and what the device added or took off itself, are not known and "
        f"are in the {where}; a damaged range cannot be told from a reflected one"
    )


def _without_curve(ranges: Ranges, residuals_m: Floats) -> str:
    known = np.isfinite(ranges.fpp1_dbm) | np.isfinite(ranges.fpp2_dbm)
    if not known.any():
        return (
            "delays only, without any power: how ranges change with power cannot be seen, is in delays and errors, and "
            "delays from other distances will differ"
        )
    low, high = np.percentile(_mean_dbm(ranges), SPREAD)
    reach = _change_with_power(ranges, residuals_m)
    differ = f"{reach / SPEED_OF_LIGHT * 1e9:.2f} ns"
    return (
        f"delays only: errors that change with power stay in the ranges, here {_length(reach)} between {low:.0f} and "
        f"{high:.0f} dBm; delays hold for the recorded powers, and differ by up to {differ} at others among "
        "them"
    )


def _lifted(ranges: Ranges) -> Floats:
    return lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)


def _mean_dbm(ranges: Ranges) -> Floats:
    both = np.column_stack([ranges.fpp1_dbm, ranges.fpp2_dbm])
    known = both[np.isfinite(both).any(axis=1)]
    return np.asarray(np.nanmean(known, axis=1))


def _middle_dbm(ranges: Ranges) -> float:
    return float(np.median(_mean_dbm(ranges)))


def _change_with_power(ranges: Ranges, residuals_m: Floats) -> float:
    """Return by how much the medians of errors differ over power, metres."""
    lifted = _lifted(ranges)
    known = np.isfinite(lifted)
    number, error = equal_bins(lifted[known]).number, residuals_m[known]
    medians = [
        np.median(error[number == k]) for k in np.unique(number) if np.count_nonzero(number == k) >= RANGES_A_MEDIAN
    ]
    return float(np.ptp(np.percentile(medians, SPREAD))) if medians else 0.0


def _pinned(ranges: Ranges, residuals_m: Floats) -> str:
    place = pairs_of(ranges.initiator, ranges.target, ranges.tags()).number
    medians = [np.median(residuals_m[place == k]) for k in range(int(place.max()) + 1)]
    return (
        "curve only: the delays are those that were given; what they have in common that is wrong is in the curve, "
        f"where they differ it stays in the ranges (medians of pairs lie within {_length(float(np.ptp(medians)))})"
    )


def warnings_of(ranges: Ranges, inliers: float, free: list[list[int]], seconds: float) -> list[str]:
    """Return sentences, the gravest first.

    `inliers` is the share of ranges within three sigmas, `seconds` the time that ranges cover.
    """
    found = []
    if free:
        groups = "; ".join(", ".join(map(str, group)) for group in free)
        found.append(
            f"the data leave the delays of tags {groups} free; those written are the smallest that agree with the data"
        )
    delays = known_delays(ranges.antenna_delays, ranges.tags())
    apart = [f"{tag} ({one})" for tag, one in delays.items() if tag is not None and one.reply != one.tx]
    if apart:
        found.append(
            f"the stamps of tag{'s' * (len(apart) > 1)} {', '.join(apart)} carry two antenna delays, the register's "
            "and another constant in those of delayed replies: no delay of a tag fits both; program the firmware's "
            "constants, too (`calib export --to firmware`), and record anew"
        )
    everything = len(ranges) + sum(ranges.excluded.values())
    for reason, count in ranges.excluded.items():
        if reason != STATIC and count > MANY_MISSING * everything:
            found.append(f"{100 * count / everything:.0f} % of the exchanges were left out: {reason}")
    if 1 - inliers > MANY_OUTLIERS:
        found.append(f"{100 * (1 - inliers):.0f} % of the ranges lie beyond three sigmas of the calibrated errors")
    if seconds < SHORT_S:
        found.append(f"only {seconds:.0f} s of data: errors that persist are few, so intervals may be too narrow")
    return found
