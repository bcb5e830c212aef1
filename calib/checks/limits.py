"""Limits of a fit: combinations that its data do not determine, and values that are physically impossible.

Impossible data are refused; doubtful data get a warning.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.power_curves import ALPHA_DBM, equal_bins, lifted_power
from calib.checks.residuals import ONE_WAY_M
from calib.data.clocks import as_length, corrected
from calib.data.ranges import NO_STAMPS, STATIC, Ranges, growth_fault, look_like
from calib.errors import UnanswerableError
from calib.estimator.known_distances import RangeFit
from calib.findings import FIT_LEVELS, SMALLEST_NS, STRETCHES, Finding, exceeds, warning
from calib.spread import TWO_SIDED_95, medians, robust_spread
from uwblink.arrays import Floats
from uwblink.protocols.table import is_single_sided
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import names_in

LOUD_M: Final = 0.5
"""Maximum spread of errors of UWB ranges: noise is 3 to 10 cm, and mean detours of published flights are 0.1 to 0.5 m
(MILUV, STAR-loc)."""

REGISTER_NS: Final = 65_536 * TICK_S * 1e9
"""Antenna delays are registers of 16 bits, in ticks: up to 1.03 us, twice the delay of an unprogrammed board (514 ns).
A larger delay is a length in the wrong unit: 154 m of range per tag."""


def limits(found: RangeFit, ranges: Ranges, residuals_m: Floats, fixed: Mapping[int, float]) -> Iterator[Finding]:
    """Yield findings about undetermined values; `residuals_m` (n,) are fully corrected errors."""
    model, pairs, count = found.model, found.model.settings.constants == "pair", len(found.model.pairs.ends)
    bare = int(np.count_nonzero(ranges.protocol == NO_STAMPS))
    unread = any(is_single_sided(name) and not corrected(name) for name in names_in(ranges.protocol))
    if bare:
        yield warning(
            "ranges without stamps",
            f"{'' if bare == len(ranges) else f'{bare} of {len(ranges)} '}ranges without stamps: clock skew, and "
            f"corrections by the device itself, are unknown and contained in the {'constants' if pairs else 'delays'}; "
            f"damaged ranges cannot be distinguished from reflected ones",
        )
    if ranges.uncorrected_skew is not None:
        yield warning("clock skew", str(ranges.uncorrected_skew))
    elif unread:
        yield warning(
            "clock skew",
            "single-sided ranges without reply times and carrier readings: the effect of clock skew is unknown, and "
            "contained in the antenna delays",
        )
    if ranges.clocks_apart is not None:
        yield warning("clocks contradict the carriers", str(ranges.clocks_apart), ranges.clocks_apart.p_value)
    if pairs:
        yield warning(
            "constants of pairs",
            f"{'the constant of one pair' if count == 1 else f'constants of {count} pairs'}: antenna delays are not "
            f"determined, other pairs cannot be corrected, and other constant errors of a pair (an obstacle, a wrong "
            f"lever arm) are in its constant",
        )
    if model.curve is None:
        yield _without_curve(found, ranges, residuals_m)
    if fixed and set(model.tags) <= set(fixed):
        apart_m = float(np.ptp(medians(residuals_m, ranges.pairs.number)))
        yield warning(
            "given delays",
            f"curve only: the delays are the given ones; a common error of the delays is in the curve, and their "
            f"individual errors stay in the ranges (medians of pairs lie within {as_length(apart_m)})",
        )


def _without_curve(found: RangeFit, ranges: Ranges, residuals_m: Floats) -> Finding:
    if not found.model.settings.delays_only and found.model.powered.any():
        return warning(
            "constant power",
            f"the first-path power never changes ({np.median(_mean_dbm(ranges)):.1f} dBm): the curve is flat, and "
            f"the delays are valid only at this power",
        )
    lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    known = np.isfinite(lifted)
    if not known.any():
        return warning(
            "no powers",
            "delays only, without any power: the effect of power is unknown and contained in delays and errors, so "
            "delays from other distances will differ",
        )
    low, high = np.percentile(_mean_dbm(ranges), (5, 95))
    number = equal_bins(lifted[known])
    middle = medians(residuals_m[known], number)[np.bincount(number) >= 20]
    reach = float(np.ptp(np.percentile(middle, (5, 95)))) if len(middle) else 0.0
    return warning(
        "no curve",
        f"delays only: errors that change with power stay in the ranges, here {as_length(reach)} between "
        f"{low:.0f} and {high:.0f} dBm; delays are averages over the recorded powers, and differ by up to "
        f"{reach / SPEED_OF_LIGHT * 1e9:.2f} ns at single powers",
    )


def _mean_dbm(ranges: Ranges) -> Floats:
    """Return the mean powers (k,) of the ranges with powers."""
    both = np.column_stack([ranges.fpp1_dbm, ranges.fpp2_dbm])
    return np.asarray(np.nanmean(both[np.isfinite(both).any(axis=1)], axis=1))


def refuse_impossible(ranges: Ranges) -> None:
    """Raise `UnanswerableError` if ranges cannot be fitted with any settings."""
    for reason in _impossible(ranges):
        raise UnanswerableError(f"{ranges.source}: {reason}")


def _impossible(ranges: Ranges) -> Iterator[str]:
    """Yield the reasons why ranges are impossible."""
    missing = {reason: count for reason, count in ranges.excluded.items() if reason != STATIC}
    share = sum(missing.values()) / max(len(ranges) + sum(missing.values()), 1)
    if share > 0.5:
        worst = max(missing, key=lambda reason: missing[reason])
        yield (
            f"{100 * share:.0f} % of the exchanges were left out, most because of {worst}; check the protocol and "
            f"the columns of the recording"
        )
    sessions = np.unique(ranges.session)
    if len(ranges) > 1 and not any(np.ptp(ranges.time_ns[ranges.session == number]) for number in sessions):
        yield "all ranges have the same time, so the persistence of errors cannot be estimated; give their times"
    # Spreads of ranges and true distances: a unit or two columns may be wrong.
    if fault := growth_fault("ranges", ranges.raw_m, ranges.truth_m):
        yield f"{fault}; give both in metres"
    # Clock ratios that are impossible for crystals: wrapped stamps, or columns in the wrong order.
    weight = ranges.weight_target[ranges.protocol == "ds"]
    skew = 1e6 * float(np.median(np.abs(2 * weight - 1))) if len(weight) else 0.0
    # Crystals of these boards are within 20 ppm, over temperature and age.
    if skew > 100.0:
        yield (
            f"clocks differ by {skew:.0f} ppm according to third messages, but crystals by at most 40 ppm; the third "
            f"leg is longer than the period of the stamps' counter, or the columns of stamps are in the wrong order"
        )


def dependence_on_initiator(ranges: Ranges) -> Iterator[Finding]:
    """Yield a finding about a pair whose ranges depend on the initiator, a sign of uncorrected clock skew.

    Medians of raw errors show it even if a fit takes such ranges for reflections.
    """
    ways = _medians_by_way(ranges.error_m, ranges)
    both = {(a, b): _mean_of_stretches(m - ways[b, a]) for (a, b), m in ways.items() if a < b and (b, a) in ways}
    tested = [
        (exceeds(mean_m, std, STRETCHES - 1, tolerance=ONE_WAY_M, tried=len(both)), -abs(mean_m), pair)
        for pair, (mean_m, std) in both.items()
    ]
    for p_value, _, (a, b) in sorted(tested)[:1]:
        if p_value < FIT_LEVELS["directions"]:
            mean_m = both[a, b][0]
            yield warning(
                "clock skew",
                f"pair {a}-{b}: ranges are {100 * abs(mean_m):.0f} cm {'longer' if mean_m > 0 else 'shorter'} if tag "
                f"{a} initiates: clock skew is not corrected, or the carrier reading has the wrong sign",
                p_value,
            )


def _medians_by_way(values: Floats, ranges: Ranges) -> dict[tuple[int, int], Floats]:
    """Return medians (`STRETCHES`,) of finite values (n,) in stretches of time, by (initiator, target).

    The stretches of a way have equal counts; ways with fewer than 20 values are left out.
    """
    known = np.isfinite(values)
    link = (ranges.initiator * 65_536 + ranges.target)[known]
    order = np.lexsort((ranges.time_ns[known], link))
    own = values[known][order]
    which, first, count = np.unique(link[order], return_index=True, return_counts=True)
    return {
        divmod(of, 65_536): np.array([np.median(part) for part in np.array_split(own[start : start + n], STRETCHES)])
        for of, start, n in zip(which.tolist(), first.tolist(), count.tolist(), strict=True)
        if n >= 20
    }


def _mean_of_stretches(values: Floats) -> tuple[float, float]:
    """Return the mean of values (`STRETCHES`,) of stretches of time, and its standard error by their scatter."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))


