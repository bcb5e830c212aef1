"""Tags that read or send powers unlike the others: what that puts into their delays, and ranges do not show.

At the ends of a link a frame and its answer take the same way, so what differs is the tags' own: how strongly one sends
and how high it reads. Only the sum is seen. A tag that reads powers too high has its ranges corrected as stronger ones
are, and its delay takes what that is on average: right for its ranges, not for its antenna.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.power_curves import lifted_power
from calib.data.ranges import Ranges
from calib.findings import SMALLEST_NS
from calib.spread import STD_OF_MEDIAN, TWO_SIDED_95, medians, spreads
from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

RANGES_LOOKED_AT: Final = 6_000
"""Of more ranges so many are looked at, spread over all."""

GOLDEN: Final = 0.618034
"""What numbers are multiplied by whose fractions keep in step with no schedule of pairs."""

RANGES_A_LEVEL: Final = 20
"""Ranges a pair by which its levels are told."""

SAME_LEVEL_DB: Final = 0.5
"""Levels of tags that differ by less are taken for the same; medians of a pair's ranges are known to a tenth of it."""

LEVELS_DIFFER: Final = 4.0
"""Standard errors beyond which levels differ; readings of one place come together, so that these are a little small."""


def unlike_powers(ranges: Ranges, calibration: Calibration) -> Iterator[str]:
    """Name tags whose powers are unlike those of the others, so much that their delays may hold more than they say."""
    levels = power_levels_db(ranges)
    if not levels:
        return
    each_ns, unlike = _ns_a_decibel(ranges, calibration), {}
    for tag, (level, std) in levels.items():
        half_ns = TWO_SIDED_95 * calibration.delays_std_ns.get(tag, 0.0)
        if (
            half_ns > 0
            and abs(level) > max(SAME_LEVEL_DB, LEVELS_DIFFER * std)
            and abs(level) * each_ns > max(half_ns, SMALLEST_NS)
        ):
            unlike[tag] = level
    if unlike:
        named = ", ".join(f"{tag} ({level:+.1f} dB)" for tag, level in unlike.items())
        held_ps = 1e3 * each_ns * max(map(abs, unlike.values()))
        yield (
            f"powers of tag{'s' * (len(unlike) > 1)} {named} stand apart from the others': they are read so, or sent "
            f"the other way; a delay holds what its tag reads wrongly, up to {held_ps:.0f} ps here, which is right for "
            "ranges and not for the antenna"
        )


def power_levels_db(ranges: Ranges) -> dict[int, tuple[float, float]]:
    """Return by how much each tag reads powers higher, less how much more strongly it sends, than most others.

    In dB, each with its standard error; tags of which no pair has enough ranges with both powers are left out.
    """
    rows = _spread(len(ranges))
    # The initiator reads what the target sent, and the target what the initiator sent.
    apart = ranges.fpp2_dbm[rows] - ranges.fpp1_dbm[rows]
    rows, apart = rows[np.isfinite(apart)], apart[np.isfinite(apart)]
    link = ranges.initiator[rows] * 65_536 + ranges.target[rows]
    links, number, count = np.unique(link, return_inverse=True, return_counts=True)
    enough = count >= RANGES_A_LEVEL
    if not enough.any():
        return {}
    ends = np.divmod(links[enough], 65_536)
    tags = np.unique(ends)
    inverse = np.linalg.pinv(np.subtract(*(np.equal.outer(end, tags).astype(float) for end in ends)))
    middle, spread = (of(apart, number)[enough] for of in (medians, spreads))
    levels: Floats = inverse @ middle
    near = np.abs(np.subtract.outer(levels, levels)) < SAME_LEVEL_DB
    levels -= levels[near[np.argmax(near.sum(axis=1))]].mean()
    std = np.sqrt(inverse**2 @ ((STD_OF_MEDIAN * spread) ** 2 / count[enough]))
    return dict(zip(tags.tolist(), zip(levels.tolist(), std.tolist(), strict=True), strict=True))


def _spread(count: int) -> Ints:
    """Return which of so many ranges are looked at, in their order."""
    if count <= RANGES_LOOKED_AT:
        return np.arange(count)
    number = np.arange(RANGES_LOOKED_AT)
    return np.asarray((number + number * GOLDEN % 1) * count / RANGES_LOOKED_AT, dtype=np.int64)


def _ns_a_decibel(ranges: Ranges, calibration: Calibration) -> float:
    """Return what a delay takes, in ns, where its tag reads powers a decibel too high: at one end of a range of two."""
    rows = _spread(len(ranges))
    powers = ranges.fpp1_dbm[rows], ranges.fpp2_dbm[rows]
    lifted = [
        lifted_power(*both, calibration.lift, calibration.alpha_dbm)
        for both in (powers, (powers[0] + 1, powers[1]), (powers[0], powers[1] + 1))
    ]
    known = np.all(np.isfinite(lifted), axis=0)
    at, first, second = (float(np.mean(calibration.bias_curve(power[known]))) for power in lifted)
    # A range has half of either end's delay.
    return abs(0.5 * (first + second) - at) / (0.5 * SPEED_OF_LIGHT) * 1e9
