"""What clock skew may have left in single-sided ranges: by their reply time, and by their carriers' readings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.formulas import Intervals
from uwblink.protocols.table import PROTOCOLS, is_single_sided
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges, intervals, names_in, without_stamps

CRYSTAL_PPM: Final = 20.0
"""By how much a crystal may be off its frequency (IEEE 802.15.4, 15.4.9)."""

HALF_A_PPM: Final = 0.5 * SPEED_OF_LIGHT * 1e-6
"""What a ppm makes of a second of reply, in metres."""


@dataclass(frozen=True, slots=True)
class LeftSkew:
    """What skew may have left in ranges, metres.

    `bound_m` is for crystals at the ends of what they may be, `reply_s` the median reply; `told_m` is what 95 % of the
    carriers' readings stay below, NaN where they were not read.
    """

    bound_m: float
    reply_s: float
    told_m: float


def left_skew(exchanges: Exchanges) -> LeftSkew | None:
    """Return what skew may have left in the single-sided ranges that nothing corrected; None where there are none.

    A single-sided time of flight is half of round trip less reply, so a target's clock that is faster by s makes it
    longer by s times half the reply.
    """
    return left_in([skew_terms(exchanges)])


Terms = tuple[Floats, Floats]
"""Reply times (n,) of single-sided ranges that nothing corrected, in s, and what the carriers' readings say of those
that have any, in m."""


def skew_terms(exchanges: Exchanges) -> Terms:
    """Return of some exchanges what `left_in` asks of all."""
    names = [name for name in names_in(exchanges.protocol) if is_single_sided(name) and not corrected(name)]
    rows = np.isin(exchanges.protocol, names) & ~without_stamps(exchanges)
    some = exchanges[rows]
    reply_s = intervals(some).dt32 * TICK_S
    known = np.isfinite(some.skew2_ppm) & (some.skew2_ppm != 0)
    return reply_s, np.abs(some.skew2_ppm[known]) * HALF_A_PPM * reply_s[known]


def left_in(terms: Sequence[Terms]) -> LeftSkew | None:
    """Return what skew may have left in ranges, by the terms of all of them; None where there are none."""
    reply_s, told_m = (np.concatenate(column) for column in zip(*terms, strict=True))
    if not len(reply_s):
        return None
    median = float(np.median(reply_s))
    told = float(np.quantile(told_m, 0.95)) if len(told_m) else np.nan
    return LeftSkew(bound_m=2 * CRYSTAL_PPM * HALF_A_PPM * median, reply_s=median, told_m=told)


def corrected(protocol: str) -> bool:
    """Return whether a protocol's formula takes the carriers' readings into account."""
    reply, third = np.array([1e7]), np.zeros(1)
    with np.errstate(all="ignore"):
        found = [
            float(PROTOCOLS[protocol].flight_ticks(Intervals(2 * reply, reply, third, third, np.array([ppm])))[0])
            for ppm in (0.0, 10.0)
        ]
    return found[0] != found[1]


def worst(several: Iterable[LeftSkew | None]) -> LeftSkew | None:
    """Return the one with the largest bound, None where there is none."""
    return max(filter(None, several), key=lambda one: one.bound_m, default=None)
