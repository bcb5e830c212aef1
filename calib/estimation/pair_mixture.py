"""Delays, curves and what the errors are made of, in one likelihood: reflections that differ by pair and by power.

Each pair has a share of reflected ranges, a mean detour and a noise of its own; each is drawn to what all pairs have in
common by how little the pair's own ranges say (empirical Bayes: the spreads between pairs are estimated along, by the
fixed point of Fellner and Schall). Share and noise also vary with power, in steps. Everything is estimated together by
Fisher's scoring with the squared slopes as information (Berndt, Hall, Hall, Hausman 1974), so the covariance of delays
and curves contains what the rest leaves open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.estimation.design import Design, as_design
from calib.estimation.problem import CELLS
from calib.estimation.reflections import Shape, expected
from calib.estimation.scores import Scores, Sort, Summing, Sums, inverse_of
from calib.long_columns import ROWS_AT_ONCE, computed, empty, let_go, picked
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

SLOPES: Final = ("noise", "share", "mean", "least", "outliers")
"""What a range has slopes by beside those of the design, in their order."""

LEVELS: Final = 6
"""Each sample on which the fit converges has so many times the rows of the one before."""

FIRST_SAMPLE: Final = 9000
MAX_STEPS: Final = 60
PATIENCE: Final = 20
"""Steps after which it is enough that delays and curves stand still: a share of nothing may be any small number."""

ADAPTING: Final = 10
"""Steps after which variances between pairs stand, and steps are halved at first: two points that lead to each other
have their middle between them.
"""

SHORT: Final = 0.8
LONG: Final = 0.3
LONGEST: Final = 8.0
SHORTEST: Final = 0.25
"""Shares of what was promised above which a step was short and below which it was long, and bounds of its length."""

SETTLED: Final = 1e-2
"""A step that promises less log likelihood than this by delays and curves ends it: a tenth of a standard error."""

NEARLY: Final = 0.3
"""The same for all parameters together, of which there are many that delays do not depend on."""

ROUGHLY: Final = 1.0
"""The same on a sample, from which more ranges lead away by tens."""

CHORD: Final = 0.5
"""Nearer than this to the top, the information is that of the last point where it was asked for."""

LONGEST_STEP: Final = 0.7
"""Of a logarithm or a log odds."""

SPREADS: Final[dict[str, tuple[float, float]]] = {"share": (1e-3, 4.0), "noise": (1e-4, 4.0), "mean": (1e-3, 0.5)}
"""Bounds of the variances between pairs: of log odds, log noise and log mean detour."""

CELL_VARIANCE: Final = 0.5
MEAN_VARIANCE: Final = 1.0
LEAST_VARIANCE: Final = 2.0
"""How far from their guesses the steps of share, the mean detour and the least detour may be, in logarithms squared."""

OUTLIERS: Final = -6.0
OUTLIER_VARIANCE: Final = 9.0


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """What is known beforehand: precision (D, D) and centre (D,) of the parameters, and variances between pairs."""

    columns: int
    precision: Floats
    centre: Floats
    variances: dict[str, float]
    lasting: float = 1.0

    @property
    def weighed(self) -> Floats:
        """Return the precision (D, D) beside information that counts ranges for independent that are not."""
        return self._times(self.lasting)

    @property
    def pull(self) -> Floats:
        """Return the covariance (D, D) of what the prior pulls with, where it is right."""
        return self._times(self.lasting**2)

    def _times(self, factor: float) -> Floats:
        found = self.precision.copy()
        found[self.columns :, self.columns :] *= factor
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMixture:
    """The likeliest parameters (D,), their model covariance (D, D), the slopes of every range there, and how it ended.

    `tail_share`, `tail_mean_m` and `noise` (pairs,) say what each pair's errors are made of, `noise` in the common one.
    """

    layout: Layout
    parameters: Floats
    covariance: Floats
    precision: Floats
    scores: Scores
    steps: int
    success: bool

    def of(self, sort: str) -> Floats:
        """Return the parameters of a sort."""
        return self.parameters[self.layout.slices()[sort]]

    def slope(self, name: str) -> Floats:
        """Return every range's slope by its own parameter of a kind of `SLOPES` (n,), in the order of given rows."""
        return self.scores.design.given(self.scores.slopes[SLOPES.index(name)])

    @property
    def tail_share(self) -> Floats:
        """Share of reflected ranges of each pair, at the middle step of power."""
        return np.asarray(1 / (1 + np.exp(-self.of("pair_share") - np.mean(self.of("cell_share")))))

    @property
    def tail_mean_m(self) -> Floats:
        """Mean detour of each pair's reflected ranges."""
        exponential = np.exp(self.of("mean")[0] + self.of("pair_mean"))
        return np.asarray(np.exp(self.of("least")[0]) + exponential)

    @property
    def noise(self) -> Floats:
        """Noise of each pair over the common one."""
        return np.exp(self.of("pair_noise"))


