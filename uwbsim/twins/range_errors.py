"""Calibrations for twins, and the error model of ranges that `calib.fit` fits to a flight.

This is the only module of `uwbsim` that imports `calib`. The error model is that of fits: direct ranges with normal
noise, reflections by pair, outliers. Durations of reflections are estimated from autocovariances.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import restating
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import Exchanges, intervals
from uwbsim.errors import ScenarioError, TooFewDataError
from uwbsim.scenario.loading import validated
from uwbsim.scenario.radio import Spline, TwoStateMultipath
from uwbsim.twins.flight import TwinFlight, lasting

if TYPE_CHECKING:
    from calib import Calibration

CalibrationSource = str | os.PathLike[str] | Mapping[str, Any] | Any
"""A calibration: its file, its JSON as nested tables, or a `calib.Calibration`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownDevices:
    """A calibration, its source `where`, and its bias curve over the lifted power of scenarios."""

    where: str
    calibration: Calibration
    bias: Spline

    def corrected_m(self, exchanges: Exchanges) -> Floats:
        """Return calibrated ranges in metres (n,)."""
        from calib import Ranges

        return self.calibration.apply(Ranges.from_exchanges(exchanges)).corrected_m

    def require(self, tags: list[int]) -> None:
        """Raise `ScenarioError` unless the calibration has a delay for each of these tags."""
        missing = [tag for tag in tags if tag not in self.calibration.delays_ns]
        if missing:
            known = ", ".join(map(str, sorted(self.calibration.delays_ns)))
            raise ScenarioError(
                f"{self.where}: no delay of tag {', '.join(map(str, missing))} of the recording; it has delays of "
                f"{known}; fit one from a recording with all tags"
            )


def read_calibration(source: CalibrationSource) -> KnownDevices:
    """Read a calibration; raises `ScenarioError` that names file and key."""
    from calib import CalibError, Calibration, load_calibration

    where = str(source) if isinstance(source, str | os.PathLike) else "calibration"
    if not isinstance(source, str | os.PathLike | Mapping | Calibration):
        raise ScenarioError(f"calibration: found {source!r:.60}, expected a file (.json) or a calibration")
    with restating(ScenarioError, CalibError):
        known = Calibration.from_json(json.dumps(source), where) if isinstance(source, Mapping) else source
        found = known if isinstance(known, Calibration) else load_calibration(known)
    for key, text in (
        ("groups", "it has curves by group, but a scenario has only one; fit one curve for all tags"),
        ("pair_offsets", "it has constants of pairs, but a scenario has delays of tags; fit delays"),
    ):
        if getattr(found, key):
            raise ScenarioError(f"{where}: {key}: {text}")
    # Scenarios lift powers with alpha = -82 dBm. With another alpha, 10^((p - alpha)/10) differs by this factor.
    scale, curve = 10 ** ((found.alpha_dbm + 82.0) / 10), found.bias_curve
    knots = tuple(knot * scale for knot in curve.knots)
    table = {"knots": knots, "coefficients": curve.coefficients, "degree": curve.degree}
    bias = validated(Spline, table, f"{where}: bias_curve")
    return KnownDevices(where=where, calibration=found, bias=bias)


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedRangeErrors:
    """The errors of calibrated ranges; lengths are in metres.

    `delays_ns` are changes of the calibration's delays by tag that fit the flight. `direct_std_m` is the standard
    deviation of direct ranges in addition to the noise of receive stamps; `share` is the share of reflected ranges,
    `mean_excess_m` their mean detour, and `excess_shape` the shape of a gamma distribution with the mean and variance
    of the detours. `life_s` is the duration of reflections. `pair_share`, `pair_excess_m` and `pair_life_s` are those
    of pairs (pairs,), shrunk towards the values of all pairs. If the recording does not determine durations, `life_s`
    is None and `pair_life_s` NaN. `reflected` (n,) are the probabilities of a reflection.
    """

    delays_ns: dict[int, float]
    direct_std_m: float
    share: float
    mean_excess_m: float
    excess_shape: float
    life_s: float | None
    pair_share: Floats
    pair_excess_m: Floats
    pair_life_s: Floats
    reflected: Floats


