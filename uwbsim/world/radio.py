"""Received power and what depends on it: antenna gain, shadowing, bias, noise, printed values."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.interpolate import BSpline

from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import truncate4
from uwbsim.random_streams import stream
from uwbsim.scenario.radio import AntennaTable, BiasTable, Radio, SigmaSpline, Spline

if TYPE_CHECKING:
    from scipy.interpolate import RegularGridInterpolator

ALPHA_DBM: Final = -82.0
FPP_OFFSET_DB: Final = 121.74
"""DW1000 User Manual, section 4.7.1, for a pulse repetition frequency of 64 MHz."""

SKEW_GRID_PPM: Final = 9.3132e-4
"""One count of the carrier integrator (firmware wire format, section 4)."""

CARRIER_REFERENCE_DBM: Final = -90.0
"""Where the bias of the carrier integrator's readings is `skew_bias_ppm`: in the middle of the boards' powers."""

SATURATION_SHARPNESS: Final = 1.5
"""How suddenly readings of power saturate: fitted to the powers of the ICRA 2023 flights, half of which end within 3 dB
of their highest."""

NULL_DEPTH: Final = 0.1
SHADOW_HARMONICS: Final = 3
SHADOW_ORDERS: Final = np.arange(1, SHADOW_HARMONICS + 1)


def dipole_gain_db(sine: Floats) -> Floats:
    """Gain of a short dipole at the angle to its axis with this sine; nulls are 20 dB deep."""
    return 1.76 + 20 * np.log10(np.maximum(sine, NULL_DEPTH))


ANTENNAS: Final[dict[str, Callable[[Floats], Floats]]] = {
    "isotropic": np.zeros_like,
    "dipole": dipole_gain_db,
}


def shadowing_phases(seed: int, tag: int) -> Floats:
    """Return what makes the shadow of a tag's body its own, the same in every run with a seed, shape (harmonics,)."""
    return stream(seed, "shadowing", tag).uniform(0, 2 * np.pi, SHADOW_HARMONICS)


def gain_db(radio: Radio, phases: Floats, direction: Floats) -> Floats:
    """Gain of a tag towards unit vectors (n, 3) in its body's frame, in dB, shape (n,).

    The antenna stands along the body's z axis. Shadowing by the body is a smooth function of azimuth with standard
    deviation `shadowing_db`; `phases` are those of the tag (harmonics,), or of n tags (n, harmonics).
    """
    if isinstance(radio.antenna, AntennaTable):
        gain = _table_gain_db(radio.antenna, direction)
    else:
        gain = ANTENNAS[radio.antenna](np.hypot(direction[:, 0], direction[:, 1]))
    if radio.shadowing_db:
        azimuth = np.arctan2(direction[:, 1], direction[:, 0])
        waves = np.cos(azimuth[:, None] * SHADOW_ORDERS + phases).sum(axis=1)
        gain = gain + radio.shadowing_db * waves * np.sqrt(2 / SHADOW_HARMONICS)
    return gain


def _table_gain_db(table: AntennaTable, direction: Floats) -> Floats:
    azimuth = np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))
    elevation = np.degrees(np.arcsin(np.clip(direction[:, 2], -1, 1)))
    return np.asarray(_interpolator(table)(np.column_stack([azimuth, elevation])))


@lru_cache(maxsize=16)
def _interpolator(table: AntennaTable) -> RegularGridInterpolator:
    from scipy.interpolate import RegularGridInterpolator

    return RegularGridInterpolator((table.azimuth_deg, table.elevation_deg), np.array(table.gain_db))


def path_gain_db(radio: Radio, distance_m: Floats) -> Floats:
    """First-path power over distance without antennas, in dBm, shape (n,)."""
    nearest = np.maximum(distance_m, 0.05)
    return radio.first_path_at_1m_dbm - 10 * radio.path_loss_exponent * np.log10(nearest)


def lifted(power_dbm: Floats) -> Floats:
    """Lifted power 10^((p - alpha)/10) (ICRA 2023, section IV)."""
    return np.asarray(10 ** ((power_dbm - ALPHA_DBM) / 10))


