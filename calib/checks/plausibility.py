"""What hardware and arithmetic allow: data that cannot be what they claim are refused or named before they are
believed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from calib.data.ranges import STATIC, Ranges
from calib.errors import UnanswerableError
from calib.estimator.pairs import pairs_of
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints
from uwblink.ticks import TICK_S

MOST_LEFT_OUT: Final = 0.5
SCALE: Final = (0.75, 1.35)
"""How many metres a range may grow in a metre of true distance: a foot is 0.305 m, a yard 0.914."""

RANGES_ASKED: Final = 100_000
"""Of more ranges, only every so many are asked for their scale and their clocks."""

UNITS: Final = {0.001: "millimetres", 0.01: "centimetres", 0.3048: "feet"}
FEWEST_SPREADS: Final = 3.0
"""True distances must spread by so much more than errors for their scale to be known."""

SKEW_PPM: Final = 100.0
"""Clock ratios beyond this are none: crystals of these boards keep 20 ppm each, over temperature and age."""

LONGEST_NS: Final = 2.5
"""Boards of one kind differ by less in their antenna delays (published ones by 0.6 ns)."""

ONE_WAY_M: Final = 0.05
WAYS_DIFFER: Final = 8.0
MEDIAN: Final = 1.2533
"""Standard error of a median over that of a mean."""

RANGES_A_WAY: Final = 20
LOUD_M: Final = 0.5
"""Errors that spread by more are not those of a UWB range."""

REGISTER_NS: Final = 65_536 * TICK_S * 1e9
"""Antenna delays are registers of 16 bits, in ticks: up to 1.03 us, twice what a board has that is programmed with none
(514 ns). A delay beyond is a length in the wrong unit: 154 m of range a tag."""


def refuse_impossible(ranges: Ranges) -> None:
    """Raise `UnanswerableError` where ranges cannot be fitted whatever the settings."""
    _mostly_left_out(ranges)
    if len(ranges) > 1 and not _has_times(ranges):
        raise UnanswerableError(
            f"{ranges.source}: all ranges have the same time, so nothing says how long errors last; give their times"
        )
    _scale(ranges)
    _clock_ratios(ranges)


def _has_times(ranges: Ranges) -> bool:
    """Return whether some session has more than one time."""
    times = (ranges.time_ns[ranges.session == number] for number in np.unique(ranges.session))
    return any(np.ptp(some) > 0 for some in times)


def _mostly_left_out(ranges: Ranges) -> None:
    missing = {reason: count for reason, count in ranges.excluded.items() if reason != STATIC}
    share = sum(missing.values()) / max(len(ranges) + sum(missing.values()), 1)
    if share > MOST_LEFT_OUT:
        worst = max(missing, key=lambda reason: missing[reason])
        raise UnanswerableError(
            f"{ranges.source}: {100 * share:.0f} % of the exchanges were left out, most for {worst}; "
            "more than half is no sample: see to the protocol and the columns of the recording"
        )


def _scale(ranges: Ranges) -> None:
    """Compare how ranges and true distances spread: a unit or two columns may be wrong."""
    every = slice(None, None, max(len(ranges) // RANGES_ASKED, 1))
    raw, truth = ranges.raw_m[every], ranges.truth_m[every]
    slope = robust_slope(truth, raw)
    rest = robust_spread(raw - slope * truth)
    if SCALE[0] < slope < SCALE[1] or abs(slope) * robust_spread(truth) < FEWEST_SPREADS * rest:
        return
    guess = _looks_like(slope)
    raise UnanswerableError(
        f"{ranges.source}: ranges grow by {slope:.3g} m in a metre of true distance; "
        f"{guess and guess + '; '}give both in metres"
    )


def _looks_like(ratio: float) -> str:
    """Return what ranges that are so many times the true distances look like, an empty text where no unit is near."""
    whose = "true distances" if ratio < 1 else "ranges"
    smaller = min(ratio, 1 / max(ratio, 1e-9))
    near = [name for own, name in UNITS.items() if abs(np.log(max(smaller, 1e-9) / own)) < 0.2]
    return f"{whose} look like {near[0]}" if near else ""


def robust_slope(x: Floats, y: Floats) -> float:
    """Return how y (n,) grows with x (n,): the median slope between thirds (Tukey's line)."""
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)
    low, high = order[:third], order[-third:]
    run = float(np.median(x[high]) - np.median(x[low]))
    return float(np.median(y[high]) - np.median(y[low])) / run if run > 0 else 1.0


