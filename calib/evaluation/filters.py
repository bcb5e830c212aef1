"""Filters: updates by a range, for many filters at once, and an error-state filter with inertial readings.

Filters differ in the error of a range that they assume. All update along the line of sight: mean and covariance of the
state follow from the mean and variance of the noise in an innovation (moments of the posterior for Gaussian noise and
state), by a gate or by a mixture of errors. A diverged filter restarts from ranges alone (`multilaterate`).

The error-state Kalman filter has several headings at once, so that its arrays are (headings, ...). State errors (17):
position, velocity, attitude (in the axes of the body), bias of gyro, bias of accelerometer, offset of the height sensor
(Solà 2017, sections 5 to 7), and the error that measurements of one exchange share. Without an IMU, attitude and biases
are not estimated, and velocity wanders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.calibration.applying import noise_m
from calib.calibration.model import Calibration
from calib.data.ranges import Ranges
from calib.range_errors.densities import ONE_KIND, ROOT_2PI, LongDetours, densities
from uwblink.arrays import Bools, Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeErrors:
    """The error model of a range: reflected with probability `share`, by a least detour and an exponential one.

    Metres and shares of 1. Outliers have the share `outlier` and a size of about `outlier_m`. Of several ranges,
    `share` and `detour_m` are columns (n,), or (n, 2) of differences of arrival, which reflections of the one reception
    lengthen and of the other shorten. `detour_m` is the mean of both kinds of exponential detour, `long` their
    proportions, `location_m` the centre of the noise of a range.
    """

    share: Floats | float
    least_m: float
    detour_m: Floats | float
    outlier: float
    outlier_m: float
    long: LongDetours = ONE_KIND
    location_m: float = 0.0

    def at(self, rows: Any) -> RangeErrors:
        """Return the model of some of several ranges, or of one."""
        return replace(self, share=np.asarray(self.share)[rows], detour_m=np.asarray(self.detour_m)[rows])


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, RangeErrors]:
    """Return the noise (n,) of corrected ranges within a flight, and their errors.

    Outliers have a share of a thousandth at least, of about 3 m, because a filter meets errors that the calibration did
    not. Without an error model a tenth of the ranges is taken to be reflected, by 30 cm on average.
    """
    model, lifted = calibration.errors, calibration.lifted(ranges)
    if model is None:
        share, detour_m = np.repeat([[0.1], [0.3]], len(ranges), axis=1)
        unknown = RangeErrors(share=share, least_m=0.0, detour_m=detour_m, outlier=0.01, outlier_m=3.0)
        return noise_m(calibration, ranges), unknown
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    errors = RangeErrors(
        share=shapes.tail_share,
        least_m=model.least_m,
        detour_m=shapes.detour_m,
        outlier=max(model.outlier_share, 1e-3),
        outlier_m=max(model.outlier_m, 3.0),
        long=model.long,
        location_m=model.location_m,
    )
    return np.hypot(model.within_m(shapes.noise_m), calibration.bias_curve.beyond(lifted)), errors


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeUpdate:
    """An update by a range: mean and variance of the noise in the innovation, and whether the range is accepted.

    `log_density` is that of the innovation, in 1/m; `nis` is its square over its variance with plain noise.
    """

    noise_m: Floats
    variance_m2: Floats
    believed: Bools
    log_density: Floats
    nis: Floats


def gated_update(innovation_m: Floats, variance_m2: Floats, gate: float) -> RangeUpdate:
    """Accept an innovation if its square over its variance is below the gate; otherwise the state does not change."""
    believed = innovation_m**2 < gate * variance_m2
    return RangeUpdate(
        noise_m=np.where(believed, innovation_m, 0.0),
        variance_m2=np.where(believed, 0.0, variance_m2),
        believed=believed,
        log_density=-0.5 * (innovation_m**2 / variance_m2 + np.log(2 * np.pi * variance_m2)),
        nis=innovation_m**2 / variance_m2,
    )


def mixture_update(innovation_m: Floats, variance_m2: Floats, errors: RangeErrors) -> RangeUpdate:
    """Weigh direct, reflected and outlying ranges by the likelihood of the innovation.

    The noise in a reflected range is a normal distribution, truncated above (`calib.range_errors.densities`,
    docs/theory.md); in a difference of arrival that reads short, truncated below. An outlier has no information.
    """
    sigma_m, inside = np.sqrt(variance_m2), 1 - errors.outlier
    shares, detours_m = np.atleast_1d(errors.share, errors.detour_m)
    direct = np.prod(1 - shares)
    wide = np.hypot(errors.outlier_m, sigma_m)
    wild = errors.outlier * np.exp(-0.5 * (innovation_m / wide) ** 2) / (wide * ROOT_2PI) + 1e-300
    core = np.exp(-0.5 * innovation_m**2 / variance_m2) / (sigma_m * ROOT_2PI) * (inside * direct)
    total, mean, square = core + wild, core * innovation_m, core * innovation_m**2 + wild * variance_m2
    for sign, share, detour_m in zip((1.0, -1.0), shares, detours_m, strict=False):
        if share:
            found = densities(sign * innovation_m, sigma_m, errors.least_m, detour_m, errors.long)
            tail = found.reflected * (inside * (1 - direct) * share / shares.sum())
            noise = sign * found.noise_m()
            total, mean = total + tail, mean + tail * noise
            square = square + tail * (noise**2 + variance_m2 * found.noise_var())
    mean, square, wild = mean / total, square / total, wild / total
    return RangeUpdate(
        noise_m=mean,
        variance_m2=np.maximum(square - mean**2, 0.0),
        believed=wild < 0.5,
        log_density=np.log(total),
        nis=innovation_m**2 / variance_m2,
    )


@dataclass(frozen=True, slots=True)
class Fix:
    """A position (3,) and its covariance (3, 3), in metres."""

    place_m: Floats
    covariance_m2: Floats


def multilaterate(
    range_m: Floats, anchor_m: Floats, spread_m: float, height_m: float | None = None, sign: Floats | float = 1.0
) -> Fix:
    """Return the position from ranges (n,) to anchors (n, 3), by a Cauchy loss from nine starts.

    Instead of a distance a measurement may be the sum of several, with signs (n, k) to anchors (n, k, 3). Errors beyond
    15 cm count less: reflections are longer. `spread_m` is a further error of each range: its lever arm, or motion of
    the body. A `height_m` above the world's zero counts as a measurement with a standard deviation of 30 cm.
    """
    scale = float(np.hypot(0.15, spread_m))

    def misfit(place: Floats) -> Floats:
        distance = np.linalg.norm(place - anchor_m, axis=-1) * sign
        errors = (distance.reshape(len(range_m), -1).sum(axis=1) - range_m) / scale
        return errors if height_m is None else np.append(errors, (place[2] - height_m) / 0.3)

    places = anchor_m.reshape(-1, 3)
    middle, reach = places.mean(axis=0), np.maximum(np.ptp(places, axis=0), 1.0)
    starts = [middle, *(middle + 0.4 * reach * np.array(signs) for signs in product((-1, 1), repeat=3))]
    found = min((least_squares(misfit, start, loss="cauchy") for start in starts), key=lambda one: float(one.cost))
    slopes = np.asarray(found.jac, dtype=np.float64)
    return Fix(np.asarray(found.x), np.asarray(np.linalg.inv(slopes.T @ slopes + 1e-3 * np.eye(3))))


GRAVITY_M_S2: Final = 9.81
"""Between 9.78 at the equator and 9.83 at the poles; the biases of a consumer accelerometer are larger."""

SIZE: Final = 17
"""Size of the state. The names below slice its parts: position, velocity, attitude, biases, offset of the height
sensor, and the error that measurements of one exchange share, in units of its standard deviation."""

P, V, A, G, F, H, E = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15), 15, 16


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessNoise:
    """Process noise of the filter: accelerometer and gyro (per root of Hz), their biases, and motion without an IMU.

    The defaults are those of a consumer IMU on a small vibrating drone. `acceleration` (m/s^2 per root of Hz) is the
    random walk of velocity without an IMU.
    """

    force: float = 0.05
    gyro: float = 0.005
    force_bias: float = 0.02
    gyro_bias: float = 0.0005
    acceleration: float = 1.0
    height_m: float = 0.1
    height_offset: float = 0.005


class InertialFilter:
    """Predicts by inertial readings or constant velocity, and updates by ranges and heights."""

    def __init__(
        self, fix: Fix, attitudes: Floats, noise: ProcessNoise, *, inertial: bool, speed_m_s: float = 1.0
    ) -> None:
        """Start at a fix with attitudes (headings, 3, 3), body to world."""
        count = len(attitudes)
        self.noise, self.inertial = noise, inertial
        # Attitude errors move into the attitude, so that part of the state stays zero.
        self.state, self.attitude = np.zeros((count, SIZE)), attitudes.copy()
        self.likelihood = np.zeros(count)
        spread = np.zeros(SIZE)
        if inertial:
            # Headings are those of a grid; other standard deviations are those of consumer sensors.
            spread[A], spread[G], spread[F] = (0.3, 0.3, np.pi / count), 0.02, 0.4
        spread[H] = 0.15
        self.covariance = np.tile(np.diag(spread**2), (count, 1, 1))
        self.restart(fix, speed_m_s)

    def predict(self, dt: float, gyro: Floats, force: Floats) -> None:
        """Predict over `dt` seconds with mean angular velocity (3,) and specific force (3,); without an IMU they are
        ignored."""
        noise, state = self.noise, self.state
        step = np.zeros((len(state), SIZE, SIZE))
        step[:, P, V] = np.eye(3) * dt
        added = np.zeros(SIZE)
        if self.inertial:
            turn, pull = gyro - state[:, G], force - state[:, F]
            world = self._acceleration(pull)
            step[:, V, A] = -self.attitude @ _cross(pull) * dt
            step[:, V, F] = -self.attitude * dt
            step[:, A, A] = -_cross(turn) * dt
            step[:, A, G] = -np.eye(3) * dt
            self.attitude = self.attitude @ Rotation.from_rotvec(turn * dt).as_matrix()
            added[V], added[A] = noise.force**2 * dt, noise.gyro**2 * dt
            added[G], added[F] = noise.gyro_bias**2 * dt, noise.force_bias**2 * dt
        else:
            world = np.zeros((len(state), 3))
            added[P], added[V] = noise.acceleration**2 * dt**3 / 3, noise.acceleration**2 * dt
        state[:, P] += state[:, V] * dt + 0.5 * world * dt**2
        state[:, V] += world * dt
        added[H] = noise.height_offset**2 * dt
        whole = np.eye(SIZE) + step
        self.covariance = whole @ self.covariance @ whole.transpose(0, 2, 1) + np.diag(added)
        self.covariance = (self.covariance + self.covariance.transpose(0, 2, 1)) / 2

    def begin_exchange(self) -> None:
        """Begin another exchange, whose measurements share another error."""
        self.state[:, E] = 0.0
        self.covariance[:, E, :] = self.covariance[:, :, E] = 0.0
        self.covariance[:, E, E] = 1.0

    def update_range(
        self,
        measured_m: float,
        noise_m: float,
        errors: RangeErrors,
        arm_m: Floats,
        anchor_m: Floats,
        sign: Floats,
        common_m: float,
    ) -> RangeUpdate:
        """Update by a sum of distances with a `sign` (k,) to anchors (k, 3): one in a range, two in a difference.

        Measurements of an exchange share an error with a standard deviation of `common_m`. Returns the update.
        """
        towards = self.state[:, None, P] - anchor_m
        towards = towards + ((self.attitude @ arm_m)[:, None] if self.inertial else np.array([0.0, 0.0, arm_m[2]]))
        distance = np.maximum(np.linalg.norm(towards, axis=2), 1e-6)
        row = np.zeros_like(self.state)
        row[:, P] = np.einsum("hk,hki->hi", sign / distance, towards)
        row[:, E] = common_m
        if self.inertial:
            row[:, A] = -np.einsum("hi,hij->hj", row[:, P], self.attitude @ _cross(np.tile(arm_m, (len(distance), 1))))
        else:
            # Heading is unknown: a lever arm may point anywhere.
            noise_m = float(np.hypot(noise_m, np.linalg.norm(row[0, P]) * np.hypot(arm_m[0], arm_m[1]) / np.sqrt(2)))
        expected = distance @ sign + common_m * self.state[:, E]
        update = self._update_scalar(row, measured_m - expected, noise_m, errors)
        self.likelihood = self.likelihood + update.log_density
        return update

    def update_height(self, height_m: float) -> None:
        """Update by a height above the world's zero; the sensor may have an offset."""
        row = np.zeros_like(self.state)
        row[:, [2, H]] = 1.0
        errors = RangeErrors(share=1e-6, least_m=0.0, detour_m=1.0, outlier=0.05, outlier_m=1.0)
        self._update_scalar(row, height_m - self.state[:, 2] - self.state[:, H], self.noise.height_m, errors)

    def _update_scalar(self, row: Floats, innovation: Floats, noise_m: float, errors: RangeErrors) -> RangeUpdate:
        """Update by a scalar measurement with derivatives `row` (headings, states) and a non-normal error."""
        reach = np.einsum("hij,hj->hi", self.covariance, row)
        variance = np.einsum("hi,hi->h", row, reach) + noise_m**2
        update = mixture_update(innovation, variance, errors)
        gain = reach / variance[:, None]
        self._move(gain * update.noise_m[:, None])
        change = (update.variance_m2 - variance)[:, None, None]
        self.covariance = self.covariance + gain[:, :, None] * gain[:, None, :] * change
        return update

    def update_gravity(self, force: Floats, std: float) -> None:
        """Update by the direction of gravity: the mean specific force (3,) with an acceleration of `std` m/s^2 per
        axis.

        The update determines the sum of tilt error and accelerometer bias.
        """
        pull = force - self.state[:, F]
        slopes = [(A, -self.attitude @ _cross(pull)), (F, -self.attitude)]
        self._update_linear(slopes, -self._acceleration(pull), std)

    def _acceleration(self, force: Floats) -> Floats:
        """Return the acceleration in the world (headings, 3) of specific forces (headings, 3) in the body's axes."""
        return np.asarray(np.einsum("hij,hj->hi", self.attitude, force) - (0.0, 0.0, GRAVITY_M_S2))

    def limit_speed(self, speed_m_s: float) -> None:
        """Update by a velocity of zero with standard deviation `speed_m_s`: it bounds the state while there are no
        ranges."""
        self._update_linear([(V, np.eye(3))], -self.state[:, V], speed_m_s)

    def _update_linear(self, parts: Sequence[tuple[slice, Floats]], innovation: Floats, std: float) -> None:
        """Update by a linear measurement of parts of the state (headings, 3, 3 each) with normal noise."""
        rows = np.zeros((len(self.state), 3, SIZE))
        for part, slopes in parts:
            rows[:, :, part] = slopes
        reach = self.covariance @ rows.transpose(0, 2, 1)
        gain = reach @ np.linalg.inv(rows @ reach + std**2 * np.eye(3))
        self._move(np.einsum("hij,hj->hi", gain, innovation))
        # Joseph's form: symmetric and positive whatever rounding does.
        left = np.eye(SIZE) - gain @ rows
        self.covariance = left @ self.covariance @ left.transpose(0, 2, 1) + std**2 * gain @ gain.transpose(0, 2, 1)

    def restart(self, fix: Fix, speed_m_s: float) -> None:
        """Restart at a fix, with the present attitude and biases."""
        self.state[:, P], self.state[:, V] = fix.place_m, 0.0
        for part, covariance in ((P, fix.covariance_m2), (V, np.eye(3) * speed_m_s**2)):
            self.covariance[:, part, :] = self.covariance[:, :, part] = 0
            self.covariance[:, part, part] = covariance

    def _move(self, by: Floats) -> None:
        self.state = self.state + by
        if self.inertial:
            self.attitude = self.attitude @ Rotation.from_rotvec(by[:, A]).as_matrix()
        self.state[:, A] = 0.0


def _cross(vectors: Floats) -> Floats:
    """Return the cross-product matrices (n, 3, 3) of vectors (n, 3)."""
    return np.asarray(np.cross(np.eye(3), vectors[:, None, :]))
