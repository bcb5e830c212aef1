"""A calibration within a filter or smoother: corrected ranges as measurements, and delays as states.

Ranges are direct, reflected or outliers. An update follows from the mean and variance of the noise in an innovation
(moments of the posterior for Gaussian noise and state), by a gate or by a mixture of errors. The filters of
`calib.evaluation` use these functions; `RangeUpdate` offers them to other filters, `calib.factors` to smoothers.
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
from uwblink.arrays import Bools, Floats, Ints

__all__ = ["DelayStates", "RangeUpdate"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeErrors:
    """The error model of a range: reflected with probability `share`, by a least detour and an exponential one.

    Metres and shares of 1. Outliers have the share `outlier` and a size of about `outlier_m`. Of several ranges,
    `share` and `detour_m` are columns (n,), or (n, 2) of differences of arrival, which reflections of the one reception
    lengthen and of the other shorten. `detour_m` is the mean of both kinds of exponential detour, `long` their
    proportions, `location_m` the centre of the noise of a range. Of the `share`, `known` is that of reflections that
    lengthened the range before by the same detour, and say no more of the distance.
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
    """An update by a range: mean and variance of the noise in the innovation, and whether the range is accepted.

    `log_density` is that of the innovation, in 1/m; `nis` is its square over its variance with plain noise; `tail` is
    the probability that the range was not direct. `reflected` (..., sides) are probabilities of a reflection.
    """

    noise_m: Floats
    variance_m2: Floats
    believed: Bools
    log_density: Floats
    nis: Floats
    tail: Floats
    reflected: Floats


def gated_update(innovation_m: Floats, variance_m2: Floats, gate: float) -> WeighedInnovation:
    """Accept an innovation if its square over its variance is below the gate; otherwise the state does not change.

    What is not accepted has the density at the gate.
    """
    believed = innovation_m**2 < gate * variance_m2
    return WeighedInnovation(
        noise_m=np.where(believed, innovation_m, 0.0),
        variance_m2=np.where(believed, 0.0, variance_m2),
        believed=believed,
        log_density=-0.5 * (np.minimum(innovation_m**2 / variance_m2, gate) + np.log(2 * np.pi * variance_m2)),
        nis=innovation_m**2 / variance_m2,
        tail=np.where(believed, 0.0, 1.0),
        reflected=np.zeros((*np.shape(innovation_m), 1)),
    )


def mixture_update(innovation_m: Floats, variance_m2: Floats, errors: RangeErrors) -> WeighedInnovation:
    """Weigh direct, reflected and outlying ranges by the likelihood of the innovation.

    Of several ranges shares and detours are (n, sides). The noise in a reflected range is a normal distribution,
    truncated above (`calib.range_errors.densities`, docs/theory.md); in a difference of arrival that reads short,
    truncated below. An outlier has no information.
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
        noise, new = sign * found.noise_m(), each * (share - old)
        tails.append(each * share)
        total, mean = total + tails[-1], mean + new * noise
        square = square + new * (noise**2 + variance_m2 * found.noise_var()) + each * old * variance_m2
    mean, square, wild = mean / total, square / total, wild / total
    return WeighedInnovation(
        noise_m=mean,
        variance_m2=np.maximum(square - mean**2, 0.0),
        believed=wild < 0.5,
        log_density=np.log(total),
        nis=innovation_m**2 / variance_m2,
        tail=1 - core / total,
        reflected=np.stack([one / total for one in tails], axis=-1) + wild[..., None] * shares,
    )


class Reflections:
    """Which pairs of tags are reflected, as filters (...) come to know: a renewal process of each pair.

    After `renewal_s` on average it is drawn anew whether ranges of a pair are reflected, and by what detour.
    """

    def __init__(self, renewal_s: float, shape: tuple[int, ...]) -> None:
        """Begin with nothing known of filters and pairs (..., pairs)."""
        self.renewal_s, self.lasting = renewal_s, np.zeros((*shape, 2))

    def decay(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        self.lasting *= math.exp(-dt / self.renewal_s) if self.renewal_s else 0.0

    def weigh(
        self, innovation_m: Floats, variance_m2: Floats, errors: RangeErrors, pair: Ints, used: Bools
    ) -> WeighedInnovation:
        """Return the `mixture_update` by what is known of the pairs (sides,) in a measurement.

        Filters (...) that have `used` it learn from it.
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
    """Changes of antenna delays since a calibration, as states of a filter: metres that light travels in them.

    A range depends on half of two of them. They begin at zero with `covariance_m2` (tags, tags) and are random walks of
    `walk_m` in a root of a second. `delays_ns` and `std_ns` (tags,) are those of the calibration; what that does not
    determine stays undetermined, because no range depends on it.
    """

    tags: tuple[int, ...] = ()
    covariance_m2: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    delays_ns: Floats = field(default_factory=lambda: np.zeros(0))
    std_ns: Floats = field(default_factory=lambda: np.zeros(0))
    walk_m: float = 0.0
    speed_of_light: float = 1.0

    @classmethod
    def of(cls, calibration: Calibration, tags: Sequence[int], *, walk_m: float = 0.005) -> DelayStates:
        """Return those of some tags.

        The covariance is that of the calibration. With the default walk the errors of filters are as large as they say
        where ranges of one tag or of two drift by 2 cm/K over 10 K in two minutes (`benchmarks/dependences.py`), and
        those of all others by 2.15 mm/K (DW1000 user manual, section 8.3.1). Raises `BadInputError` for a calibration
        without delays of single tags.
        """
        if calibration.pair_offsets:
            raise BadInputError("the calibration has constants of pairs instead of delays; fit it with `constants` tag")
        return cls(
            tags=tuple(tags),
            covariance_m2=(1e-9 * calibration.speed_of_light) ** 2 * calibration.covariance_ns2(tags),
            delays_ns=np.array([calibration.delays_ns.get(tag, math.nan) for tag in tags]),
            std_ns=np.array([calibration.delays_std_ns.get(tag, math.nan) for tag in tags]),
            walk_m=walk_m,
            speed_of_light=calibration.speed_of_light,
        )

    def slopes(self, ends: Ints, slopes: Floats) -> Floats:
        """Return derivatives of ranges by these states (n, tags), from those by the delays of both `ends` (n, 2)."""
        return np.asarray(np.einsum("ne,net->nt", slopes, ends[..., None] == np.array(self.tags, dtype=np.int64)))

    def estimates(
        self, change_m: Floats | float = 0.0, covariance_m2: Floats | None = None
    ) -> dict[int, tuple[float, float]]:
        """Return delays in ns and their standard deviations by tag, infinite where undetermined.

        Without arguments they are those of the calibration.
        """
        known = self.covariance_m2 if covariance_m2 is None else covariance_m2
        metres_a_ns = 1e-9 * self.speed_of_light
        std_ns = np.where(np.isinf(self.std_ns), np.inf, np.sqrt(np.diag(known)) / metres_a_ns)
        both = zip((self.delays_ns + change_m / metres_a_ns).tolist(), std_ns.tolist(), strict=True)
        return dict(zip(self.tags, both, strict=True))