def refuse_refuted(delays_ns: Mapping[int, float], residuals_m: Floats, ranges: Ranges) -> None:
    """Raise `UnanswerableError` if a fit found impossible values, so that its calibration is useless.

    Impossible are delays beyond the registers, and errors as large as the ranges: then true distances are unrelated to
    the ranges, or in another unit and nearly constant, so that their scale is not visible.
    """
    typical = float(np.median(np.abs(ranges.raw_m)))
    largest = max(map(abs, delays_ns.values()), default=0.0)
    spread = robust_spread(residuals_m)
    # No UWB radio measures a kilometre; then true distances may be in that unit, too.
    if largest < REGISTER_NS and spread < max(typical, LOUD_M) and (typical < 1000.0 or spread < LOUD_M):
        return
    ratio = typical / max(float(np.median(np.abs(ranges.truth_m))), 1e-9)
    guess = look_like("ranges", ratio) or "they may have another unit, or belong to other tags"
    raise UnanswerableError(
        f"{ranges.source}: impossible for a radio: a delay of {largest:.0f} ns (registers hold {REGISTER_NS:.0f}), "
        f"errors with a spread of {spread:.3g} m in ranges of {typical:.3g} m; check the units of the true distances "
        f"and of the "
        f"ranges: {guess}"
    )


