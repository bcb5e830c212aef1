"""Channel impulse responses as boards print them, and detection of the first path in a response.

A printed response has a first path, its echoes, and noise. With geometric multipath it is the sum of the link's paths
with their phases, and noise. `detect` sums the paths of a link in the accumulator, which has a tap every 1.0016 ns, and
returns first path, powers and noise. Pulses are Gaussian; the peak of the direct path is `EDGE_TO_PEAK` after a whole
tap, where the chip puts a first path.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from scipy.sparse import coo_array

from uwblink.arrays import Complexes, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.wire.messages import Cir
from uwbsim.scenario.radio import Radio
from uwbsim.world.radio import FPP_OFFSET_DB

PULSE_TAPS: Final = 1.2
"""Half width of a pulse at 1/e of its height: 2 ns full width at half maximum, a bandwidth of 440 MHz."""

EDGE_TO_PEAK: Final = 1.5
"""Taps from the leading edge that the chip reports to the peak of the pulse."""

TAP_S: Final = 1.0016 * 1e-9
"""Half a period of 499.2 MHz, at which the accumulator is sampled (DW1000 User Manual, 7.2.26)."""

TAP_M: Final = TAP_S * SPEED_OF_LIGHT
INDEX_STEPS: Final = 1000
"""The boards print the first path in thousandths of a tap."""

LARGEST_TAP: Final = 32_767
"""Taps are 16 bits wide."""

BEFORE: Final = 6
"""Taps before the leading edge of the direct path: a pulse is shorter."""

SEARCHED_TAPS: Final = 64
"""Taps in which a first path is searched: 17 m."""

REACH: Final = 4
"""Taps on either side of a pulse's peak that are computed: the fourth has 1.5e-5 of its height."""

BLOCK: Final = 2 * REACH
"""Taps of a single pulse."""

FRACTIONS: Final = 128
"""Positions within a tap at which pulses are tabulated, 2 mm of path apart."""

CURVATURE: Final = 1 / PULSE_TAPS**2
"""The logarithm of a pulse is -CURVATURE (taps from its peak)^2."""

OWN_TAPS: Final = np.arange(1, 4)
"""Taps after the edge whose squares are the first path's power (DW1000 User Manual, 4.7.1)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """p paths of n links: length minus the straight line, in metres, and complex amplitude.

    Shapes (n, p); an amplitude's square is a power in mW, its phase that of the carrier.
    """

    detour_m: Floats
    amplitude: Complexes


@dataclass(frozen=True, slots=True)
class PathsHeard:
    """The paths of a link for its impulse response: the power of the first path in dBm, and p paths, (p,) each.

    `delay_s` are relative to the detected first path. Real `amplitude` are the amplitudes of echoes after it, as
    fractions of its amplitude. Complex `amplitude`, in roots of mW, are the amplitudes of all paths from geometry,
    including the first; some may be before the path that the chip detects.
    """

    power_dbm: float
    delay_s: Floats
    amplitude: Floats | Complexes


def peak_amplitude(power_dbm: float) -> float:
    """Return the peak of a first path in the chip's counts, from its power (DW1000 User Manual, 4.7.1).

    The power is 10 log10((F1^2 + F2^2 + F3^2)/N^2) - 121.74 of the three taps after the leading edge; the chip
    accumulates N = 118 of the 128 symbols of the preamble.
    """
    return float(118 * np.sqrt(10 ** ((power_dbm + FPP_OFFSET_DB) / 10) / _squares(OWN_TAPS)))


def impulse_response(rng: np.random.Generator, stamp: int, paths: PathsHeard) -> tuple[int, tuple[int, ...]]:
    """Draw a response: index of the first path in thousandths of a tap, and 1016 magnitudes.

    The index has the fractional part of the receive `stamp` (ticks); 64 ticks are a tap. Diffuse echoes are added to
    `paths`, unless these are complex.
    """
    # The chip places the first path at 745, within one tap (DW1000 User Manual, 7.2.40.1).
    index = int(INDEX_STEPS * (745.0 + rng.integers(-1, 2) + stamp % 64 / 64))
    # The chip reports the leading edge; the peak of the pulse follows it.
    peak = index / INDEX_STEPS + EDGE_TO_PEAK
    noise = 45.0
    if np.iscomplexobj(paths.amplitude):
        wave = _from_geometry(peak, paths)
        # Noise of real and imaginary part: 28 counts of a response at full gain, and a fraction of the strongest tap,
        # because preambles do not correlate perfectly. By power, 265 responses of MILUV's boards have 0.0090 (at -82
        # dBm), 0.0091, 0.0113, 0.0122 and 0.0185 (at -93 dBm) of their strongest taps.
        noise = float(np.hypot(28.0, 0.009 * np.abs(wave).max()))
    else:
        wave = _with_diffuse(rng, peak, paths)
    wave = wave + noise * (rng.normal(size=Cir.TAPS) + 1j * rng.normal(size=Cir.TAPS))
    re, im = (np.minimum(np.abs(np.trunc(part)), LARGEST_TAP) for part in (wave.real, wave.imag))
    # The firmware's estimate of a magnitude: the larger part and a quarter of the smaller.
    return index, tuple((np.maximum(re, im) + np.minimum(re, im) // 4).astype(np.int64).tolist())


def _with_diffuse(rng: np.random.Generator, peak: float, paths: PathsHeard) -> Complexes:
    """Return a first path, known echoes and diffuse ones, all with random phases."""
    taps = np.arange(Cir.TAPS)
    amplitude = peak_amplitude(paths.power_dbm)
    wave = amplitude * np.exp(-(((taps - peak) / PULSE_TAPS) ** 2)) + 0j
    count, decay_taps = rng.poisson(12), 14.0
    later = rng.exponential(decay_taps, count)
    strength = 0.25 * np.exp(-later / decay_taps) * rng.rayleigh(size=count)
    known = [*zip(later.tolist(), strength.tolist(), strict=True)]
    known += [*zip((paths.delay_s / TAP_S).tolist(), paths.amplitude.tolist(), strict=True)]
    for (place, share), phase in zip(known, rng.uniform(0, 2 * np.pi, len(known)), strict=True):
        wave += amplitude * share * np.exp(1j * phase - ((taps - peak - place) / PULSE_TAPS) ** 2)
    return np.asarray(wave)


def _from_geometry(peak: float, paths: PathsHeard) -> Complexes:
    """Return the sum of all paths, scaled down if it exceeds the largest tap, like the chip's gain control."""
    place = peak + paths.delay_s / TAP_S
    taps = np.floor(place)[:, None] + np.arange(-5, 6)
    pulses = np.exp(-(((taps - place[:, None]) / PULSE_TAPS) ** 2)) * (peak_amplitude(0.0) * paths.amplitude)[:, None]
    inside = (taps >= 0) & (taps < Cir.TAPS)
    at, pulses = taps[inside].astype(np.intp), pulses[inside]
    parts = [np.bincount(at, part, minlength=Cir.TAPS) for part in (pulses.real, pulses.imag)]
    wave = parts[0] + 1j * parts[1]
    return np.asarray(wave * min(1.0, LARGEST_TAP / max(float(np.abs(wave).max()), 1.0)))


