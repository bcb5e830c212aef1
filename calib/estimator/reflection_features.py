"""Features of receptions that change the log odds of a reflection, as unknowns of the error model.

The slopes are fitted beside all else: no range is labelled as reflected beforehand, its likelihood is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from calib.calibration.error_model import ErrorModel, FeatureSlope
from calib.data.ranges import FEATURES, Ranges
from calib.estimator.grouped_errors import logarithms
from calib.estimator.range_rows import Part
from calib.estimator.unknowns import Prior, Unknown
from uwblink.arrays import Floats

UNIT_OF_PRIOR = np.array([3.0, 2.0])
"""Changes of `FEATURES` (dB, taps) by which the odds of a reflection may change by a factor of e: the standard
deviation of the prior of a slope is 1 for each. A judgement; makers of chips take 6 dB for a sign of a reflection
(APS006, part 3), two of these."""


@dataclass(frozen=True, kw_only=True)
class ReflectionFeatures:
    """The features of ranges that vary, by `number` among `FEATURES` (k,): in `values` (n, k + 1) units from `centre`.

    They are 0 where one is unknown; the last column is 1 where all are. `bounds` (2, k) are the least and the largest.
    """

    number: list[int]
    centre: Floats
    bounds: Floats
    values: Floats

    @classmethod
    def of(cls, ranges: Ranges) -> ReflectionFeatures | None:
        """Return the features of ranges, None where none varies."""
        columns = (ranges.features[:, k].astype(np.float64) for k in range(len(FEATURES)))
        varied = {k: one for k, one in enumerate(columns) if len(np.unique(one[np.isfinite(one)])) > 1}
        if not varied:
            return None
        found = np.column_stack(list(varied.values()))
        centre, bounds = np.nanmean(found, axis=0), np.array([np.nanmin(found, axis=0), np.nanmax(found, axis=0)])
        unknown = ~np.isfinite(found).any(axis=1)
        values = np.column_stack([np.nan_to_num((found - centre) / UNIT_OF_PRIOR[[*varied]]), unknown])
        return cls(number=[*varied], centre=centre, bounds=bounds, values=values)

    def block(self) -> tuple[Unknown, Part]:
        """Return the slopes of the log odds as unknowns, and the part that ranges have in them."""
        names = (*(FEATURES[k] for k in self.number), "unknown")
        unknown = logarithms("odds of feature", names, np.zeros(len(names)), Prior.of_deviation(1.0))
        return unknown, Part(
            parameter="odds", kind="odds of feature", columns=np.arange(len(names))[None], values=self.values
        )

    def state(self, stated: ErrorModel, slopes: Floats, share: Floats) -> ErrorModel:
        """Return an error model with the features whose `slopes` (k + 1,) were fitted.

        `share` (n,) are the shares of reflections by the model without them, with features at their centre. The model's
        shares become those of ranges of which no feature is known, with the same mean over all ranges.
        """
        base, mean = logit(share), float(np.mean(expit(logit(share) + self.values @ slopes)))
        shift = float(brentq(lambda more: np.mean(expit(base + more)) - mean, -50.0, 50.0))
        features = {
            FEATURES[k]: FeatureSlope(float(slope / UNIT_OF_PRIOR[k]), float(centre), (float(low), float(high)))
            for k, slope, centre, low, high in zip(self.number, slopes, self.centre, *self.bounds, strict=False)
        }
        tail_share = tuple(np.clip(expit(logit(stated.tail_share) + shift), 1e-4, 1 - 1e-4).tolist())
        return replace(stated, tail_share=tail_share, features=features, known_log_odds=-shift)
