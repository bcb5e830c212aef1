"""Channel impulse responses as the boards print them: a first path, its echoes, and noise.

Of a link whose paths follow from geometry the response has these, with their phases, and nothing else.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Complexes, Floats
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.wire.messages import Cir
from uwbsim.units import NS
from uwbsim.world.propagation import Link
from uwbsim.world.radio import ALPHA_DBM, FPP_OFFSET_DB

FIRST_PATH: Final = 745.0
"""Where the chip puts the first path, give or take a tap (DW1000 User Manual, 7.2.40.1)."""

NOISE: Final = 45.0
RECORDED_NOISE: Final = 28.0
SELF_NOISE: Final = 0.009
"""Noise of recorded responses, as the standard deviation of either part: in the counts of a response that is not turned
down, and as a share of the strongest tap besides (preambles do not correlate perfectly). By power, 265 responses of
MILUV's boards have 0.0090 (at -82 dBm), 0.0091, 0.0113, 0.0122 and 0.0185 (at -93 dBm) of their strongest taps."""

NEAREST_ECHO_M: Final = 0.01
FAINTEST_ECHO: Final = 1e-4
DECAY_TAPS: Final = 14.0
PULSE_TAPS: Final = 1.2
EDGE_TO_PEAK: Final = 1.5
REACH: Final = 5
"""Taps on either side of a pulse's peak where it is still there."""

DIFFUSE: Final = 12
TICKS_A_TAP: Final = 64
TAP_S: Final = 1.0016 * NS
VALUES_A_TRANSFER: Final = 50
HEADER_FIELDS: Final = 5
INDEX_STEPS: Final = 1000
"""The boards print the first path in thousandths of a tap."""


ACCUMULATED: Final = 118
"""Preamble symbols that the chip adds up, of 128."""

LARGEST: Final = 32_767
"""Taps are 16 bits wide."""

Echo = tuple[float, float]
"""A path after the first: its delay in seconds, and its amplitude as a share of the first's."""


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

    Where `waves` are known, they are all that there is.
    """

    power_dbm: float
    echoes: list[Echo]
    waves: Waves | None = None


def paths_heard(link: Link, detour_m: float = 0.0) -> PathsHeard:
    """Return what a response shows of a single link, whose first path is `detour_m` longer still by chance."""
    power = float(link.power_dbm[0])
    if link.paths_m is None or link.paths_dbm is None:
        return PathsHeard(power_dbm=power, echoes=[])
    later_m = link.paths_m[0] - float(link.distance_m[0] + link.excess_m[0]) - detour_m
    shares = 10 ** ((link.paths_dbm[0] - power) / 20)
    echoes = [
        (later / SPEED_OF_LIGHT, share)
        for later, share in zip(later_m.tolist(), shares.tolist(), strict=True)
        if later > NEAREST_ECHO_M and share > FAINTEST_ECHO
    ]
    return PathsHeard(power_dbm=power, echoes=echoes)


def peak_amplitude(power_dbm: float) -> float:
    """Return the peak of a first path in the chip's counts, from its power (DW1000 User Manual, 4.7.1).

    The power is 10 log10((F1^2 + F2^2 + F3^2)/N^2) - 121.74 of the three taps from the leading edge on.
    """
    taps = np.arange(1, 4) - EDGE_TO_PEAK
    squares = float(np.sum(np.exp(-2 * (taps / PULSE_TAPS) ** 2)))
    return float(ACCUMULATED * np.sqrt(10 ** ((power_dbm + FPP_OFFSET_DB) / 10) / squares))


def impulse_response(
    rng: np.random.Generator, stamp: int | None = None, paths: PathsHeard | None = None
) -> tuple[int, tuple[int, ...]]:
    """Draw one: index of the first path in thousandths of a tap, and 1016 magnitudes.

    With a receive `stamp` (ticks) the index has its fraction; `paths` are known ones, besides the diffuse, unless
    `paths.waves` has all. Without them the first path has the power of the boards' usual ones, -82 dBm.
    """
    fraction = rng.uniform() if stamp is None else stamp % TICKS_A_TAP / TICKS_A_TAP
    index = int(INDEX_STEPS * (FIRST_PATH + rng.integers(-1, 2) + fraction))
    # The chip reports the leading edge; the peak of the pulse follows it.
    peak = index / INDEX_STEPS + EDGE_TO_PEAK
    noise = NOISE
    if paths and paths.waves:
        wave = _from_geometry(peak, paths.waves)
        noise = float(np.hypot(RECORDED_NOISE, SELF_NOISE * np.abs(wave).max()))
    else:
        wave = _with_diffuse(rng, peak, paths)
    wave = wave + noise * (rng.normal(size=Cir.TAPS) + 1j * rng.normal(size=Cir.TAPS))
    re, im = (np.minimum(np.abs(np.trunc(part)), LARGEST) for part in (wave.real, wave.imag))
    # The firmware's estimate of a magnitude: the larger part and a quarter of the smaller.
    return index, tuple((np.maximum(re, im) + np.minimum(re, im) // 4).astype(np.int64).tolist())


def _with_diffuse(rng: np.random.Generator, peak: float, paths: PathsHeard | None) -> Complexes:
    """A first path, known echoes and diffuse ones, all with phases by chance."""
    taps = np.arange(Cir.TAPS)
    amplitude = peak_amplitude(paths.power_dbm if paths else ALPHA_DBM)
    wave = amplitude * np.exp(-(((taps - peak) / PULSE_TAPS) ** 2)) + 0j
    count = rng.poisson(DIFFUSE)
    later = rng.exponential(DECAY_TAPS, count)
    strength = 0.25 * np.exp(-later / DECAY_TAPS) * rng.rayleigh(size=count)
    known = [*zip(later.tolist(), strength.tolist(), strict=True)]
    known += [(delay_s / TAP_S, share) for delay_s, share in paths.echoes] if paths else []
    for (place, share), phase in zip(known, rng.uniform(0, 2 * np.pi, len(known)), strict=True):
        wave += amplitude * share * np.exp(1j * phase - ((taps - peak - place) / PULSE_TAPS) ** 2)
    return np.asarray(wave)


def _from_geometry(peak: float, waves: Waves) -> Complexes:
    """The sum of all paths; turned down as a whole, as the chip's gain control does, where it would not fit."""
    place = peak + waves.delay_s / TAP_S
    taps = np.floor(place)[:, None] + np.arange(-REACH, REACH + 1)
    pulses = np.exp(-(((taps - place[:, None]) / PULSE_TAPS) ** 2)) * (peak_amplitude(0.0) * waves.amplitude)[:, None]
    inside = (taps >= 0) & (taps < Cir.TAPS)
    at, pulses = taps[inside].astype(np.intp), pulses[inside]
    parts = [np.bincount(at, part, minlength=Cir.TAPS) for part in (pulses.real, pulses.imag)]
    wave = parts[0] + 1j * parts[1]
    return np.asarray(wave * min(1.0, LARGEST / max(float(np.abs(wave).max()), 1.0)))


def in_transfers(line: bytes) -> list[bytes]:
    """Cut a printed response into its USB transfers of 50 values, and one for the line end."""
    body, end = line[:-2], line[-2:]
    parts = body.split(b"|")
    cuts = [0, *range(HEADER_FIELDS + VALUES_A_TRANSFER, len(parts), VALUES_A_TRANSFER), len(parts)]
    pieces = [b"|".join(parts[a:b]) for a, b in itertools.pairwise(cuts)]
    # Each piece after the first begins with the bar that separates it from the one before.
    return [pieces[0], *(b"|" + piece for piece in pieces[1:]), end]
