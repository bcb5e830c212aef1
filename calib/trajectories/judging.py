"""Which delays the ranges determine when trajectories are unknown, and which inputs contradict the ranges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from calib.calibration.model import Calibration
from calib.calibration.power_curves import basis
from calib.estimator.inverse import Matrix, inverse_of
from calib.estimator.known_distances import KnownDistances
from calib.estimator.rows import sum_rows
from calib.estimator.unknowns import Layout
from calib.information import Unknown, Verdict, judge
from calib.spread import TWO_SIDED_95
from calib.trajectories.motion import MOTION, TapeRows
from calib.trajectories.search import Search
from uwblink.arrays import Floats, Ints

PRIOR_NS = 2.0
"""Prior standard deviation of a delay: delays of boards of one type differ by less."""

SCALE_NS, LOOSEST = 0.2, 0.5
"""A direction of delays is determined if its standard error is at most LOOSEST * SCALE_NS (3 cm of range).

The value comes from simulations (docs/accuracy.md): wider intervals did not hold.
"""

GROWTH = 3.0
"""If a fit with known distances is less certain than that, a direction may be so many times less certain."""

GEOMETRY_ALONE_FACTOR = 3.0
"""Factor on standard errors where only geometry determines distances: there the problem is not linear, and errors up to
4.2 linearised standard errors were observed (docs/accuracy.md)."""

TAPE_UNCHECKED, TAPE_MIN_DEVIATION, TAPE_MIN_ERROR_M = 0.999, 4.0, 0.03
"""A tape that no range checks (leverage above the first) is not tested. Others contradict the fit if their deleted
residual exceeds so many standard errors and so many metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """The verdict on the delays of `tags` that are not pinned, which are those number `own` (k,) of all tags.

    `variance_factor` inflates covariances where only geometry determines distances. `distance_std_m` is the root mean
    square standard error of the distances. `sentences` name contradictions.
    """

    tags: tuple[int, ...]
    own: Ints
    verdict: Verdict
    variance_factor: float
    distance_std_m: float
    sentences: tuple[str, ...]

    @property
    def free_tags(self) -> list[int]:
        """Return the tags whose delays are not determined."""
        return [int(tag) for tag in self.verdict.named("delay") if tag]

    def undetermined_text(self, covariance_ns2: Floats) -> str:
        """Return a sentence on the delays that are not determined; `covariance_ns2` is that of all tags."""
        free, own = self.free_tags, covariance_ns2[np.ix_(self.own, self.own)]
        if len(free) < len(self.tags):
            worst = np.sqrt(np.max(np.diag(own)[np.isin(self.tags, free)]))
            return (
                f"the ranges do not determine the delays of tags {', '.join(map(str, free))}: known to ± "
                f"{TWO_SIDED_95 * float(worst):.2f} ns (95 %) at worst"
            )
        count = len(own)
        rows = np.full((1, count), 1 / count), np.eye(count)[1:] - np.eye(count)[0]
        spread, differences = (TWO_SIDED_95 * float(np.sqrt(np.max(np.diag(row @ own @ row.T)))) for row in rows)
        return (
            f"the ranges determine no delay: what all have in common is known to ± {spread:.2f} ns (95 %), and "
            f"differences to ± {differences:.2f} ns"
        )


def judge_delays(found: KnownDistances, top: Search) -> Judgement:
    """Return the verdict on the delays of a fit, and contradictions to its trajectories."""
    layout, optimum = top.optimum.layout, top.optimum
    unpinned = np.intersect1d(layout.indices(["delay"]), layout.free())
    own = unpinned - layout.where["delay"].start
    tags = tuple(found.model.tags[k] for k in own)
    factor = GEOMETRY_ALONE_FACTOR**2 if top.motion.scene.by_geometry_alone else 1.0
    information = sum_rows([top.rows, *top.gauge], optimum.x).information + optimum.priors.precision()
    with_truth = with_known_distances(information, layout, unpinned)
    # The distances of 400 ranges give their root mean square standard error.
    some = np.unique(np.linspace(0, len(top.rows) - 1, 400).astype(np.int64))
    moved = top.geometry.derivatives(optimum.x, some)
    return Judgement(
        tags=tags,
        own=own,
        verdict=verdict_on(factor * found.covariances["delay"][np.ix_(own, own)], with_truth, tags),
        variance_factor=factor,
        distance_std_m=float(np.sqrt(np.mean(np.einsum("kp,pk->k", moved, optimum.covariance @ moved.T)))),
        sentences=(*_of_motion(top), *_of_tapes(top)),
    )


