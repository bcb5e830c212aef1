"""Filters: updates by a range, for many filters at once, and error-state filters with inertial readings.

Filters differ in the assumed error of a range. All update along the line of sight: mean and covariance of the state
follow from the mean and variance of the noise in an innovation (moments of the posterior for Gaussian noise and state),
by a gate or by a mixture of errors. A diverged filter restarts from ranges alone (`multilaterate`).

The error-state Kalman filter (Solà 2017, sections 5 to 7) has bodies in the frame of a reference (`RelativeFilter`).
One body in a room is a special case (`InertialFilter`): a room is a reference with the readings of a body at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.calibration.model import Calibration
from calib.calibration.patterns import Pattern
from calib.data.ranges import Ranges
from calib.online import FIXED_DELAYS, DelayStates, RangeErrors, WeighedInnovation, gated_update, mixture_update
from uwblink.arrays import Floats, Ints


def squared_over(wrong: Floats, covariance: Floats) -> Floats:
    """Return squares (...) of errors (..., k) over their covariance (..., k, k)."""
    return np.asarray(np.sum(wrong * np.linalg.solve(covariance, wrong[..., None])[..., 0], axis=-1))


@dataclass(frozen=True, slots=True)
class Fix:
    """A position (3,) and its covariance (3, 3), in metres."""

    place_m: Floats
    covariance_m2: Floats


def multilaterate(
    range_m: Floats, anchor_m: Floats, spread_m: float, height_m: float | None = None, sign: Floats | float = 1.0
) -> Fix:
    """Return the position from ranges (n,) to anchors (n, 3), by a Cauchy loss from nine starts.

    A measurement may also be a sum of several distances, with signs (n, k) to anchors (n, k, 3). Errors beyond 15 cm
    have less weight, because reflections are longer. `spread_m` is a further error of each range: its lever arm, or
    motion of the body. A `height_m` above the world's zero counts as a measurement with a standard deviation of 30 cm.
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
    # A direction that ranges do not determine has a standard deviation of 30 m, about the size of a hall.
    return Fix(np.asarray(found.x), np.asarray(np.linalg.inv(slopes.T @ slopes + 1e-3 * np.eye(3))))


GRAVITY_M_S2: Final = 9.81
"""Between 9.78 at the equator and 9.83 at the poles; the biases of a consumer accelerometer are larger."""

BODY: Final = 15
"""States of a body. The names below slice them: position, velocity, attitude, biases of gyro and accelerometer."""

P, V, A, G, F = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)

REST: Final = np.array([0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY_M_S2])
"""Readings of an IMU without errors at rest in a room: angular velocity and specific force."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessNoise:
    """Process noise of the filter: accelerometer `force` (m/s^2 per root of Hz) and `gyro` (rad/s per root of Hz).

    Their biases are random walks of `force_bias` (m/s^2 per root of a second) and `gyro_bias` (rad/s per root of a
    second), which begin with standard deviations of `force_start` (m/s^2) and `gyro_start` (rad/s). The defaults are
    those of a consumer IMU on a small vibrating drone. `acceleration` (m/s^2 per root of Hz) is the random walk of
    velocity without an IMU. Readings of heights have noise of `height_m` (m), and an offset that is a random walk of
    `height_offset` (m per root of a second).
    """

    force: float = 0.05
    gyro: float = 0.005
    force_bias: float = 0.02
    gyro_bias: float = 0.0005
    force_start: float = 0.4
    gyro_start: float = 0.02
    acceleration: float = 1.0
    height_m: float = 0.1
    height_offset: float = 0.005


IMUS: Final = {
    "drone": ProcessNoise(),
    "consumer": ProcessNoise(
        force=3e-3, gyro=1.7e-4, force_bias=2e-3, gyro_bias=1.7e-4, force_start=0.1, gyro_start=8.7e-3
    ),
    "industrial": ProcessNoise(
        force=1e-3, gyro=8.7e-5, force_bias=5e-4, gyro_bias=3.5e-5, force_start=0.03, gyro_start=1.7e-3
    ),
    "tactical": ProcessNoise(
        force=3e-4, gyro=1.7e-5, force_bias=5e-5, gyro_bias=1.7e-6, force_start=0.01, gyro_start=8.7e-5
    ),
}
"""Noise by grade of IMU, as in a scenario's `imu.grade`: a consumer IMU that vibrates, and values of data sheets."""


