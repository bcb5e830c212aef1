"""Antenna gain and group delay by direction, received power, and bias, noise and printed readings by power."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import factorial, isqrt, sqrt
from typing import Any, Final

import numpy as np
from scipy.interpolate import BSpline, RegularGridInterpolator
from scipy.special import lpmv

from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import truncate4
from uwbsim.random_streams import stream
from uwbsim.scenario.devices import DirectionTable, GroupDelay, GroupDelayTable
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import AntennaTable, BiasTable, Radio, SigmaSpline, Spline

FPP_OFFSET_DB: Final = 121.74
"""DW1000 User Manual, section 4.7.1, for a pulse repetition frequency of 64 MHz."""

NEAREST_PATH_M: Final = 0.05
"""Least length of a path in its gain: the far-field formula does not hold closer to an antenna."""

SHADOW_ORDERS: Final = np.arange(1, 4)
"""Harmonics of azimuth in the shadowing of a tag by its body: smooth over some 60 degrees, a judgement."""


def _dipole_db(sine: Floats) -> Floats:
    """Return the gain of a short dipole in dB, with nulls 20 dB below its maximum."""
    return 1.76 + 20 * np.log10(np.maximum(sine, 0.1))


ANTENNAS: Final[dict[str, Callable[[Floats], Floats]]] = {"isotropic": np.zeros_like, "dipole": _dipole_db}
"""Gain in dB at the angle to the antenna's axis with this sine."""


def harmonics(direction: Floats, degree: int) -> Floats:
    """Return the real spherical harmonics of degree 0 to `degree` at unit vectors (n, 3), (n, (degree + 1)^2).

    Ordered by degree l, then by m from -l to l; negative m have the sine of azimuth. Their root mean square over all
    directions is one.
    """
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    height = np.clip(direction[:, 2], -1, 1)
    columns = []
    for l in range(degree + 1):  # noqa: E741 - the usual symbol
        for m in range(-l, l + 1):
            scale = sqrt((2 * l + 1) * factorial(l - abs(m)) / factorial(l + abs(m)) * (2 if m else 1))
            # (-1)^m removes the Condon-Shortley sign of lpmv.
            wave = (-1) ** m * (np.sin(-m * azimuth) if m < 0 else np.cos(m * azimuth))
            columns.append(scale * lpmv(abs(m), l, height) * wave)
    return np.column_stack(columns)


def shadowing_phases(scenario: Scenario) -> Floats:
    """Return the phases of the harmonics of each tag's shadowing, (tags, harmonics), drawn from the seed."""
    streams = (stream(scenario.run.seed, "shadowing", tag.id) for tag in scenario.tags)
    return np.array([one.uniform(0, 2 * np.pi, len(SHADOW_ORDERS)) for one in streams])


def antenna_gain_db(scenario: Scenario, phases: Floats, tags: Ints, direction: Floats) -> Floats:
    """Return the gains in dB of tags with indices (n,) towards unit vectors (n, 3) in their bodies' frames, (n,).

    The antenna stands along the body's z axis. Shadowing by the body is a smooth function of azimuth with standard
    deviation `shadowing_db`; `phases` (tags, harmonics) are from `shadowing_phases`.
    """
    radio = scenario.radio
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    if isinstance(radio.antenna, AntennaTable):
        gain = _interpolated(radio.antenna, np.degrees(azimuth), np.clip(direction[:, 2], -1, 1))
    else:
        gain = ANTENNAS[radio.antenna](np.hypot(direction[:, 0], direction[:, 1]))
    if radio.shadowing_db:
        waves = np.cos(azimuth[:, None] * SHADOW_ORDERS + phases[tags]).sum(axis=1)
        gain = gain + radio.shadowing_db * waves * np.sqrt(2 / len(SHADOW_ORDERS))
    for place, tag in enumerate(scenario.tags):
        if tag.pattern_db:
            mine = np.flatnonzero(tags == place)
            own = harmonics(direction[mine], isqrt(len(tag.pattern_db)) - 1)
            gain[mine] += own @ np.array(tag.pattern_db)
    return gain


def _interpolated(table: DirectionTable, azimuth_deg: Floats, sine: Floats) -> Floats:
    """Return the values of a table at azimuths (n,) and elevations with these sines (n,)."""
    return np.asarray(_interpolator(table)(np.column_stack([azimuth_deg, np.degrees(np.arcsin(sine))])))


@lru_cache(maxsize=16)
def _interpolator(table: DirectionTable) -> Any:
    return RegularGridInterpolator((table.azimuth_deg, table.elevation_deg), np.array(getattr(table, table.quantity)))


def group_delay_m(scenario: Scenario, tags: Ints, direction: Floats) -> Floats:
    """Return the group delays, in metres of path (n,), of tags with indices (n,) towards unit vectors (n, 3).

    The vectors are in the frames of the tags' bodies.
    """
    delay = np.zeros(len(tags))
    for place in np.unique(tags).tolist():
        model = scenario.tags[place].group_delay or scenario.radio.group_delay
        if model is not None:
            rows = np.flatnonzero(tags == place)
            delay[rows] = _group_delay_cm(model, direction[rows]) * 1e-2
    return delay


def _group_delay_cm(model: GroupDelay, direction: Floats) -> Floats:
    azimuth = np.arctan2(direction[:, 1], direction[:, 0]) - np.radians(model.turned_deg)
    sine = np.clip(direction[:, 2], -1, 1)
    if isinstance(model, GroupDelayTable):
        # The azimuth of a turned board may be beyond the ends of the table, which are the same direction.
        return _interpolated(model, (np.degrees(azimuth) + 180) % 360 - 180, sine)
    around = np.zeros(len(azimuth))
    for wave, heights in ((np.cos, model.cosine_cm), (np.sin, model.sine_cm)):
        for order, height in enumerate(heights, start=1):
            around += height * wave(order * azimuth)
    return model.mean_cm + around * np.sqrt(1 - sine**2) + model.elevation_cm * sine


