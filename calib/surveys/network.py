"""Boards that stand still as a network of distances: unknowns in columns, what was measured in rows, and derivatives.

A mean of raw ranges of a pair is distance - w_i b_i - w_j b_j + curve(power) + error, with b = c d the delays in metres
(docs/theory.md). Its error is constant for a pair and an arrangement, so more ranges do not shrink it: it has a
variance of its own, which is estimated (`calib.surveys.adjustment`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from calib.surveys.orders import agrees, along
from calib.surveys.pair_means import PairMeans
from calib.surveys.power import PowerModel
from uwblink.arrays import Bools, Floats, Ints

DIMENSIONS: Final = {"line": 1, "plane": 2, "": 3}
GUESS_M: Final = 0.45
"""What a delay is without any data, as a standard deviation: 1.5 ns."""

FAR_M: Final = 1e3
DETOUR_M: Final = 0.3
DETOUR_STD_M: Final = 0.25
"""How much longer a reflected way is, before any data: two in three detours within these."""


@dataclass(frozen=True, slots=True)
class Place:
    """An arrangement of boards: its name, in how many dimensions they may stand, and who they are.

    `beside_m` is how far they stand out into the last of these dimensions, as a standard deviation. `order` are tags as
    they are said to stand along a line, or nothing.
    """

    name: str
    dimensions: int
    tags: tuple[int, ...]
    beside_m: float = FAR_M
    order: tuple[int, ...] = ()

    @property
    def ordered_rows(self) -> list[int]:
        """The numbers among `tags` of those whose order is said, in that order."""
        return [self.tags.index(tag) for tag in self.order]


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Distances and coordinates that are known, as columns.

    `ends` (k, 2) are points (rows of `Network.points`), `distance_m` and `distance_std_m` (k,) go with them and
    `distance_of` says from which statement each comes; `at` (l,) are points at `position_m` (l, 3), known to
    `position_std_m` (l,).
    """

    ends: Ints
    distance_m: Floats
    distance_std_m: Floats
    distance_of: Ints
    at: Ints
    position_m: Floats
    position_std_m: Floats

    @classmethod
    def nothing(cls) -> Known:
        """Return no distance and no position."""
        none, ids = np.zeros(0), np.zeros(0, dtype=np.int64)
        return cls(
            ends=ids.reshape(0, 2), distance_m=none, distance_std_m=none, distance_of=ids, at=ids,
            position_m=none.reshape(0, 3), position_std_m=none,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Network:
    """Means of pairs, where they belong, and what is known beside them.

    The unknowns are coordinates, then delays in metres, then coefficients of the curve over power. `reflected` (n,) are
    means that a detour lengthens, by what is known of detours beforehand.
    """

    means: PairMeans
    places: tuple[Place, ...]
    tags: tuple[int, ...]
    known: Known
    fixed_m: dict[int, float]
    power: PowerModel | None
    reflected: Bools

    @cached_property
    def points(self) -> list[tuple[int, int]]:
        """Arrangement and tag of every point."""
        return [(k, tag) for k, place in enumerate(self.places) for tag in place.tags]

    @cached_property
    def point_of(self) -> dict[tuple[int, int], int]:
        """The number of a point by arrangement and tag."""
        return {point: k for k, point in enumerate(self.points)}

    @cached_property
    def columns(self) -> Ints:
        """The column of each coordinate (points, 3), -1 where it is not free."""
        free = np.array([[axis < self.places[k].dimensions for axis in range(3)] for k, _ in self.points])
        return np.where(free, np.cumsum(free.ravel()).reshape(free.shape) - 1, -1)

    @cached_property
    def coordinates(self) -> int:
        """How many coordinates are unknown."""
        return int(self.columns.max()) + 1

    @cached_property
    def delay_columns(self) -> Ints:
        """The columns of the delays (tags,)."""
        return self.coordinates + np.arange(len(self.tags))

    @cached_property
    def curve_columns(self) -> Ints:
        """The columns of the curve's coefficients."""
        size = 0 if self.power is None else self.power.size
        return self.coordinates + len(self.tags) + np.arange(size)

    @cached_property
    def size(self) -> int:
        """How many unknowns there are."""
        return self.coordinates + len(self.tags) + len(self.curve_columns)

    @cached_property
    def ends(self) -> Ints:
        """The points between which each mean was measured (n, 2)."""
        m = self.means
        rows = zip(m.arrangement.tolist(), m.first.tolist(), m.second.tolist(), strict=True)
        return np.array([(self.point_of[k, i], self.point_of[k, j]) for k, i, j in rows]).reshape(-1, 2)

    @cached_property
    def linear(self) -> Floats:
        """The part of the derivatives (n, unknowns) that does not depend on where boards are: delays and curve."""
        found = np.zeros((len(self.means), self.size))
        number = dict(zip(self.tags, self.delay_columns.tolist(), strict=True))
        rows = np.arange(len(self.means))
        found[rows, [number[t] for t in self.means.first.tolist()]] -= self.means.weight_first
        found[rows, [number[t] for t in self.means.second.tolist()]] -= self.means.weight_second
        if self.power is not None:
            found[:, self.curve_columns] = self.power.design
        return found

    def positions(self, x: Floats) -> Floats:
        """Return the points (points, 3) that a vector of unknowns stands for."""
        return np.where(self.columns >= 0, x[np.maximum(self.columns, 0)], 0.0)

    def with_positions(self, x: Floats, positions: Floats) -> Floats:
        """Return a vector of unknowns with other points (points, 3)."""
        found = x.copy()
        free = self.columns >= 0
        found[self.columns[free]] = positions[free]
        return found

    def residuals(self, x: Floats) -> Floats:
        """Return what was measured less what the unknowns say: means, known distances, known coordinates."""
        place = self.positions(x)
        k = self.known
        means = self.means.range_m - _lengths(place, self.ends) - self.linear @ x - DETOUR_M * self.reflected
        return np.concatenate(
            [means, k.distance_m - _lengths(place, k.ends), (k.position_m - place[k.at])[self._position_free]]
        )

    def jacobian(self, x: Floats) -> Floats:
        """Return the derivatives of what the unknowns say, a row each of `residuals`."""
        place = self.positions(x)
        at = np.zeros((int(self._position_free.sum()), self.size))
        at[np.arange(len(at)), self.columns[self.known.at][self._position_free]] = 1.0
        return np.vstack(
            [self.linear + self._of_lengths(place, self.ends), self._of_lengths(place, self.known.ends), at]
        )

    def std_m(self, pair_std_m: float) -> Floats:
        """Return the standard deviation of each row, with that of a pair's constant error."""
        k = self.known
        each = np.repeat(k.position_std_m[:, None], 3, axis=1)[self._position_free]
        means = np.sqrt(self.means.std_m**2 + pair_std_m**2 + DETOUR_STD_M**2 * self.reflected)
        return np.concatenate([means, k.distance_std_m, each])

    def prior(self, curve_std_m: float) -> Floats:
        """Return what is known of the unknowns before any data (unknowns, unknowns), as information.

        That is hardly anything of delays and coordinates, for what the data leave free to be a number, and all of
        those that are fixed.
        """
        found = np.zeros((self.size, self.size))
        diagonal = np.full(self.size, FAR_M**-2)
        for (k, _), columns in zip(self.points, self.columns.tolist(), strict=True):
            diagonal[columns[self.places[k].dimensions - 1]] = self.places[k].beside_m ** -2
        fixed = [tag in self.fixed_m for tag in self.tags]
        diagonal[self.delay_columns] = np.where(fixed, 1e-5**-2, GUESS_M**-2)
        found[np.diag_indices(self.size)] = diagonal
        if self.power is not None:
            found[np.ix_(self.curve_columns, self.curve_columns)] = self.power.precision / curve_std_m**2
        return found

    def centre(self) -> Floats:
        """Return the unknowns (unknowns,) that the prior is about: zeros but for fixed delays."""
        found = np.zeros(self.size)
        found[self.delay_columns] = [self.fixed_m.get(tag, 0.0) for tag in self.tags]
        return found

    def motions(self, x: Floats, *, all_places: bool = False) -> Floats:
        """Return unit vectors (k, unknowns): rigid motions of arrangements, which change no distance.

        Of arrangements without known positions, or of all.
        """
        place = self.positions(x)
        held = {self.points[k][0] for k in self.known.at.tolist()}
        rows = [
            row for k in range(len(self.places)) if all_places or k not in held for row in self._motions_of(place, k)
        ]
        return np.array(rows).reshape(-1, self.size)

    def rows_of(self, arrangement: int) -> Bools:
        """Return which rows (n, and those of what is known) belong to an arrangement."""
        k = self.known
        owner = np.array([a for a, _ in self.points])
        each = np.repeat(owner[k.at][:, None], 3, axis=1)[self._position_free]
        return np.asarray(np.concatenate([self.means.arrangement, owner[k.ends[:, 0]], each]) == arrangement)

    def seats(self, arrangement: int) -> list[int]:
        """Return the points (rows of `points`) of an arrangement, in the order of its tags."""
        return [n for n, (k, _) in enumerate(self.points) if k == arrangement]

    def out_of_order(self, x: Floats) -> list[int]:
        """Return the arrangements in which boards do not stand in the order that is said."""
        said = [k for k, place in enumerate(self.places) if place.order]
        points = self.positions(x) if said else np.zeros((0, 3))
        return [k for k in said if not agrees(along(points[self.seats(k)][self.places[k].ordered_rows]))]

    def marked(self, reflected: Bools) -> Network:
        """Return the network with other means (n,) taken to be reflected."""
        return replace(self, reflected=reflected)

    @cached_property
    def _position_free(self) -> Bools:
        return (self.columns[self.known.at] >= 0).reshape(-1, 3)

    def _of_lengths(self, place: Floats, ends: Ints) -> Floats:
        found = np.zeros((len(ends), self.size))
        apart = place[ends[:, 0]] - place[ends[:, 1]]
        length = np.linalg.norm(apart, axis=1)
        # Boards on top of each other have no direction: any will do to part them.
        unit = np.where(length[:, None] > 1e-9, apart / np.maximum(length, 1e-9)[:, None], [1.0, 0.0, 0.0])
        for end, sign in ((0, 1.0), (1, -1.0)):
            columns = self.columns[ends[:, end]]
            row, axis = np.nonzero(columns >= 0)
            found[row, columns[row, axis]] += sign * unit[row, axis]
        return found

    def _motions_of(self, place: Floats, arrangement: int) -> list[Floats]:
        here = [k for k, (a, _) in enumerate(self.points) if a == arrangement]
        columns, middle = self.columns[here], place[here] - place[here].mean(axis=0)
        dimensions = self.places[arrangement].dimensions
        fields = [np.tile(np.eye(3)[axis], (len(here), 1)) for axis in range(dimensions)]
        turns = {1: (), 2: (2,), 3: (0, 1, 2)}[dimensions]
        fields += [np.cross(np.eye(3)[axis], middle) for axis in turns]
        rows = np.zeros((len(fields), self.size))
        for row, moving in zip(rows, fields, strict=True):
            row[columns[columns >= 0]] = moving[columns >= 0]
        _, size, basis = np.linalg.svd(rows, full_matrices=False)
        return list(basis[size > 1e-6 * size[0]])


def _lengths(place: Floats, ends: Ints) -> Floats:
    return np.asarray(np.linalg.norm(place[ends[:, 0]] - place[ends[:, 1]], axis=1))
