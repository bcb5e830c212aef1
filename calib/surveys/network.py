"""Boards that stand still as a network of distances: unknown places, delays and curve, and rows of measurements.

A mean of raw ranges of a pair is distance - w_i d_i - w_j d_j + curve(power) + error, with delays d (docs/theory.md).
Its error is constant for a pair and an arrangement, so more ranges do not reduce it: it has a separate variance, which
is estimated (`calib.surveys.solution`). Known positions and delays are priors of the unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from calib.calibration.power_curves import ALPHA_DBM, DEGREE, basis
from calib.estimator.inverse import inverse_of
from calib.estimator.range_model import BOARD_DELAY_STD_NS, METRES_A_NS
from calib.estimator.rows import Terms, normal_terms
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown
from calib.surveys.knowledge import KnownPosition
from calib.surveys.recordings import PairMeans
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import KnownDistance

DIMENSIONS = {"line": 1, "plane": 2, "": 3}
"""The number of dimensions of an arrangement, by its known shape."""


DETOUR_MEAN_M, DETOUR_STD_M = 0.3, 0.25
"""Prior mean and standard deviation of the detour of a reflected path (published detours are 0.1 to 0.5 m). Half or
twice of either moves delays beside reflections by 0.28 standard errors (`python -m benchmarks.constants`)."""

CURVE_LENGTH_DB = 4.0
"""Length of the Gaussian process (Matern 5/2 over decibels) that is the prior of a curve.

