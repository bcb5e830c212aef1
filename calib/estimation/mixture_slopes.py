"""What the likelihood by pair is of: which parameters stand where, the errors, and their slopes by each parameter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.densities import LONG_FACTOR, LongDetours
from calib.estimation.design import Design, as_design
from calib.estimation.problem import CELLS
from calib.estimation.reflections import Shape, expected
from calib.estimation.scores import Scores, Sort, Summing, Sums
from calib.long_columns import ROWS_AT_ONCE, empty, let_go, picked, put
from uwblink.arrays import Floats, Ints

SLOPES: Final = ("noise", "share", "pair_mean", "mean", "least", "outliers", "long_share")
"""What a range has slopes by beside those of the design, in their order."""

OUTLIERS_OVER_M: Final = 10.0
"""Outliers are anywhere within a room, at least: over the span of a few errors they would pass for long detours."""

COMMON: Final = ("mean", "least", "outliers", "long_share")
"""Parameters that all ranges share, in their order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Which parameters stand where: those of the design, then logarithms and log odds of the rest.

    `mean` is the mean of the first kind of detour beyond `shortest_m`, the least that it may be.
    """

    columns: int
    pairs: int
    cells: int = CELLS
    shortest_m: float = 0.0

    def counts(self) -> dict[str, int]:
        """Return how many there are of each sort."""
        return (
            {"design": self.columns}
            | dict.fromkeys(COMMON, 1)
            | {
                "cell_noise": self.cells,
                "cell_share": self.cells,
                "pair_share": self.pairs,
                "pair_noise": self.pairs,
                "pair_mean": self.pairs,
            }
        )

    def slices(self) -> dict[str, slice]:
        """Return where each sort stands."""
        found, at = {}, 0
        for name, count in self.counts().items():
            found[name] = slice(at, at + count)
            at += count
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """What is fitted: `error + design @ x` (n,) metres, in the order in which the design keeps rows.

    `place` (blocks,) is that of the design's blocks: step of power within pair. Outliers have the `density`.
    """

    error: Floats
    design: Design
    place: Ints
    pairs: int
    density: float

    @classmethod
    def of(cls, error: Floats, matrix: Design | Floats, place: Ints, pairs: int) -> Errors:
        """Return errors (n,) whose places (n,) are known, in the order in which they are given."""
        design = as_design(matrix).blocked(place)
        density = 1 / max(float(np.ptp(error)), OUTLIERS_OVER_M)
        return cls(
            error=design.kept(error),
            design=design,
            place=design.first_of(design.kept(place)),
            pairs=pairs,
            density=density,
        )

    def sample(self, rows: Ints) -> Errors:
        """Return some rows, by their numbers as they were given."""
        keep = self.design.chosen(rows)
        design = self.design.sample(rows)
        place = np.repeat(self.place, self.design.counts)[keep]
        return replace(self, error=picked(self.error, keep), design=design, place=design.first_of(place))

    def parts(self, group: Ints, count: int, values: Floats) -> list[Floats]:
        """Return values (n,) apart by groups of blocks, of which `group` (blocks,) are the numbers."""
        found: list[list[Floats]] = [[values[:0]] for _ in range(count)]
        bounds = self.design.starts.tolist()
        for k, number in enumerate(group.tolist()):
            found[number].append(values[bounds[k] : bounds[k + 1]])
        return [np.concatenate(some) for some in found]


def sums_at(errors: Errors, layout: Layout, theta: Floats, *, squares: bool) -> tuple[Sums, float]:
    """Return the sums of all slopes at parameters, with those of `squares`, and the log likelihood."""
    summing, likelihood = Summing(errors.design, len(SLOPES), squares=squares), 0.0
    for blocks, rows, piece in _pieces(errors, layout, theta):
        summing.add(blocks, rows, piece.score, piece.slopes)
        likelihood += float(piece.log_density.sum())
    return summing.sums(errors.place, layout.pairs * layout.cells, _sorts(layout)), likelihood


@dataclass(frozen=True, slots=True, kw_only=True)
class _Piece:
    """The slopes of some ranges (n,), by the residual and in the order of `SLOPES`, and their log densities."""

    score: Floats
    slopes: tuple[Floats, ...]
    log_density: Floats


def _pieces(errors: Errors, layout: Layout, theta: Floats) -> Iterator[tuple[slice, slice, _Piece]]:
    """Yield blocks, rows and slopes at parameters, for as many rows at once as the cache holds."""
    part = {name: theta[rows] for name, rows in layout.slices().items()}
    sigma = np.exp(part["pair_noise"][:, None] + part["cell_noise"]).ravel()[errors.place]
    share = 1 / (1 + np.exp(-part["pair_share"][:, None] - part["cell_share"])).ravel()[errors.place]
    long, above = long_detours(part["long_share"]), float(np.exp(part["mean"][0]))
    mean = (long.mean * (layout.shortest_m + above) * np.exp(part["pair_mean"]))[errors.place // layout.cells]
    design, counts = errors.design, errors.design.counts
    for blocks, rows in design.passing():
        shape = Shape(
            sigma_m=np.repeat(sigma[blocks], counts[blocks]),
            tail_share=np.repeat(share[blocks], counts[blocks]),
            mean_m=np.repeat(mean[blocks], counts[blocks]),
            least_m=float(np.exp(part["least"][0])),
            outlier_share=float(1 / (1 + np.exp(-part["outliers"][0]))),
            outlier_density=errors.density,
            long=long,
        )
        residual = errors.error[rows] + design.piece_times(part["design"], blocks, rows)
        yield blocks, rows, _slopes(residual, shape, above / (layout.shortest_m + above))


def long_detours(log_odds: Floats) -> LongDetours:
    """Return the second kind of detour from its log odds (1,)."""
    return LongDetours(share=float(1 / (1 + np.exp(-log_odds[0]))), factor=LONG_FACTOR)


def _slopes(residual: Floats, shape: Shape, moved: float) -> _Piece:
    """Return the slopes of the log likelihood at residuals (n,); means of detours are `moved` so much by their own."""
    found, sigma, long = expected(residual, shape), shape.sigma_m, shape.long
    z, core, tail = residual / sigma, found.core, found.tail
    both, tail_noise = core + tail, found.tail_noise_m / sigma
    noise, mean = core * (z * z - 1), np.zeros_like(z)
    beyond = residual - shape.least_m
    for share, kind in zip(found.tails, found.kinds, strict=True):
        part = kind.noise_m / sigma
        noise += share * (part * part + kind.noise_var - 1)
        mean += share * ((beyond - kind.noise_m) / kind.detour_m - 1)
    return _Piece(
        score=-(core * z + tail_noise) / sigma,
        slopes=(
            noise,
            tail - shape.tail_share * both,
            mean,
            moved * mean,
            tail_noise * (shape.least_m / sigma),
            (1 - shape.outlier_share) - both,
            found.tails[1] - long.share * tail,
        ),
        log_density=found.log_density,
    )


def slopes_at(errors: Errors, layout: Layout, theta: Floats, name: str) -> Floats:
    """Return the slope of each range (n,) by its own parameter of a kind of `SLOPES`, at parameters."""
    found, which = empty(len(errors.error)), SLOPES.index(name)
    for _, rows, piece in _pieces(errors, layout, theta):
        put(found, rows, piece.slopes[which])
    let_go(found, errors.error)
    return found


def scores_at(errors: Errors, layout: Layout, theta: Floats) -> tuple[Scores, Sums]:
    """Return the slopes of all ranges at parameters, and their sums with those of squares."""
    found = empty(len(errors.error), each=(1 + len(SLOPES),))
    summing = Summing(errors.design, len(SLOPES), squares=True)
    for blocks, rows, piece in _pieces(errors, layout, theta):
        for column, values in zip(found, (piece.score, *piece.slopes), strict=True):
            put(column, rows, values)
        summing.add(blocks, rows, piece.score, piece.slopes)
        if rows.start // ROWS_AT_ONCE != rows.stop // ROWS_AT_ONCE:
            let_go(found, errors.error)
    let_go(found, errors.error)
    places, sorts = layout.pairs * layout.cells, _sorts(layout)
    scores = Scores(
        design=errors.design,
        score=found[0],
        slopes=tuple(found[1:]),
        place=errors.place,
        places=places,
        sorts=sorts,
    )
    return scores, summing.sums(errors.place, places, sorts)


def _sorts(layout: Layout) -> tuple[Sort, ...]:
    """Return the sorts of parameters in the layout's order."""
    noise, share, mean = (SLOPES.index(name) for name in ("noise", "share", "pair_mean"))
    pair, cell = np.divmod(np.arange(layout.pairs * layout.cells), layout.cells)
    return (
        *(Sort(slope=SLOPES.index(name)) for name in COMMON),
        *(Sort(slope=slope, whose=cell, count=layout.cells) for slope in (noise, share)),
        *(Sort(slope=slope, whose=pair, count=layout.pairs) for slope in (share, noise, mean)),
    )