def reported_dbm(radio: Radio, power_dbm: Floats) -> Floats:
    """Return what receivers make of first-path powers: the same, or saturating.

    The lifted powers' inverses to the power of `SATURATION_SHARPNESS` add up with that of the highest.
    """
    if radio.saturation_dbm is None:
        return power_dbm
    above = SATURATION_SHARPNESS / 10 * (power_dbm - radio.saturation_dbm)
    return np.asarray(power_dbm - 10 / SATURATION_SHARPNESS * np.log10(1 + 10**above))


def reception_bias_s(radio: Radio, power_dbm: Floats, total_dbm: Floats | None = None) -> Floats:
    """What power adds to a receive stamp, in seconds: a spline goes by first-path power, a table by total power.

    Each of the two receptions of a range carries it, so a range has the mean of the curve's values.
    """
    if isinstance(radio.bias, BiasTable):
        return _table_bias_m(radio.bias, power_dbm if total_dbm is None else total_dbm) / SPEED_OF_LIGHT
    return _spline(radio.bias, power_dbm) / SPEED_OF_LIGHT


def _table_bias_m(table: BiasTable, total_dbm: Floats) -> Floats:
    order = np.argsort(table.power_dbm)
    return np.asarray(np.interp(total_dbm, np.array(table.power_dbm)[order], np.array(table.bias_m)[order]))


def reception_noise_s(radio: Radio, power_dbm: Floats) -> Floats:
    """Standard deviation of a receive stamp, in seconds: white noise and the sigma curve.

    The curve gives the range's; a range has c sqrt(s^2/2 (1 + r + r^2)) (docs/theory.md).
    """
    white = radio.rx_noise_s
    ratio = radio.sigma.reply_ratio if radio.sigma else 0.0
    factor = SPEED_OF_LIGHT * np.sqrt((1 + ratio + ratio**2) / 2)
    return np.asarray(np.hypot(white, _spline(radio.sigma, power_dbm) / factor))


def printed_power_dbm(radio: Radio, power_dbm: Floats, noise: Floats) -> Floats:
    """First-path power as the boards print it: 10 log10 of a whole number, cut to four decimals.

    `noise` is standard normal, shape (n,).
    """
    read = reported_dbm(radio, power_dbm + noise * radio.power_noise_db)
    if not radio.quantize:
        return read
    counts = np.maximum(np.rint(10 ** ((read + FPP_OFFSET_DB) / 10)), 1)
    return truncate4(10 * np.log10(counts) - FPP_OFFSET_DB)


def carrier_bias_ppm(radio: Radio, power_dbm: Floats) -> Floats:
    """Return the bias of the carrier integrator's readings of frames with these first-path powers."""
    return np.asarray(radio.skew_bias_ppm + radio.skew_bias_ppm_per_db * (power_dbm - CARRIER_REFERENCE_DBM))


def printed_skew_ppm(radio: Radio, skew_ppm: Floats, noise: Floats, power_dbm: Floats) -> Floats:
    """Relative skew as the boards print it: whole counts of the carrier integrator, with its sign, bias and noise.

    `skew_ppm` is by how much the receiver's clock is faster than the sender's.
    """
    read = radio.carrier_sign * skew_ppm + carrier_bias_ppm(radio, power_dbm) + noise * radio.skew_noise_ppm
    if not radio.quantize:
        return read
    return truncate4(np.rint(read / SKEW_GRID_PPM) * SKEW_GRID_PPM)


def _spline(curve: Spline | SigmaSpline | None, power_dbm: Floats) -> Floats:
    if curve is None:
        return np.zeros_like(power_dbm)
    spline, inner = _bspline(curve)
    return np.asarray(spline(np.clip(lifted(power_dbm), *inner)))


@lru_cache(maxsize=16)
def _bspline(curve: Spline) -> tuple[BSpline, tuple[float, float]]:
    """Return a curve of a scenario as a spline, and the range in which it is not constant."""
    knots = np.array(curve.knots)
    return BSpline(knots, np.array(curve.coefficients), curve.degree), (knots[curve.degree], knots[-1 - curve.degree])