class GaussianFilters:
    """Filters at once, with states (..., n) and covariances (..., n, n).

    States after the first `known` are errors that measurements share, in units of their standard deviation:
    Gauss-Markov processes of first order (Bar-Shalom, Li and Kirubarajan 2001, section 8.2).
    """

    def __init__(self, state: Floats, covariance: Floats, known: int) -> None:
        """Start at states with covariances."""
        self.state, self.covariance, self.known = state, covariance, known

    def add_variance(self, states: Any, variance: Floats | float) -> None:
        """Add variances to those of some states."""
        np.einsum("...ii->...i", self.covariance)[..., states] += variance

    def append(self, covariance: Floats) -> slice:
        """Append states of zero with a covariance (k, k), and return their indices."""
        size, count = self.state.shape[-1], len(covariance)
        self.state = np.concatenate([self.state, np.zeros((*self.state.shape[:-1], count))], axis=-1)
        around = [(0, 0)] * (self.covariance.ndim - 2) + [(0, count)] * 2
        self.covariance = np.pad(self.covariance, around)
        self.covariance[..., size:, size:] = covariance
        return slice(size, size + count)

    def append_delays(self, delays: DelayStates) -> None:
        """Append states of delays (`changes`): shared errors in metres that do not decay."""
        self.delays, self.changes = delays, self.append(delays.covariance_m2)

    def wander(self, dt: float) -> None:
        """Let delays change for `dt` seconds."""
        self.add_variance(self.changes, self.delays.walk_m**2 * dt)

    def decay(self, errors: slice, kept: Floats) -> None:
        """Let shared errors decay to shares `kept` (..., k) of their values, with constant standard deviation."""
        self.state[..., errors] *= kept
        self.covariance[..., errors, :] *= kept[..., None]
        self.covariance[..., errors] *= kept[..., None, :]
        self.add_variance(errors, 1 - kept**2)

    def forget(self, states: Any, covariance: Floats) -> None:
        """Set states to zero, with a covariance, and independent of all others."""
        self.state[..., states] = 0.0
        self.covariance[..., states, :] = 0.0
        self.covariance[..., states] = 0.0
        self.covariance[..., states, states] = covariance

    def update(
        self,
        row: Floats,
        innovation: Floats,
        noise_m2: Floats | float,
        weigh: Callable[[Floats, Floats], WeighedInnovation],
    ) -> WeighedInnovation:
        """Update by scalar measurements with derivatives `row` (..., n) and noise of variance `noise_m2`.

        `innovation` (...) is measured minus expected, without the shared errors, which are linear. `weigh` is a
        function of innovations and their variances (...), like `mixture_update`.
        """
        innovation = innovation - np.sum((row * self.state)[..., self.known :], axis=-1)
        reach = np.matmul(self.covariance, row[..., None])[..., 0]
        variance = np.sum(row * reach, axis=-1) + noise_m2
        update = weigh(innovation, variance)
        gain = reach / variance[..., None]
        self._move(gain * update.noise_m[..., None])
        change = gain * (update.variance_m2 - variance)[..., None]
        self.covariance += gain[..., None] * change[..., None, :]
        return update

    def _move(self, by: Floats) -> None:
        self.state += by


@dataclass(frozen=True, slots=True, eq=False)
class EndPattern:
    """A pattern over direction at an `end` (0 or 1) of a distance in a measurement; `axes` (3, 3) are the axes of the
    antenna's body in the axes of the body that the filter estimates."""

    pattern: Pattern
    distance: int
    end: int
    axes: Floats