def in_transfers(line: bytes) -> list[bytes]:
    """Split a printed response into its USB transfers of 50 values, and one for the line end."""
    body, end = line[:-2], line[-2:]
    parts = body.split(b"|")
    values, header = 50, 5
    cuts = [0, *range(header + values, len(parts), values), len(parts)]
    pieces = [b"|".join(parts[a:b]) for a, b in itertools.pairwise(cuts)]
    # Each piece after the first begins with the bar that separates it from the one before.
    return [pieces[0], *(b"|" + piece for piece in pieces[1:]), end]


@dataclass(frozen=True, slots=True)
class Detected:
    """Readings of n responses, (n,) each.

    `excess_m` is the apparent length of the first path minus the straight line, `power_dbm` its power by the chip's
    formula, `total_dbm` the power of the whole response, `noise_s` the standard deviation of its edge by noise.
    """

    excess_m: Floats
    power_dbm: Floats
    total_dbm: Floats
    noise_s: Floats


def detect(paths: Paths, radio: Radio, noise_share: float) -> Detected:
    """Return the readings of the responses of paths.

    The threshold is the dynamic range of the radio below the strongest tap, or its sensitivity; `noise_share` is the
    standard deviation of noise as a fraction of it, 0 for stamps without noise. The first path is the first peak after
    the response exceeds the threshold. Its arrival is where its leading edge has half its height (0.52 in the median of
    944 responses of MILUV's boards), plus the time from this point to the peak of a single pulse. So the arrival of a
    single path is exact at any power.
    """
    parts = accumulate(paths)
    squares = parts[0] ** 2
    squares += parts[1] ** 2
    strongest = _height(squares.max(axis=1))
    least = np.log(10) / 20
    threshold = np.maximum(strongest - radio.dynamic_range_db * least, radio.sensitivity_dbm * least)
    # A response below the sensitivity also has a first path.
    threshold = np.minimum(threshold, strongest - 0.5)
    peak, top = _first_peak(squares, np.argmax(squares >= np.exp(2 * threshold)[:, None], axis=1))
    edge, slope = _half_height(squares, peak, top)
    # From half the height of a single pulse to its peak.
    arrival = edge + PULSE_TAPS * float(np.sqrt(np.log(2)))
    first = np.floor(arrival - EDGE_TO_PEAK + 1e-6).astype(np.int64)[:, None] + OWN_TAPS
    own = np.take_along_axis(squares, np.clip(first, 0, SEARCHED_TAPS - 1), axis=1).sum(axis=1) / _squares(OWN_TAPS)
    total = squares.sum(axis=1) / _squares(np.arange(-8, 9))
    # Paths after the last tap contribute only to the total power.
    late = paths.detour_m >= (SEARCHED_TAPS - BEFORE - EDGE_TO_PEAK) * TAP_M
    if np.any(late):
        total += np.sum(np.abs(np.where(late, paths.amplitude, 0)) ** 2, axis=1)
    noise = noise_share * np.exp(np.minimum(threshold - top, 0)) * 2
    # The slope is limited to 0.2 of the logarithm per tap, so that noise stays finite on flat edges.
    return Detected(
        excess_m=(arrival - BEFORE - EDGE_TO_PEAK) * TAP_M,
        power_dbm=10 * np.log10(np.maximum(own, 1e-20)),
        total_dbm=10 * np.log10(np.maximum(total, 1e-20)),
        noise_s=noise / np.maximum(slope, 0.2) * TAP_S,
    )


