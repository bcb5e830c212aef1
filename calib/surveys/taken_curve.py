"""A curve over power that is taken over from another calibration, where a survey's powers say too little of one."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from calib.calibration.model import Calibration, load_calibration, require_calibration
from calib.calibration.power_curves import ALPHA_DBM, Curve, basis
from calib.errors import BadInputError, UnanswerableError
from calib.surveys.adjustment import Adjusted, information_at
from calib.surveys.pair_means import LIFT, PairMeans
from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True)
class TakenCurve:
    """A curve, the covariance (m, m) of its coefficients in m^2, and the lifted powers at which it holds."""

    curve: Curve
    covariance_m2: Floats

    def design(self, lifted: Floats) -> Floats:
        """Return the derivatives (n, m) of the curve at lifted powers with respect to its coefficients."""
        return basis(np.clip(lifted, *self.curve.range), np.array(self.curve.knots))


def taken_curve(curve_from: Calibration | str | os.PathLike[str] | None) -> TakenCurve | None:
    """Return the curve of a calibration, or of its file.

    Raises `BadInputError` for one of another lifting, and for one that has no curve.
    """
    if curve_from is None:
        return None
    known = load_calibration(curve_from) if isinstance(curve_from, str | os.PathLike) else curve_from
    require_calibration(known, "curve_from")
    if known.lift != LIFT or known.alpha_dbm != ALPHA_DBM:
        text = f"it lifts powers by {known.lift} above {known.alpha_dbm:g} dBm, expected {LIFT} above {ALPHA_DBM:g} dBm"
        raise BadInputError(text, parameter="curve_from")
    if known.bias_curve.flat:
        raise BadInputError("it has no curve over power", parameter="curve_from")
    size = len(known.bias_curve.coefficients)
    spread = np.zeros((size, size)) if known.uncertainty is None else np.array(known.uncertainty.bias_m2)
    return TakenCurve(known.bias_curve, spread)


def corrected(means: PairMeans, taken: TakenCurve) -> tuple[PairMeans, list[str]]:
    """Return the means less the curve, and what to say of powers that it was not fitted at.

    Raises `UnanswerableError` where powers lack.
    """
    if not np.isfinite(means.lifted).all():
        raise UnanswerableError("pairs have no power, so no curve can be taken off (`curve_from`)")
    beyond = int(np.count_nonzero(~taken.curve.inside(means.lifted)))
    said = [f"{beyond} pairs have powers that the curve taken over was not fitted at"] if beyond else []
    return replace(means, range_m=means.range_m - taken.curve(means.lifted)), said


def widened_by(found: Adjusted, taken: TakenCurve) -> Adjusted:
    """Return an adjustment whose covariance has what the curve's own errors do to delays and places."""
    rows = found.network.jacobian(found.x)[: len(found.network.means)] / found.std_m[: len(found.network.means), None]
    information = information_at(found.network, found.x, found.std_m, found.curve_std_m, guess=True)
    design = taken.design(found.network.means.lifted) / found.std_m[: len(found.network.means), None]
    gain = np.linalg.solve(information, rows.T @ design)
    return replace(found, open_m2=found.open_m2 + gain @ taken.covariance_m2 @ gain.T)
