"""What ranges say of delays when trajectories are unknown too: which are determined, and what contradicts the rest."""

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
from calib.trajectories.motion import TapeRows
from calib.trajectories.search import MOTION, Found
from uwblink.arrays import Floats, Ints

PRIOR_NS = 2.0
"""Delays of boards of one kind differ by less: what a direction is known by where nothing else says anything."""

GUESS_NS, LOOSEST = 0.2, 0.5
"""A direction of delays counts as determined if it is known to half of so much (3 cm of range), by standard error.

Calibrated by simulation (docs/accuracy.md): intervals beyond were seen not to hold.
"""

GROWTH = 3.0
"""Few ranges leave delays less known than that even where distances are given; then so many times as much will do."""

ALONE = 3.0
"""By geometry alone a fit is linear no further: errors of up to 4.2 of its standard errors were seen, which are so many
times as large there as linear propagation has them (docs/accuracy.md)."""

LOOKED_AT = 400
"""Distances whose standard errors are averaged."""

TAPE_ALONE, TAPE_SURELY, TAPE_MATTERS_M = 0.999, 4.0, 0.03
"""A tape that is known by itself alone, to such a share, contradicts nothing; others do by so many standard errors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """The verdict on the delays of `tags` that are not pinned, whose covariance (tags, tags) is `covariance_ns2`.

    `absorbed` says for the least known direction of delays how many times its variance grew because distances are not
    known; `distance_std_m` is the root mean square of standard errors of distances, `sentences` say what contradicts.
    """

    tags: tuple[int, ...]
    verdict: Verdict
    covariance_ns2: Floats
    absorbed: float
    distance_std_m: float
    by_geometry_alone: bool
    sentences: tuple[str, ...]

    @property
    def free_tags(self) -> list[int]:
        """Return the tags whose delays are not determined."""
        return [int(tag) for tag in self.verdict.named("delay") if tag]

    @property
    def said(self) -> str:
        """Return as a sentence what is not determined."""
        return "".join(self.left_open(self.covariance_ns2))

    def beyond_linear(self, covariance: Floats) -> Floats:
        """Return a covariance of delays, wider where geometry alone tells them."""
        return covariance * ALONE**2 if self.by_geometry_alone else covariance

    def left_open(self, covariance_ns2: Floats) -> list[str]:
        """Return as a sentence what is not determined; none where everything is. Delays have a covariance by tag."""
        free = self.free_tags
        if not free:
            return []
        if len(free) < len(self.tags):
            known = np.sqrt([covariance_ns2[k, k] for k, tag in enumerate(self.tags) if tag in free])
            return [
                f"the ranges do not determine the delays of tags {', '.join(map(str, free))}: known to ± "
                f"{TWO_SIDED_95 * float(known.max()):.2f} ns (95 %) at worst"
            ]
        count = len(self.tags)
        rows = np.full((1, count), 1 / count), np.eye(count)[1:] - np.eye(count)[0]
        spread, differences = (
            TWO_SIDED_95 * float(np.sqrt(np.max(np.diag(row @ covariance_ns2[:count, :count] @ row.T)))) for row in rows
        )
        return [
            f"the ranges determine no delay: what all have in common is known to ± {spread:.2f} ns (95 %), and "
            f"differences to ± {differences:.2f} ns"
        ]


def judged(found: KnownDistances, top: Found) -> Judged:
    """Return the verdict on a fit's delays, and what contradicts its trajectories."""
    layout, optimum = top.optimum.layout, top.optimum
    where = layout.where["delay"]
    own = np.intersect1d(np.arange(where.start, where.stop), layout.free())
    tags = tuple(int(layout.blocks[0].names[k - where.start]) for k in own)
    some = np.ix_(own - where.start, own - where.start)
    by_geometry_alone = top.scene.by_geometry_alone
    covariance = found.covariances["delay"][some] * (ALONE**2 if by_geometry_alone else 1.0)
    information = sum_rows([top.rows, *top.gauge], optimum.x).information + optimum.priors.precision()
    with_truth = with_known_distances(information, layout, own)
    return Judged(
        tags=tags,
        verdict=verdict_on(covariance, with_truth, tags),
        covariance_ns2=covariance,
        absorbed=_absorbed(optimum.covariance[:, own][own], with_truth),
        distance_std_m=_distance_std(top),
        by_geometry_alone=by_geometry_alone,
        sentences=(*_of_motion(top), *_of_tapes(top)),
    )


def with_known_distances(information: Matrix, layout: Layout, own: Ints) -> Floats:
    """Return the covariance of some unknowns (k, k) that a fit with known distances would leave.

    `information` (p, p) is what ranges and priors know; nothing of motion is unknown then.
    """
    others = np.setdiff1d(layout.free(), layout.indices(MOTION))
    some = information[others][:, others]
    dense = some.toarray() if sparse.issparse(some) else some
    place = np.searchsorted(others, own)
    return np.asarray(inverse_of(dense, np.arange(len(others)))[:, place])[place]


