"""The curve of bias over power where boards stand still: few powers, so a prior says what such curves are like.

The prior is a Gaussian process over decibels with a Matern 5/2 covariance. Its standard deviation is estimated with
the rest (`calib.surveys.adjustment`). It is zero at the reference power, like every fitted curve here, and is written
as cubic splines over lifted power.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, DEGREE, basis
from uwblink.arrays import Floats

SEGMENTS: Final = 12
"""Enough that splines follow a process of this length over 25 dB; the prior, not their number, makes them smooth."""

CURVE_STD_M: Final = 0.1
CURVE_FACTOR: Final = 1.7
"""Standard deviation of a curve before any data, and the factor by which that may be wrong."""

BEND_DB: Final = 4.0
"""Length of the process. Both are from the three published curves of boards (`icra2023`, `icra2023-july`, `miluv` of
`uwbsim`): at 13 powers from -95 to -77 dBm, with errors of 5 mm, the likeliest lengths are 4, 6 and 4 dB, the mean
standard deviations 0.11, 0.14 and 0.09 m, each known to a factor of 1.7. The shorter length costs little where a curve
is straight; the longer one takes a bend for an error of pairs, and what all delays share for what it is not."""

NARROWEST_DB: Final = 3.0
"""Span of powers below which there is no curve to speak of."""


@dataclass(frozen=True, slots=True)
class PowerModel:
    """Cubic splines (n, m) at the powers of rows, and the information (m, m) on coefficients for a spread of 1."""

    knots: Floats
    design: Floats
    precision: Floats

    @property
    def size(self) -> int:
        """How many coefficients there are."""
        return int(self.design.shape[1])


def in_dbm(lifted: Floats) -> Floats:
    """Return the powers that lifted ones stand for."""
    return np.asarray(ALPHA_DBM + 10 * np.log10(lifted))


def power_model(lifted: Floats) -> PowerModel | None:
    """Return the model of a curve at lifted powers (n,); None where powers lack, or hardly vary."""
    if not len(lifted) or not np.isfinite(lifted).all() or not (lifted > 0).all():
        return None
    power = in_dbm(lifted)
    low, high = float(power.min()), float(power.max())
    if high - low < NARROWEST_DB:
        return None
    inner = 10 ** ((np.linspace(low, high, SEGMENTS + 1) - ALPHA_DBM) / 10)
    knots = np.concatenate([[inner[0]] * DEGREE, inner, [inner[-1]] * DEGREE])
    dense = np.linspace(low, high, 60)
    splines = basis(10 ** ((dense - ALPHA_DBM) / 10), knots)
    back = np.linalg.pinv(splines)
    covariance = back @ _process(dense) @ back.T
    precision: Floats = np.asarray(np.linalg.inv(covariance + 1e-4 * np.eye(len(covariance))), dtype=np.float64)
    return PowerModel(knots, basis(lifted, knots), precision)


def _process(power: Floats) -> Floats:
    """Return the covariance (n, n) of a process with a spread of 1, given that it is zero at the reference."""
    both = np.append(power, ALPHA_DBM)
    apart = math.sqrt(5.0) * np.abs(both[:, None] - both) / BEND_DB
    whole = (1 + apart + apart**2 / 3) * np.exp(-apart)
    return np.asarray(whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[-1, :-1]))
