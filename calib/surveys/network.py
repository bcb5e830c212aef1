"""Boards that stand still as a network of distances: unknown places, delays and curve, and rows of what was measured.

A mean of raw ranges of a pair is distance - w_i d_i - w_j d_j + curve(power) + error, with delays d (docs/theory.md).
Its error is constant for a pair and an arrangement, so more ranges do not shrink it: it has a variance of its own,
which is estimated (`calib.surveys.solution`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, DEGREE, basis
from calib.estimator.inverse import inverse_of
from calib.estimator.range_model import METRES_A_NS
from calib.estimator.rows import Terms, normal_terms
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown
from calib.surveys.recordings import PairMeans
from uwblink.arrays import Bools, Floats, Ints

DIMENSIONS = {"line": 1, "plane": 2, "": 3}
"""In how many dimensions boards may stand, by what is known of an arrangement."""

PLACE_STD_M = 30.0
"""Standard deviation of a coordinate about those that are known, before any data: it holds what no range determines."""

BESIDE_STD_M = 0.5
"""The same of how far boards stand beside a line, or a plane, that is none."""

DETOUR_M, DETOUR_STD_M = 0.3, 0.25
"""How much longer a reflected way is, before any data: two in three detours within these of each other."""

CURVE_LENGTH_DB = 4.0
"""Length of the Gaussian process (Matern 5/2 over decibels) that a curve is before any data.

From the three published curves of boards (`icra2023`, `icra2023-july`, `miluv` of `uwbsim`): at 13 powers from -95 to
-77 dBm, with errors of 5 mm, the likeliest lengths are 4, 6 and 4 dB, the mean standard deviations 0.11, 0.14 and
0.09 m, each known to a factor of 1.7. The shorter length costs little where a curve is straight; the longer one takes a
bend for an error of pairs, and what all delays share for what it is not.
"""

CURVE_SEGMENTS = 12
"""Enough that splines follow a process of this length over 25 dB; the prior, not their number, makes them smooth."""

NARROWEST_DB = 3.0
"""Span of powers below which there is no curve to speak of."""

DELAY_STD_NS = 2.0
"""How far a delay may be from what was configured: published boards differ by 0.6 ns. Surveys need it: without known
distances a scale of the places can pass for a delay."""


@dataclass(frozen=True, slots=True)
class CurvePrior:
    """Cubic splines `design` (n, m) at the powers of rows, and the information (m, m) on them for a spread of 1 m."""

    knots: Floats
    design: Floats
    precision: Floats

    @classmethod
    def at(cls, lifted: Floats) -> CurvePrior | None:
        """Return that of a curve at lifted powers (n,); None where powers lack, or hardly vary."""
        if not len(lifted) or not np.isfinite(lifted).all() or not (lifted > 0).all():
            return None
        power = in_dbm(lifted)
        low, high = float(power.min()), float(power.max())
        if high - low < NARROWEST_DB:
            return None
        inner = 10 ** ((np.linspace(low, high, CURVE_SEGMENTS + 1) - ALPHA_DBM) / 10)
        knots = np.concatenate([[inner[0]] * DEGREE, inner, [inner[-1]] * DEGREE])
        dense = np.linspace(low, high, 60)
        back = np.linalg.pinv(basis(10 ** ((dense - ALPHA_DBM) / 10), knots))
        # The process, given that it is zero at the reference power.
        both = np.append(dense, ALPHA_DBM)
        apart = math.sqrt(5.0) * np.abs(both[:, None] - both) / CURVE_LENGTH_DB
        likeness = (1 + apart + apart**2 / 3) * np.exp(-apart)
        process = likeness[:-1, :-1] - np.outer(likeness[:-1, -1], likeness[-1, :-1])
        covariance = back @ process @ back.T
        precision: Floats = np.asarray(np.linalg.inv(covariance + 1e-4 * np.eye(len(covariance))), dtype=np.float64)
        return cls(knots, basis(lifted, knots), precision)


def in_dbm(lifted: Floats) -> Floats:
    """Return the powers that lifted ones stand for."""
    return np.asarray(ALPHA_DBM + 10 * np.log10(lifted))


@dataclass(frozen=True, slots=True)
class Boards:
    """The boards of an arrangement: its name, in how many dimensions they may stand, and their tags.

    `order` are tags as they are said to stand along a line, or nothing. Where `freed`, the last dimension is how far
    they stand beside the line or plane that they are said to be on.
    """

    name: str
    dimensions: int
    tags: tuple[int, ...]
    order: tuple[int, ...] = ()
    freed: bool = False


def numbered(arrangements: Sequence[Boards]) -> dict[tuple[int, int], int]:
    """Return the number of every point by arrangement and tag, in order."""
    points = [(k, tag) for k, boards in enumerate(arrangements) for tag in boards.tags]
    return {point: n for n, point in enumerate(points)}


@dataclass(frozen=True, kw_only=True)
class Known:
    """Distances and positions that are known.

    `ends` (k, 2) are points (`Network.points`), `distance_m` and `distance_std_m` (k,) go with them, and `statement`
    (k,) says which of `names` each comes from; `at` (l,) are points at `position_m` (l, 3), known to `position_std_m`
    (l,).
    """

    ends: Ints
    distance_m: Floats
    distance_std_m: Floats
    statement: Ints
    at: Ints
    position_m: Floats
    position_std_m: Floats
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Case:
    """What a network's errors may be: which means are reflected (n,), the spread of pairs and that of the curve, m."""

    marks: Bools
    pair_m: float
    curve_m: float

    def scaled(self, pair: float, curve: float) -> Case:
        """Return the case with other spreads, by the logarithms of their factors."""
        return replace(self, pair_m=self.pair_m * math.exp(pair), curve_m=self.curve_m * math.exp(curve))


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """A network about unknowns (p,) in a case: what is `left` of each row (n,) beside the detours of reflected means.

    `jacobian` (n, p) has the derivatives of what is predicted, `std` (n,) the standard deviations of rows. `prior`
    (p, p) is the precision of what is known of the unknowns beforehand, from whose centre they are `away` (p,). `free`
    are the indices of those that are sought.
    """

    left: Floats
    jacobian: Floats
    std: Floats
    prior: Floats
    away: Floats
    free: Ints

    def information(self) -> Floats:
        """Return the information (p, p) of the rows."""
        rows = self.jacobian / self.std[:, None]
        return rows.T @ rows

    def covariance(self) -> Floats:
        """Return the covariance (p, p) of the free unknowns by rows and prior, zero elsewhere."""
        return np.asarray(inverse_of(self.information() + self.prior, self.free))