def accumulate(paths: Paths) -> Floats:
    """Return the accumulators of n links around their direct paths: real and imaginary parts in roots of mW.

    Shape (2, n, `SEARCHED_TAPS`). A pulse extends over the block of taps where it begins and the next one, so each path
    adds one row of a table, times its amplitude, to two blocks: a product with a sparse matrix.
    """
    count, blocks = len(paths.amplitude), SEARCHED_TAPS // BLOCK
    place = (BEFORE + EDGE_TO_PEAK + paths.detour_m / TAP_M) * FRACTIONS
    inside = (paths.detour_m < (SEARCHED_TAPS - BEFORE - EDGE_TO_PEAK) * TAP_M) & (place >= 0)
    nearest = np.clip(np.rint(place), 0, SEARCHED_TAPS * FRACTIONS - 1).astype(np.int32)
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
    return taps.reshape(2, count, -1)[:, :, REACH - 1 : REACH - 1 + SEARCHED_TAPS]


def _squares(taps: Ints) -> float:
    """Return the sum of the squares of a pulse of height one in taps after its edge."""
    return float(np.sum(np.exp(-2 * CURVATURE * (taps - EDGE_TO_PEAK) ** 2)))


@cache
def _pulses() -> Floats:
    """Return pulses on two blocks of taps, by the position of the peak in the first, in `FRACTIONS` of a tap.

    Shape (positions, taps of two blocks). The first tap is `REACH` - 1 before the position zero.
    """
    step, fraction = np.divmod(np.arange(BLOCK * FRACTIONS), FRACTIONS)
    taps = np.arange(2 * BLOCK) - (REACH - 1) - step[:, None]
    pulses = np.exp(-CURVATURE * (taps - (fraction / FRACTIONS)[:, None]) ** 2)
    return np.asarray(np.where((taps > -REACH) & (taps <= REACH), pulses, 0))


def _height(squares: Floats) -> Floats:
    """Return the logarithms of amplitudes from their squares; of 1e-20 roots of mW at least."""
    return np.asarray(np.log(np.maximum(squares, 1e-20**2)) / 2)


def _first_peak(squares: Floats, begin: Ints) -> tuple[Ints, Floats]:
    """Return the tap of the first peak from `begin` on, and its height by a parabola through its neighbours."""
    rows, last = np.arange(len(squares)), squares.shape[1] - 2
    falls = squares[:, :-1] >= squares[:, 1:]
    falls &= np.arange(squares.shape[1] - 1) >= begin[:, None]
    peak = np.clip(np.where(falls.any(axis=1), np.argmax(falls, axis=1), last), 1, last)
    left, top, right = (_height(squares[rows, peak + k]) for k in (-1, 0, 1))
    bend = np.minimum(left - 2 * top + right, -1e-6)
    return peak, np.asarray(top - np.clip((right - left) ** 2 / (8 * bend), -1, 0))


def _half_height(squares: Floats, peak: Ints, top: Floats) -> tuple[Floats, Floats]:
    """Return the position in taps at which the edge before a peak has half its height, and the slope there.

    The logarithm between two taps has the curvature of a pulse.
    """
    rows, half = np.arange(len(squares)), top - np.log(2)
    below = (squares < np.exp(2 * half)[:, None]) & (np.arange(squares.shape[1]) < peak[:, None])
    # The last tap before the peak that is lower, or the first tap.
    before = np.where(below.any(axis=1), squares.shape[1] - 1 - np.argmax(below[:, ::-1], axis=1), 0)
    low, high = (_height(squares[rows, before + k]) for k in (0, 1))
    rise = np.maximum(high - low, 1e-9)
    # low + (rise + k) u - k u^2 = half.
    linear, missing = rise + CURVATURE, np.clip(half - low, 0, rise)
    root = np.sqrt(np.maximum(linear**2 - 4 * CURVATURE * missing, 0))
    return before + 2 * missing / (linear + root), root
