"""Channel impulse responses: as the boards print them, and what a chip reads off one.

A printed response has a first path, its echoes, and noise; that of a link whose paths follow from geometry has these
paths, with their phases, and nothing else. `detect` sums the paths of a link in the accumulator, which has a tap every
1.0016 ns, and reads first path, powers and noise off it. Pulses are Gaussian; the direct path lies where the chip puts
a first path, `EDGE_TO_PEAK` after a whole tap.
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
from uwbsim.world.geometric_paths import Paths
from uwbsim.world.radio import ALPHA_DBM, FPP_OFFSET_DB

PULSE_TAPS: Final = 1.2
"""Half width of a pulse where it is 1/e of its height: 2 ns from half to half, which is a bandwidth of 440 MHz."""

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
"""Taps before the direct path's edge; the pulse reaches back no further."""

TAPS: Final = 64
"""Taps in which a first path is looked for: 17 m."""


REACH: Final = 4
"""Taps on either side of a pulse's peak where it is still there: 1.5e-5 of its height at the fourth."""

BLOCK: Final = 2 * REACH
"""Taps in which a pulse alone is there."""

FRACTIONS: Final = 128
"""Places in a tap at which pulses are tabulated, 2 mm of path apart."""

CURVATURE: Final = 1 / PULSE_TAPS**2
"""The logarithm of a pulse is a parabola; this is its coefficient, turned round."""

OWN_TAPS: Final = np.arange(1, 4)
"""Taps after the edge whose squares are the first path's power (DW1000 User Manual, 4.7.1)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Waves:
    """All paths of a link from geometry, (p,) each: seconds after the first path, and amplitudes in roots of mW.

    Some come before what the chip takes for the first path.
    """

    delay_s: Floats
    amplitude: Complexes


@dataclass(frozen=True, slots=True, kw_only=True)
class PathsHeard:
    """What an impulse response shows of a link: the power of the first path in dBm, and the paths after it.

    `echoes` are their delays in seconds and amplitudes as shares of the first's. Where `waves` are known, they are all
    that there is.
    """

    power_dbm: float
    echoes: list[tuple[float, float]]
    waves: Waves | None = None


def peak_amplitude(power_dbm: float) -> float:
    """Return the peak of a first path in the chip's counts, from its power (DW1000 User Manual, 4.7.1).

    The power is 10 log10((F1^2 + F2^2 + F3^2)/N^2) - 121.74 of the three taps from the leading edge on; of 128 symbols
    of the preamble the chip adds up N = 118.
    """
    squares = float(np.sum(np.exp(-2 * ((OWN_TAPS - EDGE_TO_PEAK) / PULSE_TAPS) ** 2)))
    return float(118 * np.sqrt(10 ** ((power_dbm + FPP_OFFSET_DB) / 10) / squares))


def impulse_response(
    rng: np.random.Generator, stamp: int | None = None, paths: PathsHeard | None = None
) -> tuple[int, tuple[int, ...]]:
    """Draw one: index of the first path in thousandths of a tap, and 1016 magnitudes.

    With a receive `stamp` (ticks) the index has its fraction; `paths` are known ones, besides the diffuse, unless
    `paths.waves` has all. Without them the first path has the power of the boards' usual ones, -82 dBm.
    """
    ticks_per_tap = 64
    fraction = rng.uniform() if stamp is None else stamp % ticks_per_tap / ticks_per_tap
    # The chip puts the first path at 745, give or take a tap (DW1000 User Manual, 7.2.40.1).
    index = int(INDEX_STEPS * (745.0 + rng.integers(-1, 2) + fraction))
    # The chip reports the leading edge; the peak of the pulse follows it.
    peak = index / INDEX_STEPS + EDGE_TO_PEAK
    noise = 45.0
    if paths and paths.waves:
        wave = _from_geometry(peak, paths.waves)
        # Noise of either part: 28 counts of a response that is not turned down, and a share of the strongest tap, as
        # preambles do not correlate perfectly. By power, 265 responses of MILUV's boards have 0.0090 (at -82 dBm),
        # 0.0091, 0.0113, 0.0122 and 0.0185 (at -93 dBm) of their strongest taps.
        noise = float(np.hypot(28.0, 0.009 * np.abs(wave).max()))
    else:
        wave = _with_diffuse(rng, peak, paths)
    wave = wave + noise * (rng.normal(size=Cir.TAPS) + 1j * rng.normal(size=Cir.TAPS))
    re, im = (np.minimum(np.abs(np.trunc(part)), LARGEST_TAP) for part in (wave.real, wave.imag))
    # The firmware's estimate of a magnitude: the larger part and a quarter of the smaller.
    return index, tuple((np.maximum(re, im) + np.minimum(re, im) // 4).astype(np.int64).tolist())


def _with_diffuse(rng: np.random.Generator, peak: float, paths: PathsHeard | None) -> Complexes:
    """A first path, known echoes and diffuse ones, all with phases by chance."""
    taps = np.arange(Cir.TAPS)
    amplitude = peak_amplitude(paths.power_dbm if paths else ALPHA_DBM)
    wave = amplitude * np.exp(-(((taps - peak) / PULSE_TAPS) ** 2)) + 0j
    count, decay_taps = rng.poisson(12), 14.0
    later = rng.exponential(decay_taps, count)
    strength = 0.25 * np.exp(-later / decay_taps) * rng.rayleigh(size=count)
    known = [*zip(later.tolist(), strength.tolist(), strict=True)]
    known += [(delay_s / TAP_S, share) for delay_s, share in paths.echoes] if paths else []
    for (place, share), phase in zip(known, rng.uniform(0, 2 * np.pi, len(known)), strict=True):
        wave += amplitude * share * np.exp(1j * phase - ((taps - peak - place) / PULSE_TAPS) ** 2)
    return np.asarray(wave)


def _from_geometry(peak: float, waves: Waves) -> Complexes:
    """The sum of all paths; turned down as a whole, as the chip's gain control does, where it would not fit."""
    place = peak + waves.delay_s / TAP_S
    taps = np.floor(place)[:, None] + np.arange(-5, 6)
    pulses = np.exp(-(((taps - place[:, None]) / PULSE_TAPS) ** 2)) * (peak_amplitude(0.0) * waves.amplitude)[:, None]
    inside = (taps >= 0) & (taps < Cir.TAPS)
    at, pulses = taps[inside].astype(np.intp), pulses[inside]
    parts = [np.bincount(at, part, minlength=Cir.TAPS) for part in (pulses.real, pulses.imag)]
    wave = parts[0] + 1j * parts[1]
    return np.asarray(wave * min(1.0, LARGEST_TAP / max(float(np.abs(wave).max()), 1.0)))