def end_patterns(
    calibration: Calibration, ends: Ints, sign: Floats, axes: Mapping[int, Floats]
) -> list[list[EndPattern]]:
    """Return the patterns of measurements (n,) of distances between tags `ends` (n, k, 2) with a `sign` (n, k).

    `axes` are the axes of tags whose bodies the filter does not turn.
    """
    found: list[list[EndPattern]] = [[] for _ in ends]
    for one in calibration.patterns:
        for row, distance, end in np.argwhere(np.isin(ends, one.tags) & (sign != 0)[..., None]).tolist():
            own = axes.get(int(ends[row, distance, end]), np.eye(3))
            found[row].append(EndPattern(one, distance, end, own))
    return found


def without_directions(ranges: Ranges) -> Ranges:
    """Return ranges without the directions by true poses, because filters compute directions from their own
    estimates.
    """
    return replace(ranges, toward=np.full_like(ranges.toward, np.nan))


class RelativeFilter(GaussianFilters):
    """Poses of bodies in the frame of a reference: a room, or one more body with an IMU (`moving`).

    Several filters at once: arrays begin with (filters, bodies). Of a body with angular velocity w and specific force f
    and a reference with w0 and f0, attitude C, position p and velocity v in the axes of the reference obey

        C' = C [w]x - [w0]x C,  p' = v - w0 x p,  v' = C f - f0 - w0 x v

    Gravity cancels (Shalaby et al. 2023, arXiv 2304.03837). There is no state for the place of the whole team:
    distances between bodies do not determine it, and as a state it would seem determined by errors of linearization
    (Huang et al. 2011, Autonomous Robots 30). Errors of attitudes are in the axes of the body. States: `BODY` of each
    body, the biases of a moving reference, and others that the caller defines.
    """

    def __init__(
        self, place_m: Floats, attitudes: Floats, spread: Floats, noise: ProcessNoise, *, moving: bool = False
    ) -> None:
        """Start at places (filters, bodies, 3) with attitudes (filters, bodies, 3, 3), and standard deviations."""
        count, self.bodies = attitudes.shape[:2]
        self.noise = noise
        # Attitude errors are moved into the attitude, so this part of the state stays zero. The last body is the
        # reference.
        self.attitude = np.concatenate([attitudes, np.tile(np.eye(3), (count, 1, 1, 1))], axis=1)
        covariance = np.tile(np.diag(spread**2), (count, 1, 1))
        super().__init__(np.zeros((count, len(spread))), covariance, BODY * self.bodies + 6 * moving)
        self.own[..., P] = place_m

    @property
    def own(self) -> Floats:
        """The states of the bodies (filters, bodies, `BODY`), which can be written to."""
        return self.state[:, : BODY * self.bodies].reshape(len(self.state), self.bodies, BODY)

    def predict(self, dt: float, readings: Floats, reference: Floats = REST) -> None:
        """Predict over `dt` seconds by mean angular velocities and specific forces of bodies (bodies, 6) and (6,)."""
        noise, own, fixed = self.noise, self.own, slice(BODY * self.bodies, self.known)
        moving = fixed.start < fixed.stop
        still = reference - (self.state[:, fixed] if moving else 0.0 * self.state[:, :6])
        turn, pull, rate = readings[:, :3] - own[..., G], readings[:, 3:] - own[..., F], still[:, None, :3]
        # Forces are rotated by the attitude at the middle of the step.
        middle, back, half = turned_by(turn * (dt / 2)), turned_by(-rate * dt), turned_by(rate * (dt / 2))
        pull, attitude = np.einsum("fbij,fbj->fbi", middle, pull), self.attitude[:, :-1]
        force = np.einsum("fbij,fbj->fbi", attitude, pull) - np.einsum("fbij,fbj->fbi", half, still[:, None, 3:])
        place = own[..., P] + own[..., V] * dt + 0.5 * force * dt**2
        own[..., P] = np.einsum("fbij,fbj->fbi", back, place)
        own[..., V] = np.einsum("fbij,fbj->fbi", back, own[..., V] + force * dt)
        tilt, axes = -back @ attitude @ _cross(pull) * dt, -back @ attitude @ middle * dt
        turned = turned_by(turn * dt)
        self.attitude[:, :-1] = back @ attitude @ turned
        step, q = np.tile(np.eye(self.known), (len(self.state), 1, 1)), np.zeros(self.known)
        towards = self.attitude[:, :-1].transpose(0, 1, 3, 2) * dt
        for b in range(self.bodies):
            p, v, a, g, f = (slice(BODY * b + one.start, BODY * b + one.stop) for one in (P, V, A, G, F))
            step[:, p, p] = step[:, v, v] = back[:, 0]
            step[:, p, v], step[:, p, a] = back[:, 0] * dt, tilt[:, b] * (dt / 2)
            step[:, v, a], step[:, v, f] = tilt[:, b], axes[:, b]
            step[:, a, a], step[:, a, g] = turned[:, b].transpose(0, 2, 1), -np.eye(3) * dt
            q[v], q[a], q[g], q[f] = (n**2 * dt for n in (noise.force, noise.gyro, noise.gyro_bias, noise.force_bias))
            if moving:
                w, f = slice(fixed.start, fixed.start + 3), slice(fixed.start + 3, fixed.stop)
                step[:, p, w], step[:, v, w] = -_cross(own[:, b, P]) * dt, -_cross(own[:, b, V]) * dt
                step[:, a, w], step[:, v, f] = towards[:, b], (back @ half)[:, 0] * dt
                q[w], q[f] = noise.gyro_bias**2 * dt, noise.force_bias**2 * dt
        known = self.covariance[:, : self.known]
        known[:] = step @ known
        known = self.covariance[:, :, : self.known]
        known[:] = known @ step.transpose(0, 2, 1)
        known[:, range(self.known), range(self.known)] += q
        if moving:
            # The noise of the reference's readings is common to all bodies.
            shared = step[:, : fixed.start, fixed] * np.repeat([noise.gyro, noise.force], 3) / np.sqrt(dt)
            self.covariance[:, : fixed.start, : fixed.start] += shared @ shared.transpose(0, 2, 1)
        self.covariance = (self.covariance + self.covariance.transpose(0, 2, 1)) / 2

    def distances(self, bodies: Ints, arm_m: Floats, sign: Floats) -> tuple[Floats, Floats, Floats]:
        """Return expected sums of distances (filters,) with signs (k,), their derivatives by the states (filters,
        states), and standard deviations (filters, k) of the parts of distances that are not linear in errors of the
        state.

        Distances are between points `arm_m` (k, 2, 3) of `bodies` (k, 2); the number after the last is the reference.
        Means and standard deviations have the terms of second order (Bar-Shalom, Li and Kirubarajan 2001, section
        10.3.2): a tag that is 0.3 m off across the line of sight changes 3 m by 1.5 cm.
        """
        attitude, size = self.attitude[:, bodies], BODY * self.bodies
        points = self._points(bodies, arm_m)
        between, turns = points[:, :, 0] - points[:, :, 1], -attitude @ _cross(arm_m)
        distance = np.maximum(np.linalg.norm(between, axis=-1), 1e-6)
        along = between / distance[..., None]
        slopes = np.zeros((len(self.state), len(sign), 3, self.bodies + 1, BODY))
        for k, ends in enumerate(bodies.tolist()):
            for side, body, way in zip((0, 1), ends, (1.0, -1.0), strict=True):
                slopes[:, k, :, body, P] += way * np.eye(3)
                slopes[:, k, :, body, A] += way * turns[:, k, side]
        slopes = slopes[..., :-1, :].reshape(*slopes.shape[:3], size)
        row = np.zeros_like(self.state)
        row[:, :size] = np.einsum("fki,fkis->fs", along * sign[:, None], slopes)
        spread = slopes @ self.covariance[:, None, :size, :size] @ slopes.swapaxes(2, 3)
        bend = (np.eye(3) - along[..., None] * along[..., None, :]) @ spread / distance[..., None, None]
        expected = (distance + np.trace(bend, axis1=2, axis2=3) / 2) @ sign
        return expected, row, np.sqrt(np.einsum("fkij,fkji->fk", bend, bend) / 2)

    def _points(self, bodies: Ints, arm_m: Floats) -> Floats:
        """Return points `arm_m` (k, 2, 3) of bodies (k, 2) in the axes of the reference (filters, k, 2, 3)."""
        places = np.concatenate([self.own[..., P], np.zeros((len(self.state), 1, 3))], axis=1)
        return np.asarray(places[:, bodies] + np.einsum("fkeij,kej->fkei", self.attitude[:, bodies], arm_m))

    def longer_m(self, bodies: Ints, arm_m: Floats, sign: Floats, patterns: Iterable[EndPattern]) -> Floats:
        """Return the amount (filters,) by which patterns lengthen a sum of distances, for the estimated poses.

        Arguments are those of `distances`. The effect of pose errors on it is neglected.
        """
        longer = np.zeros(len(self.state))
        for one in patterns:
            points = self._points(bodies[[one.distance]], arm_m[[one.distance]])[:, 0]
            away = points[:, 1 - one.end] - points[:, one.end]
            axes = self.attitude[:, bodies[one.distance, one.end]] @ one.axes
            toward = np.einsum("fji,fj->fi", axes, away) / np.maximum(np.linalg.norm(away, axis=1), 1e-6)[:, None]
            longer += sign[one.distance] * (one.pattern.values(toward) @ np.array(one.pattern.coefficients_m))
        return longer

    def _move(self, by: Floats) -> None:
        super()._move(by)
        self.attitude[:, :-1] = self.attitude[:, :-1] @ turned_by(self.own[..., A])
        self.own[..., A] = 0.0


