"""A recording in the form that checks use, and a quick robust fit whose residuals are tested for one more unknown.

Of a long recording, stretches over its whole time are examined: some hundred thousand exchanges are enough for shares,
medians and errors that last. Stretches are used instead of single exchanges, because only neighbours show errors that
last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calib.data.ranges import Ranges, concatenate
from calib.data.sources import RecordedSource, Source
from calib.estimator.known_distances import FEWEST_RANGES, PILOT, Fitted, fit_likelihood, model_of, robust_fit
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import METRES_A_NS, RangeModel
from calib.estimator.range_rows import RangeRows, Robust, block_of
from calib.estimator.score_tests import REACHED, Family, Slopes, Tested
from calib.estimator.time_blocks import TimeBlocks, time_blocks
from calib.estimator.unknowns import Priors, Unknown
from calib.findings import exceeds
from calib.pairs import pairs_of
from calib.settings import FitSettings
from calib.spread import less_medians
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.contents import Contents
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.recording.summary import differences, repeated_rows, single_reports
from uwblink.twr import Exchanges


@dataclass(frozen=True, kw_only=True)
class RecordingView:
    """A recording in the form that checks use: its exchanges, each once, and their `ranges`, with NaN for unknown
    truth.

    `reported_twice` exchanges were reported by both ends, and `contradictions` are the differences of such reports;
    `doubled` rows repeated another one. A recording is `posed` if true distances come from poses, and `standing` if it
    was made for a survey: arrangements of boards, without poses and true distances. `warming` are the tags that read
    their temperature, `differences` the columns of differences of arrival without stamps.
    """

    name: str
    exchanges: Exchanges
    ranges: Ranges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    reported_twice: int
    contradictions: list[str]
    doubled: int
    posed: bool
    standing: bool
    warming: frozenset[int] = frozenset()
    differences: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @cached_property
    def quick_fit(self) -> QuickFit | None:
        """A quick fit with constants of pairs; None if too few ranges have a true distance."""
        return quick_fit([self])

    @cached_property
    def standing_m(self) -> float | None:
        """The largest change of a pair's distance if none changes by more than 10 cm, else None.

        This is two wavelengths, over which power hardly varies.
        """
        good = np.isfinite(self.ranges.truth_m)
        pair, truth_m = self.ranges.pairs.number[good], self.ranges.truth_m[good]
        span_m = max((float(np.ptp(truth_m[pair == one])) for one in np.unique(pair)), default=np.inf)
        return span_m if span_m < 0.1 else None

    def chosen(self, rows: Bools | Ints) -> RecordingView:
        """Return a view of some exchanges."""
        return replace(self, exchanges=self.exchanges[rows], ranges=self.ranges[rows])

    def less_pairs(self, error_m: Floats) -> Floats:
        """Return errors (n,) minus the median of their pair, NaN for pairs with ten or fewer."""
        good = np.isfinite(error_m)
        pair = pairs_of(self.ranges.initiator[good], self.ranges.target[good]).number
        left = np.full(len(error_m), np.nan)
        left[good] = np.where(np.bincount(pair)[pair] > 10, less_medians(error_m[good], pair), np.nan)
        return left


def view_of(name: str, source: Source) -> RecordingView:
    """Return a source in the form that checks use: each exchange once, with its range and its true distance."""
    part = select_part(source)
    again = repeated_rows(part.exchanges)
    both = part.exchanges[~again]
    reports = single_reports(both)
    e = reports.exchanges
    with np.errstate(all="ignore"):
        ranges = Ranges.from_exchanges(e)
    truth_m, posed = ranges.truth_m, False
    if len(part.poses):
        by_poses = distances_m(part.poses, part.tags, e.initiator, e.target, ranges.valid_ns)
        given = np.isfinite(truth_m)
        # Tables with places of antennas have both, which are then equal.
        apart = np.abs(truth_m - by_poses)[given & np.isfinite(by_poses)]
        posed = not given.any() or (len(apart) > 0 and float(np.median(apart)) < 0.001)
        truth_m = by_poses if posed else truth_m
    return RecordingView(
        name=name,
        exchanges=e,
        ranges=replace(ranges, truth_m=truth_m),
        poses=part.poses,
        tags=list(part.tags),
        faults=list(getattr(part, "faults", ())),
        reported_twice=reports.repeated,
        contradictions=[", ".join(differences(both, a, b)) for a, b in reports.differing.tolist()],
        doubled=int(np.count_nonzero(again)),
        posed=posed,
        differences=getattr(source, "differences", None) or {},
        warming=frozenset((getattr(source, "temperature", None) or {"tag": np.zeros(0)})["tag"].tolist()),
        standing=bool(getattr(source, "arrangements", ())) and not len(part.poses) and not np.isfinite(truth_m).any(),
    )


EXAMINED_EXCHANGES: Final = 160_000
"""Number of exchanges of a recording that are examined: four training flights."""

EXAMINED_STRETCHES: Final = 40
"""Number of stretches of time with these exchanges, evenly spread over a long recording: 20 s each at 200 exchanges per
second, twice the duration of errors in the worlds of `make worlds`."""


def select_part(source: Source) -> Source:
    """Return the part of a source to examine: all of it, or stretches of the exchanges of a long recording."""
    if not isinstance(source, RecordedSource) or source.recording.count("exchanges") <= EXAMINED_EXCHANGES:
        return source
    edges = source.recording.dividing_times("exchanges", EXAMINED_EXCHANGES // EXAMINED_STRETCHES)
    edges[-1] += 1
    chosen = np.unique(np.linspace(0, len(edges) - 2, EXAMINED_STRETCHES).round().astype(int)).tolist()
    parts = [source.recording.exchanges(edges[k], edges[k + 1]) for k in chosen]
    return Contents(exchanges=Exchanges.concatenate(parts), poses=source.poses, tags=source.tags, faults=source.faults)


def examined_part(count: int) -> str:
    """Return a sentence about the part of a recording with `count` exchanges that `examine` uses; "" if it uses all."""
    return (
        f"about {EXAMINED_EXCHANGES} of its {count} exchanges were examined, in {EXAMINED_STRETCHES} stretches over "
        f"all of its time"
        if count > EXAMINED_EXCHANGES
        else ""
    )


@dataclass(frozen=True, kw_only=True)
class QuickFit:
    """A robust fit to the ranges (n,) of all pairs with enough of them, by session and time.

    `rows` (n,) are the rows of the recordings, `error` (n,) is measured minus true, metres. `start` is the robust fit
    of a sample, with the scale of the loss, and `x` (p,) are the unknowns of all.
    """

    rows: Ints
    model: RangeModel
    error: Floats
    start: Fitted
    x: Floats

    @classmethod
    def of(cls, model: RangeModel, error: Floats, rows: Ints, start: Fitted, x: Floats) -> QuickFit:
        """Return a fit to errors (n,), searched for from unknowns (p,)."""
        found = cls(rows=rows, model=model, error=error, start=start, x=x)
        return replace(found, x=found._search(found.ranges, x, steps=20).x)

    def _search(self, ranges: RangeRows, x: Floats, steps: int) -> Optimum:
        priors = Priors(ranges.layout)
        # The roughness of the curve is estimated in the first fit.
        priors.recall(self.start.optimum.priors.by_key())
        return maximize([ranges, *self.start.gauge], priors, x, steps=steps, evidence_steps=0)

    @cached_property
    def ranges(self) -> RangeRows:
        """The ranges (n,) as rows."""
        return self.model.build(self.error, self.start.rows.errors, only=tuple(self.start.optimum.layout.where))[1]

    @property
    def ends(self) -> Ints:
        """The two tags of each range (n, 2)."""
        return np.asarray(self.model.pairs.ends[self.model.pairs.number])

    @cached_property
    def by_pair(self) -> sparse.csr_matrix:
        """Whether each range is of each pair (n, pairs)."""
        number, names = self.model.pairs.number, self.model.pairs.names
        return sparse.csr_matrix((np.ones(len(number)), number, np.arange(len(number) + 1)), (len(number), len(names)))

    @cached_property
    def residual(self) -> Floats:
        """Measured minus fitted (n,), metres."""
        return self.ranges.residuals(self.x)

    @cached_property
    def blocks(self) -> TimeBlocks:
        """Short blocks of time for sums of scores."""
        return time_blocks(self.model.ranges.time_ns, self.model.ranges.session)

    @cached_property
    def slopes(self) -> Slopes:
        """Slopes for tests of more unknowns, with the curvature of the loss, which standard errors need."""
        ranges = replace(self.ranges, errors=replace(cast("Robust", self.start.rows.errors), least=None))
        # Long blocks instead of short ones: errors that last hardly correlate sums over them.
        short = self.blocks
        # Variances of 32 sums are known to a quarter, and errors that last for a hundredth of the recording are within
        # one block.
        count = min(32, short.count)
        number = short.number.astype(np.int64) * count // short.count
        bounds = np.unique(np.append(short.bounds[:-1] * count // short.count, count))
        return Slopes(ranges, self._search(ranges, self.x, steps=1), replace(short, number=number, bounds=bounds))

    @cached_property
    def reflected(self) -> Floats:
        """The probability (n,) that each range is reflected, by the likeliest error model."""
        return self.likeliest.rows.error_slopes(self.likeliest.optimum.x, ()).reflected

    @cached_property
    def likeliest(self) -> Fitted:
        """The fit by the error model of ranges."""
        return fit_likelihood(self.model, self.error, self.start)

    def test(self, derivative: Floats | sparse.csr_matrix) -> Tested:
        """Return the slopes of the residuals by offsets with derivatives (n, k) of ranges."""
        return self.slopes.test(Family(kind="", names=(), derivative=sparse.csr_matrix(derivative)))

    def test_constants(self, more: Floats | None = None) -> Tested:
        """Return the slopes by an offset of each pair, and by `more` (n, k), in metres, with the delays of all tags
        fitted.

        The fit has a constant of each pair, which contains all of these. It is fitted by the error model, because a
        robust mean moves by centimetres if a third of a pair's ranges is reflected.
        """
        optimum, pairs, tags = self.likeliest.optimum, self.model.pairs, self.model.tags
        derivative = (
            self.by_pair if more is None else sparse.csr_matrix(sparse.hstack([self.by_pair, sparse.csr_matrix(more)]))
        )
        fitted = optimum.layout.indices(["delay"])
        family = Family(kind="pair", names=pairs.names, derivative=derivative, fitted=fitted)
        found = Slopes(self.likeliest.rows, optimum, self.blocks).test(family)
        # Constants are in ns.
        metres = (METRES_A_NS - 1) * found.information[:, : len(fitted)] @ optimum.x[fitted]
        ends = np.zeros((len(found.total), len(tags)))
        ends[: len(fitted)] = np.equal.outer(pairs.ends, tags).sum(axis=1)
        taken = found.information @ ends
        left = np.eye(len(ends)) - taken @ np.linalg.pinv(ends.T @ taken, rcond=1e-9, hermitian=True) @ ends.T
        return replace(found, total=found.total + metres).combined(left)

    def offset(
        self, course: Floats, pairs: Floats | None = None, *, tolerance: float = 0.0, tried: int = 1
    ) -> tuple[float, float, QuickFit]:
        """Return an offset of pairs (k,), or of all, with a course (n,), its p-value, and a fit to ranges without it.

        The p-value is for an offset within the tolerance, after `tried` trials. Slopes at zero are not enough for a
        large offset, so it is fitted; its remainder in residuals is not noise, so its standard error is from the fit
        without it.
        """
        pairs = np.ones(len(self.model.pairs.names)) if pairs is None else pairs
        derivative = pairs[self.model.pairs.number] * course
        offset, part = block_of(
            Unknown(kind="offset", names=("",), start=np.zeros(1)),
            np.zeros((len(derivative), 1), dtype=np.int64),
            derivative[:, None],
        )
        kinds = tuple(self.start.optimum.layout.where)
        _, ranges = self.model.build(self.error, self.start.rows.errors, [offset], [part], only=kinds)
        x = self._search(ranges, np.append(self.x, 0.0), steps=20).x
        size = -float(x[-1])
        rest = QuickFit.of(self.model, self.error - size * derivative, self.rows, self.start, x[:-1])
        tested = rest.test(sparse.csr_matrix(self.by_pair.multiply(course[:, None])))
        known, alone = float(pairs @ tested.information @ pairs), np.diag(tested.covariance) * pairs
        # Errors of different pairs hardly correlate, so each pair contributes to their variance (Welch and
        # Satterthwaite).
        variance = max(float(pairs @ tested.covariance @ pairs), float(alone.sum()))
        std = float(np.sqrt(variance)) / known if known > REACHED * tested.whole else np.inf
        freedom = min(tested.lasting.freedom, tested.blocks - 1.0) * alone.sum() ** 2 / max(np.sum(alone**2), 1e-300)
        return size, exceeds(size, std, float(freedom), tolerance=tolerance, tried=tried), rest


def quick_fit(views: Sequence[RecordingView], constants: str = "pair", ranges_a_pair: int = 40) -> QuickFit | None:
    """Fit a curve over power and constants by "pair" or "tag" to recordings, a session each; None if ranges are few.

    Pairs with fewer than `ranges_a_pair` are left out: with 40 a median is known to a fifth of the ranges' spread.
    """
    kept = [_of_common_pairs(view, ranges_a_pair) for view in views]
    if sum(map(len, kept)) < FEWEST_RANGES or not all(map(len, kept)):
        return None
    ranges = concatenate([view.ranges[rows] for view, rows in zip(views, kept, strict=True)])
    model = model_of(ranges, FitSettings(constants=constants), trimmed=False)
    error, kinds = model.ranges.error_m, ("delay", *model.curve_kinds())
    # Convex, so that steps from zero find offsets of any size; its slope is bounded, so that reflections have little
    # more weight than other ranges.
    start = robust_fit(model, error, "soft_l1", None, kinds, sample=PILOT)
    return QuickFit.of(model, error, np.concatenate(kept), start, start.optimum.x)


def _of_common_pairs(view: RecordingView, ranges_a_pair: int) -> Ints:
    """Return the rows with a true distance of pairs that have enough of them, by time."""
    rows = np.flatnonzero(np.isfinite(view.ranges.error_m))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    pair = view.ranges.pairs.number[rows]
    return np.asarray(rows[np.bincount(pair)[pair] >= ranges_a_pair])
