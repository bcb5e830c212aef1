"""Differences of arrival as rows of a fit, beside the ranges of the same exchanges.

Their errors do not correlate with those of the ranges (`calib.data.arrivals`). A range depends on half the sum of both
delays, and a difference of arrival on half their difference: rows of both kinds determine different combinations of
delays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.calibration.power_curves import lift
from calib.data.arrivals import Arrivals
from calib.estimator.grouped_errors import error_unknowns, logarithms, scattered
from calib.estimator.range_model import METRES_A_NS, OFFSETS, RangeModel, SplineValues
from calib.estimator.range_rows import OF_ERRORS, RESIDUAL, Errors, Mixture, Part, RangeRows
from calib.estimator.time_blocks import TimeBlocks, lasting_in_pairs
from calib.estimator.unknowns import Layout, Prior, Unknown
from calib.pairs import pairs_of
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

HEARD = "heard "
"""Prefix of the kinds of unknowns that only differences of arrival have."""

OFFSET_OF_PATH, PATH_SIGNS = f"{HEARD}offset of path", np.array([-1.0, 1.0])
"""Constants of the paths from initiator and target to a listener, and how they enter a difference of arrival."""


@dataclass(frozen=True, kw_only=True)
class ArrivalModel:
    """Unknowns and parts of differences of arrival (n,); `residual` (n,) is in metres, for unknowns of zero.

    `exchange` (n,) is the row of the range of each difference, `listener` (n,) a number among `listeners`, `targets`
    (n,) the tags that respond, `path` (n, 2) the numbers among `paths` of those from initiator and target to the
    listener. Each row has the weight 1/`design_effect` of an independent row.
    """

    residual: Floats
    exchange: Ints
    listener: Ints
    listeners: tuple[str, ...]
    key: Ints
    unknowns: tuple[Unknown, ...]
    parts: tuple[Part, ...]
    targets: Ints
    paths: tuple[str, ...]
    path: Ints
    design_effect: float = 1.0

    @classmethod
    def of(cls, model: RangeModel) -> ArrivalModel | None:
        """Return the model of the arrivals of a model's ranges, None where there are none."""
        ranges, arrivals = model.ranges, model.ranges.arrivals
        if arrivals is None or not len(arrivals):
            return None
        parts = list[Part]()
        if model.curve is not None:
            powers = (ranges.fpp1_dbm[arrivals.exchange], arrivals.response_dbm, arrivals.poll_dbm)
            lifted = [lift(power, model.settings.alpha_dbm) for power in powers]
            low, high = model.span
            good = np.logical_and.reduce([(one >= low) & (one <= high) for one in lifted])
            arrivals, lifted = arrivals[good], [one[good] for one in lifted]
            if not len(arrivals):
                return None
            parts += _curve_parts(model, model.curve, arrivals, lifted)
        row = arrivals.exchange
        ends = np.column_stack([ranges.initiator[row], ranges.target[row]])
        weights = np.column_stack([-ranges.weight_initiator[row], 1 - ranges.weight_target[row]])
        tags = np.searchsorted(model.tags, ends)
        parts.append(Part(parameter=RESIDUAL, kind="delay", columns=tags, values=METRES_A_NS * weights))
        listeners, listener = np.unique(arrivals.listener, return_inverse=True)
        pairs = pairs_of(ends.ravel(), np.repeat(arrivals.listener, 2))
        paths, number = tuple(f"path {name}" for name in pairs.names), pairs.number.reshape(-1, 2)
        signs = np.broadcast_to(PATH_SIGNS, number.shape)
        parts.append(Part(parameter=RESIDUAL, kind=OFFSET_OF_PATH, columns=number, values=signs))
        key = np.unique(ends[:, 0] << 32 | ends[:, 1] << 16 | arrivals.listener, return_inverse=True)[1]
        return cls(
            residual=arrivals.error_m,
            exchange=row,
            listener=listener,
            listeners=tuple(map(str, listeners.tolist())),
            key=key,
            unknowns=(scattered(OFFSET_OF_PATH, paths, OFFSETS),),
            parts=tuple(parts),
            targets=ends[:, 1],
            paths=paths,
            path=number,
        )

    def error_model(self, residual: Floats) -> tuple[Mixture, list[Unknown], list[Part]]:
        """Return the error model with its unknowns and parts, started from robust spreads of residuals (n,)."""
        spread = max(robust_spread(residual), 1e-3)
        unknowns, parts = error_unknowns(spread, self.listeners, self.listener, whose="listener")
        side = logarithms("late share", ("",), np.zeros(1), Prior.of_deviation(1.0))
        everyone = np.zeros((1, 1), dtype=np.int64)
        parts.append(Part(parameter="side", kind="late share", columns=everyone))
        return (
            Mixture(parameters=(*OF_ERRORS, "side"), dispersion=self.design_effect),
            [replace(one, kind=HEARD + one.kind) for one in (*unknowns, side)],
            [replace(one, kind=HEARD + one.kind) for one in parts],
        )

    def rows(self, layout: Layout, errors: Errors, more: Sequence[Part] = ()) -> RangeRows:
        """Return the rows of all differences of arrival, with the parts whose unknowns a layout has."""
        used = [part for part in (*self.parts, *more) if part.kind in layout.where]
        return RangeRows.of(self.residual, self.key, used, errors, layout, exchange=self.exchange)

    def with_weight(self, own: Floats, of_ranges: Floats, pairs: Ints, blocks: TimeBlocks) -> ArrivalModel:
        """Return the model with the weight of a difference of arrival relative to a range.

        `own` (n,) and `of_ranges` (m,) are slopes by residuals, `pairs` (m,) the numbers of the ranges' pairs. Sums of
        slopes vary more than sums over independent rows. They vary more by target than by pair, because listeners share
        receptions and receive a reflection in every exchange while it lasts. The weight of rows is divided by the ratio
        of both (Kish's design effects).
        """
        target = np.unique(self.targets, return_inverse=True)[1]
        lasting = lasting_in_pairs(own, target, replace(blocks, number=blocks.number[self.exchange]))
        return replace(self, design_effect=max(lasting / lasting_in_pairs(of_ranges, pairs, blocks), 1.0))


def _curve_parts(model: RangeModel, spline: SplineValues, arrivals: Arrivals, lifted: list[Floats]) -> Iterator[Part]:
    """Yield the bias over power of three receptions minus the range's bias: weights of all splines of each curve."""
    ranges, row = model.ranges, arrivals.exchange
    i, j, k = ranges.initiator[row], ranges.target[row], arrivals.listener
    of_range = SplineValues(knots=spline.knots, values=spline.values[row], first=spline.first[row])
    at_target, response, poll = (SplineValues.at(one, spline.knots) for one in lifted)
    received = [(1.0, at_target, (i, j)), (1.0, response, (j, k)), (-1.0, poll, (i, k)), (-1.0, of_range, (i, j))]
    groups: list[tuple[int, ...] | None] = [*model.settings.groups.values()] or [None]
    for kind, group in zip(model.curve_kinds(), groups, strict=True):
        whole = np.zeros((len(row), spline.size))
        for sign, one, ends in received:
            share = sign if group is None else sign * 0.5 * sum(np.isin(end, group).astype(float) for end in ends)
            np.add.at(whole, (np.arange(len(row))[:, None], one.columns), one.values * np.reshape(share, (-1, 1)))
        yield Part(parameter=RESIDUAL, kind=kind, columns=np.arange(spline.size)[None], values=-whole)
