"""A calibration within a filter or smoother: corrected ranges as measurements, and delays as states.

Ranges are direct, reflected or outliers. An innovation contains Gaussian noise, and a detour if the range is reflected.
A gate, or a mixture of these three kinds of errors, gives the posterior mean and variance of the noise, which determine
the update (docs/theory.md). The filters of `calib.evaluation` use these functions. `RangeUpdate` provides them for
other filters, `calib.factors` for smoothers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from calib.calibration.applying import noise_m
from calib.calibration.model import Calibration
from calib.data.ranges import Ranges
from calib.errors import BadInputError
from calib.range_errors.densities import ONE_KIND, ROOT_2PI, LongDetours, densities
from uwblink.arrays import ArrayRows, Bools, Floats, Ints

__all__ = ["DelayStates", "RangeUpdate"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeErrors:
    """The error model of ranges, in metres and shares of 1.

    A range is reflected with the probability `share`; its detour is `least_m` plus an exponential part with the mean
    `detour_m`, of the two kinds that `long` describes. It is an outlier with the probability `outlier`; outliers have
    the standard deviation `outlier_m`. `location_m` is the centre of the noise. For several ranges, `share` and
    `detour_m` are arrays (n,); for differences of arrival (n, 2): a reflection of the first reception lengthens the
    difference, one of the second shortens it.

    `known` is the part of `share` whose reflection and detour already lengthened the previous range of the pair. The
    filter has absorbed this detour, so the range gives no new information on the distance.
    """

    share: Floats | float
    least_m: float
    detour_m: Floats | float
    outlier: float
    outlier_m: float
    long: LongDetours = ONE_KIND
    location_m: float = 0.0
    known: Floats | float = 0.0

    def at(self, rows: Any) -> RangeErrors:
        """Return the model of the ranges in `rows` (an index of NumPy)."""
        return replace(self, share=np.asarray(self.share)[rows], detour_m=np.asarray(self.detour_m)[rows])


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, RangeErrors]:
    """Return the noise (n,) of corrected ranges within a flight, in metres, and their error model.

    Outliers have a share of at least 0.001 and a standard deviation of at least 3 m, because a filter meets errors that
    the recording of the calibration does not contain. Without an error model, a tenth of the ranges is assumed to be
    reflected, by 30 cm on average (judgements).
    """
    model, lifted = calibration.errors, calibration.lifted(ranges)
    if model is None:
        share, detour_m = np.repeat([[0.1], [0.3]], len(ranges), axis=1)
        unknown = RangeErrors(share=share, least_m=0.0, detour_m=detour_m, outlier=0.01, outlier_m=3.0)
        return noise_m(calibration, ranges), unknown
    shapes = model.shapes(lifted, ranges.initiator, ranges.target, model.log_odds_of(ranges.features))
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
class WeighedInnovation:
    """Posterior mean and variance of the noise in an innovation, and whether the range is `accepted`.

    `log_density` is the logarithm of the density of the innovation (1/m). `nis` is the square of the innovation over
    its variance (normalised innovation squared). `tail` is the probability that the range is not direct. `reflected`
    (..., sides) are the probabilities of a reflection of each reception.
    """

    noise_m: Floats
    variance_m2: Floats
    accepted: Bools
    log_density: Floats
    nis: Floats
    tail: Floats
    reflected: Floats


def gated_update(innovation_m: Floats, variance_m2: Floats, gate: float) -> WeighedInnovation:
    """Accept an innovation if its square over its variance is below the gate; otherwise the state does not change.

    A rejected innovation has the density of one at the gate.
    """
    accepted = innovation_m**2 < gate * variance_m2
    return WeighedInnovation(
        noise_m=np.where(accepted, innovation_m, 0.0),
        variance_m2=np.where(accepted, 0.0, variance_m2),
        accepted=accepted,
        log_density=-0.5 * (np.minimum(innovation_m**2 / variance_m2, gate) + np.log(2 * np.pi * variance_m2)),
        nis=innovation_m**2 / variance_m2,
        tail=np.where(accepted, 0.0, 1.0),
        reflected=np.zeros((*np.shape(innovation_m), 1)),
    )


def mixture_update(innovation_m: Floats, variance_m2: Floats, errors: RangeErrors) -> WeighedInnovation:
    """Return the posterior moments of the noise if a range is direct, reflected or an outlier.

    For several ranges, shares and detours are (n, sides). The noise in a reflected range has a truncated normal
    distribution: truncated above if the reflection lengthens the measurement (`calib.range_errors.densities`,
    docs/theory.md), below if it shortens it (second side of a difference of arrival). An outlier has no information:
    its noise keeps mean 0 and variance `variance_m2`.
    """
    sigma_m, inside = np.sqrt(variance_m2), 1 - errors.outlier
    shares, detours_m = np.atleast_1d(errors.share, errors.detour_m)
    known = np.broadcast_to(errors.known, shares.shape)
    direct, any_share = np.prod(1 - shares, axis=-1), np.maximum(shares.sum(axis=-1), 1e-300)
    wide = np.hypot(errors.outlier_m, sigma_m)
    wild = errors.outlier * np.exp(-0.5 * (innovation_m / wide) ** 2) / (wide * ROOT_2PI) + 1e-300
    core = np.exp(-0.5 * innovation_m**2 / variance_m2) / (sigma_m * ROOT_2PI) * (inside * direct)
    total, mean, square = core + wild, core * innovation_m, core * innovation_m**2 + wild * variance_m2
    tails = []
    for side, sign in zip(range(shares.shape[-1]), (1.0, -1.0), strict=False):
        share, old, detour_m = shares[..., side], known[..., side], detours_m[..., side]
        found = densities(sign * innovation_m, sigma_m, errors.least_m, detour_m, errors.long)
        each = found.reflected * (inside * (1 - direct) / any_share)
        # A known reflection (`old`) lengthens the range as before: its noise keeps its prior moments.
        noise, new = sign * found.noise_m(), each * (share - old)
        tails.append(each * share)
        total, mean = total + tails[-1], mean + new * noise
        square = square + new * (noise**2 + variance_m2 * found.noise_var()) + each * old * variance_m2
    mean, square, wild = mean / total, square / total, wild / total
    return WeighedInnovation(
        noise_m=mean,
        variance_m2=np.maximum(square - mean**2, 0.0),
        accepted=wild < 0.5,
        log_density=np.log(total),
        nis=innovation_m**2 / variance_m2,
        tail=1 - core / total,
        reflected=np.stack([one / total for one in tails], axis=-1) + wild[..., None] * shares,
    )


class Reflections:
    """Probabilities that pairs of tags are reflected now, for filters (...), by a renewal process of each pair.

    A pair keeps its reflection, or the direct path, for an exponential time with the mean `renewal_s`. Then reflection
    and detour are drawn again.
    """

    def __init__(self, renewal_s: float, shape: tuple[int, ...]) -> None:
        """Take the shape (..., pairs) of filters and pairs."""
        # Probabilities that the last reflection (0) or the last direct path (1) of a pair still lasts.
        self.renewal_s, self.lasting = renewal_s, np.zeros((*shape, 2))

    def decay(self, dt: float) -> None:
        """Predict the probabilities `dt` seconds later."""
        self.lasting *= math.exp(-dt / self.renewal_s) if self.renewal_s else 0.0

    def weigh(
        self, innovation_m: Floats, variance_m2: Floats, errors: RangeErrors, pair: Ints, used: Bools
    ) -> WeighedInnovation:
        """Return the `mixture_update` with the present probabilities of the pairs (sides,) of a measurement.

        Then update the probabilities of the filters (...) in the mask `used`.
        """
        sides = pair[: np.count_nonzero(errors.share)]
        before = self.lasting[..., sides, :]
        reflected, direct = before[..., 0], before[..., 1]
        share = reflected + (1 - reflected - direct) * np.atleast_1d(errors.share)[: len(sides)]
        found = mixture_update(innovation_m, variance_m2, replace(errors, share=share, known=reflected))
        learned = np.stack([found.reflected, 1 - found.reflected], axis=-1)
        self.lasting[..., sides, :] = np.where(used[..., None, None], learned, before)
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayStates:
    """Changes of antenna delays since a calibration, as states of a filter, in metres (times the speed of light).

    A range depends on half of the changes of its two tags. The states start at zero with `covariance_m2` (tags, tags)
    and are random walks with a standard deviation of `walk_m` after one second. `delays_ns` and `std_ns` (tags,) are
    those of the calibration. Combinations of delays that the calibration does not determine stay undetermined.
    """

    tags: tuple[int, ...] = ()
    covariance_m2: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    delays_ns: Floats = field(default_factory=lambda: np.zeros(0))
    std_ns: Floats = field(default_factory=lambda: np.zeros(0))
    walk_m: float = 0.0
    speed_of_light: float = 1.0

    @classmethod
    def of(cls, calibration: Calibration, tags: Sequence[int], *, walk_m: float = 0.005) -> DelayStates:
        """Return the states of some tags, with the covariance of the calibration.

        The default of `walk_m` was chosen by simulation (`benchmarks/dependences.py`): filters are consistent if ranges
        of one or two tags drift by 2 cm/K over 10 K in two minutes, and those of all others by 2.15 mm/K (DW1000 user
        manual, section 8.3.1). Raises `BadInputError` for a calibration with constants of pairs, and for tags without a
        delay.
        """
        if calibration.pair_offsets:
            raise BadInputError("the calibration has constants of pairs instead of delays; fit it with `constants` tag")
        return cls(
            tags=tuple(tags),
            covariance_m2=(1e-9 * calibration.speed_of_light) ** 2 * calibration.covariance_ns2(tags),
            delays_ns=np.array([calibration.delays_ns[tag] for tag in tags]),
            std_ns=np.array([calibration.delays_std_ns.get(tag, math.nan) for tag in tags]),
            walk_m=walk_m,
            speed_of_light=calibration.speed_of_light,
        )

    def slopes(self, ends: Ints, slopes: Floats) -> Floats:
        """Return derivatives of ranges by these states (n, tags), given `slopes` (n, 2) by the delays of `ends`
        (n, 2).
        """
        return np.asarray(np.einsum("ne,net->nt", slopes, ends[..., None] == np.array(self.tags, dtype=np.int64)))

    def estimates(
        self, change_m: Floats | float = 0.0, covariance_m2: Floats | None = None
    ) -> dict[int, tuple[float, float]]:
        """Return the delay of each tag in ns and its standard deviation, which is infinite if undetermined.

        `change_m` (tags,) and `covariance_m2` (tags, tags) are the present states of a filter; by default those of the
        calibration.
        """
        known = self.covariance_m2 if covariance_m2 is None else covariance_m2
        metres_a_ns = 1e-9 * self.speed_of_light
        std_ns = np.where(np.isinf(self.std_ns), np.inf, np.sqrt(np.diag(known)) / metres_a_ns)
        both = zip((self.delays_ns + change_m / metres_a_ns).tolist(), std_ns.tolist(), strict=True)
        return dict(zip(self.tags, both, strict=True))


FIXED_DELAYS: Final = DelayStates()
"""The states of a filter with fixed delays."""


@dataclass(frozen=True, kw_only=True)
class RangeUpdate(ArrayRows):
    """Corrected ranges (n,) as measurements of any filter or smoother.

    A range `measured_m` is the distance of two antennas, plus `delay_slopes` (n, 2) times the changes of the delays of
    both `ends` (n, 2) in metres (`DelayStates`), plus noise with the standard deviation `noise_m`, plus the detour of a
    reflection or an outlier by the model `errors`.

    >>> import calib, numpy as np
    >>> from calib.online import RangeUpdate
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> one = RangeUpdate.of(known, calib.Ranges.from_arrays(3.0, initiator=1, target=2, fpp1_dbm=-85.0))
    >>> innovation_m, along = one.innovation(np.zeros(3), np.array([0.0, 0.0, 2.9]))
    >>> found = one.weigh(innovation_m, 0.05**2)
    >>> found.tail.shape, bool(found.noise_m[0] < innovation_m[0])
    ((1,), True)
    """

    measured_m: Floats
    noise_m: Floats
    errors: RangeErrors
    ends: Ints
    delay_slopes: Floats

    @classmethod
    def of(cls, calibration: Calibration, ranges: Ranges) -> RangeUpdate:
        """Return ranges as measurements.

        Raises the errors of `Calibration.apply`, and `BadInputError` for a range without power if the calibration
        needs one.
        """
        noise, known = range_errors(calibration, ranges)
        errors = replace(known, share=np.reshape(known.share, (-1, 1)), detour_m=np.reshape(known.detour_m, (-1, 1)))
        measured_m = calibration.apply(ranges).corrected_m - errors.location_m
        if not np.isfinite(measured_m + noise).all():
            row = int(np.argmin(np.isfinite(measured_m + noise)))
            raise BadInputError(f"{ranges.source}: range {row} has no power, which the calibration needs")
        return cls(
            measured_m=measured_m, noise_m=noise, errors=errors, ends=ends_of(ranges), delay_slopes=delay_slopes(ranges)
        )

    def innovation(self, first_m: Floats, second_m: Floats, changes_m: Floats | float = 0.0) -> tuple[Floats, Floats]:
        """Return innovations (n,) and the derivatives `along` (n, 3) of distances by the place of the first antenna.

        `first_m` and `second_m`, (n, 3) or (3,), are the places of the antennas of initiator and target in metres;
        `changes_m` (n, 2) are the changes of their delays. Other derivatives of the expected range: by the second place
        -`along`; by the changes of the delays `delay_slopes`; by a small rotation of the first body, as a vector in its
        own axes, arm x (C' along), with the attitude C (body to world) and the lever arm in the body's axes.
        """
        apart = np.atleast_2d(first_m - second_m)
        distance = np.maximum(np.linalg.norm(apart, axis=-1), 1e-6)
        expected = distance + np.sum(self.delay_slopes * changes_m, axis=-1)
        return self.measured_m - expected, apart / distance[:, None]

    def weigh(self, innovation_m: Floats, state_m2: Floats | float = 0.0) -> WeighedInnovation:
        """Return the posterior moments of the noise in innovations (n,), which drive the update of a filter.

        `state_m2` is the variance h' P h that the state contributes. With s^2 = h' P h + `noise_m`^2, the gain
        K = P h / s^2, and mean n and variance v of the noise: add K n to the state and K (v - s^2) K' to P.
        """
        return mixture_update(innovation_m, self.noise_m**2 + state_m2, self.errors)

    def at(self, rows: Any) -> RangeUpdate:
        """Return some of the ranges."""
        return replace(self[rows], errors=self.errors.at(rows))

    @cached_property
    def likeliest(self) -> tuple[Floats, WeighedInnovation]:
        """The innovations (n,) with the largest likelihood if the state is exact, and their posterior moments.

        They are 0 or larger, because reflections lengthen ranges. Bisection finds them: the derivative of the log
        likelihood by the innovation is -n / s^2, with the mean n of the noise.
        """
        low, high = -4 * self.noise_m, self.errors.least_m + 6 * self.noise_m
        for _ in range(50):
            middle = (low + high) / 2
            below = self.weigh(middle).noise_m < 0
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return low, self.weigh(low)

    def whiten(self, innovation_m: Floats) -> tuple[Floats, Floats]:
        """Return residuals r (n,) for least squares and their derivatives (n,) by the innovation.

        r^2 / 2 is the logarithm of the largest likelihood over the likelihood of the innovation. Its derivative is
        n / s^2, with the mean n of the noise (Tweedie's formula), so r' = n / (s^2 r). At the maximum, where r = 0, r'
        is the root of the curvature (s^2 - v) / s^4, with the variance v of the noise.
        """
        (likeliest_m, top), found = self.likeliest, self.weigh(innovation_m)
        away_m = innovation_m - likeliest_m
        residual = np.sign(away_m) * np.sqrt(2 * np.maximum(top.log_density - found.log_density, 0.0))
        top_slope = np.sqrt(np.maximum(self.noise_m**2 - top.variance_m2, 0.0)) / self.noise_m**2
        near = np.abs(away_m) < 1e-3 * self.noise_m
        slope = found.noise_m / np.where(near, 1.0, residual * self.noise_m**2)
        return np.where(near, top_slope * away_m, residual), np.where(near, top_slope, slope)


def ends_of(ranges: Ranges) -> Ints:
    """Return the tags (n, 2) whose delays ranges contain: rows of the ranges, then rows of their arrivals."""
    ends, heard = ranges.ends, ranges.arrivals
    return ends if heard is None else np.concatenate([ends, ends[heard.exchange]])


def delay_slopes(ranges: Ranges) -> Floats:
    """Return derivatives (n, 2) by the delays of `ends_of`, in metres per metre: of ranges, then of their arrivals.

    A corrected difference of arrival contains the target's delay minus the delays of the range
    (`Calibration.correct_arrivals`).
    """
    slopes, heard = -np.column_stack([ranges.weight_initiator, ranges.weight_target]), ranges.arrivals
    return slopes if heard is None else np.concatenate([slopes, -slopes[heard.exchange] - (0.0, 1.0)])