def path_gain_db(radio: Radio, distance_m: Floats) -> Floats:
    """Return the first-path power at distances without antenna gains, in dBm, (n,)."""
    nearest = np.maximum(distance_m, NEAREST_PATH_M)
    return radio.first_path_at_1m_dbm - 10 * radio.path_loss_exponent * np.log10(nearest)


def lifted(power_dbm: Floats) -> Floats:
    """Return lifted power 10^((p - alpha)/10) with alpha = -82 dBm (ICRA 2023, section IV)."""
    return np.asarray(10 ** ((power_dbm + 82.0) / 10))


SATURATION_SHARPNESS: Final = 1.5
"""Fitted to the ICRA 2023 flights, in which half of the readings are within 3 dB of the highest."""


def reported_dbm(radio: Radio, power_dbm: Floats) -> Floats:
    """Return the first-path powers read by receivers, saturated if the radio has a saturation.

    With lifted powers x of the path, y of the reading and z of saturation: y^-s = x^-s + z^-s, s being
    `SATURATION_SHARPNESS`.
    """
    if radio.saturation_dbm is None:
        return power_dbm
    above = SATURATION_SHARPNESS / 10 * (power_dbm - radio.saturation_dbm)
    return np.asarray(power_dbm - 10 / SATURATION_SHARPNESS * np.log10(1 + 10**above))


def before_saturation_dbm(reading_dbm: Floats, saturation_dbm: float) -> tuple[Floats, Floats]:
    """Return the powers of saturated readings, the inverse of `reported_dbm`, and their derivatives by the readings."""
    left = 1 - 10 ** (SATURATION_SHARPNESS / 10 * (reading_dbm - saturation_dbm))
    return np.asarray(reading_dbm - 10 / SATURATION_SHARPNESS * np.log10(left)), 1 / left


def reception_bias_s(radio: Radio, power_dbm: Floats, total_dbm: Floats | None = None) -> Floats:
    """Return the bias of a receive stamp by power, in seconds: a spline over first-path power, a table over total
    power.

    Both receptions of a range have this bias, so the bias of a range is the mean of the curve's two values.
    """
    if isinstance(radio.bias, BiasTable):
        order = np.argsort(radio.bias.power_dbm)
        powers, biases = (np.array(column)[order] for column in (radio.bias.power_dbm, radio.bias.bias_m))
        return np.asarray(np.interp(power_dbm if total_dbm is None else total_dbm, powers, biases)) / SPEED_OF_LIGHT
    return _spline(radio.bias, power_dbm) / SPEED_OF_LIGHT


def reception_noise_s(radio: Radio, power_dbm: Floats) -> Floats:
    """Return the standard deviation of a receive stamp, in seconds: white noise and the sigma curve.

    The curve is the standard deviation of a range, c sqrt(s^2/2 (1 + r + r^2)) (docs/theory.md).
    """
    ratio = radio.sigma.reply_ratio if radio.sigma else 0.0
    factor = SPEED_OF_LIGHT * np.sqrt((1 + ratio + ratio**2) / 2)
    return np.asarray(np.hypot((radio.rx_noise_ps * 1e-12), _spline(radio.sigma, power_dbm) / factor))


def printed_power_dbm(radio: Radio, power_dbm: Floats, noise: Floats) -> Floats:
    """Return first-path power as the boards print it: 10 log10 of a whole number, truncated to four decimals.

    `noise` is standard normal, (n,).
    """
    read = reported_dbm(radio, power_dbm + noise * radio.power_noise_db)
    if not radio.quantize:
        return read
    counts = np.maximum(np.rint(10 ** ((read + FPP_OFFSET_DB) / 10)), 1)
    return truncate4(10 * np.log10(counts) - FPP_OFFSET_DB)


def carrier_bias_ppm(radio: Radio, power_dbm: Floats) -> Floats:
    """Return the bias of the carrier integrator's readings of frames by first-path power.

    It is `skew_bias_ppm` at -90 dBm, in the middle of the boards' powers.
    """
    return np.asarray(radio.skew_bias_ppm + radio.skew_bias_ppm_per_db * (power_dbm + 90.0))


def printed_skew_ppm(radio: Radio, skew_ppm: Floats, noise: Floats, power_dbm: Floats) -> Floats:
    """Return relative skew as the boards print it: whole counts of the carrier integrator, with sign, bias and noise.

    `skew_ppm` is the rate of the receiver's clock relative to the sender's.
    """
    read = radio.carrier_sign * skew_ppm + carrier_bias_ppm(radio, power_dbm) + noise * radio.skew_noise_ppm
    if not radio.quantize:
        return read
    count_ppm = 9.3132e-4  # of the carrier integrator (firmware wire format, section 4)
    return truncate4(np.rint(read / count_ppm) * count_ppm)


def _spline(curve: Spline | SigmaSpline | None, power_dbm: Floats) -> Floats:
    if curve is None:
        return np.zeros_like(power_dbm)
    spline, inner = _bspline(curve)
    return np.asarray(spline(np.clip(lifted(power_dbm), *inner)))


@lru_cache(maxsize=16)
def _bspline(curve: Spline) -> tuple[BSpline, tuple[float, float]]:
    """Return a curve of a scenario as a spline, and its domain, beyond which it is constant."""
    knots = np.array(curve.knots)
    return BSpline(knots, np.array(curve.coefficients), curve.degree), (knots[curve.degree], knots[-1 - curve.degree])