def fit_pair_mixture(errors: Errors, start: Floats, ridge: Floats, lasting: float = 1.0) -> PairMixture:
    """Return the likeliest parameters, from a robust `start` (m,) of those of the design.

    `ridge` (m, m) is the inverse covariance of what is known of them beforehand, in 1/m^2.
    """
    layout = Layout(columns=errors.design.shape[1], pairs=errors.pairs)
    theta, prior = _start(errors, layout, start, ridge, lasting)
    steps, success = 0, False
    for some in _levels(errors):
        nearly = NEARLY if some is errors else ROUGHLY
        theta, prior, taken, success = _climb(some, layout, theta, prior, nearly)
        steps += taken
    scores = _all_scores(errors, layout, theta)
    covariance = inverse_of(scores.information() + prior.weighed, layout.pairs, len(SPREADS))
    return PairMixture(
        layout=layout,
        parameters=theta,
        covariance=covariance,
        precision=prior.pull,
        scores=scores,
        steps=steps,
        success=success,
    )


def _levels(errors: Errors) -> Iterator[Errors]:
    """Yield samples of growing size, and everything last."""
    count = len(errors.error)
    order, size = np.random.default_rng(0).permutation(count), FIRST_SAMPLE
    while 2 * size < count:
        yield errors.sample(np.sort(order[:size]))
        size *= LEVELS
    yield errors


