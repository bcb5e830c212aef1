"""How fast clocks of pairs run against each other: by double-sided stamps, beside what the carriers' readings say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.table import PROTOCOLS, third_from_target
from uwblink.twr import Exchanges, intervals

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
    from_target = np.isin(exchanges.protocol, third_from_target())
    with np.errstate(all="ignore"):
        target = np.where(from_target, spans.dt53, spans.dt32 + spans.dt64)
        initiator = np.where(from_target, spans.dt64, spans.dt41 + spans.dt53)
        return np.asarray((target / initiator - 1) * 1e6)


def clock_skews(exchanges: Exchanges) -> list[ClockSkew]:
    """Return the skew of every pair with enough double-sided exchanges, in the pairs' order."""
    double = [name for name in np.unique(exchanges.protocol).tolist() if PROTOCOLS[name].third_sender is not None]
    rows = np.isin(exchanges.protocol, double) & ((exchanges.tx3 | exchanges.rx3) != 0)
    if not rows.any():
        return []
    e = exchanges[rows]
    target_faster = target_faster_ppm(e)
    forth = np.where(e.initiator < e.target, 1.0, -1.0)
    by_stamps, told = forth * target_faster, forth * (e.skew1_ppm - e.skew2_ppm) / 2
    low, high = np.minimum(e.initiator, e.target), np.maximum(e.initiator, e.target)
    good = np.isfinite(by_stamps) & (np.abs(by_stamps) < IMPOSSIBLE_PPM)
    found = []
    for a, b in np.unique(np.column_stack([low, high]), axis=0).tolist():
        mine = good & (low == a) & (high == b)
        if np.count_nonzero(mine) < FEWEST:
            continue
        stamps = float(np.median(by_stamps[mine]))
        known = told[mine & np.isfinite(told)]
        carrier = float(np.median(known)) if len(known) else None
        spread = float(np.ptp(np.percentile(known, MIDDLE))) / 2 if len(known) else None
        alike = None
        if carrier is not None and abs(stamps) > CLEAR_PPM:
            alike = bool(np.sign(stamps) == np.sign(carrier))
        found.append(ClockSkew(f"{a}-{b}", int(np.count_nonzero(mine)), stamps, carrier, spread, alike))
    return found


def told(skews: Sequence[ClockSkew]) -> str:
    """Return pairs' skews in one line: how well carriers follow the stamps, and in how many pairs by the other sign."""
    slopes = [one.slope for one in skews if one.slope is not None]
    residuals = [one.residual_ppm for one in skews if one.residual_ppm is not None]
    if not slopes or not residuals:
        return f"{len(skews)} pairs by the stamps, no carriers to compare with"
    other = sum(one.same_sign is False for one in skews)
    sign = "same sign" if not other else f"OTHER SIGN in {other} of {len(skews)} pairs"
    return f"carriers over stamps {np.median(slopes):.3f}, residual {np.median(residuals):.2f} ppm, {sign}"
