"""The impulse response that paths add up to, tap by tap, and what a chip reads off it: first path, powers, noise.

The accumulator has a tap every 1.0016 ns, and the direct path lies in it as the chip puts a first path: `EDGE_TO_PEAK`
after a whole tap. Pulses are Gaussian, as in `impulse_response`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from uwblink.arrays import Complexes, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.world.geometric_paths import Paths
from uwbsim.world.impulse_response import EDGE_TO_PEAK, PULSE_TAPS, TAP_S

TAP_M: Final = TAP_S * SPEED_OF_LIGHT
BEFORE: Final = 6
"""Taps before the direct path's edge; so many of them are enough for its pulse."""

TAPS: Final = 64
"""Taps in which a first path is looked for: 17 m."""

LAST_M: Final = (TAPS - BEFORE - EDGE_TO_PEAK) * TAP_M
"""Paths that come later than this count for the total power alone."""

REACH: Final = 4
"""Taps on either side of a pulse's peak where it is still there: 1.5e-5 of its height at the fourth."""

BLOCK: Final = 2 * REACH
"""Taps in which a pulse alone is there."""

FRACTIONS: Final = 128
CURVATURE: Final = 1 / PULSE_TAPS**2
"""The logarithm of a pulse is a parabola; this is its coefficient, turned round."""

HALF_TO_PEAK: Final = PULSE_TAPS * float(np.sqrt(np.log(2)))
"""From half the height of a pulse alone to its peak."""

NOTHING: Final = 1e-20
SMALLEST_SLOPE: Final = 0.2
"""Of the logarithm over a tap: on a flatter edge noise does not count for more."""

OWN_TAPS: Final = np.arange(1, 4)
"""Taps after the edge whose squares are the first path's power (DW1000 User Manual, 4.7.1)."""

