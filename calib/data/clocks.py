"""What ranges owe to clocks: two ways of telling clock skew that should agree, and skew left in single-sided ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.spread import STD_OF_MEDIAN
from uwblink.arrays import Bools, Floats
from uwblink.protocols.table import PROTOCOLS, Intervals, is_single_sided
from uwblink.recording import IMPOSSIBLE_PPM, target_faster_ppm
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges, intervals, names_in, without_stamps

PPM_TO_METRES: Final = 0.5 * SPEED_OF_LIGHT * 1e-6
"""What a ppm of clock skew changes in a single-sided range per second of reply time: half of c times a ppm."""


@dataclass(frozen=True, slots=True)
class ClocksApart:
    """A pair, the smaller id first, whose clocks differ by `stamps_ppm`, but by `carrier_ppm` for their carriers.

    `moves_m` is what the difference does to its ranges.
    """

    pair: tuple[int, int]
    stamps_ppm: float
    carrier_ppm: float
    moves_m: float

    def __str__(self) -> str:
        """Return what is wrong as a sentence."""
        return (
            f"pair {self.pair[0]}-{self.pair[1]}: clocks run apart by {self.stamps_ppm:+.1f} ppm by the third messages "
            f"and by {self.carrier_ppm:+.1f} ppm by the carriers: if the stamps are wrong, so are its ranges, by "
            f"{100 * self.moves_m:.0f} cm"
        )


def clocks_apart(exchanges: Exchanges) -> ClocksApart | None:
    """Return the pair whose clock ratio by the stamps is farthest from that of the carriers, None where all agree.

    Most pairs settle which sign the readings have: ranges with a third message do not depend on it.
    """
    sample = ClockSample()
    sample.add(exchanges)
    return sample.farthest_pair()


class ClockSample:
    """Exchanges whose clocks are compared: at most `size`, drawn at random from all that are added."""

    def __init__(self, size: int = 10_000) -> None:
        """Begin empty."""
        self._size = size
        self._random, self._count = np.random.default_rng(0), 0
        self._parts: list[Exchanges] = []
        self._draws: list[Floats] = []

    def add(self, exchanges: Exchanges) -> None:
        """Add some more exchanges."""
        able = _comparable(exchanges)
        self._count += int(np.count_nonzero(able))
        draws = self._random.random(len(exchanges))
        # More are kept than will be compared: the share of those that are kept only falls.
        kept = able & (draws < self._share())
        self._parts.append(exchanges[kept])
        self._draws.append(draws[kept])

    def _share(self) -> float:
        return self._size / self._count if self._count > self._size else 1.0

    def farthest_pair(self) -> ClocksApart | None:
        """Return the pair whose clocks are farthest apart, None where all agree."""
        parts = [part[draws < self._share()] for part, draws in zip(self._parts, self._draws, strict=True)]
        if not sum(map(len, parts)):
            return None
        return _farthest_pair(Exchanges.concatenate(parts))


def _comparable(exchanges: Exchanges) -> Bools:
    """Return which exchanges show skew in both ways: three messages with stamps, and readings, of which 0 is none."""
    triple = [name for name in names_in(exchanges.protocol) if PROTOCOLS[name].third_sender is not None]
    able = np.isin(exchanges.protocol, triple) & ((exchanges.tx3 | exchanges.rx3) != 0)
    readings = np.abs(exchanges.skew1_ppm) + np.abs(exchanges.skew2_ppm)
    return np.asarray(able & np.isfinite(readings) & (readings != 0))


def _farthest_pair(some: Exchanges, min_exchanges: int = 20) -> ClocksApart | None:
    forth = np.where(some.initiator < some.target, 1.0, -1.0)
    stamps, carrier = forth * target_faster_ppm(some), forth * (some.skew1_ppm - some.skew2_ppm) / 2
    good = np.abs(stamps) < IMPOSSIBLE_PPM
    low, high = np.minimum(some.initiator, some.target), np.maximum(some.initiator, some.target)
    rows = {}
    for a, b in sorted(set(zip(low.tolist(), high.tolist(), strict=True))):
        mine = good & (low == a) & (high == b)
        if np.count_nonzero(mine) >= min_exchanges:
            rows[a, b] = mine
    medians = [(float(np.median(stamps[mine])), float(np.median(carrier[mine]))) for mine in rows.values()]
    carrier = carrier if sum(one * other for one, other in medians) >= 0 else -carrier
    reply_s = intervals(some).dt32 * TICK_S
    found = [_apart(pair, stamps[mine], carrier[mine], reply_s[mine]) for pair, mine in rows.items()]
    return max(filter(None, found), key=lambda one: one.moves_m, default=None)


def _apart(pair: tuple[int, int], stamps: Floats, carrier: Floats, reply_s: Floats) -> ClocksApart | None:
    """Return a pair whose two readings of skew differ for certain, None otherwise.

    Readings of a carrier may be off by 1 ppm, and by a tenth of the skew, without any fault; and eight standard errors
    of the median difference are no chance. Sigma is half of the distance between the percentiles 16 and 84.
    """
    differ = stamps - carrier
    middle = float(np.median(differ))
    std = STD_OF_MEDIAN * float(np.ptp(np.percentile(differ, (16, 84)))) / 2 / np.sqrt(len(differ))
    by_stamps, by_carrier = float(np.median(stamps)), float(np.median(carrier))
    if abs(middle) < max(1.0, 8.0 * std, 0.1 * abs(by_carrier)):
        return None
    return ClocksApart(pair, by_stamps, by_carrier, PPM_TO_METRES * abs(middle) * float(np.median(reply_s)))


@dataclass(frozen=True, slots=True)
class LeftSkew:
    """What clock skew may have left in single-sided ranges, metres.

    `bound_m` is for crystals at the ends of their tolerance, `reply_s` the median reply time; `told_m` is what 95 % of
    the carriers' readings stay below, NaN where they were not read.
    """

    bound_m: float
    reply_s: float
    told_m: float


def left_skew(exchanges: Exchanges) -> LeftSkew | None:
    """Return what skew may have left in the single-sided ranges that nothing corrected; None where there are none.

    A single-sided time of flight is half of round trip less reply, so a target's clock that is faster by s makes it
    longer by s times half the reply.
    """
    return left_skew_of([skew_terms(exchanges)])


def skew_terms(exchanges: Exchanges) -> tuple[Floats, Floats]:
    """Return reply times (n,) in s of uncorrected single-sided ranges, and what carriers say of those read, in m."""
    names = [name for name in names_in(exchanges.protocol) if is_single_sided(name) and not corrected(name)]
    rows = np.isin(exchanges.protocol, names) & ~without_stamps(exchanges)
    some = exchanges[rows]
    reply_s = intervals(some).dt32 * TICK_S
    known = np.isfinite(some.skew2_ppm) & (some.skew2_ppm != 0)
    return reply_s, np.abs(some.skew2_ppm[known]) * PPM_TO_METRES * reply_s[known]


def left_skew_of(terms: Sequence[tuple[Floats, Floats]]) -> LeftSkew | None:
    """Return what skew may have left in ranges, by `skew_terms` of all of them; None where there are none."""
    replies = [reply_s for reply_s, _ in terms if len(reply_s)]
    if not replies:
        return None
    median, told_m = float(np.median(np.concatenate(replies))), np.concatenate([metres for _, metres in terms])
    told = float(np.quantile(told_m, 0.95)) if len(told_m) else np.nan
    # Each of two crystals may be off its frequency by 20 ppm (IEEE 802.15.4, 15.4.9).
    return LeftSkew(bound_m=2 * 20.0 * PPM_TO_METRES * median, reply_s=median, told_m=told)


def corrected(protocol: str) -> bool:
    """Return whether a protocol's formula takes the carriers' readings into account."""
    reply, third = np.array([1e7]), np.zeros(1)
    with np.errstate(all="ignore"):
        found = [
            float(PROTOCOLS[protocol].flight_ticks(Intervals(2 * reply, reply, third, third, np.array([ppm])))[0])
            for ppm in (0.0, 10.0)
        ]
    return found[0] != found[1]
