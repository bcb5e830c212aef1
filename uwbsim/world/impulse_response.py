"""Channel impulse responses as the boards print them: a first path, its echoes, and noise."""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from uwblink.wire.messages import Cir
from uwbsim.units import NS

FIRST_PATH: Final = 745.0
"""Where the chip puts the first path, give or take a tap (DW1000 User Manual, 7.2.40.1)."""

NOISE: Final = 45.0
AMPLITUDE: Final = 9000.0
DECAY_TAPS: Final = 14.0
PULSE_TAPS: Final = 1.2
EDGE_TO_PEAK: Final = 1.5
DIFFUSE: Final = 12
TICKS_A_TAP: Final = 64
TAP_S: Final = 1.0016 * NS
VALUES_A_TRANSFER: Final = 50
HEADER_FIELDS: Final = 5
INDEX_STEPS: Final = 1000
"""The boards print the first path in thousandths of a tap."""


Echo = tuple[float, float]
"""A path after the first: its delay in seconds, and its amplitude as a share of the first's."""


def impulse_response(
    rng: np.random.Generator, stamp: int | None = None, echoes: list[Echo] | None = None
) -> tuple[int, tuple[int, ...]]:
    """Draw one: index of the first path in thousandths of a tap, and 1016 magnitudes.

    With a receive `stamp` (ticks) the index has its fraction; `echoes` are known paths, besides the diffuse ones.
    """
    fraction = rng.uniform() if stamp is None else stamp % TICKS_A_TAP / TICKS_A_TAP
    index = int(INDEX_STEPS * (FIRST_PATH + rng.integers(-1, 2) + fraction))
    taps = np.arange(Cir.TAPS)
    # The chip reports the leading edge; the peak of the pulse follows it.
    peak = index / INDEX_STEPS + EDGE_TO_PEAK
    wave = AMPLITUDE * np.exp(-(((taps - peak) / PULSE_TAPS) ** 2)) + 0j
    count = rng.poisson(DIFFUSE)
    later = rng.exponential(DECAY_TAPS, count)
    strength = 0.25 * np.exp(-later / DECAY_TAPS) * rng.rayleigh(size=count)
    paths = [*zip(later.tolist(), strength.tolist(), strict=True)]
    paths += [(delay_s / TAP_S, share) for delay_s, share in echoes or []]
    for (place, share), phase in zip(paths, rng.uniform(0, 2 * np.pi, len(paths)), strict=True):
        wave += AMPLITUDE * share * np.exp(1j * phase - ((taps - peak - place) / PULSE_TAPS) ** 2)
    wave += NOISE * (rng.normal(size=Cir.TAPS) + 1j * rng.normal(size=Cir.TAPS))
    re, im = np.abs(np.trunc(wave.real)), np.abs(np.trunc(wave.imag))
    # The firmware's estimate of a magnitude: the larger part and a quarter of the smaller.
    return index, tuple((np.maximum(re, im) + np.minimum(re, im) // 4).astype(np.int64).tolist())


def in_transfers(line: bytes) -> list[bytes]:
    """Cut a printed response into its USB transfers of 50 values, and one for the line end."""
    body, end = line[:-2], line[-2:]
    parts = body.split(b"|")
    cuts = [0, *range(HEADER_FIELDS + VALUES_A_TRANSFER, len(parts), VALUES_A_TRANSFER), len(parts)]
    pieces = [b"|".join(parts[a:b]) for a, b in itertools.pairwise(cuts)]
    # Each piece after the first begins with the bar that separates it from the one before.
    return [pieces[0], *(b"|" + piece for piece in pieces[1:]), end]
