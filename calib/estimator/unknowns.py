"""The unknowns of a fit: blocks of numbers of one kind, their priors, and their indices in the vector of all unknowns.

A block is a named vector with a start and Gaussian priors. The weight of a prior may be estimated with the unknowns, by
the fixed point of Fellner and Schall as Wood and Fasiolo (Biometrics 2017) generalise it: the roughness of a curve, the
variance of offsets between pairs and between sessions, and the spread of error models between pairs are estimated in
this one way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy import sparse
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from calib.errors import BadInputError
from calib.estimator.inverse import MOST_DENSE, Inverse, Matrix, trace_of_product, variances
from uwblink.arrays import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """A Gaussian prior with the precision `weight` times `structure` (k, k), about `centre` (k,).

    `structure` None is the identity; for many unknowns it is sparse, with `rows` independent rows. With `bounds` the
    weight is estimated between them, starting at `weight`, from data with `freedom` degrees of freedom. `unit` is the
    kind of the logarithms (k,) of units: standard deviations are proportional to a power of the units, estimated with
    the weight between 0 (all are equal) and 1. In layouts without this kind they are equal. With `members` (k, m) a
    logarithm is the mean of those of m units by these weights.
    """

    weight: float
    structure: Floats | sparse.csc_matrix | None = None
    centre: Floats | float = 0.0
    bounds: tuple[float, float] | None = None
    rows: int | None = None
    freedom: float = math.inf
    unit: str | None = None
    members: Floats | None = None

    @classmethod
    def of_deviation(cls, deviation: float, centre: Floats | float = 0.0) -> Prior:
        """Return independent priors with one standard deviation."""
        return cls(weight=deviation**-2, centre=centre)

    @classmethod
    def of_spread(
        cls, start: float, least: float, most: float, freedom: float = math.inf, unit: str | None = None
    ) -> Prior:
        """Return independent priors about zero, whose standard deviation is estimated between `least` and `most`."""
        return cls(weight=start**-2, bounds=(most**-2, least**-2), freedom=freedom, unit=unit)

    def matrix(self, size: int) -> Matrix:
        """Return the structure as a matrix, the identity (size, size) where it is None."""
        return _diagonal(np.ones(size)) if self.structure is None else self.structure

    def rank(self, matrix: Matrix) -> int:
        """Return the rank of the structure as a `matrix`."""
        if self.rows is not None or self.structure is None or not isinstance(matrix, np.ndarray):
            return int(matrix.shape[0]) if self.rows is None else self.rows
        return int(np.linalg.matrix_rank(matrix, hermitian=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Unknown:
    """A block of unknowns of one kind: `names` (k,) of the elements, `start` (k,) of the search.

    `known` (k,) marks elements that keep their start; `logarithm` is True for logarithms of lengths and log odds.
    """

    kind: str
    names: tuple[str, ...]
    start: Floats
    priors: tuple[Prior, ...] = ()
    known: Bools | None = None
    logarithm: bool = False

    def __post_init__(self) -> None:
        """Raise `BadInputError` where start and names differ in length."""
        if len(self.start) != len(self.names):
            raise BadInputError(f"{self.kind}: {len(self.start)} values for {len(self.names)} names")


@dataclass(frozen=True)
class Layout:
    """Blocks of unknowns side by side in one vector of `size` numbers."""

    blocks: tuple[Unknown, ...]
    where: dict[str, slice] = field(init=False)

    def __post_init__(self) -> None:
        """Compute the indices of the blocks; raises `BadInputError` if two have one kind."""
        kinds = [block.kind for block in self.blocks]
        twice = [kind for kind in kinds if kinds.count(kind) > 1]
        if twice:
            raise BadInputError(f"two blocks of unknowns are called {twice[0]!r}")
        ends = np.cumsum([0, *(len(block.start) for block in self.blocks)]).tolist()
        object.__setattr__(self, "where", dict(zip(kinds, map(slice, ends[:-1], ends[1:]), strict=True)))

    @property
    def size(self) -> int:
        """Return the number of unknowns."""
        return sum(len(block.start) for block in self.blocks)

    def start(self, given: Mapping[str, Floats] | None = None) -> Floats:
        """Return the start of a search (p,): the `given` values of some kinds, and the start of the other blocks."""
        values = [(given or {}).get(block.kind, block.start) for block in self.blocks]
        return np.concatenate([np.asarray(own, dtype=np.float64).ravel() for own in values])

    def free(self) -> Ints:
        """Return the indices of the unknowns that are not known already."""
        known = [np.zeros(len(b.start), bool) if b.known is None else b.known for b in self.blocks]
        return np.flatnonzero(~np.concatenate(known))

    def logarithms(self) -> Bools:
        """Return which unknowns (p,) are logarithms."""
        return np.repeat([b.logarithm for b in self.blocks], [len(b.start) for b in self.blocks])

    def indices(self, kinds: Sequence[str]) -> Ints:
        """Return the indices of some kinds, in the order given; kinds that are not in the layout are skipped."""
        found = [np.arange(self.where[kind].start, self.where[kind].stop) for kind in kinds if kind in self.where]
        return np.concatenate([np.zeros(0, dtype=np.int64), *found])


class Priors:
    """The priors of a layout with their present weights, and their structures as matrices."""

    def __init__(self, layout: Layout, weights: Sequence[float] | None = None) -> None:
        """Store the priors with their own weights, or with given ones in the order of blocks and priors."""
        self.layout = layout
        self.keys = [(block.kind, k) for block in layout.blocks for k in range(len(block.priors))]
        self.all = [(layout.where[block.kind], prior) for block in layout.blocks for prior in block.priors]
        self.weights = [prior.weight for _, prior in self.all] if weights is None else list(weights)
        # Of units, by prior: the first value is the middle of the possible ones.
        self.powers = np.full(len(self.all), 0.5)
        self.structures = [prior.matrix(where.stop - where.start) for where, prior in self.all]
        self.ranks = [prior.rank(matrix) for (_, prior), matrix in zip(self.all, self.structures, strict=True)]
        entries = [sparse.coo_matrix(matrix) for matrix in self.structures]
        starts = np.repeat([where.start for where, _ in self.all], [one.nnz for one in entries]).astype(np.int64)
        self._which = np.repeat(np.arange(len(entries)), [one.nnz for one in entries])
        self._data, row, column = (
            np.concatenate([np.zeros(0), *(getattr(one, name) for one in entries)]) for name in ("data", "row", "col")
        )
        self._place = (starts + row.astype(np.int64), starts + column.astype(np.int64))

    def scale_by_units(self, x: Floats) -> None:
        """Set the structures of priors with units to the units at unknowns (p,), to their present powers."""
        for k, (_, prior) in enumerate(self.all):
            if (logarithm := self._logarithm_of_unit(prior, x)) is not None:
                own = np.exp(-2 * self.powers[k] * logarithm)
                self.structures[k], self._data[self._which == k] = _diagonal(own), own

    def _logarithm_of_unit(self, prior: Prior, x: Floats) -> Floats | None:
        """Return the logarithms of a prior's units (k,) minus their mean, None without a unit in the layout."""
        if prior.unit not in self.layout.where:
            return None
        own = x[self.layout.where[prior.unit]]
        own = own if prior.members is None else prior.members @ own
        return np.asarray(own - own.mean())

    def by_key(self) -> dict[tuple[str, int], float]:
        """Return the present weights by kind and number of the prior."""
        return dict(zip(self.keys, self.weights, strict=True))

    def recall(self, known: Mapping[tuple[str, int], float]) -> None:
        """Use the weights of an earlier search for the priors that both have."""
        self.weights = [known.get(key, weight) for key, weight in self.by_key().items()]

    def precision(self) -> Matrix:
        """Return the precision of all priors (p, p); a sparse one for many unknowns."""
        size = self.layout.size
        data = np.array(self.weights)[self._which] * self._data
        if size > MOST_DENSE:
            return sparse.csc_matrix((data, self._place), shape=(size, size))
        found = np.zeros((size, size))
        np.add.at(found, self._place, data)
        return found

    def value(self, x: Floats) -> float:
        """Return the log density of the priors at unknowns (p,), minus its constant."""
        return -0.5 * sum(weight * float(away @ pulled) for weight, _, away, pulled in self._distances(x))

    def pull(self, x: Floats) -> Floats:
        """Return the slope of the log density of the priors at unknowns (p,)."""
        found = np.zeros(len(x))
        for weight, where, _, pulled in self._distances(x):
            found[where] -= weight * pulled
        return found

    def update(self, x: Floats, covariance: Inverse) -> float:
        """Estimate the weights with bounds from unknowns (p,) and their covariance (p, p).

        Returns the expected gain of the log likelihood of the weights, integrated over the unknowns.
        """
        gain = 0.0
        for k, (where, prior) in enumerate(self.all):
            if prior.bounds is None:
                continue
            away = x[where] - prior.centre
            if (logarithm := self._logarithm_of_unit(prior, x)) is not None:
                # The expected likelihood is largest where the scaled squares have the smallest sum.
                square = np.log(away**2 + variances(covariance, where))
                total = partial(_log_sum_of_scaled, square, logarithm)
                self.powers[k] = minimize_scalar(total, bounds=(0, 1), method="bounded").x
                self.scale_by_units(x)
            weight = self.weights[k]
            left = self.ranks[k] - weight * trace_of_product(covariance, self.structures[k], where)
            size = max(float(away @ (self.structures[k] @ away)), 1e-300)
            self.weights[k] = float(np.clip(max(left, 1e-2) / size, *prior.bounds))
            gain += 0.5 * (left - weight * size) * math.log(self.weights[k] / weight)
        return gain

    def deviation(self, kind: str) -> float:
        """Return the present standard deviation of the last prior of a kind."""
        return float({own: weight for (own, _), weight in self.by_key().items()}[kind] ** -0.5)

    def _distances(self, x: Floats) -> list[tuple[float, slice, Floats, Floats]]:
        """Return weight, block, distance from the centre (k,), and structure times distance (k,) of each prior."""
        away = [x[where] - prior.centre for where, prior in self.all]
        pulled = [np.asarray(matrix @ own) for matrix, own in zip(self.structures, away, strict=True)]
        return list(zip(self.weights, [where for where, _ in self.all], away, pulled, strict=True))


def _diagonal(values: Floats) -> Matrix:
    """Return a diagonal matrix (k, k), a sparse one for many values (k,)."""
    return np.diag(values) if len(values) <= MOST_DENSE else sparse.diags(values, format="csc")


def _log_sum_of_scaled(square: Floats, logarithm: Floats, power: float) -> float:
    """Return the logarithm of the sum of squares, given as logarithms (k,), over units (k,) to a power."""
    return float(logsumexp(square - 2 * power * logarithm))
