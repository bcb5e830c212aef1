"""From an adjusted network to what a survey returns: the calibration, what it rests on, places with covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

import uwblink
from calib.calibration.model import Calibration
from calib.calibration.parts import Matrix, Uncertainty
from calib.calibration.power_curves import ALPHA_DBM, DEGREE, Curve, flat_curve
from calib.information import Verdict
from calib.surveys.adjustment import Adjusted
from calib.surveys.frames import framed
from calib.surveys.gathering import Gathered
from calib.surveys.pair_means import LIFT
from calib.surveys.power import PowerModel
from calib.surveys.scales import M_PER_NS
from calib.surveys.surveyed import SurveyedArrangement, SurveyedBoard
from calib.surveys.taken_curve import TakenCurve
from uwblink.arrays import Floats
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT


def calibration_of(
    gathered: Gathered,
    found: Adjusted,
    verdict: Verdict,
    widened: float,
    warnings: list[str],
    more: Mapping[str, Any],
    taken: TakenCurve | None,
) -> Calibration:
    """Return the calibration: delays that are determined, the curve, how well both are known and what they rest on.

    `more` goes into its provenance; a curve that was `taken` over is its curve.
    """
    network = found.network
    known = verdict.determined
    tags = [tag for tag, good in zip(network.tags, known.tolist(), strict=True) if good]
    delays = dict(zip(network.tags, (found.x[network.delay_columns] / M_PER_NS).tolist(), strict=True))
    std = dict(zip(network.tags, (verdict.std * widened).tolist(), strict=True))
    pinned = dict.fromkeys(network.fixed_m, 0.0)
    covariance = verdict.covariance[np.ix_(known, known)] * widened**2
    noise = float(np.sqrt(np.average(network.means.noise_m**2, weights=network.means.count)))
    sigma = math.hypot(noise, found.pair_std_m)
    curve, curve_covariance, span = _curve(found, widened, taken)
    variance = np.full((DEGREE + 1,) * 2, (0.5 * sigma / math.sqrt(max(found.freedom, 1.0))) ** 2)
    return Calibration(
        delays_ns={tag: delays[tag] for tag in tags},
        delays_std_ns={tag: std[tag] for tag in tags} | {t: s for t, s in pinned.items() if t in tags},
        loss="gaussian",
        scale_ns=noise / M_PER_NS,
        lift=LIFT,
        alpha_dbm=ALPHA_DBM,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=curve,
        sigma_curve=flat_curve(sigma, span),
        provenance=_provenance(gathered, found, verdict, warnings, curve) | dict(more),
        uncertainty=Uncertainty(tuple(tags), _rows(covariance), _rows(curve_covariance), _rows(variance)),
        antenna_delays=known_delays(gathered.antenna_delays, tags),
    )


def _curve(found: Adjusted, widened: float, taken: TakenCurve | None) -> tuple[Curve, Floats, tuple[float, float]]:
    """Return the curve, the covariance of its coefficients, and the lifted powers between which it holds."""
    if taken is not None:
        return taken.curve, taken.covariance_m2, taken.curve.range
    power: PowerModel | None = found.network.power
    lifted = found.network.means.lifted
    if power is None:
        known = lifted[np.isfinite(lifted)]
        span = (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)
        return flat_curve(0.0, span), np.zeros((DEGREE + 1,) * 2), span
    columns = found.network.curve_columns
    span = (float(power.knots[0]), float(power.knots[-1]))
    coefficients = tuple(found.x[columns].tolist())
    covariance = found.covariance()[np.ix_(columns, columns)] * widened**2
    return Curve(tuple(power.knots.tolist()), coefficients, DEGREE, span), covariance, span


def _rows(matrix: Floats) -> Matrix:
    return tuple(tuple(row) for row in matrix.tolist())


def _provenance(
    gathered: Gathered, found: Adjusted, verdict: Verdict, warnings: list[str], curve: Curve
) -> dict[str, Any]:
    network = found.network
    rests = {
        "arrangements": [
            {"name": p.name, "known": {1: "line", 2: "plane", 3: ""}[p.dimensions], "tags": list(p.tags)}
            for p in network.places
        ],
        "known_distances": len(set(network.known.distance_of.tolist())),
        "known_positions": len(network.known.at),
        "pair_error_m": found.pair_std_m,
        "freedom": found.freedom,
    }
    gauge = "no curve; the delays carry the constant"
    if not curve.flat:
        gauge = f"the bias curve is zero at {ALPHA_DBM:g} dBm; the delays carry the constant"
    if not curve.flat and network.power is None:
        gauge = "that of the calibration whose curve was taken over"
    more = {"fixed_ns": {str(t): d / M_PER_NS for t, d in sorted(network.fixed_m.items())}} if network.fixed_m else {}
    return more | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": list(gathered.sources),
        "exchanges": gathered.exchanges,
        "pairs": len(network.means),
        "recipe": "survey",
        "rests_on": rests,
        "fitted": f"delays of {int(verdict.determined.sum())} tags from the geometry of boards that stood still",
        "converged": found.settled,
        "standard_errors": f"constant errors of pairs, {found.freedom:.0f} degrees of freedom",
        "undetermined": [[int(tag) for tag in verdict.named("delay")]] if verdict.free else [],
        "warnings": warnings,
        "gauge": gauge,
    }


def arrangements_of(found: Adjusted, widened: float) -> tuple[SurveyedArrangement, ...]:
    """Return where boards stood in each arrangement, in its frame, with covariance widened by Student's quantile."""
    network = found.network
    covariance = found.covariance() * widened**2
    rows = []
    for k, place in enumerate(network.places):
        there = framed(network, found.x, covariance, k)
        spread = [there.covariance_m2[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] for n in range(len(place.tags))]
        boards = tuple(
            SurveyedBoard(tag, (float(p[0]), float(p[1]), float(p[2])), c, bool(np.trace(c) < 1.0))
            for tag, p, c in zip(place.tags, there.position_m, spread, strict=True)
        )
        rows.append(
            SurveyedArrangement(place.name, {1: "line", 2: "plane", 3: ""}[place.dimensions], boards, there.words)
        )
    return tuple(rows)
