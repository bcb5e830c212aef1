"""Whether two ways of telling how fast clocks run agree: third messages, which ranges rest on, and carriers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from uwblink.arrays import Bools, Floats
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.relative_clocks import IMPOSSIBLE_PPM, target_faster_ppm
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import COLUMNS, Exchanges, intervals, names_in

ENOUGH: Final = 10_000
"""Exchanges that are asked, drawn by chance, if there are more."""

FEWEST: Final = 20
APART_PPM: Final = 1.0
APART_SHARE: Final = 0.1
"""Readings of a carrier may be off by so much, and by such a share, without anybody's fault."""

SURELY: Final = 8.0
"""Standard errors of a median difference beyond which it is none by chance."""

MEDIAN: Final = 1.2533
SPREAD: Final = (16, 84)


@dataclass(frozen=True, slots=True)
class ClocksApart:
    """A pair, the smaller id first, whose clocks run apart by `stamps_ppm`, and by `carrier_ppm` for their carriers.

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
    """Return the pair whose clock ratio by the stamps is farthest from what carriers say, None where all agree.

    Which sign readings have is settled by most pairs: that of all is no matter for ranges with a third message.
    """
    asked = Asked()
    asked.add(exchanges)
    return asked.apart()


class Asked:
    """Exchanges of which the clocks are compared: as many as it takes, drawn by chance from all that come by."""

    def __init__(self) -> None:
        """Begin with none."""
        self._random, self._count = np.random.default_rng(0), 0
        self._parts: list[Exchanges] = []
        self._draws: list[Floats] = []

    def add(self, exchanges: Exchanges) -> None:
        """Look at some more exchanges."""
        able = _able(exchanges)
        self._count += int(np.count_nonzero(able))
        draws = self._random.random(len(exchanges))
        # More are kept than of all will be asked: their number only grows.
        kept = able & (draws < self._share())
        self._parts.append(exchanges[kept])
        self._draws.append(draws[kept])

    def _share(self) -> float:
        return ENOUGH / self._count if self._count > ENOUGH else 1.0

    def apart(self) -> ClocksApart | None:
        """Return the pair whose clocks are farthest apart, None where all agree."""
        parts = [part[draws < self._share()] for part, draws in zip(self._parts, self._draws, strict=True)]
        joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
        return _farthest_pair(replace(parts[0], **joined))


def _farthest_pair(some: Exchanges) -> ClocksApart | None:
    if not len(some):
        return None
    forth = np.where(some.initiator < some.target, 1.0, -1.0)
    stamps, carrier = forth * target_faster_ppm(some), forth * (some.skew1_ppm - some.skew2_ppm) / 2
    good = np.abs(stamps) < IMPOSSIBLE_PPM
    low, high = np.minimum(some.initiator, some.target), np.maximum(some.initiator, some.target)
    rows = {
        (a, b): good & (low == a) & (high == b) for a, b in sorted(set(zip(low.tolist(), high.tolist(), strict=True)))
    }
    rows = {pair: mine for pair, mine in rows.items() if np.count_nonzero(mine) >= FEWEST}
    medians = {pair: (float(np.median(stamps[mine])), float(np.median(carrier[mine]))) for pair, mine in rows.items()}
    carrier = carrier if sum(one * other for one, other in medians.values()) >= 0 else -carrier
    reply_s = intervals(some).dt32 * TICK_S
    found = (_apart(pair, stamps[mine], carrier[mine], reply_s[mine]) for pair, mine in rows.items())
    return farthest(found)


def farthest(several: Iterable[ClocksApart | None]) -> ClocksApart | None:
    """Return the pair whose ranges it moves most, None where there is none."""
    return max(filter(None, several), key=lambda one: one.moves_m, default=None)


def _able(exchanges: Exchanges) -> Bools:
    """Return which exchanges tell both: three messages with stamps, and readings, of which 0 is none."""
    triple = [name for name in names_in(exchanges.protocol) if PROTOCOLS[name].third_sender is not None]
    able = np.isin(exchanges.protocol, triple) & ((exchanges.tx3 | exchanges.rx3) != 0)
    readings = np.abs(exchanges.skew1_ppm) + np.abs(exchanges.skew2_ppm)
    return np.asarray(able & np.isfinite(readings) & (readings != 0))


def _apart(pair: tuple[int, int], stamps: Floats, carrier: Floats, reply_s: Floats) -> ClocksApart | None:
    """Return a pair whose readings are apart for certain, None otherwise."""
    differ = stamps - carrier
    middle = float(np.median(differ))
    std = MEDIAN * float(np.ptp(np.percentile(differ, SPREAD))) / 2 / np.sqrt(len(differ))
    by_stamps, by_carrier = float(np.median(stamps)), float(np.median(carrier))
    if abs(middle) < max(APART_PPM, SURELY * std, APART_SHARE * abs(by_carrier)):
        return None
    moves = 0.5 * SPEED_OF_LIGHT * 1e-6 * abs(middle) * float(np.median(reply_s))
    return ClocksApart(pair, by_stamps, by_carrier, moves)
