"""A quick robust fit of recordings, whose residuals are tested for one more unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from calib.checks.recording_view import RecordingView, pair_ids
from calib.data.ranges import Ranges, concatenate
from calib.estimator.known_distances import FEWEST_RANGES, PILOT, Fitted, Recipe, likeliest, model_of, robust_fit
from calib.estimator.optimize import maximize
from calib.estimator.range_model import RangeModel
from calib.estimator.score_tests import REACHED, Family, Slopes
from calib.estimator.time_blocks import GAP_S, TimeBlocks, time_blocks
from calib.estimator.unknowns import Priors
from calib.range_errors.density import OUTLIERS_OVER_M, error_slopes
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

RANGES_A_PAIR: Final = 40
"""Ranges of a pair, below which its median is not known to a fifth of their spread; it is left out."""

STRETCHES_OF_SCORES: Final = 32
"""Stretches of time over which scores are summed: variances of sums are then known to a quarter, and errors that last
for a hundredth of the recording are in one stretch."""

CLIP: Final = 2.5
"""Spreads beyond which a residual counts no further: a reflection is not to move a mean."""


@dataclass(frozen=True, kw_only=True)
class QuickFit:
    """A robust fit to the ranges (n,) of all pairs with enough of them, by session and time.

    `rows` (n,) are those of each recording, `error` (n,) is measured less true and `residual` (n,) less fitted, metres.
    `time_s` (n,) counts from the first range, without pauses, `host_s` (n,) with them. `slopes` test for more unknowns.
    """

    rows: Ints
    model: RangeModel
    error: Floats
    start: Fitted
    residual: Floats
    time_s: Floats
    host_s: Floats
    slopes: Slopes

    @property
    def pair(self) -> Ints:
        """The number of each range's pair (n,)."""
        return self.model.pairs.number

    @property
    def ends(self) -> Ints:
        """The tags of each pair (k, 2)."""
        return self.model.pairs.ends

    @property
    def session(self) -> Ints:
        """The number of each range's recording (n,)."""
        return self.model.ranges.session

    def less(self, metres: Floats) -> QuickFit:
        """Return a fit to ranges that are shorter by some metres (n,)."""
        return _fitted(self.model, self.error - metres, self.rows)

    @cached_property
    def reflected(self) -> Floats:
        """The probability (n,) that each range is reflected, by the likeliest error model beside all else."""
        found = likeliest(self.model, self.error, self.start)
        values = {name: np.atleast_1d(of) for name, of in found.rows.values(found.optimum.x).items()}
        return error_slopes(found.residuals, values, span_m=OUTLIERS_OVER_M).reflected

    def named(self, pair: int) -> str:
        """Return a pair as it is written."""
        return "-".join(map(str, self.ends[pair].tolist()))

    def of_tag(self, tag: int) -> Bools:
        """Return which ranges (n,) are a tag's."""
        return np.asarray((self.ends == tag).any(axis=1)[self.pair])

    @property
    def clipped(self) -> Floats:
        """The residuals (n,), held within `CLIP` spreads."""
        reach = CLIP * max(robust_spread(self.residual), 1e-4)
        return np.clip(self.residual, -reach, reach)

    def offsets(self, family: Family) -> tuple[Floats, Floats, Floats, float]:
        """Return offsets (k,), what is known of each in 1/m^2, standard errors (k,), and degrees of freedom.

        Errors that last are in the standard errors, which are infinite for offsets of which nothing is known.
        """
        tested = self.slopes.test(family)
        information = np.diag(tested.information)
        known = information > REACHED * tested.whole
        information = np.where(known, information, 1.0)
        std = np.sqrt(np.maximum(np.diag(tested.covariance), 1e-300)) / information
        size = np.where(known, -tested.total / information, 0.0)
        dof = min(tested.lasting.freedom, tested.blocks - 1.0)
        return size, np.where(known, information, 0.0), np.where(known, std, np.inf), dof


def quick_fit(
    views: Sequence[RecordingView], constants: str = "pair", ranges_a_pair: int = RANGES_A_PAIR
) -> QuickFit | None:
    """Fit a curve over power and constants by "pair" or "tag" to recordings, a session each; None if ranges are few."""
    kept = [_of_common_pairs(view, ranges_a_pair) for view in views]
    if sum(map(len, kept)) < FEWEST_RANGES or not all(map(len, kept)):
        return None
    parts = [
        Ranges.from_exchanges(view.exchanges[rows], view.truth_m[rows]) for view, rows in zip(views, kept, strict=True)
    ]
    ranges = parts[0] if len(parts) == 1 else concatenate(parts)
    model = model_of(ranges, Recipe(loss="cauchy", fixed_ns={}, groups={}, constants=constants), trimmed=False)
    error = np.concatenate([view.error_m[rows] for view, rows in zip(views, kept, strict=True)])
    return _fitted(model, error, np.concatenate(kept))


def _fitted(model: RangeModel, error: Floats, rows: Ints) -> QuickFit:
    kinds = ("delay", *model.curve_kinds())
    start = robust_fit(model, error, "cauchy", None, kinds, sample=PILOT)
    layout, whole = model.build(error, start.rows.errors, only=kinds)
    optimum = maximize([whole, *start.gauge], Priors(layout), start.optimum.x, steps=20, evidence_steps=0)
    blocks = _stretches(time_blocks(model.ranges.time_ns, model.ranges.session))
    host_s = model.ranges.time_ns * 1e-9
    steps = np.diff(host_s, prepend=host_s[0]) * (np.diff(model.ranges.session, prepend=0) == 0)
    return QuickFit(
        rows=rows,
        model=model,
        error=error,
        start=start,
        residual=whole.residuals(optimum.x),
        time_s=np.cumsum(np.minimum(steps, GAP_S)),
        host_s=host_s - host_s[0],
        slopes=Slopes(whole, optimum, blocks, np.zeros((0, layout.size))),
    )


def _stretches(blocks: TimeBlocks) -> TimeBlocks:
    """Return long blocks in the place of short ones: sums over them hardly share errors that last."""
    count = min(STRETCHES_OF_SCORES, blocks.count)
    number = blocks.number.astype(np.int64) * count // blocks.count
    bounds = np.unique(np.append(blocks.bounds[:-1] * count // blocks.count, count))
    return TimeBlocks(number=number.astype(np.int32), bounds=bounds, seconds=blocks.seconds)


def _of_common_pairs(view: RecordingView, ranges_a_pair: int) -> Ints:
    """Return the rows with a true distance of pairs that have enough of them, by time."""
    rows = np.flatnonzero(np.isfinite(view.error_m))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    _, pair, count = np.unique(pair_ids(view.exchanges)[rows], return_inverse=True, return_counts=True)
    return np.asarray(rows[count[pair] >= ranges_a_pair])