def in_transfers(line: bytes) -> list[bytes]:
    """Cut a printed response into its USB transfers of 50 values, and one for the line end."""
    body, end = line[:-2], line[-2:]
    parts = body.split(b"|")
    values, header = 50, 5
    cuts = [0, *range(header + values, len(parts), values), len(parts)]
    pieces = [b"|".join(parts[a:b]) for a, b in itertools.pairwise(cuts)]
    # Each piece after the first begins with the bar that separates it from the one before.
    return [pieces[0], *(b"|" + piece for piece in pieces[1:]), end]


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
    parts = accumulate(paths)
    squares = parts[0] ** 2
    squares += parts[1] ** 2
    strongest = _height(squares.max(axis=1))
    least = np.log(10) / 20
    threshold = np.maximum(strongest - sensing.dynamic_range_db * least, sensing.sensitivity_dbm * least)
    # Who is not heard has a first path all the same.
    threshold = np.minimum(threshold, strongest - 0.5)
    peak, top = _first_peak(squares, np.argmax(squares >= np.exp(2 * threshold)[:, None], axis=1))
    edge, slope = _half_height(squares, peak, top)
    # From half the height of a pulse alone to its peak.
    arrival = edge + PULSE_TAPS * float(np.sqrt(np.log(2)))
    first = np.floor(arrival - EDGE_TO_PEAK + 1e-6).astype(np.int64)[:, None] + OWN_TAPS
    own = np.take_along_axis(squares, np.clip(first, 0, TAPS - 1), axis=1).sum(axis=1) / _squares(OWN_TAPS)
    total = squares.sum(axis=1) / _squares(np.arange(-8, 9))
    # Paths that come after the last tap count for the total power alone.
    late = paths.detour_m >= (TAPS - BEFORE - EDGE_TO_PEAK) * TAP_M
    if np.any(late):
        total += np.sum(np.abs(np.where(late, paths.amplitude, 0)) ** 2, axis=1)
    noise = sensing.noise_share * np.exp(np.minimum(threshold - top, 0)) * 2
    # On a flatter edge than 0.2, of the logarithm over a tap, noise does not count for more.
    return Detected(
        excess_m=(arrival - BEFORE - EDGE_TO_PEAK) * TAP_M,
        power_dbm=10 * np.log10(np.maximum(own, 1e-20)),
        total_dbm=10 * np.log10(np.maximum(total, 1e-20)),
        noise_s=noise / np.maximum(slope, 0.2) * TAP_S,
    )


def accumulate(paths: Paths) -> Floats:
    """Return the accumulators of n links around their direct paths: real and imaginary parts in roots of mW.

    Shape (2, n, `TAPS`).
    A pulse lies in the block of taps where it begins and the next one; so each path adds one row of a table to two
    blocks at its amplitude, which a sparse matrix does without a list of its taps.
    """
    count, blocks = len(paths.amplitude), TAPS // BLOCK
    place = (BEFORE + EDGE_TO_PEAK + paths.detour_m / TAP_M) * FRACTIONS
    inside = (paths.detour_m < (TAPS - BEFORE - EDGE_TO_PEAK) * TAP_M) & (place >= 0)
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


def _squares(taps: Ints) -> float:
    """Return the sum of the squares of a pulse of height one in taps after its edge."""
    return float(np.sum(np.exp(-2 * CURVATURE * (taps - EDGE_TO_PEAK) ** 2)))


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
    """The logarithm of an amplitude, of its square; of 1e-20 roots of mW at least."""
    return np.asarray(np.log(np.maximum(squares, 1e-20**2)) / 2)


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