FIXED_DELAYS: Final = DelayStates()
"""The states of a filter with fixed delays."""


@dataclass(frozen=True, kw_only=True)
class RangeUpdate:
    """Corrected ranges (n,) as measurements of any filter or smoother.

    A range `measured_m` is the distance of two antennas, plus `delay_slopes` (n, 2) times the changes of the delays of
    both `ends` (n, 2) in metres (`DelayStates`), plus an error: noise of `noise_m`, and what `errors` says.

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
        """Return ranges as measurements; raises what `Calibration.apply` raises, and `BadInputError` without a power
        where the calibration needs one."""
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
        """Return innovations (n,) and derivatives (n, 3) of the distances by the first antenna's place.

        Places are (n, 3) or (3,), of initiator and target, in metres; `changes_m` (n, 2) are those of their delays. The
        derivative by the second place is the negative one, that by the delays `delay_slopes`; that by a rotation vector
        of the first body, in its own axes, is arm x C' along, with its attitude C.
        """
        apart = np.atleast_2d(first_m - second_m)
        distance = np.maximum(np.linalg.norm(apart, axis=-1), 1e-6)
        expected = distance + np.sum(self.delay_slopes * changes_m, axis=-1)
        return self.measured_m - expected, apart / distance[:, None]

    def weigh(self, innovation_m: Floats, state_m2: Floats | float = 0.0) -> WeighedInnovation:
        """Return what innovations (n,) say, where the state contributes a variance of `state_m2` to them.

        With variance s^2 of an innovation, P h its covariance with the state, K = P h / s^2, and mean n and variance v
        of its noise: the state moves by K n, and its covariance grows by K (v - s^2) K'.
        """
        return mixture_update(innovation_m, self.noise_m**2 + state_m2, self.errors)

    def at(self, rows: Any) -> RangeUpdate:
        """Return some of the ranges."""
        names = ("measured_m", "noise_m", "ends", "delay_slopes")
        return RangeUpdate(errors=self.errors.at(rows), **{name: getattr(self, name)[rows] for name in names})

    @cached_property
    def likeliest(self) -> tuple[Floats, WeighedInnovation]:
        """The innovations (n,) with the largest likelihood, were the state exact, which reflections move up from zero;
        and what they say."""
        low, high = -4 * self.noise_m, self.errors.least_m + 6 * self.noise_m
        for _ in range(50):
            middle = (low + high) / 2
            below = self.weigh(middle).noise_m < 0
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return low, self.weigh(low)

    def whiten(self, innovation_m: Floats) -> tuple[Floats, Floats]:
        """Return residuals r (n,) of least squares and their derivatives (n,) by the innovation.

        Half of r^2 is the logarithm of the largest likelihood over that of the innovation. Its slope n / s^2 follows
        from the mean noise n (Tweedie's formula), and its curvature at the top from the variance of noise.
        """
        (likeliest_m, top), found = self.likeliest, self.weigh(innovation_m)
        away_m = innovation_m - likeliest_m
        residual = np.sign(away_m) * np.sqrt(2 * np.maximum(top.log_density - found.log_density, 0.0))
        steepest = np.sqrt(np.maximum(self.noise_m**2 - top.variance_m2, 0.0)) / self.noise_m**2
        near = np.abs(away_m) < 1e-3 * self.noise_m
        slope = found.noise_m / np.where(near, 1.0, residual * self.noise_m**2)
        return np.where(near, steepest * away_m, residual), np.where(near, steepest, slope)


def ends_of(ranges: Ranges) -> Ints:
    """Return the tags (n, 2) on whose delays ranges, and then their arrivals, depend."""
    ends, heard = ranges.ends, ranges.arrivals
    return ends if heard is None else np.concatenate([ends, ends[heard.exchange]])


def delay_slopes(ranges: Ranges) -> Floats:
    """Return derivatives (n, 2) of corrected ranges, and then of their arrivals, by changes of those tags' delays.

    A difference of arrival is corrected by the target's delay less those of the range (`Calibration.correct_arrivals`).
    """
    slopes, heard = -np.column_stack([ranges.weight_initiator, ranges.weight_target]), ranges.arrivals
    return slopes if heard is None else np.concatenate([slopes, -slopes[heard.exchange] - (0.0, 1.0)])