def with_known_distances(information: Matrix, layout: Layout, own: Ints) -> Floats:
    """Return the covariance (k, k) that some unknowns would have if all distances were known.

    `information` (p, p) is that of ranges and priors; the unknowns of motion are held.
    """
    others = np.setdiff1d(layout.free(), layout.indices(MOTION))
    some = information[others][:, others]
    dense = some.toarray() if sparse.issparse(some) else some
    place = np.searchsorted(others, own)
    return np.asarray(inverse_of(dense, np.arange(len(others)))[:, place])[place]


def verdict_on(covariance: Floats, with_truth: Floats, tags: Sequence[int]) -> Verdict:
    """Return the verdict on delays with a covariance (tags, tags), compared with that for known distances."""
    if not tags:
        return judge(np.eye(1) * 1e6, [Unknown("delay", "")])
    guess = np.maximum(SCALE_NS, GROWTH / LOOSEST * np.sqrt(np.maximum(np.diag(with_truth), 0.0)))
    information = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) + np.eye(len(covariance)) / PRIOR_NS**2
    unknowns = [Unknown("delay", str(tag), scale) for tag, scale in zip(tags, guess.tolist(), strict=True)]
    return judge((information + information.T) / 2, unknowns, loosest=LOOSEST)


def _of_motion(top: Search) -> Iterator[str]:
    missed_m = top.missed_motion_m()
    if missed_m:
        yield (
            f"bodies move faster than control points every {top.motion.places.step_s:.1f} s follow: about "
            f"{100 * missed_m:.0f} cm of their motion is not in the trajectories, and distances are off "
            "by it; fly more calmly"
        )


def _of_tapes(top: Search) -> Iterator[str]:
    """Yield a sentence for each tape that the ranges contradict, by deleted residuals (Cook and Weisberg 1982)."""
    rows, x = top.known.get("tape"), top.optimum.x
    if not isinstance(rows, TapeRows):
        return
    left, tapes = rows.left(x), top.motion.scene.tapes
    for number, one in enumerate(tapes.stated):
        mine = np.flatnonzero(tapes.number == number)
        moved = rows.geometry.derivatives(x, mine).mean(axis=0)
        share = min(float(moved @ (top.optimum.covariance @ moved)) / one.sigma_m**2, 1.0)
        if share > TAPE_UNCHECKED:
            continue
        without = float(left[mine].mean()) / (1 - share)
        deviation = abs(without) * math.sqrt(1 - share) / one.sigma_m
        if deviation < TAPE_MIN_DEVIATION or abs(without) < TAPE_MIN_ERROR_M:
            continue
        way = "more" if without > 0 else "less"
        yield (
            f"the distance of tags {one.first} and {one.second}, {one.distance_m:.3f} m, is {100 * abs(without):.0f} "
            f"cm {way} than all else says ({deviation:.0f} standard errors): measure it again"
        )


def curve_uncertainty(found: KnownDistances, known: Calibration) -> Floats:
    """Return the covariance (tags, tags) in ns^2 that the uncertainty of a kept curve adds to the delays."""
    optimum, rows, model = found.searches[0].optimum, found.searches[0].rows, found.model
    size = len(found.delays)
    if known.uncertainty is None or len(known.uncertainty.bias_m2) != len(known.bias_curve.coefficients):
        return np.zeros((size, size))
    low, high = known.bias_curve.range
    splines = basis(np.clip(model.lifted, low, high), np.array(known.bias_curve.knots))[rows.order]
    # Derivatives of the unknowns by an error of each range: covariance times information.
    pieces = list(rows.terms(optimum.x))
    slopes = sparse.vstack([terms.as_matrix(terms.slopes, optimum.layout.size) for terms in pieces])
    linked = slopes.T @ (np.concatenate([np.asarray(terms.score) for terms in pieces])[:, None] * splines)
    reach = (optimum.covariance @ linked)[optimum.layout.where["delay"]]
    return np.asarray(reach @ np.array(known.uncertainty.bias_m2) @ reach.T)