@dataclass(frozen=True)
class Lengths:
    """Rows of lengths that were measured, in a `case` (`Network.linear`)."""

    network: Network
    case: Case

    def terms(self, x: Floats) -> Iterator[Terms]:
        """Yield all rows as one block."""
        left, jacobian = self.network.linear(x, self.case.marks)
        block = normal_terms(left, self.network.std_m(self.case), jacobian.T, np.arange(len(x))[None])
        yield replace(block, starts=np.array([0, len(left)]))


@dataclass(frozen=True, kw_only=True)
class Network:
    """Means of pairs, the boards they belong to, and what is known beside them.

    `pair_m` is the constant error of pairs, None to estimate it. The unknowns are three coordinates of each point,
    delays in ns, and coefficients of the curve over power; known are coordinates beyond an arrangement's dimensions,
    and delays of `fixed_ns`.
    """

    means: PairMeans
    arrangements: tuple[Boards, ...]
    tags: tuple[int, ...]
    known: Known
    fixed_ns: dict[int, float]
    curve: CurvePrior | None
    pair_m: float | None = None

    @cached_property
    def points(self) -> dict[tuple[int, int], int]:
        """The number of every point by arrangement and tag, in order."""
        return numbered(self.arrangements)

    @cached_property
    def owner(self) -> Ints:
        """The arrangement of every point (points,)."""
        return np.array([k for k, _ in self.points])

    @cached_property
    def layout(self) -> Layout:
        """The unknowns, and what is known of them beforehand, with a curve of 1 m."""
        fixed = np.array([tag in self.fixed_ns for tag in self.tags])
        delays = np.array([self.fixed_ns.get(tag, 0.0) for tag in self.tags])
        dimensions = np.array([boards.dimensions for boards in self.arrangements])[self.owner, None]
        freed = np.array([boards.freed for boards in self.arrangements])[self.owner, None]
        std = np.where(freed & (np.arange(3) == dimensions - 1), BESIDE_STD_M, PLACE_STD_M).ravel()
        centre = np.zeros((len(self.points), 3))
        for k in range(len(self.arrangements)):
            known = self.known.position_m[self.owner[self.known.at] == k]
            centre[self.owner == k] = known.mean(axis=0) if len(known) else 0.0
        precision = np.zeros((0, 0)) if self.curve is None else self.curve.precision
        size = len(precision)
        return Layout(
            (
                Unknown(
                    kind="place",
                    names=tuple(str(tag) for _, tag in self.points for _ in range(3)),
                    start=centre.ravel(),
                    known=(np.arange(3) >= dimensions).ravel(),
                    priors=(Prior(weight=1.0, structure=np.diag(std**-2), centre=centre.ravel(), rows=centre.size),),
                ),
                Unknown(
                    kind="delay",
                    names=tuple(map(str, self.tags)),
                    start=delays,
                    known=fixed,
                    priors=(Prior.of_deviation(DELAY_STD_NS, delays),),
                ),
                Unknown(
                    kind="curve",
                    names=("",) * size,
                    start=np.zeros(size),
                    priors=(Prior(weight=1.0, structure=precision, rows=size),),
                ),
            )
        )

    def seats(self, arrangement: int) -> Ints:
        """Return the points (rows of `points`) of an arrangement, in the order of its tags."""
        return np.flatnonzero(self.owner == arrangement)

    def free(self, only: int | None = None) -> Ints:
        """Return the indices of the free unknowns; of `only` one arrangement's places where that is given."""
        free = self.layout.free()
        return free if only is None else np.intersect1d(free, 3 * self.seats(only)[:, None] + np.arange(3))

    def rows_of(self, only: int | None = None) -> Bools:
        """Return which means (n,) belong to an arrangement; all of them for none."""
        return np.asarray(self.means.arrangement == (self.means.arrangement if only is None else only))

    def positions(self, x: Floats) -> Floats:
        """Return the points (points, 3) that a vector of unknowns stands for."""
        return x[self.layout.where["place"]].reshape(-1, 3).copy()

    def with_positions(self, x: Floats, positions: Floats) -> Floats:
        """Return a vector of unknowns with other points (points, 3)."""
        found = x.copy()
        mine = np.setdiff1d(self.free(), np.arange(3 * len(self.points), len(x)))
        found[mine] = positions.ravel()[mine]
        return found

    @cached_property
    def ends(self) -> Ints:
        """The points between which each length was measured (n, 2): means, then known distances."""
        rows = zip(self.means.arrangement.tolist(), self.means.ends.tolist(), strict=True)
        of_means = [(self.points[k, i], self.points[k, j]) for k, (i, j) in rows]
        return np.concatenate([np.array(of_means).reshape(-1, 2), self.known.ends])

    @cached_property
    def _of_delays_and_curve(self) -> Floats:
        """The derivatives of all rows (n, p) by delays and curve, which do not depend on places."""
        found = np.zeros((len(self.ends) + 3 * len(self.known.at), self.layout.size))
        number = np.searchsorted(self.tags, self.means.ends) + self.layout.where["delay"].start
        rows = np.arange(len(self.means))
        found[rows[:, None], number] = -METRES_A_NS * self.means.weights
        if self.curve is not None:
            found[: len(rows), self.layout.where["curve"]] = self.curve.design
        return found

    def linear(self, x: Floats, marks: Bools | float = 0.0) -> tuple[Floats, Floats]:
        """Return what is left of each row (n,), and derivatives (n, p): means, known distances, coordinates.

        Of means with `marks` (n,) a detour is taken off.
        """
        place, known, found = self.positions(x), self.known, self._of_delays_and_curve.copy()
        apart = place[self.ends[:, 0]] - place[self.ends[:, 1]]
        length = np.linalg.norm(apart, axis=1)
        measured = np.concatenate([self.means.range_m, known.distance_m, known.position_m.ravel()])
        told = np.concatenate([length, place[known.at].ravel()])
        left = measured - told - found @ x
        left[: len(self.means)] -= DETOUR_M * marks
        # Boards on top of each other have no direction: any will do to part them.
        unit = np.where(length[:, None] > 1e-9, apart / np.maximum(length, 1e-9)[:, None], [1.0, 0.0, 0.0])
        rows = np.arange(len(length))[:, None]
        for end, sign in ((0, 1.0), (1, -1.0)):
            found[rows, 3 * self.ends[:, [end]] + np.arange(3)] = sign * unit
        found[np.arange(len(length), len(left)), (3 * known.at[:, None] + np.arange(3)).ravel()] = 1.0
        return left, found

    def std_m(self, case: Case) -> Floats:
        """Return the standard deviation of each row, with the constant errors of pairs."""
        means = np.sqrt(self.means.std_m**2 + case.pair_m**2 + DETOUR_STD_M**2 * case.marks)
        return np.concatenate([means, self.known.distance_std_m, np.repeat(self.known.position_std_m, 3)])

    def priors(self, curve_m: float, only: int | None = None) -> Priors:
        """Return what is known of the unknowns beforehand, with the spread of the curve.

        All but `only` one arrangement's places are known if that is given.
        """
        layout = self.layout
        if only is not None:
            known = ~np.isin(np.arange(layout.size), self.free(only))
            layout = Layout(tuple(replace(one, known=known[layout.where[one.kind]]) for one in layout.blocks))
        return Priors(layout, [1.0, DELAY_STD_NS**-2, curve_m**-2])

    def at(self, x: Floats, case: Case, only: int | None = None) -> Linear:
        """Return the network about unknowns (p,) in a case; `only` one arrangement's places are free if given."""
        left, jacobian = self.linear(x, case.marks)
        return Linear(
            left=left,
            jacobian=jacobian,
            std=self.std_m(case),
            prior=np.asarray(self.priors(case.curve_m).precision()),
            away=x - self.layout.start(),
            free=self.free(only),
        )