def fit_range_errors(flight: TwinFlight, receive_noise_s: Floats) -> FittedRangeErrors:
    """Fit the errors of ranges, given the noise of receive stamps (n,) in seconds, zero if unknown.

    The fit uses equal powers: reflections are weaker than direct paths, so a second bias curve, in addition to that of
    the calibration, would follow reflections. Raises `TooFewDataError` if `calib.fit` raises an error.
    """
    from calib import CalibError, Ranges, fit

    x, pair, count = flight.exchanges, flight.pair, len(flight.pairs)
    ranges = Ranges.from_arrays(
        flight.distance_m + flight.residual_m,
        initiator=x.initiator,
        target=x.target,
        fpp1_dbm=-82.0,
        truth_m=flight.distance_m,
        time_ns=x.time_ns,
        source=flight.where,
    )
    with restating(TooFewDataError, CalibError):
        # The twin has the errors of this recording, so errors that differ between recordings are left out.
        found = fit(ranges, between_m=0.0).calibration
    if found.errors is None:
        raise TooFewDataError(f"{flight.where}: the errors of its ranges are all equal")
    applied = found.apply(ranges)
    shapes = found.errors.shapes(applied.lifted, x.initiator, x.target)
    excess, reflected = found.errors.least_m + shapes.detour_m, applied.tail_probability
    mean, shape, share = TwoStateMultipath(model="two-state").mean_excess_m, 1.0, np.zeros(count)
    pair_excess, life, pair_life = np.full(count, mean), None, np.full(count, np.nan)
    # With fewer than five ranges that are more likely reflected than direct, assume no reflections (a judgement).
    if np.count_nonzero(reflected > 0.5) < 5:
        reflected = np.zeros(len(x))
    else:
        mean = float(np.average(excess, weights=reflected))
        square = float(np.average(found.errors.square_m2(shapes.detour_m), weights=reflected))
        shape = mean**2 / (square - mean**2)
        number = np.bincount(pair, minlength=count)
        share, pair_excess = (np.bincount(pair, v, count) / number for v in (shapes.tail_share, excess))
        _, life = lasting(flight.time_s, pair, reflected)
        if life is not None:
            pair_life = _lives(flight, reflected, life, share)
    white = range_noise_m(flight, receive_noise_s)
    # Skew causes errors of ranges with two messages that look like delays. The twin simulates skew, so leave them out.
    from_delays = len(flight.row.messages) > 2
    return FittedRangeErrors(
        delays_ns={tag: delay if from_delays else 0.0 for tag, delay in found.delays_ns.items()},
        direct_std_m=float(np.sqrt(np.maximum(np.mean(shapes.noise_m**2 - white**2), 0.0))),
        share=float(reflected.mean()),
        mean_excess_m=mean,
        excess_shape=shape,
        life_s=life,
        pair_share=share,
        pair_excess_m=pair_excess,
        pair_life_s=pair_life,
        reflected=reflected,
    )


def _lives(flight: TwinFlight, reflected: Floats, life_s: float, share: Floats) -> Floats:
    """Return the durations of reflections of pairs (pairs,) in seconds, shrunk towards that of all pairs.

    The logarithm of an estimated duration has the variance 2 / spells. The variance between pairs is the variance of
    the estimates minus the mean of that.
    """
    spells = np.maximum(2 * share * (1 - share) * flight.time_s[-1] / life_s, 1e-9)
    off, estimated = np.zeros(len(share)), np.flatnonzero(spells >= 6)
    for k in estimated:
        rows = np.flatnonzero(flight.pair == k)
        _, own = lasting(flight.time_s[rows], np.zeros(len(rows), dtype=np.int64), reflected[rows])
        off[k] = np.log((own or life_s) / life_s)
    between = max(np.var(off[estimated]) - np.mean(2 / spells[estimated]), 0.0) if len(estimated) > 2 else 0.0
    return np.asarray(life_s * np.exp(off * between / (between + 2 / spells)))


def range_noise_m(flight: TwinFlight, receive_noise_s: Floats) -> Floats:
    """Return the standard deviation of ranges (n,) in metres by the noise s of receive stamps (n,) in seconds.

    It is c s sqrt((1 + r + r^2) / 2) with r = dt32 / dt53, 0 for two messages (docs/theory.md).
    """
    spans, ratio = intervals(flight.exchanges), np.zeros(len(flight))
    if len(flight.row.messages) > 2:
        ratio = spans.dt32 / np.maximum(spans.dt53, 1.0)
    return np.asarray(SPEED_OF_LIGHT * receive_noise_s * np.sqrt((1 + ratio + ratio**2) / 2))