def _start(errors: Errors, layout: Layout, start: Floats, ridge: Floats, lasting: float) -> tuple[Floats, Prior]:
    """Return first parameters, from robust spreads of the residuals, and what is known beforehand."""
    where = layout.slices()
    fitted = errors.design.times(start)
    residual = computed(len(fitted), lambda rows: errors.error[rows] + fitted[rows])
    spread = _spread(residual)
    theta = np.zeros(where["pair_mean"].stop)
    theta[where["design"]] = start
    theta[where["mean"]] = np.log(4 * spread)
    theta[where["least"]] = np.log(0.5 * spread)
    theta[where["outliers"]] = OUTLIERS
    cells = errors.parts(errors.place % layout.cells, layout.cells, residual)
    theta[where["cell_noise"]] = np.log([0.9 * _spread(part) for part in cells])
    noise, odds = [], []
    for part in errors.parts(errors.place // layout.cells, layout.pairs, residual):
        noise.append(_spread(part, spread))
        beyond = np.mean(part > 2.5 * noise[-1]) - np.mean(part < -2.5 * noise[-1]) if len(part) else 0.1
        odds.append(np.clip(1.6 * beyond, 0.01, 0.6))
    theta[where["pair_share"]] = np.log(np.array(odds) / (1 - np.array(odds)))
    theta[where["pair_noise"]] = np.log(np.array(noise) / np.median(noise))
    precision, centre = np.zeros((len(theta),) * 2), np.zeros(len(theta))
    precision[where["design"], where["design"]] = ridge
    known = {"mean": MEAN_VARIANCE, "least": LEAST_VARIANCE, "outliers": OUTLIER_VARIANCE, "cell_share": CELL_VARIANCE}
    for name, variance in known.items():
        _set(precision, where[name], 1 / variance)
    centre[: where["cell_noise"].start][-3:] = theta[where["mean"].start : where["cell_noise"].start]
    _set(precision, where["cell_noise"], 1e-6)
    return theta, _between(
        theta,
        Prior(columns=layout.columns, precision=precision, centre=centre, variances={}, lasting=lasting),
        layout,
        None,
    )


def _spread(values: Floats, otherwise: float = 1e-3) -> float:
    if len(values) < 5:
        return otherwise
    return max(robust_spread(values), 1e-3)


def _set(matrix: Floats, where: slice, value: float) -> None:
    matrix[np.arange(where.start, where.stop), np.arange(where.start, where.stop)] = value


def _between(theta: Floats, prior: Prior, layout: Layout, covariance: Floats | None) -> Prior:
    """Return the prior with the variances between pairs that parameters and their covariance suggest."""
    where, variances = layout.slices(), dict(prior.variances)
    precision, centre = prior.precision.copy(), prior.centre.copy()
    centre[where["pair_share"]] = theta[where["pair_share"]].mean()
    for name, (low, high) in SPREADS.items():
        rows = where[f"pair_{name}"]
        square = float(np.sum((theta[rows] - centre[rows]) ** 2))
        used = float(layout.pairs)
        if covariance is not None:
            used = max(used - prior.lasting * float(np.trace(covariance[rows, rows])) / variances[name], 1e-2 * used)
        else:
            square = max(square, 0.05 * used)
        variances[name] = min(max(square / used, low), high)
        _set(precision, rows, 1 / variances[name])
    return replace(prior, precision=precision, centre=centre, variances=variances)


def _climb(
    errors: Errors, layout: Layout, theta: Floats, prior: Prior, nearly: float
) -> tuple[Floats, Prior, int, bool]:
    """Climb to the top of the likelihood of some errors: parameters, prior, steps, and whether it is the top."""
    best, top, step, shorter = -np.inf, theta, np.zeros_like(theta), 0
    information, gain, length, promised = np.zeros((0, 0)), np.inf, 1.0, 0.0
    for steps in range(1, MAX_STEPS + 1):
        fresh = steps == 1 or gain > CHORD
        sums, likelihood = _sums(errors, layout, theta, squares=fresh)
        value = likelihood - 0.5 * float((theta - prior.centre) @ prior.weighed @ (theta - prior.centre))
        if value < best - SETTLED and shorter < 6:
            step, shorter, promised = 0.3 * step, shorter + 1, 0.0
            theta = top + step
            continue
        if steps == ADAPTING + 1:
            length = 0.5
        elif steps > ADAPTING and promised > 0:
            length = _length(length, (value - best) / promised)
        information = sums.information() if fresh else information
        covariance = inverse_of(information + prior.weighed, layout.pairs, len(SPREADS))
        slope = sums.gradient() - prior.weighed @ (theta - prior.centre)
        step, shorter = covariance @ slope, 0
        own = slice(0, layout.columns)
        still = abs(float(slope[own] @ step[own])) < SETTLED
        gain = float(slope @ step)
        if still and (gain < nearly or steps > PATIENCE):
            return theta, prior, steps, True
        longest = float(np.max(np.abs(step[layout.columns :])))
        step *= min(length, LONGEST_STEP / max(longest, 1e-12))
        promised = float(slope @ step)
        top, theta = theta, theta + step
        if steps <= ADAPTING:
            prior = _between(theta, prior, layout, covariance)
        best = likelihood - 0.5 * float((top - prior.centre) @ prior.weighed @ (top - prior.centre))
    return theta, prior, steps, False


def _length(before: float, kept: float) -> float:
    """Return how much of a step to take, by the share that the last one kept of what its slope promised.

    Squared slopes are not quite the curvature: a step to the top keeps a half, one that keeps all was short.
    """
    if kept > SHORT:
        return min(2 * before, LONGEST)
    return max(before / 2, SHORTEST) if kept < LONG else before


def _sums(errors: Errors, layout: Layout, theta: Floats, *, squares: bool) -> tuple[Sums, float]:
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


def _all_scores(errors: Errors, layout: Layout, theta: Floats) -> Scores:
    """Return the slopes of all ranges at parameters."""
    found = empty(len(errors.error), each=(1 + len(SLOPES),))
    for _, rows, piece in _pieces(errors, layout, theta):
        found[0, rows], found[1:, rows] = piece.score, piece.slopes
        if rows.start // ROWS_AT_ONCE != rows.stop // ROWS_AT_ONCE:
            let_go(found, errors.error)
    let_go(found, errors.error)
    return Scores(
        design=errors.design,
        score=found[0],
        slopes=tuple(found[1:]),
        place=errors.place,
        places=layout.pairs * layout.cells,
        sorts=_sorts(layout),
    )


def _sorts(layout: Layout) -> tuple[Sort, ...]:
    """Return the sorts of parameters in the layout's order."""
    noise, share, mean, least, outliers = range(len(SLOPES))
    pair, cell = np.divmod(np.arange(layout.pairs * layout.cells), layout.cells)
    return (
        *(Sort(slope=slope) for slope in (mean, least, outliers)),
        *(Sort(slope=slope, whose=cell, count=layout.cells) for slope in (noise, share)),
        *(Sort(slope=slope, whose=pair, count=layout.pairs) for slope in (share, noise, mean)),
    )
