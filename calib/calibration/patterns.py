"""Dependences of ranges on direction, as spherical harmonics in the frame of the tag's body, and on temperature."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from calib.calibration.document import Celsius, Matrix, Metres, Number, StdM, Tags, joint
from calib.errors import DirectionWarning, TemperatureWarning
from uwblink.arrays import Bools, Floats
from uwblink.display import first_few
from uwblink.errors import warn

if TYPE_CHECKING:
    from calib.calibration.model import Calibration
    from calib.data.ranges import Ranges

HARMONICS: Final = 8
"""Number of spherical harmonics of degrees 1 and 2, one and two periods around: published patterns have these."""


def harmonics(toward: Floats | NDArray[np.float32]) -> Floats:
    """Return the real spherical harmonics of degrees 1 and 2 (n, 8) at unit vectors (n, 3).

    Their mean over all directions is 0 and their mean square is 1. The first three are proportional to the components
    of the vector: an error of the lever arm has the same effect.
    """
    x, y, z = np.asarray(toward, dtype=np.float64).T
    first = np.sqrt(3) * np.array([x, y, z])
    second = np.sqrt(15) * np.array([x * y, y * z, x * z, (x * x - y * y) / 2, (z * z - 1 / 3) * np.sqrt(3) / 2])
    return np.asarray(np.concatenate([first, second]).T)


@dataclass(frozen=True, slots=True)
class Pattern:
    """Dependence of ranges on direction for some tags, relative to the average over the fitted directions.

    Each end of a range contributes the sum of `coefficients_m` (8,) times (`harmonics` - `centre`) (8,);
    `covariance_m2` (8, 8) is the covariance of the coefficients. `rms_m` is the root mean square over the fitted
    directions, uncertainty included.
    """

    covariate: ClassVar[str] = "toward"
    tags: Tags
    coefficients_m: tuple[Metres, ...]
    centre: tuple[Number, ...]
    covariance_m2: Matrix
    rms_m: StdM

    def values(self, toward: Floats | NDArray[np.float32]) -> Floats:
        """Return the harmonics less their centre (n, 8) at unit vectors (n, 3), NaN for unknown ones."""
        return np.asarray(harmonics(toward) - np.array(self.centre))

    def std_m(self, values: Floats) -> Floats:
        """Return the standard error (n,) in metres, at `values` (n, 8), or at sums of the values of two ends."""
        variance = np.einsum("ni,ij,nj->n", values, np.array(self.covariance_m2), values)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _sizes_fit(pattern: Pattern) -> bool:
    rows = pattern.covariance_m2
    sizes = {len(pattern.coefficients_m), len(pattern.centre), len(rows), *map(len, rows)}
    return sizes == {HARMONICS} and all(row[k] >= 0 for k, row in enumerate(rows))


CheckedPattern = Annotated[
    Pattern,
    joint(_sizes_fit, f"expected {HARMONICS} coefficients and centres, and as many rows and columns of covariance"),
]


@dataclass(frozen=True, slots=True)
class TemperatureSlope:
    """Linear dependence of the ranges of some tags on temperature.

    Each end contributes `m_per_k` times its temperature minus `reference_c`; `std_m_per_k` is the standard error of the
    slope. `span_c` are the lowest and the highest fitted temperature.
    """

    covariate: ClassVar[str] = "temperature_c"
    tags: Tags
    m_per_k: Metres
    std_m_per_k: StdM
    reference_c: Celsius
    span_c: tuple[Celsius, Celsius]

    @property
    def coefficients_m(self) -> tuple[float]:
        """The slope as a tuple, like the coefficients of a `Pattern`."""
        return (self.m_per_k,)

    @property
    def centre(self) -> tuple[float]:
        """The reference temperature as a tuple, like the centre of a `Pattern`."""
        return (self.reference_c,)

    @property
    def covariance_m2(self) -> tuple[tuple[float]]:
        """The variance of the slope as a matrix, like the covariance of a `Pattern`."""
        return ((self.std_m_per_k**2,),)

    @property
    def rms_m(self) -> float:
        """The root mean square effect of an end with unknown temperature, in metres.

        All temperatures of the fitted span have the same probability; the slope includes its standard error.
        """
        low, high = (value - self.reference_c for value in self.span_c)
        # The mean square of a uniform distribution from `low` to `high`.
        return math.hypot(self.m_per_k, self.std_m_per_k) * math.sqrt((low**2 + low * high + high**2) / 3)

    def values(self, temperature_c: Floats | NDArray[np.float32]) -> Floats:
        """Return temperatures (n,) minus the reference, (n, 1)."""
        return np.asarray(temperature_c, dtype=np.float64)[:, None] - self.reference_c

    def std_m(self, values: Floats) -> Floats:
        """Return the standard error (n,) in metres, at `values` (n, 1), or at sums of the values of two ends."""
        return np.asarray(self.std_m_per_k * np.abs(values[:, 0]))


CheckedSlope = Annotated[
    TemperatureSlope,
    joint(lambda slope: slope.span_c[0] <= slope.span_c[1], "span_c: expected the lowest before the highest"),
]


def dependences_m(calibration: Calibration, ranges: Ranges) -> tuple[Floats, Floats]:
    """Return the effect of directions and temperatures on ranges (n,), and its standard deviation (n,), in metres.

    For an end with an unknown direction or temperature the effect is 0, and the variance includes the square of `rms_m`
    of the pattern or slope.
    """
    longer, variance = np.zeros((2, len(ranges)))
    every: tuple[Pattern | TemperatureSlope, ...] = (*calibration.patterns, *calibration.temperatures)
    for one in every:
        values = np.zeros((len(ranges), len(one.coefficients_m)))
        for end, ids in enumerate((ranges.initiator, ranges.target)):
            rows = np.flatnonzero(np.isin(ids, one.tags))
            own = one.values(getattr(ranges, one.covariate)[rows, end])
            unknown = np.asarray(np.isnan(own).any(axis=1))
            values[rows] += np.where(unknown[:, None], 0.0, own)
            variance[rows] += np.where(unknown, one.rms_m**2, 0.0)
        longer += values @ np.array(one.coefficients_m)
        variance += one.std_m(values) ** 2
    return longer, np.sqrt(variance)


def lack_direction(calibration: Calibration, ranges: Ranges) -> Bools:
    """Return a mask (n,) of ranges in which a tag with a pattern has an unknown direction."""
    tags = [tag for one in calibration.patterns for tag in one.tags]
    return np.asarray((np.isin(ranges.ends, tags) & np.isnan(ranges.toward).any(axis=2)).any(axis=1))


def warn_of_directions(lacking: int, count: int, source: str) -> None:
    """Give a `DirectionWarning` if `lacking` of `count` ranges have no direction at a tag with a pattern."""
    if lacking:
        warn(
            f"{source}: {100 * lacking / count:.3g} % of the ranges have no known direction: they are corrected "
            "without the patterns over direction, and their total sigma is larger",
            DirectionWarning,
        )


def warn_of_temperatures(calibration: Calibration, ranges: Ranges) -> None:
    """Give a `TemperatureWarning` that names tags with temperatures more than 5 K outside the fitted ones.

    Within 5 K a slope with an error of half of the manual's 2.15 mm/K (DW1000 user manual, section 8.3.1) changes
    ranges by 5 mm, less than their repeatability.
    """
    for low, high in sorted({one.span_c for one in calibration.temperatures}):
        with np.errstate(invalid="ignore"):
            outside = (ranges.temperature_c < low - 5.0) | (ranges.temperature_c > high + 5.0)
        fitted = {tag for one in calibration.temperatures if one.span_c == (low, high) for tag in one.tags}
        if tags := sorted(fitted & {*ranges.ends[outside].tolist()}):
            named = first_few(map(str, tags))
            text = f"tags {named} were used more than 5 K outside the {low:.0f} to {high:.0f} °C at which"
            warn(f"{text} the calibration was fitted; the correction is extrapolated", TemperatureWarning)