def refuse_contradicted(inliers: float, ranges: Ranges, findings: Sequence[Finding]) -> None:
    """Raise `UnanswerableError`, with the findings, if most ranges contradict their own fit."""
    # Of direct ranges 99.7 % lie within. If more than half are reflected, delays depend on the minority; invented
    # places leave 0 to 34 % (swarm broadcasts).
    if inliers < 0.5:
        evidence = "; ".join(map(str, findings)) or "no single tag or pair explains it"
        raise UnanswerableError(
            f"{ranges.source}: {100 * (1 - inliers):.0f} % of the ranges lie outside three sigmas of this fit, which "
            f"is therefore useless; check the true distances, and which tag is at which position ({evidence})"
        )


def implausible_values(delays_ns: Mapping[int, float], residuals_m: Floats) -> Iterator[Finding]:
    """Yield findings about fitted values that are implausible for hardware."""
    spread, worst = robust_spread(residuals_m), max(delays_ns, key=lambda tag: abs(delays_ns[tag]), default=-1)
    # Boards of one kind differ by less than 2.5 ns: four times the difference of published delays (0.6 ns).
    if abs(delays_ns.get(worst, 0.0)) > 2.5:
        yield warning(
            "implausible delay",
            f"tag {worst}: the delay of {delays_ns[worst]:+.1f} ns is larger than differences of boards (2.5 ns)",
        )
    if spread > LOUD_M:
        yield warning("large errors", f"errors spread by {spread:.2f} m after the fit, more than those of UWB ranges")


def limits_of_data(ranges: Ranges, inliers: float, seconds: float) -> Iterator[Finding]:
    """Yield findings about the data of a fit, the most serious first.

    `inliers` is the share of ranges within three sigmas, `seconds` the time that ranges cover.
    """
    delays = known_delays(ranges.antenna_delays, ranges.tags())
    apart = [f"{tag} ({one})" for tag, one in delays.items() if tag is not None and one.reply != one.tx]
    if apart:
        yield warning(
            "two antenna delays of a tag",
            f"the stamps of tag{'s' * (len(apart) > 1)} {', '.join(apart)} contain two antenna delays, that of the "
            f"register and a different constant in delayed replies: no single delay of a tag fits both",
        )
    everything = len(ranges) + sum(ranges.excluded.values())
    for reason, count in ranges.excluded.items():
        if reason != STATIC and count > 0.05 * everything:
            text = f"{100 * count / everything:.0f} % of the exchanges were left out: {reason}"
            yield warning("exchanges left out", text)
    if inliers < 0.6:
        text = f"{100 * (1 - inliers):.0f} % of the ranges lie outside three sigmas of the calibrated errors"
        yield warning("ranges outside three sigmas", text)
    if seconds < 25.0:
        text = f"only {seconds:.0f} s of data: too short to estimate persistent errors, so intervals may be too narrow"
        yield warning("short recording", text)


