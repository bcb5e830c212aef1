"""What calibrations are made of, and what they make: groups of tags, constants of pairs, corrected ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Generic, NamedTuple, TypeVar

import numpy as np

from calib.calibration.document import Metres, Number, StdM, number, pair_name
from calib.calibration.power_curves import BiasCurve, SigmaCurve
from calib.data.ranges import Ranges
from calib.errors import BadInputError
from calib.pairs import pairs_of
from uwblink.arrays import Bools, Floats
from uwblink.display import as_text, excerpt
from uwblink.twr import LARGEST_ID

Tags = tuple[Annotated[int, number(0, LARGEST_ID, "the id of a tag", int)], ...]

T = TypeVar("T")

Matrix = tuple[tuple[Number, ...], ...]
"""A matrix as a tuple of rows."""


def matrix_of(values: Floats) -> Matrix:
    """Return an array (n, k) as a tuple of rows."""
    return tuple(map(tuple, values.tolist()))


@dataclass(frozen=True, slots=True)
class TagGroup:
    """Tags of one design, and their curves; a range between groups gets the mean of both groups' curves."""

    tags: Tags
    bias_curve: BiasCurve
    sigma_curve: SigmaCurve


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Covariance matrices of a fit.

    `delays_ns2` (tags, tags) goes with `tags`; `bias_m2` and `sigma_m2` (m, m) go with the coefficients of the curves.
    """

    tags: Tags
    delays_ns2: Matrix
    bias_m2: Matrix
    sigma_m2: Matrix


@dataclass(frozen=True, slots=True)
class PairOffset:
    """By how much the ranges of a pair are too long, and its standard error, in metres."""

    offset_m: Metres
    std_m: StdM


def offset_of(offsets: Mapping[tuple[int, int], PairOffset], first: int, second: int) -> PairOffset:
    """Return the constant of a pair, in either direction; raises `BadInputError` for a pair that has none."""
    try:
        return offsets[min(first, second), max(first, second)]
    except KeyError as error:
        known = ", ".join(pair_name(pair) for pair in sorted(offsets)[:6])
        raise BadInputError(
            f"no constant for pair {pair_name(error.args[0])} in the calibration, which knows {known}"
            f"{' and others' if len(offsets) > 6 else ''}"
        ) from None


def offsets_m(offsets: Mapping[tuple[int, int], PairOffset], ranges: Ranges) -> Floats:
    """Return the constant of each range's pair (n,), zeros where there are none; raises what `offset_of` raises."""
    if not offsets or not len(ranges):
        return np.zeros(len(ranges))
    pairs = pairs_of(ranges.initiator, ranges.target)
    return np.array([offset_of(offsets, *pair).offset_m for pair in pairs.ends.tolist()])[pairs.number]


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedRanges:
    """Ranges in three stages, metres, and what is known of them, shape (n,).

    `sigma_m` is the noise of direct ranges. `sigma_total_m` is the standard deviation of all of them, reflected ones
    included, about a mean of `mean_error_m`; `tail_share` is the share of such ranges of this pair at this power that
    are reflected. `tail_probability` is the same given the range itself, where its true distance is known, and
    `outlier` marks what is then neither noise nor a reflection; elsewhere it equals `tail_share`, and nothing is
    marked. `clamped` marks lifted powers at which the curves had no data and are held constant; `sigma_total_m` grows
    there by the slope of the curve at its end. All but `sigma_m` and `clamped` are NaN where a calibration has no error
    model (`Calibration.errors`), and without a power.

    >>> import calib
    >>> flight = calib.load_ranges(calib.sample_flight())
    >>> corrected = calib.fit(flight).calibration.apply(flight)
    >>> corrected.corrected_m.shape
    (900,)
    """

    raw_m: Floats
    delay_corrected_m: Floats
    corrected_m: Floats
    sigma_m: Floats
    lifted: Floats
    clamped: Bools
    sigma_total_m: Floats
    mean_error_m: Floats
    tail_share: Floats
    tail_probability: Floats
    outlier: Bools

    def __repr__(self) -> str:
        """Return a headline and the first rows, in lines of 79 characters."""
        columns = {column.name: getattr(self, column.name) for column in fields(self)}
        return as_text(f"{len(self.raw_m)} corrected ranges", excerpt(columns))


class CorrectedRange(NamedTuple, Generic[T]):
    """A corrected range and its standard deviation, metres; `clamped` where its power is beyond the curves'.

    `sigma_m` is the noise of a direct range; `sigma_total_m` includes reflections, which are the share `tail_share` of
    the ranges of this pair at this power; both are NaN without an error model. Without a power at either end the range
    has the delays' part only, and its standard deviations are NaN. Each is a number, or an array (n,).
    """

    range_m: T
    sigma_m: T
    clamped: Any
    sigma_total_m: T
    tail_share: T

    def __repr__(self) -> str:
        """Return a headline and the first rows, in lines of 79 characters."""
        columns = {name: np.atleast_1d(values) for name, values in self._asdict().items()}
        return as_text(f"{len(columns['range_m'])} corrected ranges", excerpt(columns))


def columns_of(applied: CorrectedRanges) -> CorrectedRange[Floats]:
    """Return corrected ranges as columns; those without a power have the delays' part only."""
    powered = np.isfinite(applied.lifted)
    return CorrectedRange(
        np.where(powered, applied.corrected_m, applied.delay_corrected_m),
        np.where(powered, applied.sigma_m, np.nan),
        applied.clamped,
        applied.sigma_total_m,
        applied.tail_share,
    )