def verdict_on(covariance: Floats, with_truth: Floats, tags: Sequence[int]) -> Verdict:
    """Return what delays of a covariance (tags, tags) are determined, beside that of a fit with known distances."""
    if not tags:
        return judge(np.eye(1) * 1e6, [Unknown("delay", "")])
    guess = np.maximum(GUESS_NS, GROWTH / LOOSEST * np.sqrt(np.maximum(np.diag(with_truth), 0.0)))
    information = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) + np.eye(len(covariance)) / PRIOR_NS**2
    unknowns = [Unknown("delay", str(tag), scale) for tag, scale in zip(tags, guess.tolist(), strict=True)]
    return judge((information + information.T) / 2, unknowns, loosest=LOOSEST)


def _absorbed(covariance: Floats, with_truth: Floats) -> float:
    """Return the largest ratio of two covariances over all directions."""
    if not len(with_truth):
        return 1.0
    values, vectors = np.linalg.eigh(with_truth)
    kept = values > 1e-9 * values[-1]
    root = vectors[:, kept] / np.sqrt(values[kept])
    return float(np.linalg.eigvalsh(root.T @ covariance @ root)[-1])


def _distance_std(top: Found) -> float:
    """Return the root mean square of the standard errors of some distances."""
    some = np.unique(np.linspace(0, len(top.rows) - 1, LOOKED_AT).astype(np.int64))
    moved, columns = top.geometry.distances(top.optimum.x, some)[1], top.geometry.columns[some]
    rows = np.zeros((len(some), top.optimum.layout.size))
    np.add.at(rows, (np.arange(len(some))[:, None], columns), moved)
    return float(np.sqrt(np.mean(np.einsum("kp,pk->k", rows, top.optimum.covariance @ rows.T))))


def _of_motion(top: Found) -> Iterator[str]:
    if top.coarse.shows:
        yield (
            f"bodies move faster than control points every {top.motion.places.step_s:.1f} s follow: about "
            f"{100 * top.coarse.motion_m:.0f} cm of their motion is not in the trajectories, and distances are off by "
            "it; fly more calmly"
        )


def _of_tapes(top: Found) -> Iterator[str]:
    """Yield in sentences which distances are not what the fit would say without them (deleted residuals; Cook 1982)."""
    rows = top.known.get("tape")
    if not isinstance(rows, TapeRows):
        return
    left, moved = rows.residuals(top.optimum.x), rows.geometry.distances(top.optimum.x)[1]
    for number, one in enumerate(top.scene.tapes.stated):
        mine = np.flatnonzero(top.scene.tapes.number == number)
        row = np.zeros(top.optimum.layout.size)
        np.add.at(row, rows.geometry.columns[mine], moved[mine] / len(mine))
        share = min(float(row @ (top.optimum.covariance @ row)) / one.sigma_m**2, 1.0)
        off = -float(left[mine].mean())
        if share > TAPE_ALONE or abs(off) < TAPE_SURELY * one.sigma_m * math.sqrt(1 - share):
            continue
        if abs(off) < TAPE_MATTERS_M * (1 - share):
            continue
        deviation, without = off / (one.sigma_m * math.sqrt(1 - share)), -off / (1 - share)
        way = "more" if without > 0 else "less"
        yield (
            f"the distance of tags {one.first} and {one.second}, {one.distance_m:.3f} m, is {100 * abs(without):.0f} "
            f"cm {way} than all else says ({abs(deviation):.0f} standard errors): measure it again"
        )


def curve_uncertainty(found: KnownDistances, known: Calibration) -> Floats:
    """Return what a taken curve's own covariance adds to that of the delays (tags, tags) in ns^2; 0 without one."""
    optimum, rows, model = found.searches[0].optimum, found.searches[0].rows, found.model
    size = len(found.delays)
    if known.uncertainty is None or len(known.uncertainty.bias_m2) != len(known.bias_curve.coefficients):
        return np.zeros((size, size))
    low, high = known.bias_curve.range
    splines = basis(np.clip(model.lifted, low, high), np.array(known.bias_curve.knots))[rows.order]
    # By how much unknowns move with an error of each range: their covariance times what it tells of them.
    linked, at = np.zeros((optimum.layout.size, splines.shape[1])), 0
    for terms, score in rows.terms_and_scores(optimum.x):
        here = slice(at, at + len(score))
        linked += terms.as_matrix(terms.slopes, optimum.layout.size).T @ (score[:, None] * splines[here])
        at = here.stop
    reach = (optimum.covariance @ linked)[optimum.layout.where["delay"]]
    return np.asarray(reach @ np.array(known.uncertainty.bias_m2) @ reach.T)
