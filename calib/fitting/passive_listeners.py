"""Antenna delays from overheard exchanges only, without ranges: the delay of each target as its listeners measure
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.applying import heard_receptions, reception_bias_m
from calib.calibration.model import Calibration
from calib.data.ranges import Ranges
from calib.estimator.grouped_errors import fit_grouped_errors
from calib.estimator.range_model import METRES_A_NS

MIN_OF_DELAY: Final = 50
"""Ranges or receptions for the delay of one tag: their mean is known to a seventh of the noise, 0.03 ns."""


@dataclass(frozen=True, slots=True)
class OverheardDelay:
    """The delay of a target as its listeners see it, in ns: centre of the core, its standard error, how many heard."""

    delay_ns: float
    std_ns: float
    count: int


def heard_delays(ranges: Ranges, calibration: Calibration) -> dict[int, OverheardDelay]:
    """Return delays by tag from the arrivals of ranges; empty if there are none.

    The bias curve of the calibration corrects each of the three receptions (`calib.data.arrivals`).
    """
    arrivals = ranges.arrivals
    if arrivals is None:
        return {}
    bias_m = reception_bias_m(calibration, heard_receptions(ranges))
    target, of_range = ranges.target[arrivals.exchange], ranges.error_m[arrivals.exchange]
    error_m = arrivals.error_m + of_range - bias_m
    found = {}
    for tag in np.unique(target).tolist():
        values = error_m[(target == tag) & np.isfinite(error_m)]
        if len(values) >= MIN_OF_DELAY:
            # Reflections lengthen three receptions: two of them the difference of arrival, and one shortens it. The
            # balance is a tail on the long side, as of ranges.
            parts = fit_grouped_errors([values])
            centre_ns, std_ns = -float(parts.centre_m[0]) / METRES_A_NS, float(parts.centre_std_m[0]) / METRES_A_NS
            found[int(tag)] = OverheardDelay(centre_ns, std_ns, len(values))
    return found
