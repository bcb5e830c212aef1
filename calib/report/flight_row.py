"""A flight, fitted and evaluated: the row of a sweep over calibrations."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from calib.data.sources import Data, load_ranges
from calib.evaluation.statistics import evaluate
from calib.fitting.fitting import fit


def evaluate_flight(flight: Data) -> Mapping[str, Any]:
    """Fit a flight and evaluate the fit on it; return the figures as one row.

    `flight` is what `uwbsim.simulate` gives, or one of whatever else `load_ranges` takes. The row has the number of
    `exchanges` that could be used; mean, standard deviation and robust spread in metres of the errors of `raw`,
    `delays` and `full` ranges; `rejected`; and, compared with what was planted, `delays_rms_ns`, `curve_rms_m` and
    `correction_rms_m`, None where nothing was; and `settled`, 0 where the fit stopped before it did. Raises
    `UnanswerableError` where the flight cannot be fitted.
    """
    ranges = load_ranges(flight)
    result = fit(ranges)
    found = evaluate(ranges, result.calibration).to_dict()
    overall, planted = found["overall"], found.get("planted") or {}
    delays = list((planted.get("delay_error_ns") or {}).values())
    errors = product(("raw", "delays", "full"), ("mean_m", "std_m", "robust_std_m"))
    return {
        "exchanges": overall["raw"]["n"],
        **{f"{stage}_{what}": overall[stage][what] for stage, what in errors},
        "settled": int(result.success),
        "rejected": overall["rejected"],
        "delays_rms_ns": float(np.sqrt(np.mean(np.square(delays)))) if delays else None,
        "curve_rms_m": planted.get("curve_rms_m"),
        "correction_rms_m": planted.get("correction_rms_m"),
    }
