"""How fast clocks of pairs run against each other: by double-sided stamps, beside what the carriers' readings say."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats
from uwblink.protocols.table import PROTOCOLS, third_from_target
from uwblink.twr import Exchanges, intervals, names_in

FEWEST: Final = 5
MIDDLE: Final = (16, 84)
"""Percent between which single readings scatter by one standard deviation to either side."""

IMPOSSIBLE_PPM: Final = 1000.0
CLEAR_PPM: Final = 0.5
"""Skew of less has no sign that readings could have the wrong way."""


@dataclass(frozen=True, slots=True)
class ClockSkew:
    """A pair, the smaller id first: by how many ppm the second's clock is faster than the first's.

    `stamps_ppm` says so by the third leg of `count` exchanges, `carrier_ppm` by the carriers' readings, None where
    there are none; `slope` is the one over the other, `residual_ppm` how far single ones scatter about their median,
    `same_sign` None where the skew is too small to tell.
    """

    pair: str
    count: int
    stamps_ppm: float
    carrier_ppm: float | None
    residual_ppm: float | None
    same_sign: bool | None

    @property
    def slope(self) -> float | None:
        """Return carrier over stamps, None where the skew is too small to tell."""
        if self.carrier_ppm is None or abs(self.stamps_ppm) <= CLEAR_PPM:
            return None
        return self.carrier_ppm / self.stamps_ppm

    def __str__(self) -> str:
        """Return stamps, carriers, slope, residual and sign in one line."""
        if self.carrier_ppm is None or self.residual_ppm is None:
            return f"pair {self.pair}: {self.stamps_ppm:+.2f} ppm by the stamps, carriers not read"
        signs = {True: ", same sign", False: ", OTHER SIGN", None: ""}
        slope = "" if self.slope is None else f", slope {self.slope:.3f}"
        return (
            f"pair {self.pair}: {self.stamps_ppm:+.2f} ppm by the stamps, {self.carrier_ppm:+.2f} by the carriers"
            f"{slope}, residual {self.residual_ppm:.2f}{signs[self.same_sign]}"
        )


def target_faster_ppm(exchanges: Exchanges) -> Floats:
    """Return by how much the target's clock is faster, by the stamps of three messages (n,); of two, no number.

    Two messages of one sender are as far apart where they are received: the second and the third, if the target sends
    both, else the first and the third. Antenna delays cancel.
    """
    spans = intervals(exchanges)
    from_target = np.isin(exchanges.protocol, third_from_target(names_in(exchanges.protocol)))
    with np.errstate(all="ignore"):
        target = np.where(from_target, spans.dt53, spans.dt32 + spans.dt64)
        initiator = np.where(from_target, spans.dt64, spans.dt41 + spans.dt53)
        return np.asarray((target / initiator - 1) * 1e6)


class SkewReadings:
    """What exchanges say of their clocks, kept as they come: twenty bytes an exchange."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._pair: list[NDArray[np.uint32]] = []
        self._stamps: list[Floats] = []
        self._carriers: list[Floats] = []

    def add(self, exchanges: Exchanges) -> None:
        """Take some more exchanges."""
        double = [name for name in names_in(exchanges.protocol) if PROTOCOLS[name].third_sender is not None]
        rows = np.isin(exchanges.protocol, double) & ((exchanges.tx3 | exchanges.rx3) != 0)
        if not rows.any():
            return
        e = exchanges if rows.all() else exchanges[rows]
        forth = np.where(e.initiator < e.target, 1.0, -1.0)
        by_stamps, told = forth * target_faster_ppm(e), forth * (e.skew1_ppm - e.skew2_ppm) / 2
        good = np.isfinite(by_stamps) & (np.abs(by_stamps) < IMPOSSIBLE_PPM)
        pair = np.minimum(e.initiator, e.target) << 16 | np.maximum(e.initiator, e.target)
        self._pair.append(pair[good].astype(np.uint32))
        self._stamps.append(by_stamps[good])
        self._carriers.append(told[good])

    def skews(self) -> list[ClockSkew]:
        """Return the skew of every pair with enough double-sided exchanges, in the pairs' order."""
        if not self._pair:
            return []
        pair, stamps, told = (np.concatenate(parts) for parts in (self._pair, self._stamps, self._carriers))
        found = (_skew(int(one), stamps[pair == one], told[pair == one]) for one in np.unique(pair))
        return [one for one in found if one.count >= FEWEST]


def clock_skews(exchanges: Exchanges | Iterable[Exchanges]) -> list[ClockSkew]:
    """Return the skew of every pair with enough double-sided exchanges, in the pairs' order.

    `exchanges` are all, or come some at a time, as from `Recording.exchange_blocks`.
    """
    readings = SkewReadings()
    for some in [exchanges] if isinstance(exchanges, Exchanges) else exchanges:
        readings.add(some)
    return readings.skews()


def _skew(pair: int, by_stamps: Floats, told: Floats) -> ClockSkew:
    stamps, known = float(np.median(by_stamps)), told[np.isfinite(told)]
    carrier = float(np.median(known)) if len(known) else None
    spread = float(np.ptp(np.percentile(known, MIDDLE))) / 2 if len(known) else None
    alike = None
    if carrier is not None and abs(stamps) > CLEAR_PPM:
        alike = bool(np.sign(stamps) == np.sign(carrier))
    return ClockSkew(f"{pair >> 16}-{pair & 0xFFFF}", len(by_stamps), stamps, carrier, spread, alike)


def told(skews: Sequence[ClockSkew]) -> str:
    """Return pairs' skews in one line: how well carriers follow the stamps, and in how many pairs by the other sign."""
    slopes = [one.slope for one in skews if one.slope is not None]
    residuals = [one.residual_ppm for one in skews if one.residual_ppm is not None]
    if not slopes or not residuals:
        return f"{len(skews)} pairs by the stamps, no carriers to compare with"
    other = sum(one.same_sign is False for one in skews)
    sign = "same sign" if not other else f"OTHER SIGN in {other} of {len(skews)} pairs"
    return f"carriers over stamps {np.median(slopes):.3f}, residual {np.median(residuals):.2f} ppm, {sign}"