def _clock_ratios(ranges: Ranges) -> None:
    """Refuse clock ratios that no crystals have: stamps that wrapped, or columns in the wrong order."""
    every = slice(None, None, max(len(ranges) // RANGES_ASKED, 1))
    weight = ranges.weight_target[every][ranges.protocol[every] == "ds"]
    if not len(weight):
        return
    skew = 1e6 * float(np.median(np.abs(2 * weight - 1)))
    if skew > SKEW_PPM:
        raise UnanswerableError(
            f"{ranges.source}: clocks differ by {skew:.0f} ppm by their third messages, crystals by 40 at most; the "
            "third leg is longer than stamps count before they wrap, or the columns of stamps are in another order"
        )


def one_way(ranges: Ranges) -> Iterator[str]:
    """Name the pair whose ranges depend most on who initiates, as they do where clock skew is left in them."""
    first, second, raw, truth = ranges.initiator, ranges.target, ranges.raw_m, ranges.truth_m
    tags = ranges.tags()
    pairs = pairs_of(first, second, tags)
    parts = _parts(raw - truth, pairs.number * 2 + (first < second))
    worst, said = 0.0, ""
    for number, part in parts.items():
        back = parts.get(number - 1, part[:0])
        if number % 2 == 0 or min(len(part), len(back)) < RANGES_A_WAY:
            continue
        differ = float(np.median(part) - np.median(back))
        std = MEDIAN * float(np.hypot(*(robust_spread(some) / np.sqrt(len(some)) for some in (part, back))))
        if abs(differ) > max(ONE_WAY_M, WAYS_DIFFER * std, worst):
            a, b = pairs.ends[number // 2]
            worst = abs(differ)
            way = "longer" if differ > 0 else "shorter"
            said = (
                f"pair {a}-{b}: ranges read {100 * worst:.0f} cm {way} if tag {a} initiates: "
                "clock skew is not corrected, or with the wrong sign of the carrier's reading"
            )
    if said:
        yield said


def _parts(error: Floats, key: Ints) -> dict[int, Floats]:
    """Return errors (n,) apart by their keys (n,)."""
    sizes = np.bincount(key)
    several = error[np.argsort(key, kind="stable")]
    return dict(enumerate(np.split(several, np.cumsum(sizes)[:-1])))


def refuse_refuted(delays_ns: Mapping[int, float], residuals_m: Floats, ranges: Ranges) -> None:
    """Raise `UnanswerableError` where a fit found what no radio has, so that its calibration is of no use.

    Delays beyond what registers hold, and errors as large as the ranges are: then true distances say nothing of the
    ranges, as they do in another unit where bodies move so little that how ranges grow with them is not seen.
    """
    every = slice(None, None, max(len(ranges) // RANGES_ASKED, 1))
    typical = float(np.median(np.abs(ranges.raw_m[every])))
    largest = max(map(abs, delays_ns.values()), default=0.0)
    spread = robust_spread(residuals_m[every])
    if largest < REGISTER_NS and spread < max(typical, LOUD_M):
        return
    ratio = typical / max(float(np.median(np.abs(ranges.truth_m[every]))), 1e-9)
    guess = _looks_like(ratio) or "they may be in another unit, or of other tags"
    raise UnanswerableError(
        f"{ranges.source}: no radio has a delay of {largest:.0f} ns (registers hold {REGISTER_NS:.0f}) or errors that "
        f"spread by {spread:.3g} m in ranges of {typical:.3g} m; check the units of the true distances and of the "
        f"ranges: {guess}"
    )


def implausible(delays_ns: Mapping[int, float], residuals_m: Floats) -> Iterator[str]:
    """Yield sentences on fitted values that hardware does not have."""
    large = {tag: delay for tag, delay in delays_ns.items() if abs(delay) > LONGEST_NS}
    if large:
        tag = max(large, key=lambda tag: abs(large[tag]))
        yield (
            f"tag {tag}: a delay of {large[tag]:+.1f} ns is more than boards differ by ({LONGEST_NS} ns); see to the "
            "unit of true distances, the order of stamps, the carrier's sign and the configured antenna delays"
        )
    spread = robust_spread(residuals_m)
    if spread > LOUD_M:
        yield f"errors spread by {spread:.2f} m after the fit, those of UWB ranges by a decimetre: whose truth is it?"
