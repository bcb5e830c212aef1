"""The result of a fit: a calibration, its origin, and figures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import calib
from calib.calibration.model import Calibration, CalibrationResult
from calib.data.ranges import Ranges
from calib.findings import Finding
from uwblink.arrays import Bools, Floats

if TYPE_CHECKING:
    from calib.figures import Axes


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Ranges (n,) that were held out, and the calibration that was fitted to the others."""

    ranges: Ranges
    calibration: Calibration


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FitResult(CalibrationResult):
    """The result of `fit`: a calibration with its warnings, residuals and figures.

    `ranges` are those that were fitted (n,), `residuals_m` their fully corrected errors, corrected range less truth;
    `inliers` those within three sigmas. `message` states how the search ended; `findings` are known limits and
    doubts, the most serious first. `held_out` is there if `FitSettings.hold_out` asked for it. The `plot_` methods draw
    into matplotlib axes, new ones if none are given, and return them.

    >>> import calib
    >>> result = calib.fit(calib.sample_flight())
    >>> print(repr(result).split(":")[0])
    Fit of 900 ranges of memory
    >>> axes = result.plot_bias()
    """

    calibration: Calibration
    ranges: Ranges
    residuals_m: Floats
    inliers: Bools
    success: bool
    message: str
    findings: list[Finding]
    held_out: HeldOut | None = None

    def headline(self) -> str:
        """Return one line: the fitted ranges, and how the search ended."""
        return f"Fit of {len(self.ranges)} ranges of {self.ranges.source}: {self.message}"

    def correct(self, *columns: Any, **named: Any) -> Any:
        """Correct one range, or arrays of them, as `Calibration.correct` does."""
        return self.calibration.correct(*columns, **named)

    def plot_bias(self, axes: Axes | None = None) -> Axes:
        """Draw medians of the delay-corrected errors over lifted power, in cm, and the fitted curve with its band."""
        return calib.figures.curve_over_power(
            self.ranges, self.calibration.apply(self.ranges), self.calibration, "bias", axes
        )

    def plot_sigma(self, axes: Axes | None = None) -> Axes:
        """Draw robust standard deviations of the errors over lifted power, in cm, and the curve with its band."""
        return calib.figures.curve_over_power(
            self.ranges, self.calibration.apply(self.ranges), self.calibration, "sigma", axes
        )

    def plot_residuals(self, axes: Axes | None = None) -> Axes:
        """Draw a histogram of the errors in cm: raw, with the delays corrected, and fully corrected."""
        return calib.figures.histogram(self.ranges, self.calibration.apply(self.ranges), axes)

    def plot_delays(self, axes: Axes | None = None) -> Axes:
        """Draw the antenna delays in ns with their 95 % intervals."""
        return calib.figures.delays(self.calibration, axes=axes)

    def _repr_html_(self) -> str:
        """Return the calibration as HTML, and a figure of the errors that it leaves, for notebooks."""
        from uwblink.pages.figures import notebook_image

        applied = self.calibration.apply(self.ranges)
        draw = partial(calib.figures.distribution, ranges=self.ranges, applied=applied)
        drawn = notebook_image(draw, "errors of the fitted ranges, raw and corrected")
        return CalibrationResult._repr_html_(self) + drawn
