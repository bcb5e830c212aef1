"""What the likelihood by pair is of: which parameters stand where, the errors, and their slopes by each parameter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.estimation.design import Design, as_design
from calib.estimation.problem import CELLS
from calib.estimation.reflections import Shape, expected
from calib.estimation.scores import Scores, Sort, Summing, Sums
from calib.long_columns import ROWS_AT_ONCE, empty, let_go, picked, put
from uwblink.arrays import Floats, Ints

SLOPES: Final = ("noise", "share", "mean", "least", "outliers")
"""What a range has slopes by beside those of the design, in their order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Which parameters stand where: those of the design, then logarithms and log odds of the rest."""

    columns: int
    pairs: int
    cells: int = CELLS

    def counts(self) -> dict[str, int]:
        """Return how many there are of each sort."""
        common = {"design": self.columns, "mean": 1, "least": 1, "outliers": 1}
        return common | {
            "cell_noise": self.cells,
            "cell_share": self.cells,
            "pair_share": self.pairs,
            "pair_noise": self.pairs,
            "pair_mean": self.pairs,
        }

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
        density = 1 / (float(np.ptp(error)) + 1e-9)
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
    mean = np.exp(part["mean"][0] + part["pair_mean"])[errors.place // layout.cells]
    design, counts = errors.design, errors.design.counts
    for blocks, rows in design.passing():
        shape = Shape(
            sigma_m=np.repeat(sigma[blocks], counts[blocks]),
            tail_share=np.repeat(share[blocks], counts[blocks]),
            mean_m=np.repeat(mean[blocks], counts[blocks]),
            least_m=float(np.exp(part["least"][0])),
            outlier_share=float(1 / (1 + np.exp(-part["outliers"][0]))),
            outlier_density=errors.density,
        )
        yield blocks, rows, _slopes(errors.error[rows] + design.piece_times(part["design"], blocks, rows), shape)


def _slopes(residual: Floats, shape: Shape) -> _Piece:
    """Return the slopes of the log likelihood at residuals (n,)."""
    found = expected(residual, shape)
    z, noise = residual / shape.sigma_m, found.noise_m / shape.sigma_m
    core, tail = found.core, found.tail
    both, tail_noise = core + tail, tail * noise
    return _Piece(
        score=-(core * z + tail_noise) / shape.sigma_m,
        slopes=(
            core * (z * z - 1) + tail * (noise * noise + found.noise_var - 1),
            tail - shape.tail_share * both,
            tail * ((residual - shape.least_m - found.noise_m) / shape.mean_m - 1),
            tail_noise * (shape.least_m / shape.sigma_m),
            (1 - shape.outlier_share) - both,
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
    noise, share, mean, least, outliers = range(len(SLOPES))
    pair, cell = np.divmod(np.arange(layout.pairs * layout.cells), layout.cells)
    return (
        *(Sort(slope=slope) for slope in (mean, least, outliers)),
        *(Sort(slope=slope, whose=cell, count=layout.cells) for slope in (noise, share)),
        *(Sort(slope=slope, whose=pair, count=layout.pairs) for slope in (share, noise, mean)),
    )
