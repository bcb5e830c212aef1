"""The part of an antenna's delay that depends on direction, as low-order harmonics in the frame of its body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
from numpy.typing import NDArray

from calib.calibration.document import Matrix, Metres, Number, StdM, Tags, joint
from uwblink.arrays import Floats

if TYPE_CHECKING:
    from calib.calibration.model import Calibration
    from calib.data.ranges import Ranges

HARMONICS: Final = 8
"""Number of spherical harmonics of degrees 1 and 2: waves once and twice around, as published patterns have them."""


def harmonics(toward: Floats | NDArray[np.float32]) -> Floats:
    """Return the real spherical harmonics of degrees 1 and 2 (n, 8) at unit vectors (n, 3).

    Their mean over all directions is 0, their mean square 1. The first three are the components of the vector: a wrong
    lever arm has the same effect.
    """
    x, y, z = np.asarray(toward, dtype=np.float64).T
    first = np.sqrt(3) * np.array([x, y, z])
    second = np.sqrt(15) * np.array([x * y, y * z, x * z, (x * x - y * y) / 2, (z * z - 1 / 3) * np.sqrt(3) / 2])
    return np.asarray(np.concatenate([first, second]).T)


def _misfit(pattern: Pattern) -> str:
    sizes = {len(pattern.coefficients_m), len(pattern.centre), *map(len, pattern.covariance_m2)}
    rows = pattern.covariance_m2
    good = sizes == {HARMONICS} and len(rows) == HARMONICS and all(row[k] >= 0 for k, row in enumerate(rows))
    return "" if good else f"expected {HARMONICS} coefficients and centres, and as many rows and columns of covariance"


@dataclass(frozen=True, slots=True)
class Pattern:
    """By how much ranges of some tags are longer in a direction than on average over the fitted ones.

    That is the sum of `coefficients_m` (8,) times `harmonics` less `centre` (8,), of each end; `covariance_m2` (8, 8)
    is that of the coefficients. `rms_m` is the root mean square over the fitted directions, what is unknown included.
    """

    tags: Tags
    coefficients_m: tuple[Metres, ...]
    centre: tuple[Number, ...]
    covariance_m2: Matrix
    rms_m: StdM

    def values(self, toward: Floats | NDArray[np.float32]) -> Floats:
        """Return the harmonics less their centre (n, 8) at unit vectors (n, 3), NaN for unknown ones."""
        return np.asarray(harmonics(toward) - np.array(self.centre))

    def std_m(self, values: Floats) -> Floats:
        """Return the standard error of a sum of the pattern at such values (n, 8), or sums of them."""
        variance = np.einsum("ni,ij,nj->n", values, np.array(self.covariance_m2), values)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


CheckedPattern = Annotated[Pattern, joint(_misfit)]


def patterns_m(calibration: Calibration, ranges: Ranges) -> tuple[Floats, Floats]:
    """Return by how much patterns make ranges longer (n,), and the standard deviation of what is unknown of that (n,).

    Where a direction is not known the first is 0, and the second has the mean square of the pattern.
    """
    longer, variance = np.zeros((2, len(ranges)))
    for pattern in calibration.patterns:
        values = np.zeros((len(ranges), HARMONICS))
        for end, ids in enumerate((ranges.initiator, ranges.target)):
            rows = np.flatnonzero(np.isin(ids, pattern.tags))
            own = pattern.values(ranges.toward[rows, end])
            unknown = np.asarray(np.isnan(own).any(axis=1))
            values[rows] += np.where(unknown[:, None], 0.0, own)
            variance[rows] += np.where(unknown, pattern.rms_m**2, 0.0)
        longer += values @ np.array(pattern.coefficients_m)
        variance += pattern.std_m(values) ** 2
    return longer, np.sqrt(variance)
