"""Clock skew by stamps and by carrier integrators, and errors of single-sided ranges by skew."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.findings import FIT_LEVELS, exceeds
from calib.pairs import pairs_of
from calib.spread import STD_OF_MEDIAN, medians, spreads
from uwblink.protocols.table import PROTOCOLS, Intervals, is_single_sided
from uwblink.recording import IMPOSSIBLE_PPM, target_faster_ppm
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges, intervals, names_in, without_stamps

PPM_TO_METRES: Final = 0.5 * SPEED_OF_LIGHT * 1e-6
"""Error of a single-sided range per ppm of clock skew and second of reply time: c/2 times 1e-6 (m)."""


@dataclass(frozen=True, slots=True)
class ClocksApart:
    """A pair, the smaller id first, with different relative clock skews by stamps and by carriers, in ppm.

    `moves_m` is the error of its ranges if the stamps are wrong, `p_value` the probability of such a difference between
    sound readings.
    """

    pair: tuple[int, int]
    stamps_ppm: float
    carrier_ppm: float
    moves_m: float
    p_value: float

    def __str__(self) -> str:
        """Return a sentence about the fault."""
        return (
            f"pair {self.pair[0]}-{self.pair[1]}: the relative clock skew is {self.stamps_ppm:+.1f} ppm by the third "
            f"messages and {self.carrier_ppm:+.1f} ppm by the carriers: if the stamps are wrong, the error of its "
            f"ranges is "
            f"{100 * self.moves_m:.0f} cm"
        )


def clocks_apart(exchanges: Exchanges) -> ClocksApart | None:
    """Return the pair whose skews by stamps and by carriers differ most, by their effect on ranges; None if all agree.

    The comparison uses exchanges with three messages and readings of the carrier integrator; a reading of 0 means that
    it was not read. The sign of the readings is not known, because ranges with three messages do not depend on it: the
    sign with the better agreement over all pairs is used. Median differences up to 1 ppm or a tenth of the skew are
    tolerated, and pairs with fewer than 20 exchanges are ignored (judgements).
    """
    readings = np.abs(exchanges.skew1_ppm) + np.abs(exchanges.skew2_ppm)
    triple = [name for name in names_in(exchanges.protocol) if PROTOCOLS[name].third_sender is not None]
    able = np.isin(exchanges.protocol, triple) & ((exchanges.tx3 | exchanges.rx3) != 0)
    rows = np.flatnonzero(able & np.isfinite(readings) & (readings != 0))
    # A sample bounds the run time. It is random, because a regular one could coincide with the schedule of pairs.
    some = exchanges[np.sort(np.random.default_rng(0).permutation(rows)[:20_000])]
    some = some[np.abs(target_faster_ppm(some)) < IMPOSSIBLE_PPM]
    pair = pairs_of(some.initiator, some.target).number
    _, first, count = np.unique(pair, return_index=True, return_counts=True)
    forth, enough = np.where(some.initiator < some.target, 1.0, -1.0), count >= 20
    stamps, carrier = forth * target_faster_ppm(some), forth * (some.skew1_ppm - some.skew2_ppm) / 2
    by_stamps, by_carrier = medians(stamps, pair), medians(carrier, pair)
    sign = 1.0 if np.sum((by_stamps * by_carrier)[enough]) >= 0 else -1.0
    differ, by_carrier = medians(stamps - sign * carrier, pair), sign * by_carrier
    std = STD_OF_MEDIAN * spreads(stamps - sign * carrier, pair) / np.sqrt(count)
    tolerance = np.maximum(1.0, 0.1 * np.abs(by_carrier))
    p_values = np.array(
        [
            exceeds(float(value), float(error), several - 1, tolerance=float(least), tried=int(enough.sum()))
            for value, error, several, least in zip(differ, std, count.tolist(), tolerance, strict=True)
        ]
    )
    moves_m = PPM_TO_METRES * np.abs(differ) * medians(intervals(some).dt32 * TICK_S, pair)
    moves_m = np.where((p_values < FIT_LEVELS["clocks"]) & enough, moves_m, 0.0)
    if not moves_m.any():
        return None
    k = int(np.argmax(moves_m))
    low, high = sorted((int(some.initiator[first[k]]), int(some.target[first[k]])))
    return ClocksApart((low, high), *(float(one[k]) for one in (by_stamps, by_carrier, moves_m, p_values)))


@dataclass(frozen=True, slots=True)
class UncorrectedSkew:
    """Errors of single-sided ranges by clock skew, in metres.

    `bound_m` is the error for crystals at the ends of their tolerance, with the median reply time `reply_s`. `read_m`
    is the 95 % quantile of the errors that follow from readings of the carrier integrators, NaN without readings.
    """

    bound_m: float
    reply_s: float
    read_m: float

    def __str__(self) -> str:
        """Return the bound as a sentence."""
        bound = (
            f"two clocks with errors of 20 ppm each cause up to {as_length(self.bound_m)} "
            f"(c/2 x 40 ppm x {1e6 * self.reply_s:.0f} µs of reply)"
        )
        if not np.isfinite(self.read_m):
            return (
                f"single-sided ranges without carrier readings: {bound}, which has the effect of an antenna delay "
                f"with opposite signs for the two initiators"
            )
        return (
            f"single-sided ranges with clock skew in them: {bound}, and by the carriers' readings up to "
            f"{as_length(self.read_m)}; imported with protocol ss-cfo they are corrected with the readings"
        )


def as_length(metres: float) -> str:
    """Return a length as text in m, cm or mm, depending on its size."""
    if metres >= 1:
        return f"{metres:.1f} m"
    return f"{100 * metres:.0f} cm" if metres >= 0.01 else f"{1e3 * metres:.1f} mm"


def uncorrected_skew(exchanges: Exchanges) -> UncorrectedSkew | None:
    """Return the errors by skew of single-sided ranges with stamps and without skew correction; None without any.

    A single-sided time of flight is (round trip - reply) / 2. If the clocks differ by the relative rate s, its error is
    s times half of the reply time.
    """
    names = [name for name in names_in(exchanges.protocol) if is_single_sided(name) and not corrected(name)]
    some = exchanges[np.isin(exchanges.protocol, names) & ~without_stamps(exchanges)]
    if not len(some):
        return None
    reply_s = intervals(some).dt32 * TICK_S
    median_s, known = float(np.median(reply_s)), np.isfinite(some.skew2_ppm) & (some.skew2_ppm != 0)
    read_m = (np.abs(some.skew2_ppm) * PPM_TO_METRES * reply_s)[known]
    # Each of two crystals may be off its frequency by 20 ppm (IEEE 802.15.4, 15.4.9).
    bound_m = 2 * 20.0 * PPM_TO_METRES * median_s
    return UncorrectedSkew(bound_m, median_s, float(np.quantile(read_m, 0.95)) if len(read_m) else np.nan)


def corrected(protocol: str) -> bool:
    """Return whether the formula of a protocol depends on readings of the carrier integrator."""
    one = np.ones(1)
    tried = [Intervals(2e7 * one, 1e7 * one, 0 * one, 0 * one, ppm * one) for ppm in (0.0, 10.0)]
    with np.errstate(all="ignore"):
        first, second = (PROTOCOLS[protocol].flight_ticks(spans)[0] for spans in tried)
    return bool(first != second)
