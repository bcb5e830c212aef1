"""What a calibration says of devices, as a scenario has it: delays of tags, and one bias curve over lifted power.

The calibration is read by `calib`, which wrote it. This is the one place where `uwbsim` imports `calib`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from uwblink.arrays import Floats
from uwblink.twr import Exchanges
from uwbsim.errors import ScenarioError
from uwbsim.scenario.radio import Spline
from uwbsim.world.radio import ALPHA_DBM

if TYPE_CHECKING:
    from calib import Calibration

CalibrationSource = str | os.PathLike[str] | Mapping[str, Any] | Any
"""A calibration: its file, its JSON as nested tables, or a `calib.Calibration`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownDevices:
    """What a calibration knows, `where` it is from, and its bias curve over the scenario's lifted power."""

    where: str
    calibration: Calibration
    bias: Spline

    def corrected_m(self, exchanges: Exchanges) -> Floats:
        """Return calibrated ranges in metres (n,); raises `ScenarioError` for tags that the calibration lacks."""
        from calib import Ranges

        self.require(np.unique([exchanges.initiator, exchanges.target]).tolist())
        return self.calibration.apply(Ranges.from_exchanges(exchanges)).corrected_m

    def require(self, tags: list[int]) -> None:
        """Raise `ScenarioError` where it does not know all of some tags."""
        missing = [tag for tag in tags if tag not in self.calibration.delays_ns]
        if missing:
            known = ", ".join(map(str, sorted(self.calibration.delays_ns)))
            raise ScenarioError(
                f"{self.where}: no delay for tag {', '.join(map(str, missing))} of the recording; it knows {known}; "
                "fit one from a recording with all tags"
            )


def read_calibration(source: CalibrationSource) -> KnownDevices:
    """Return what a calibration knows of devices; raises `ScenarioError`, one line that names file and key."""
    from calib import CalibError, Calibration, load_calibration

    where = str(source) if isinstance(source, str | os.PathLike) else "calibration"
    try:
        if isinstance(source, Calibration):
            found = source
        elif isinstance(source, Mapping):
            found = Calibration.from_json(json.dumps(source), where)
        elif isinstance(source, str | os.PathLike):
            found = load_calibration(source)
        else:
            raise ScenarioError(f"calibration: found {source!r:.60}, expected a file (.json) or a calibration")
    except CalibError as error:
        raise ScenarioError(str(error)) from error
    if found.groups:
        raise ScenarioError(
            f"{where}: groups: its tags have curves by group, and a scenario has one; fit one curve for all tags"
        )
    if found.pair_offsets:
        raise ScenarioError(
            f"{where}: pair_offsets: it knows constants of pairs, and a scenario has delays of tags; fit delays"
        )
    # A scenario lifts powers about -82 dBm: 10^((p - alpha)/10) of the calibration differs by a factor.
    scale = 10 ** ((found.alpha_dbm - ALPHA_DBM) / 10)
    curve = found.bias_curve
    try:
        bias = Spline(
            knots=tuple(knot * scale for knot in curve.knots), coefficients=curve.coefficients, degree=curve.degree
        )
    except ValidationError as error:
        raise ScenarioError(f"{where}: bias_curve: {error.errors()[0]['msg']}") from error
    return KnownDevices(where=where, calibration=found, bias=bias)