H, E = BODY, BODY + 1
"""States of `InertialFilter` after those of its body: the offset of the height sensor, and the error that measurements
of one exchange share, in units of its standard deviation. Changes of delays follow, if any."""


class InertialFilter(RelativeFilter):
    """One body in a room, with several headings at once; updates by ranges to points of the room, and by heights.

    Without an IMU the body is assumed to be level, and its velocity is a random walk. With delays as states each
    heading has two filters: with fixed delays, and with delays that `drift` (filters,).
    """

    def __init__(
        self,
        fix: Fix,
        attitudes: Floats,
        noise: ProcessNoise,
        *,
        inertial: bool,
        speed_m_s: float = 1.0,
        delays: DelayStates = FIXED_DELAYS,
    ) -> None:
        """Start at a fix with attitudes (headings, 3, 3), body to world."""
        count, spread = len(attitudes), np.zeros(BODY + 2)
        self.drift = np.repeat([False, True], [count, count if delays.tags else 0])
        self.inertial, self.likelihood = inertial, np.zeros(len(self.drift))
        if inertial:
            # Headings are a grid; other standard deviations are typical of consumer sensors.
            spread[A], spread[G], spread[F] = (0.3, 0.3, np.pi / count), noise.gyro_start, noise.force_start
        else:
            noise = replace(noise, force=noise.acceleration, gyro=0.0, gyro_bias=0.0, force_bias=0.0)
        spread[H] = 0.15
        super().__init__(fix.place_m, np.resize(attitudes[:, None], (len(self.drift), 1, 3, 3)), spread, noise)
        self.append_delays(delays)
        self.restart(fix, speed_m_s)

    @property
    def drifts(self) -> float:
        """The probability that delays drift."""
        odds = np.exp(self.likelihood - self.likelihood.max())
        return float(odds[self.drift].sum() / odds.sum())

    def step(self, dt: float, readings: Floats) -> None:
        """Predict over `dt` seconds by mean readings (6,); without an IMU they are ignored."""
        self.predict(dt, readings[None] if self.inertial else REST[None])
        self.add_variance(H, self.noise.height_offset**2 * dt)
        self.wander(dt)

    def begin_exchange(self) -> None:
        """Begin another exchange, whose measurements share a new error."""
        self.forget(E, np.ones(1))

    def update_range(
        self,
        measured_m: float,
        noise_m: float,
        errors: RangeErrors,
        arm_m: Floats,
        anchor_m: Floats,
        sign: Floats,
        shared: Floats | float,
        patterns: Sequence[EndPattern] = (),
    ) -> WeighedInnovation:
        """Update by a sum of distances with a `sign` (k,) to anchors (k, 3): one in a range, two in a difference.

        `shared` are the standard deviation in metres of the error that measurements of an exchange share, and the
        derivatives by delays, where these are states. In `patterns` the body is at end 0. Returns the update.
        """
        points = np.stack([np.tile(arm_m if self.inertial else arm_m * (0.0, 0.0, 1.0), (len(sign), 1)), anchor_m], 1)
        bodies = np.tile([0, 1], (len(sign), 1))
        expected, row, bent_m = self.distances(bodies, points, sign)
        if not self.inertial:
            # The heading is unknown, and so are the directions of lever arm and pattern.
            noise_m = float(np.hypot(noise_m, np.linalg.norm(row[0, P]) * np.hypot(arm_m[0], arm_m[1]) / np.sqrt(2)))
            noise_m = math.hypot(noise_m, *(one.pattern.rms_m for one in patterns if one.end == 0))
            patterns = [one for one in patterns if one.end]
        expected += self.longer_m(bodies, points, sign, patterns)
        row[:, E:] = shared
        row[~self.drift, E + 1 :] = 0.0
        variance = noise_m**2 + np.sum((sign * bent_m) ** 2, axis=1)
        update = self.update(row, measured_m - expected, variance, partial(mixture_update, errors=errors))
        self.likelihood = self.likelihood + update.log_density
        return update

    def update_height(self, height_m: float) -> None:
        """Update by a height above the world's zero; the sensor may have an offset."""
        row = np.zeros_like(self.state)
        row[:, [2, H]] = 1.0
        errors = RangeErrors(share=1e-6, least_m=0.0, detour_m=1.0, outlier=0.05, outlier_m=1.0)
        self.update(row, height_m - self.state[:, 2], self.noise.height_m**2, partial(mixture_update, errors=errors))

    def update_gravity(self, force: Floats, std: float) -> None:
        """Update by the direction of gravity: the mean specific force (3,) with an acceleration of `std` m/s^2 per
        axis.

        The update determines the sum of tilt error and accelerometer bias.
        """
        for axis in range(3):
            pull, attitude, row = force - self.state[:, F], self.attitude[:, 0], np.zeros_like(self.state)
            row[:, A], row[:, F] = -(attitude @ _cross(pull))[:, axis], -attitude[:, axis]
            innovation = REST[3 + axis] - np.einsum("hj,hj->h", attitude[:, axis], pull)
            self.update(row, innovation, std**2, partial(gated_update, gate=np.inf))

    def limit_speed(self, speed_m_s: float) -> None:
        """Update by a velocity of zero with standard deviation `speed_m_s`: it bounds the state while there are no
        ranges."""
        for axis in range(V.start, V.stop):
            row = np.zeros_like(self.state)
            row[:, axis] = 1.0
            self.update(row, -self.state[:, axis], speed_m_s**2, partial(gated_update, gate=np.inf))

    def restart(self, fix: Fix, speed_m_s: float) -> None:
        """Restart at a fix, with the present attitude and biases."""
        self.forget(P, fix.covariance_m2)
        self.forget(V, np.eye(3) * speed_m_s**2)
        self.state[:, P] = fix.place_m


def _cross(vectors: Floats) -> Floats:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    return np.asarray(vectors @ CROSS).reshape(*vectors.shape, 3)


CROSS: Final = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1).reshape(3, 9)
"""The cross-product matrices of the three axes."""


def turned_by(angles: Floats) -> Floats:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    return np.asarray(Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix()).reshape(*angles.shape, 3)
