"""Ranges as rows: an error density for each range, whose parameters are sums of unknowns times known weights.

The residual of a range (measured minus predicted, with the unknown delays, curve and offsets), the logarithm of its
noise, the log odds that it is reflected and the logarithm of the detour are such sums. A further dependence of ranges
is one more `Part` of one of them: an unknown for each tag, pair, session, direction or degree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PPoly
from scipy.special import expit

from calib.estimator.inverse import Inverse, diagonal_of
from calib.estimator.losses import Weights
from calib.estimator.rows import ROWS_AT_ONCE, Movements, Squares, Terms
from calib.estimator.unknowns import Layout, Unknown
from calib.range_errors.densities import ErrorSlopes, error_slopes
from uwblink.arrays import Floats, Ints

RESIDUAL = "residual"
"""The parameter that delays, curves and offsets add to."""

OF_ERRORS = ("noise", "odds", "detour", "least", "outliers", "long")
"""The other parameters of an error's density; differences of arrival have "side" besides."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A share of one parameter of each range: the unknowns `columns` (n, k) of a `kind` times `values` (n, k).

    Columns count within the kind's block. Without `values`, these are 1. Ranges with the same key (`RangeModel.key`)
    must have the same columns; values may differ.
    """

    parameter: str
    kind: str
    columns: Ints
    values: Floats | None = None


def block_of(
    unknown: Unknown, columns: Ints, values: Floats | None = None, *, parameter: str = RESIDUAL
) -> tuple[Unknown, Part]:
    """Return a block of unknowns and its share of a parameter: `columns` and `values` are those of `Part`."""
    return unknown, Part(parameter=parameter, kind=unknown.kind, columns=columns, values=values)


class Geometry(Protocol):
    """Distances that depend on unknowns: on positions, or on trajectories."""

    def distances(self, x: Floats, rows: Ints) -> tuple[Floats, Floats]:
        """Return the distances (m,) of some ranges at unknowns (p,), metres, and their derivatives (m, k)."""
        ...

    def movements(self, rows: Ints, derivative: Floats, bend: Floats) -> Movements:
        """Return what some ranges depend on, from the derivatives (m, k) of their distances and bends (m,)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeInformation:
    """Information of rows (n,): `residual` (n,) is that of residuals if all other parameters are fitted, too.

    The rest is the sum of the outer squares of `directions`: slopes, (n,) or (1,), by each parameter and the residual.
    """

    residual: Floats
    directions: tuple[dict[str, Floats], ...] = ()


