"""What calibrations are made of and what they make: groups of tags, uncertainty, corrected ranges."""

from __future__ import annotations

from dataclasses import dataclass, fields

from calib.calibration.json_format import Matrix
from calib.calibration.power_curves import Curve
from uwblink.arrays import Bools, Floats
from uwblink.display import as_text, excerpt


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedRanges:
    """Ranges in three stages, metres, and what is known of them, shape (n,).

    `sigma_m` is the noise of direct ranges. `sigma_total_m` is the standard deviation of all of them, reflected ones
    included, about a mean of `mean_error_m`; `tail_share` is how many such ranges of this pair at this power are
    reflected. `tail_probability` is the same after a look at the range itself, where its true distance is known, and
    `outlier` marks what is then neither noise nor a reflection; elsewhere it equals `tail_share`, and nothing is
    marked. `clamped` marks lifted powers at which the curves had no data and are held constant; `sigma_total_m` grows
    there by what they would go on by. All but `sigma_m` and `clamped` are NaN where a calibration does not say what
    errors are made of (`Calibration.errors`), and without a power.

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


@dataclass(frozen=True, slots=True)
class TagGroup:
    """Tags of one design, and their curves; a range between groups gets the mean of both groups' curves."""

    tags: tuple[int, ...]
    bias_curve: Curve
    sigma_curve: Curve


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """What is known of a fit's errors: covariance matrices as tuples of rows.

    `delays_ns2` (tags, tags) goes with `tags`; `bias_m2` and `sigma_m2` (m, m) go with the coefficients of the curves.
    """

    tags: tuple[int, ...]
    delays_ns2: Matrix
    bias_m2: Matrix
    sigma_m2: Matrix
