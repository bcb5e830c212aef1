"""What a calibration says: its numbers and words, before anything is done with them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.calibration.error_model import ErrorModel
from calib.calibration.pair_offsets import PairOffset
from calib.calibration.parts import TagGroup, Uncertainty
from calib.calibration.power_curves import Curve, lifted_power
from calib.data.ranges import Ranges
from uwblink.arrays import Floats
from uwblink.recording.antenna_delays import AntennaDelays


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CalibrationContent:
    """The fields of a `Calibration`, which says what they mean; what shows, writes and applies one needs no more."""

    delays_ns: dict[int, float]
    delays_std_ns: dict[int, float]
    loss: str
    scale_ns: float
    lift: str
    alpha_dbm: float
    speed_of_light: float
    bias_curve: Curve
    sigma_curve: Curve
    provenance: dict[str, Any] = field(default_factory=dict)
    uncertainty: Uncertainty | None = None
    groups: dict[str, TagGroup] = field(default_factory=dict)
    power_at: str = "exchange"
    errors: ErrorModel | None = None
    pair_offsets: dict[tuple[int, int], PairOffset] = field(default_factory=dict)
    antenna_delays: AntennaDelays = field(default_factory=dict)

    @property
    def stopped(self) -> bool:
        """Whether the fit behind it stopped before it settled, so that delays and intervals are not final."""
        return self.provenance.get("converged") is False

    @property
    def needs_power(self) -> bool:
        """Whether ranges without any power cannot be corrected whole."""
        curves = [self.bias_curve, self.sigma_curve]
        curves += [curve for group in self.groups.values() for curve in (group.bias_curve, group.sigma_curve)]
        return not all(curve.flat for curve in curves)

    def lifted(self, ranges: Ranges) -> Floats:
        """Return the lifted power of each range, as this calibration defines it."""
        lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, self.lift, self.alpha_dbm)
        # Where nothing depends on power, a range without any is as good as another.
        return lifted if self.needs_power else np.where(np.isfinite(lifted), lifted, self.bias_curve.range[0])
