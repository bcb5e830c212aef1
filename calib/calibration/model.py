"""Antenna delays, curves and what errors are made of: a frozen value that corrects ranges."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from calib.calibration.applying import corrected_ranges
from calib.calibration.content import CalibrationContent
from calib.calibration.display import as_html, as_text
from calib.calibration.document import fields_of, text_of
from calib.calibration.parts import CorrectedRanges
from calib.calibration.power_curves import basis
from calib.calibration.runtime import CorrectedColumns, CorrectedRange, RangeCorrector
from calib.data.ranges import Ranges
from calib.errors import BadInputError, UnanswerableError
from uwblink.arrays import Floats
from uwblink.output import write_text
from uwblink.text_files import read_text

SCALAR: Final = (float, int, np.generic)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Calibration(CalibrationContent):
    """Antenna delays of tags, in nanoseconds, and the curves of bias and standard deviation.

    A standard error is infinite where the data did not determine the delay. `power_at` says where the bias curve is
    taken: "exchange", at the lifted power of an exchange as `lift` makes it of two; or "reception", at each of the two
    powers, half of either in a range, as curves are published that correct single stamps. With `groups`, each has its
    own curves, and the plain ones are the groups' average, for a look only. `errors` says what the errors of corrected
    ranges are made of, by pair and power; None where that is not known, as in older and in imported calibrations. With
    `pair_offsets`, by pair with the smaller id first, ranges of a pair read longer by its constant, beside what delays
    and curves say, and a pair that has none cannot be corrected. `antenna_delays` is what was programmed into the tags
    when they were recorded, which delays are on top of; empty where that is not known.
    """

    _corrector: RangeCorrector | None = field(default=None, init=False, compare=False)

    def __repr__(self) -> str:
        """Return a table of delays, and of the curves at a few powers."""
        return as_text(self)

    def _repr_html_(self) -> str:
        """Return the same as HTML, for notebooks."""
        return as_html(self)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the calibration as JSON, whole or not at all; replaces a file only with `force`."""
        write_text(Path(path), self.to_json(), force=force)

    def apply(self, ranges: Ranges) -> CorrectedRanges:
        """Correct ranges: c (w_i d_i + w_j d_j) for the delays (ICRA 2023, section III), then the curve.

        Raises `BadInputError` naming the tags that have no delay in this calibration, or the pair that has no constant.
        """
        return corrected_ranges(self, ranges)

    def quantiles(self, ranges: Ranges, shares: Sequence[float] = (0.025, 0.975)) -> Floats:
        """Return the errors (n, k), in metres, below which shares (k,) of the errors of such corrected ranges lie.

        By pair and power; the truth lies with 95 % between a corrected range less its 97.5 % and less its 2.5 %
        quantile. NaN without a power. Raises `UnanswerableError` for a calibration without `errors`, `BadInputError`
        for shares that are not between 0 and 1.

        >>> import calib
        >>> known = calib.fit(calib.sample_flight()).calibration
        >>> calib.load_ranges(calib.sample_flight(seed=2))[:2]
        <Ranges of memory: 2 of tags 1, 2, 3>
        >>> known.quantiles(calib.load_ranges(calib.sample_flight(seed=2))[:2], [0.5]).shape
        (2, 1)
        """
        if self.errors is None:
            raise UnanswerableError("the calibration does not say what errors are made of; fit anew from a recording")
        lifted = self.lifted(ranges)
        found = self.errors.quantiles(shares, lifted, ranges.initiator, ranges.target)
        total = self.errors.total_m(self.errors.shapes(lifted, ranges.initiator, ranges.target))
        return np.asarray(found * np.hypot(1, self.bias_curve.beyond(lifted) / total)[:, None])

    @overload
    def correct(
        self,
        range_m: float,
        fpp1_dbm: float,
        fpp2_dbm: float,
        initiator: int,
        target: int,
        *,
        weights: tuple[float, float] = ...,
    ) -> CorrectedRange: ...

    @overload
    def correct(
        self,
        range_m: Floats,
        fpp1_dbm: ArrayLike,
        fpp2_dbm: ArrayLike,
        initiator: ArrayLike,
        target: ArrayLike,
        *,
        weights: tuple[ArrayLike, ArrayLike] = ...,
    ) -> CorrectedColumns: ...

    def correct(
        self,
        range_m: Any,
        fpp1_dbm: Any,
        fpp2_dbm: Any,
        initiator: Any,
        target: Any,
        *,
        weights: tuple[Any, Any] = (0.5, 0.5),
    ) -> CorrectedRange | CorrectedColumns:
        """Correct one range, or arrays of them (n,): the corrected range and its standard deviations, in metres.

        `range_m` is as the board gives it, powers are in dBm, NaN or 0 where a board has none. One range takes a few
        microseconds, for a robot's loop. `weights` are those of the two delays (`uwblink.twr.delay_weights`); halves
        take both clocks for equally fast (K = 1), wrong by a millionth of the delays, a hundredth of a millimetre at
        most. Equals `apply` otherwise, and raises what that raises.

        >>> import calib
        >>> known = calib.fit(calib.sample_flight()).calibration
        >>> corrected = known.correct(3.0, -85.0, -86.0, 1, 2)
        >>> f"{corrected.range_m:.2f} m, sigma {corrected.sigma_m:.2f} m"
        '2.94 m, sigma 0.03 m'
        """
        given = (range_m, fpp1_dbm, fpp2_dbm, initiator, target, *weights)
        if all([isinstance(value, SCALAR) for value in given]):  # noqa: C419 - a list takes half the time of a generator
            return self._one()(range_m, fpp1_dbm, fpp2_dbm, initiator, target, weights)
        ranges = Ranges.from_arrays(
            range_m, initiator=initiator, target=target, fpp1_dbm=fpp1_dbm, fpp2_dbm=fpp2_dbm, weights=weights
        )
        return CorrectedColumns.of(self.apply(ranges))

    def _one(self) -> RangeCorrector:
        """Return the corrector of single ranges, made when it is first asked for."""
        if self._corrector is not None:
            return self._corrector
        made = RangeCorrector(self)
        object.__setattr__(self, "_corrector", made)
        return made

    def band(self, lifted: Floats, which: Literal["bias", "sigma"]) -> Floats | None:
        """Return the standard error of a curve at lifted powers (n,), in metres; None where it is not known."""
        if self.uncertainty is None:
            return None
        curve = self.bias_curve if which == "bias" else self.sigma_curve
        covariance = np.array(self.uncertainty.bias_m2 if which == "bias" else self.uncertainty.sigma_m2)
        splines = basis(np.clip(lifted, *curve.range), np.array(curve.knots))
        return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", splines, covariance, splines), 0)))

    def to_json(self) -> str:
        """Return the calibration as JSON text."""
        return text_of(self)

    @classmethod
    def from_json(cls, text: str, where: str = "calibration") -> Self:
        """Read a calibration; raises `BadInputError` that says `where`, and which key is wrong."""
        return cls(**fields_of(text, where))


def require_calibration(value: object, parameter: str = "calibration") -> None:
    """Raise `BadInputError` where an argument is no `Calibration`."""
    if isinstance(value, Calibration):
        return
    # What a fit or a survey returns is easily taken for its calibration, and its repr is a page long.
    has_one = isinstance(getattr(value, "calibration", None), Calibration)
    remedy = "give its `.calibration`" if has_one else "`load_calibration` reads one from a file"
    seen = repr(value) if isinstance(value, str | os.PathLike) else type(value).__name__
    raise BadInputError(f"found {seen:.60}, expected a Calibration; {remedy}", parameter=parameter)


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Return the calibration in a JSON file; raises `BadInputError` that names the file, and the key that is wrong.

    >>> import calib
    >>> calib.load_calibration("nowhere.json")
    Traceback (most recent call last):
    ...
    calib.errors.BadInputError: nowhere.json: no such calibration file (.json)
    """
    return Calibration.from_json(read_text(path, BadInputError, "calibration file (.json)"), str(path))