SAME_LEVEL_DB: Final = 0.5
"""Smaller differences of levels of tags are ignored; medians of a pair's ranges are known to a tenth of this."""


def differing_power_levels(found: RangeFit, ranges: Ranges, calibration: Calibration) -> Iterator[Finding]:
    """Yield a finding about tags whose powers differ from the others so much that their delays may contain an error.

    A frame and its answer take the same path, so a difference of their powers is due to the tags: transmit power and
    error of readings. Only the sum is visible. If a tag reads powers too high, its ranges get the correction of
    stronger ones, and its delay absorbs the mean of this difference: right for its ranges, wrong for its antenna. An
    effect within the interval of the delay is no finding. Such an effect can also look like other faults, so this is
    the interval before any fault has widened it.
    """
    levels = power_levels_db(ranges)
    if not levels:
        return
    each_ns = _ns_a_decibel(ranges, calibration)
    std_ns = np.sqrt(np.maximum(np.diag(found.covariances["delay"]), 0.0)).tolist()
    half_ns = dict.fromkeys(levels, 0.0) | {
        int(name): TWO_SIDED_95 * std
        for name, std in zip(found.model.unknowns[0].names, std_ns, strict=True)
        if found.model.settings.constants == "tag"
    }
    differing = {
        tag: (level, p_value)
        for tag, (level, std) in levels.items()
        if half_ns[tag] > 0
        and abs(level) * each_ns > max(half_ns[tag], SMALLEST_NS)
        and (p_value := exceeds(level, std, STRETCHES - 1, tolerance=SAME_LEVEL_DB, tried=len(levels)))
        < FIT_LEVELS["powers"]
    }
    if differing:
        named = ", ".join(f"{tag} ({level:+.1f} dB)" for tag, (level, _) in differing.items())
        held_ps = 1e3 * each_ns * max(abs(level) for level, _ in differing.values())
        yield warning(
            "power levels of tags",
            f"powers of tag{'s' * (len(differing) > 1)} {named} differ from the others: the tags measure powers "
            f"wrongly, or transmit with another power; wrong powers change a tag's delay by up to {held_ps:.0f} ps "
            f"here, which is right for ranges but not for the antenna",
            min(p_value for _, p_value in differing.values()),
        )


def power_levels_db(ranges: Ranges) -> dict[int, tuple[float, float]]:
    """Return the excess of powers that each tag measures minus the excess that it transmits, relative to most others.

    In dB, each with its standard error, by the scatter between stretches of time; tags without a pair that has enough
    ranges with both powers are left out.
    """
    # The initiator reads the target's frame, and the target the initiator's.
    ways = _medians_by_way(ranges.fpp2_dbm - ranges.fpp1_dbm, ranges)
    if not ways:
        return {}
    ends = np.array([*ways]).T
    tags = np.unique(ends)
    inverse = np.linalg.pinv(np.subtract(*(np.equal.outer(end, tags).astype(float) for end in ends)))
    levels: Floats = inverse @ np.array([*ways.values()])
    mean = levels.mean(axis=1)
    near = np.abs(np.subtract.outer(mean, mean)) < SAME_LEVEL_DB
    levels -= levels[near[np.argmax(near.sum(axis=1))]].mean(axis=0)
    return {tag: _mean_of_stretches(own) for tag, own in zip(tags.tolist(), levels, strict=True)}


def _ns_a_decibel(ranges: Ranges, calibration: Calibration) -> float:
    """Return the change of a delay, in ns, if its tag measures powers a decibel too high."""
    lifted = [
        lifted_power(ranges.fpp1_dbm + first, ranges.fpp2_dbm + second, calibration.lift, calibration.alpha_dbm)
        for first, second in ((0, 0), (1, 0), (0, 1))
    ]
    known = np.all(np.isfinite(lifted), axis=0)
    at, first, second = (float(np.mean(calibration.bias_curve(power[known]))) for power in lifted)
    # A range contains half of the delay of each end.
    return abs(0.5 * (first + second) - at) / (0.5 * SPEED_OF_LIGHT) * 1e9