From the three published curves of boards (`icra2023`, `icra2023-july`, `miluv` of `uwbsim`): at 13 powers from -95 to
-77 dBm, with errors of 5 mm, the likeliest lengths are 4, 6 and 4 dB, the mean standard deviations 0.11, 0.14 and 0.09
m, each known to a factor of 1.7. The shorter length has little disadvantage for a straight curve; with the longer one a
bend is taken for errors of pairs, and biases the common part of all delays.
"""


NARROWEST_DB = 3.0
"""Span of powers below which no curve is fitted."""


@dataclass(frozen=True, slots=True)
class CurvePrior:
    """Cubic splines `design` (n, m) at the powers of rows, and the information (m, m) on them for a spread of 1 m."""

    knots: Floats
    design: Floats
    precision: Floats

    @classmethod
    def at(cls, lifted: Floats) -> CurvePrior | None:
        """Return the prior of a curve at lifted powers (n,); None if powers are missing, or hardly vary."""
        power = in_dbm(lifted)
        if not np.isfinite(power).all() or np.ptp(power) < NARROWEST_DB:
            return None
        low, high = float(power.min()), float(power.max())
        # Twelve segments are enough for splines to represent a process of this length over 25 dB; the prior, not their
        # number, makes them smooth.
        inner = 10 ** ((np.linspace(low, high, 13) - ALPHA_DBM) / 10)
        knots = np.concatenate([[inner[0]] * DEGREE, inner, [inner[-1]] * DEGREE])
        dense = np.linspace(low, high, 60)
        back = np.linalg.pinv(basis(10 ** ((dense - ALPHA_DBM) / 10), knots))
        # The process, given that it is zero at the reference power.
        both = np.append(dense, ALPHA_DBM)
        apart = math.sqrt(5.0) * np.abs(both[:, None] - both) / CURVE_LENGTH_DB
        likeness = (1 + apart + apart**2 / 3) * np.exp(-apart)
        process = likeness[:-1, :-1] - np.outer(likeness[:-1, -1], likeness[-1, :-1])
        precision = np.linalg.inv(back @ process @ back.T + 1e-4 * np.eye(len(back)))
        return cls(knots, basis(lifted, knots), np.asarray(precision, dtype=np.float64))


def in_dbm(lifted: Floats) -> Floats:
    """Return the powers in dBm of lifted ones, NaN if there is none."""
    return np.asarray(ALPHA_DBM + 10 * np.log10(np.where(lifted > 0, lifted, np.nan)))


@dataclass(frozen=True, slots=True)
class Boards:
    """The boards of an arrangement: its name, its number of dimensions, and their tags.

    `order` are tags in their stated order along a line, or nothing. If `freed`, the last dimension is the distance from
    the stated line or plane.
    """

    name: str
    dimensions: int
    tags: tuple[int, ...]
    order: tuple[int, ...] = ()
    freed: bool = False

    @property
    def shape(self) -> str:
        """The shape (`SHAPES`) with this number of dimensions."""
        return {dimensions: shape for shape, dimensions in DIMENSIONS.items()}[self.dimensions]


@dataclass(frozen=True, slots=True)
class Case:
    """A hypothesis on a network's errors: which means are reflected (n,), the spread of pairs and the spread of the
    curve, m.
    """

    marks: Bools
    pair_m: float
    curve_m: float

    def scaled(self, pair: float, curve: float) -> Case:
        """Return the case with spreads multiplied by factors, given by logarithms."""
        return replace(self, pair_m=self.pair_m * math.exp(pair), curve_m=self.curve_m * math.exp(curve))


class Linear:
    """A network that is linearized about unknowns (p,) in a case: all errors are normal.

    `left` (n,) is measured minus predicted and `jacobian` (n, p) the derivative of the prediction, both divided by the
    standard deviation `std` (n,) of each row. `information` (p, p) is the information of the rows, `prior` (p, p) the
    precision of the priors, and `slope` (p,) the slope of the log likelihood of both.
    """

    def __init__(self, network: Network, x: Floats, case: Case) -> None:
        """Compute the derivatives at unknowns (p,)."""
        (left, jacobian), priors = network.linear(x, case.marks), network.priors(case.curve_m)
        precision, self.std = priors.precision(), network.std_m(case)
        self.left, self.jacobian = left / self.std, jacobian / self.std[:, None]
        self.information: Floats = self.jacobian.T @ self.jacobian
        self.prior: Floats = precision.toarray() if sparse.issparse(precision) else precision
        self.slope: Floats = self.jacobian.T @ self.left + priors.pull(x)
        self._prior_value = -2 * priors.value(x)
        self._free, self._guessed = network.layout.free(), network.guessed

    @property
    def known(self) -> Floats:
        """The information (p, p) of the rows and of known facts, without guesses."""
        found, guessed = self.information + self.prior, (self._guessed, self._guessed)
        found[guessed] -= self.prior[guessed]
        return found

    @cached_property
    def covariance(self) -> Floats:
        """The covariance (p, p) of the free unknowns by rows and prior, zero elsewhere."""
        return np.asarray(inverse_of(self.information + self.prior, self._free))

    @cached_property
    def step(self) -> Floats:
        """The step (p,) to the likeliest unknowns."""
        return np.asarray(self.covariance @ self.slope)

    def deviance(self) -> float:
        """Return -2 log likelihood of the rows, integrated over the unknowns (Laplace's approximation)."""
        own = np.ix_(self._free, self._free)
        value = float(self.left @ self.left) + self._prior_value - float(self.slope @ self.step)
        value += 2 * float(np.log(self.std).sum()) + float(np.linalg.slogdet((self.information + self.prior)[own])[1])
        return value - float(np.linalg.slogdet(self.prior[own])[1])


@dataclass(frozen=True)
class Lengths:
    """Rows of measured lengths, in a `case` (`Network.linear`)."""

    network: Network
    case: Case

    def terms(self, x: Floats) -> Iterator[Terms]:
        """Yield all rows as one block."""
        left, jacobian = self.network.linear(x, self.case.marks)
        yield normal_terms(left, self.network.std_m(self.case), jacobian.T, np.arange(len(x))[None])


@dataclass(frozen=True, kw_only=True)
class Network:
    """Means of pairs, their boards, and other known facts.

    `pair_m` is the standard deviation of constant errors of pairs, None to estimate it. The unknowns are three
    coordinates of each point (a tag in an arrangement), delays in ns, and coefficients of the curve over power.
    Coordinates beyond an arrangement's dimensions are zero; the unknowns `held` (indices) are fixed, such as those that
    define a frame.
    """

    means: PairMeans
    arrangements: tuple[Boards, ...]
    tags: tuple[int, ...]
    distances: tuple[KnownDistance, ...] = ()
    positions: tuple[KnownPosition, ...] = ()
    fixed_ns: dict[int, float]
    curve: CurvePrior | None = None
    pair_m: float | None = None
    held: tuple[int, ...] = ()

    @cached_property
    def points(self) -> dict[tuple[int, int], int]:
        """The number of every point by arrangement and tag, in order."""
        every = [(k, tag) for k, boards in enumerate(self.arrangements) for tag in boards.tags]
        return {point: number for number, point in enumerate(every)}

    @cached_property
    def owner(self) -> Ints:
        """The arrangement of every point (points,)."""
        return np.array([k for k, _ in self.points])

    def arrangements_with(self, known: KnownDistance | KnownPosition) -> list[int]:
        """Return the arrangements in which a distance or a position is valid."""
        who = {known.first, known.second} if isinstance(known, KnownDistance) else {known.tag}
        return [
            k
            for k, boards in enumerate(self.arrangements)
            if known.arrangement in ("", boards.name) and who <= set(boards.tags)
        ]

    @cached_property
    def tapes(self) -> tuple[Ints, Floats]:
        """The two points of each known distance (k, 2); distance, standard deviation, number of the statement (k, 3).

        A distance that is valid in several arrangements is one reading, not several.
        """
        ends, rows = [], []
        for number, one in enumerate(self.distances):
            where = self.arrangements_with(one)
            ends += [(self.points[k, one.first], self.points[k, one.second]) for k in where]
            rows += [(one.distance_m, one.sigma_m * math.sqrt(len(where)), number)] * len(where)
        return np.array(ends, dtype=np.int64).reshape(-1, 2), np.array(rows).reshape(-1, 3)

    @cached_property
    def known_places(self) -> dict[int, tuple[Floats, float]]:
        """Known positions (3,) and their standard deviations by point; on a plane x and y count."""
        found = {}
        for one in self.positions:
            for k in (where := self.arrangements_with(one)):
                place = np.where(np.arange(3) < self.arrangements[k].dimensions, one.position_m, 0.0)
                found[self.points[k, one.tag]] = (place, one.sigma_m * math.sqrt(len(where)))
        return found

    @cached_property
    def layout(self) -> Layout:
        """The unknowns and their priors, with a curve of 1 m."""
        boards, axis = [self.arrangements[k] for k in self.owner.tolist()], np.arange(3)
        known = axis >= np.array([[one.dimensions] for one in boards])
        beside = axis == np.array([[one.dimensions - 1 if one.freed else -1] for one in boards])
        # The prior of an unknown coordinate is 30 m; of a distance from a wrong line or plane it is decimetres, because
        # an error of a metre would be noticed.
        std, centre = np.where(beside, 0.5, 30.0), np.zeros((len(boards), 3))
        for point, (place, _) in self.known_places.items():
            centre[self.owner == self.owner[point]] = place
        for point, (place, sigma) in self.known_places.items():
            centre[point], std[point] = place, sigma
        delays = np.array([self.fixed_ns.get(tag, 0.0) for tag in self.tags])
        # The prior of a known delay is 0.03 mm, far below the error of any result.
        certain = np.array([1e-4 if tag in self.fixed_ns else BOARD_DELAY_STD_NS for tag in self.tags])
        curves = [] if self.curve is None else [self.curve.precision]
        blocks = [
            ("place", centre.ravel(), np.diag(std.ravel() ** -2)),
            ("delay", delays, np.diag(certain**-2)),
            *(("curve", np.zeros(len(precision)), precision) for precision in curves),
        ]
        ends = np.cumsum([len(start) for _, start, _ in blocks])
        held = np.isin(np.arange(ends[-1]), [*np.flatnonzero(known), *self.held])
        return Layout(
            tuple(
                Unknown(
                    kind=kind,
                    names=("",) * len(start),
                    start=start,
                    known=own,
                    priors=(Prior(weight=1.0, structure=structure, centre=start, rows=len(start)),),
                )
                for (kind, start, structure), own in zip(blocks, np.split(held, ends[:-1]), strict=True)
            )
        )

    @cached_property
    def guessed(self) -> Ints:
        """The unknowns whose prior is only a guess: places and delays that were not stated."""
        places = [3 * k + axis for k in self.points.values() if k not in self.known_places for axis in range(3)]
        delays = [k for k, tag in enumerate(self.tags, start=3 * len(self.points)) if tag not in self.fixed_ns]
        return np.array([*places, *delays], dtype=np.int64)

    def members(self, arrangement: int) -> Ints:
        """Return the points (rows of `points`) of an arrangement, in the order of its tags."""
        return np.flatnonzero(self.owner == arrangement)

    def positions_m(self, x: Floats) -> Floats:
        """Return the points (points, 3) of a vector of unknowns."""
        return x[self.layout.where["place"]].reshape(-1, 3).copy()

    def with_positions(self, x: Floats, positions: Floats, members: Ints | slice = slice(None)) -> Floats:
        """Return a vector of unknowns with other points (points, 3), or other points of some `members`, if
        they are free.
        """
        place, found, free = self.positions_m(x), x.copy(), self.layout.free()
        place[members] = positions
        mine = free[free < place.size]
        found[mine] = place.ravel()[mine]
        return found

    @cached_property
    def ends(self) -> Ints:
        """The two points of each measured length (n, 2): means, then known distances."""
        rows = zip(self.means.arrangement.tolist(), self.means.ends.tolist(), strict=True)
        of_means = [(self.points[k, i], self.points[k, j]) for k, (i, j) in rows]
        return np.concatenate([np.array(of_means).reshape(-1, 2), self.tapes[0]])

    @cached_property
    def _of_delays_and_curve(self) -> Floats:
        """The derivatives of all rows (n, p) by delays and curve, which do not depend on places."""
        found = np.zeros((len(self.ends), self.layout.size))
        number = np.searchsorted(self.tags, self.means.ends) + self.layout.where["delay"].start
        rows = np.arange(len(self.means.range_m))
        found[rows[:, None], number] = -METRES_A_NS * self.means.weights
        if self.curve is not None:
            found[: len(rows), self.layout.where["curve"]] = self.curve.design
        return found

    def linear(self, x: Floats, marks: Bools | float = 0.0) -> tuple[Floats, Floats]:
        """Return the residuals (n,) and derivatives (n, p) of rows: means, known distances.

        A detour is subtracted from means with `marks` (n,).
        """
        place, found = self.positions_m(x), self._of_delays_and_curve.copy()
        apart = place[self.ends[:, 0]] - place[self.ends[:, 1]]
        length = np.linalg.norm(apart, axis=1)
        measured = np.concatenate([self.means.range_m - DETOUR_MEAN_M * marks, self.tapes[1][:, 0]])
        left = measured - length - found @ x
        # Boards at the same place have no direction: any direction separates them.
        unit = np.where(length[:, None] > 1e-9, apart / np.maximum(length, 1e-9)[:, None], [1.0, 0.0, 0.0])
        columns = 3 * self.ends[:, :, None] + np.arange(3)
        np.put_along_axis(found, columns.reshape(len(found), -1), np.hstack([unit, -unit]), axis=1)
        return left, found

    def std_m(self, case: Case) -> Floats:
        """Return the standard deviation of each row, with the constant errors of pairs."""
        means = np.sqrt(self.means.std_m**2 + case.pair_m**2 + DETOUR_STD_M**2 * case.marks)
        return np.concatenate([means, self.tapes[1][:, 1]])

    @cached_property
    def _priors(self) -> Priors:
        return Priors(self.layout)

    def priors(self, curve_m: float) -> Priors:
        """Return the priors of the unknowns, with the spread of the curve."""
        found = copy(self._priors)
        found.weights = [1.0, 1.0, curve_m**-2][: len(self.layout.blocks)]
        return found

    def alone(self, arrangement: int) -> Network:
        """Return the network of the means of one arrangement, with only its places as unknowns."""
        rows, unknowns = self.means.arrangement == arrangement, np.arange(self.layout.size)
        curve = None if self.curve is None else replace(self.curve, design=self.curve.design[rows])
        own = np.isin(unknowns // 3, self.members(arrangement)) & np.isin(unknowns, self.layout.free())
        return replace(self, means=self.means[rows], curve=curve, held=tuple(unknowns[~own].tolist()))