OWN_SQUARES: Final = float(np.sum(np.exp(-2 * CURVATURE * (OWN_TAPS - EDGE_TO_PEAK) ** 2)))
ALL_SQUARES: Final = float(np.sum(np.exp(-2 * CURVATURE * (np.arange(-8, 9) - EDGE_TO_PEAK) ** 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensing:
    """What a chip can tell: how far below the strongest tap, and above which power in dBm, it takes a first path.

    `noise_share` is the noise's standard deviation as a share of that threshold; 0 for none on the stamps.
    """

    dynamic_range_db: float
    sensitivity_dbm: float
    noise_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Detected:
    """What is read off n responses, (n,) each.

    `excess_m` is how much longer than the straight line the first path seems, `power_dbm` its power in the chip's
    formula, `total_dbm` that of the whole response, `noise_s` what noise does to its edge (standard deviation).
    """

    excess_m: Floats
    power_dbm: Floats
    total_dbm: Floats
    noise_s: Floats


def detect(paths: Paths, sensing: Sensing) -> Detected:
    """Return what a chip makes of paths.

    The first path is the first peak from where the response exceeds the threshold; the chip puts it where its leading
    edge has half its height (so it does in recorded responses: 0.52 in the median of 944 of MILUV's boards). From there
    to the peak it is as far as in a pulse alone, so a path alone is found where it is, at any power.
    """
    parts = _accumulated(paths)
    squares = parts[0] ** 2
    squares += parts[1] ** 2
    strongest = _height(squares.max(axis=1))
    least = np.log(10) / 20
    threshold = np.maximum(strongest - sensing.dynamic_range_db * least, sensing.sensitivity_dbm * least)
    # Who is not heard has a first path all the same.
    threshold = np.minimum(threshold, strongest - 0.5)
    peak, top = _first_peak(squares, np.argmax(squares >= np.exp(2 * threshold)[:, None], axis=1))
    edge, slope = _half_height(squares, peak, top)
    arrival = edge + HALF_TO_PEAK
    first = np.floor(arrival - EDGE_TO_PEAK + 1e-6).astype(np.int64)[:, None] + OWN_TAPS
    own = np.take_along_axis(squares, np.clip(first, 0, TAPS - 1), axis=1).sum(axis=1) / OWN_SQUARES
    total = squares.sum(axis=1) / ALL_SQUARES + _later(paths)
    noise = sensing.noise_share * np.exp(np.minimum(threshold - top, 0)) * 2
    return Detected(
        excess_m=(arrival - BEFORE - EDGE_TO_PEAK) * TAP_M,
        power_dbm=10 * np.log10(np.maximum(own, NOTHING)),
        total_dbm=10 * np.log10(np.maximum(total, NOTHING)),
        noise_s=noise / np.maximum(slope, SMALLEST_SLOPE) * TAP_S,
    )


def response(paths: Paths) -> Complexes:
    """Return the accumulators of n links around their direct paths, (n, `TAPS`), in roots of mW."""
    real, imaginary = _accumulated(paths)
    return np.asarray(real + 1j * imaginary)


def _accumulated(paths: Paths) -> Floats:
    """The real and the imaginary parts of `response`, (2, n, `TAPS`).

    A pulse lies in the block of taps where it begins and the next one; so each path adds one row of a table to two
    blocks at its amplitude, which a sparse matrix does without a list of its taps.
    """
    from scipy.sparse import coo_array

    count, blocks = len(paths.amplitude), TAPS // BLOCK
    place = (BEFORE + EDGE_TO_PEAK + paths.detour_m / TAP_M) * FRACTIONS
    inside = (paths.detour_m < LAST_M) & (place >= 0)
    nearest = np.clip(np.rint(place), 0, TAPS * FRACTIONS - 1).astype(np.int32)
    block, within = np.divmod(nearest, BLOCK * FRACTIONS)
    block += np.arange(count, dtype=np.int32)[:, None] * blocks
    amplitude = np.where(inside, paths.amplitude, 0).ravel()
    rows = np.stack([block, block + count * blocks]).ravel()
    values = np.concatenate([amplitude.real, amplitude.imag])
    shape = (2 * count * blocks, BLOCK * FRACTIONS)
    added = np.asarray(coo_array((values, (rows, np.tile(within.ravel(), 2))), shape=shape) @ _pulses())
    pairs = added.reshape(2, count, blocks, 2, BLOCK)
    taps = np.zeros((2, count, blocks + 1, BLOCK))
    taps[:, :, :-1] = pairs[:, :, :, 0]
    taps[:, :, 1:] += pairs[:, :, :, 1]
    return taps.reshape(2, count, -1)[:, :, REACH - 1 : REACH - 1 + TAPS]


def _later(paths: Paths) -> Floats | float:
    """The power of the paths that come after the last tap, (n,)."""
    late = paths.detour_m >= LAST_M
    if not np.any(late):
        return 0.0
    return np.asarray(np.sum(np.abs(np.where(late, paths.amplitude, 0)) ** 2, axis=1))


@cache
def _pulses() -> Floats:
    """Pulses on two blocks of taps, by where in the first they peak, in `FRACTIONS` of a tap: (places, two blocks).

    The first tap is the one `REACH` - 1 before; so far a pulse reaches back.
    """
    step, fraction = np.divmod(np.arange(BLOCK * FRACTIONS), FRACTIONS)
    taps = np.arange(2 * BLOCK) - (REACH - 1) - step[:, None]
    pulses = np.exp(-CURVATURE * (taps - (fraction / FRACTIONS)[:, None]) ** 2)
    return np.asarray(np.where((taps > -REACH) & (taps <= REACH), pulses, 0))


def _height(squares: Floats) -> Floats:
    """The logarithm of an amplitude, of its square."""
    return np.asarray(np.log(np.maximum(squares, NOTHING**2)) / 2)


def _first_peak(squares: Floats, begin: Ints) -> tuple[Ints, Floats]:
    """Return the first peak's tap from the tap `begin` on, and its height, by a parabola through its neighbours."""
    rows, last = np.arange(len(squares)), squares.shape[1] - 2
    falls = squares[:, :-1] >= squares[:, 1:]
    falls &= np.arange(squares.shape[1] - 1) >= begin[:, None]
    peak = np.clip(np.where(falls.any(axis=1), np.argmax(falls, axis=1), last), 1, last)
    left, top, right = (_height(squares[rows, peak + k]) for k in (-1, 0, 1))
    bend = np.minimum(left - 2 * top + right, -1e-6)
    return peak, np.asarray(top - np.clip((right - left) ** 2 / (8 * bend), -1, 0))


def _half_height(squares: Floats, peak: Ints, top: Floats) -> tuple[Floats, Floats]:
    """Return where the edge before a peak has half its height, in taps, and its slope there.

    Between two taps the logarithm is curved as a pulse's is.
    """
    rows, half = np.arange(len(squares)), top - np.log(2)
    below = (squares < np.exp(2 * half)[:, None]) & (np.arange(squares.shape[1]) < peak[:, None])
    # The last tap before the peak that is lower; the first there is where none is.
    before = np.where(below.any(axis=1), squares.shape[1] - 1 - np.argmax(below[:, ::-1], axis=1), 0)
    low, high = (_height(squares[rows, before + k]) for k in (0, 1))
    rise = np.maximum(high - low, 1e-9)
    # low + (rise + k) u - k u^2 = half.
    linear, missing = rise + CURVATURE, np.clip(half - low, 0, rise)
    root = np.sqrt(np.maximum(linear**2 - 4 * CURVATURE * missing, 0))
    return before + 2 * missing / (linear + root), root