class Errors(Protocol):
    """The density of residuals."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Return the parameters of the density besides the residual, for which there are parts."""
        ...

    @property
    def dispersion(self) -> float:
        """Return the ratio of the variance of sums of slopes to the variance for independent draws of the density."""
        ...

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], RangeInformation | None]:
        """Return log densities (n,), slopes by each parameter (n,) and their information.

        None means the squares of the slopes.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixture:
    """Direct, reflected or an outlier (`calib.range_errors.densities`): the likelihood of ranges.

    With `expected` the information is its expectation by the model (Fisher's information), not the squares of slopes:
    if few ranges determine an unknown, such as a place on a path, their squares scatter too much. With `restricted`
    noise is estimated by a restricted likelihood (`RangeRows.with_uncertainty`).
    """

    expected: bool = False
    restricted: bool = False
    dispersion: float = 1.0
    parameters: tuple[str, ...] = OF_ERRORS

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], RangeInformation | None]:
        """Return log densities (n,), slopes by each parameter (n,) and their information."""
        found = error_slopes(values[RESIDUAL], values)
        if not self.expected:
            return found.log_density, found.by, None
        typical = {name: np.atleast_1d(np.median(values[name])) for name in self.parameters}
        alone, factor = self._expected(typical)
        noise, odds, mean = np.exp(typical["noise"] - values["noise"]), expit(values["odds"]), expit(typical["odds"])
        # Information is proportional to the share of the ranges that have it: direct ones, or reflected ones. This is
        # right to a sixth, and to 45 % for shares where noise doubles, or residuals where the share is three times as
        # large.
        direct, reflected = np.sqrt((1 - odds) / (1 - mean)), np.sqrt(odds / mean)
        sizes = dict.fromkeys(self.parameters, reflected)
        sizes |= {"noise": direct, "odds": direct * reflected, "outliers": np.ones(1), RESIDUAL: noise}
        rows = (zip(sizes.items(), row, strict=True) for row in factor)
        directions = tuple({name: size * own for (name, size), own in row} for row in rows)
        information = np.broadcast_to(alone * (noise * direct) ** 2, found.log_density.shape)
        return found.log_density, found.by, RangeInformation(residual=information, directions=directions)

    def _expected(self, typical: dict[str, Floats]) -> tuple[float, Floats]:
        """Return the information of a residual if the other parameters are fitted, 1/m^2, and directions (k, k + 1)
        whose outer squares are the information of the others, and of the residual by its regression on these.
        """
        sigma = float(np.exp(typical["noise"][0]))
        longest = 8 * sigma + 30 * float(np.exp(typical["detour"][0]))
        beyond = np.geomspace(8.1 * sigma, longest, 120)
        residual = np.concatenate([-beyond[::-1], np.linspace(-8 * sigma, 8 * sigma, 321), beyond])
        found = error_slopes(residual, typical)
        weight = np.exp(found.log_density) * np.gradient(residual)
        weight /= weight.sum()
        slope, others = found.by[RESIDUAL], np.array([found.by[name] for name in self.parameters])
        square, across = (others * weight) @ others.T + 1e-9 * np.eye(len(others)), (others * weight) @ slope
        shared = np.linalg.lstsq(square, across, rcond=1e-8)[0]
        root = np.linalg.cholesky(square).T
        return float(weight @ slope**2 - shared @ across), np.column_stack([root, root @ shared])


@dataclass(frozen=True, slots=True, kw_only=True)
class Robust:
    """A robust loss of residuals over `scale_m`; `weights` maps residuals over scale to weights and slopes.

    The information of a residual is the loss's curvature, and at least a share `least` of its weight: with 1 a search
    descends from any start (reweighted least squares). None means the curvature itself.
    """

    weights: Weights
    scale_m: float
    least: float | None = 1.0
    dispersion: float = 1.0
    parameters: tuple[str, ...] = ()

    def with_dispersion(self, residual: Floats, effect: float = 1.0) -> Robust:
        """Return the loss with its dispersion at residuals (n,): squares of its slopes over its curvature, times the
        `effect` of correlated errors."""
        weight, slope = self.weights(residual / self.scale_m)
        square = float(np.mean((weight * residual / self.scale_m) ** 2))
        return replace(self, dispersion=effect * max(square / max(float(np.mean(slope)), 1e-3), 1e-9))

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], RangeInformation]:
        """Return minus the loss (n,), its slope by the residual (n,) and their information."""
        u = values[RESIDUAL] / self.scale_m
        weight, slope = self.weights(u)
        information = (slope if self.least is None else np.maximum(slope, self.least * weight)) / self.scale_m**2
        by, value = -weight * u / self.scale_m, -_loss(self.weights)(np.abs(u))
        return value, {RESIDUAL: by}, RangeInformation(residual=information)


@cache
def _loss(weights: Weights) -> PPoly:
    """Return the loss over residuals over scale: the integral of its score, a cubic spline with the given slopes."""
    u = np.concatenate([np.linspace(0, 10, 2001), np.geomspace(10.1, 1e9, 1000)])
    weight, slope = weights(u)
    return CubicHermiteSpline(u, u * weight, slope).antiderivative()


@dataclass(frozen=True, kw_only=True)
class RangeRows:
    """Ranges whose residuals are `residual` (n,) plus the parts of the unknowns, minus the distances of `geometry`.

    Rows are kept sorted by `key`; `order` (n,) is the index of each among the given rows. Log likelihoods are divided
    by the dispersion of the errors. `unsure_m2` (n,), in this order, are variances of the residuals of direct ranges;
    squared residuals are too small by these (`with_uncertainty`). `exchange` (n,) is the number of the exchange that
    each given row belongs to; None where a row is an exchange.
    """

    residual: Floats
    errors: Errors
    layout: Layout
    order: Ints
    starts: Ints
    parts: tuple[Part, ...]
    geometry: Geometry | None = None
    unsure_m2: Floats | None = None
    exchange: Ints | None = None

    @classmethod
    def of(
        cls,
        residual: Floats,
        key: Ints,
        parts: Sequence[Part],
        errors: Errors,
        layout: Layout,
        geometry: Geometry | None = None,
        exchange: Ints | None = None,
    ) -> RangeRows:
        """Return rows from residuals (n,) and keys (n,), given in any order."""
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        steps = np.flatnonzero(ordered[1:] != ordered[:-1]) + 1
        starts = np.concatenate([[0], steps, [len(order)]])
        kept = tuple(_sorted(part, order, starts) for part in parts)
        return cls(
            residual=residual[order],
            errors=errors,
            layout=layout,
            order=order,
            starts=starts,
            parts=kept,
            geometry=geometry,
            exchange=exchange,
        )

    def __len__(self) -> int:
        """Return the number of ranges."""
        return len(self.residual)

    def sample(self, chosen: Ints) -> RangeRows:
        """Return the rows of some exchanges."""
        exchange = self.order if self.exchange is None else self.exchange[self.order]
        rows = np.flatnonzero(np.isin(exchange, chosen))
        starts = np.searchsorted(rows, self.starts)
        there = np.diff(starts) > 0
        parts = tuple(
            replace(
                part,
                columns=part.columns if len(part.columns) == 1 else part.columns[there],
                values=None if part.values is None else np.ascontiguousarray(part.values[:, rows]),
            )
            for part in self.parts
        )
        return replace(
            self,
            residual=self.residual[rows],
            order=self.order[rows],
            starts=np.append(starts[:-1][there], len(rows)),
            parts=parts,
            unsure_m2=None if self.unsure_m2 is None else self.unsure_m2[rows],
        )

    @property
    def restricted(self) -> bool:
        """Whether their noise depends on the uncertainty of residuals.

        With fewer unknowns than a twentieth of the ranges, noise is right to 2.5 % without this.
        """
        kinds = {part.kind for part in self.parts if part.parameter == RESIDUAL}
        count = len(self.layout.indices(list(kinds)))
        return isinstance(self.errors, Mixture) and self.errors.restricted and 20 * count > len(self)

    def expecting(self) -> RangeRows:
        """Return these rows of a mixture with expected information, not squares of slopes."""
        return replace(
            self, errors=Mixture(expected=True, dispersion=self.errors.dispersion, parameters=self.errors.parameters)
        )

    def with_uncertainty(self, x: Floats, covariance: Inverse) -> RangeRows:
        """Return these rows with the variances of their residuals by the covariance (p, p) of unknowns (p,).

        The square of a residual is too small by its variance, because unknowns follow the ranges. Noise is the mean of
        both together (restricted likelihood, by the E step of Dempster, Laird and Rubin 1977), so that offsets which
        few ranges determine do not reduce it to zero. The covariance must be from expected information: with squares of
        slopes, variances grow with the fourth power of noise, and may diverge.
        """
        found = np.empty(len(self))
        for blocks, rows, values, _ in self._pieces(x):
            errors, unit = error_slopes(values[RESIDUAL], values), np.ones(rows.stop - rows.start)
            by_unknowns = self._as_terms(blocks, rows, 0.0, {RESIDUAL: unit}, None, None)
            derivatives = by_unknowns.as_matrix(by_unknowns.slopes, by_unknowns.score, self.layout.size)
            found[rows] = (errors.inlier - errors.reflected) * diagonal_of(derivatives, covariance)
        return replace(self, unsure_m2=found)

    def terms(self, x: Floats) -> Iterator[Terms]:
        """Yield all ranges, some blocks at a time."""
        for blocks, rows, values, moved in self._pieces(x):
            log_density, by, information = self.errors.slopes(values)
            if self.unsure_m2 is not None:
                over = self.unsure_m2[rows] * np.exp(-2 * values["noise"])
                log_density, by = log_density - 0.5 * over, by | {"noise": by["noise"] + over}
            share = 1 / self.errors.dispersion
            by = {name: share * slope for name, slope in by.items()} if share != 1 else by
            yield self._as_terms(blocks, rows, share * float(np.sum(log_density)), by, information, moved)

    def residuals(self, x: Floats) -> Floats:
        """Return the residuals (n,) at unknowns (p,), in the order in which rows were given; a sample's in its own."""
        return self.values(x, (RESIDUAL,))[RESIDUAL]

    def values(self, x: Floats, names: tuple[str, ...] = ()) -> dict[str, Floats]:
        """Return some parameters, or all, of every range (n,), in the same order as residuals."""
        pieces = [values for _, _, values, _ in self._pieces(x, names)]
        back = np.argsort(self.order)
        whole = {name: [np.broadcast_to(one[name], len(one[RESIDUAL])) for one in pieces] for name in pieces[0]}
        return {name: np.concatenate(columns)[back] for name, columns in whole.items()}

    def error_slopes(self, x: Floats, names: Sequence[str]) -> ErrorSlopes:
        """Return the densities of all ranges (n,) of a `Mixture` with their slopes by some parameters, as given."""
        log_density, reflected, inlier = np.empty((3, len(self)))
        by = {name: np.empty(len(self)) for name in names}
        for _, rows, values, _ in self._pieces(x):
            found, given = error_slopes(values[RESIDUAL], values), self.order[rows]
            log_density[given], reflected[given], inlier[given] = found.log_density, found.reflected, found.inlier
            for name, column in by.items():
                column[given] = found.by[name]
        return ErrorSlopes(log_density=log_density, by=by, reflected=reflected, inlier=inlier)

    def _pieces(self, x: Floats, only: tuple[str, ...] = ()) -> Iterator[tuple[slice, slice, dict[str, Floats], Any]]:
        """Yield blocks, rows, parameters, and distances with derivatives, for the rows that are computed at once."""
        names = only or (RESIDUAL, *self.errors.parameters)
        edges, first = self.starts, 0
        while first < len(edges) - 1:
            last = max(int(np.searchsorted(edges, edges[first] + ROWS_AT_ONCE, side="right")) - 1, first + 1)
            blocks, rows = slice(first, last), slice(int(edges[first]), int(edges[last]))
            counts = np.diff(edges[first : last + 1])
            values: dict[str, Any] = dict.fromkeys(names, 0.0)
            values[RESIDUAL] = self.residual[rows]
            for part in self.parts:
                if part.parameter in names:
                    values[part.parameter] = values[part.parameter] + self._sum(part, x, blocks, rows, counts)
            moved = None
            if self.geometry is not None:
                moved = self.geometry.distances(x, self.order[rows])
                values[RESIDUAL] = values[RESIDUAL] - moved[0]
            yield blocks, rows, values, moved
            first = last

    def _sum(self, part: Part, x: Floats, blocks: slice, rows: slice, counts: Ints) -> Floats:
        own = x[self.layout.where[part.kind]]
        if part.columns.shape[0] == 1:
            weights = own[part.columns[0]]
            return np.asarray(weights if part.values is None else weights @ part.values[:, rows])
        unknown = own[part.columns[blocks]]
        if part.values is None:
            return np.repeat(unknown.sum(axis=1), counts)
        found = np.zeros(rows.stop - rows.start)
        for weights, value in zip(unknown.T, part.values[:, rows], strict=True):
            found += np.repeat(weights, counts) * value
        return found

    def _as_terms(
        self,
        blocks: slice,
        rows: slice,
        value: float,
        by: dict[str, Floats],
        information: RangeInformation | None,
        moved: Any,
    ) -> Terms:
        """Return the terms of rows, with the given information, or by squares of slopes."""
        count, several = rows.stop - rows.start, blocks.stop - blocks.start
        starts = self.starts[blocks.start : blocks.stop + 1] - rows.start
        none = np.zeros((0, count))
        columns, entries, names = [np.zeros((several, 0), dtype=np.int64)], list[Floats](), list[str]()
        for part in self.parts:
            if part.parameter not in by:
                continue
            own = part.columns if len(part.columns) == 1 else part.columns[blocks]
            columns.append(np.broadcast_to(own + self.layout.where[part.kind].start, (several, own.shape[1])))
            entries.append(np.broadcast_to(1.0, (own.shape[1], count)) if part.values is None else part.values[:, rows])
            names.append(part.parameter)
        stacked = np.concatenate(columns, axis=1)

        def square(beside: dict[str, Floats], weight: Floats | float) -> Squares:
            slopes = [beside[name] * one for name, one in zip(names, entries, strict=True)]
            return Squares(entries=np.concatenate([none, *slopes]), residual=beside[RESIDUAL], weight=weight)

        of_slopes = square(by, self.errors.dispersion)
        squares = [of_slopes]
        if information is not None:
            share = 1 / self.errors.dispersion
            residual_alone = dict.fromkeys(names, np.zeros(count)) | {RESIDUAL: np.ones(count)}
            directions = information.directions if set(names) - {RESIDUAL} else ()
            squares = [square(one, share) for one in directions]
            squares.append(square(residual_alone, share * information.residual))
        slopes, score, movements = of_slopes.entries, of_slopes.residual, None
        if moved is not None and self.geometry is not None:
            distance, derivative = moved
            # Below 10 cm a second derivative does not describe a step of a search. With 5, 20 or 100 cm searches in two
            # flights have the same steps.
            bend = np.abs(score) / np.maximum(distance, 0.1)
            movements = self.geometry.movements(self.order[rows], derivative, bend)
        return Terms(
            value=value,
            slopes=slopes,
            score=score,
            columns=stacked,
            starts=starts,
            squares=squares,
            movements=movements,
        )


def _sorted(part: Part, order: Ints, starts: Ints) -> Part:
    """Return a part in the rows' own order, with columns by block; a single row of columns is for all ranges.

    Raises `ValueError` if ranges of a block have different columns.
    """
    values = None if part.values is None else np.ascontiguousarray(part.values[order].T)
    columns = part.columns
    if len(columns) > 1:
        each = columns[order]
        columns = each[starts[:-1]]
        if np.any(each != np.repeat(columns, np.diff(starts), axis=0)):
            raise ValueError(
                f"{part.kind}: columns differ between ranges of one key; give `values` that are 0 for others"
            )
    return replace(part, columns=columns, values=values)
