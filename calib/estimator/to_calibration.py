"""A calibration from a fit: delays, curves, their uncertainty, and the error model."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from calib.calibration.model import Calibration, PairOffset, TagGroup, Uncertainty, matrix_of
from calib.calibration.power_curves import DEGREE, SIGMA_FLOOR_M, Curve, flat_curve
from calib.estimator.error_summary import between_recordings, error_model
from calib.estimator.known_distances import LARGEST_SPREAD_M, KnownDistances, described_errors
from calib.estimator.range_model import METRES_A_NS, RangeModel, Spline
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT

LEAST_SPREAD_M = 1e-6
"""Smallest noise: errors without spread have no distribution."""


def calibration_of(
    found: KnownDistances,
    delays_ns2: Floats,
    *,
    lift: str,
    alpha_dbm: float,
    fixed: Mapping[int, float],
    groups: Mapping[str, tuple[int, ...]],
    between_m: float | None = None,
) -> Calibration:
    """Return the calibration of a fit; `covariance` (tags, tags) is that of its delays.

    `between_m` is the standard deviation of a pair's offset between recordings, None to estimate it.
    """
    model, search = found.model, found.searches[0]
    names = model.unknowns[0].names
    of_pairs = model.constants == "pair"
    free = {tag for group in found.free for tag in group}
    std = [
        math.inf if not of_pairs and int(name) in free else math.sqrt(max(value, 0.0))
        for name, value in zip(names, np.diag(delays_ns2), strict=True)
    ]
    fitted = [k for k, name in enumerate(names) if of_pairs or int(name) not in fixed]
    tags = [] if of_pairs else [int(names[k]) for k in fitted]
    offsets = {}
    if of_pairs:
        values = zip(model.pairs.ends.tolist(), found.delays.tolist(), std, strict=True)
        offsets = {(a, b): PairOffset(-METRES_A_NS * delay, METRES_A_NS * error) for (a, b), delay, error in values}
        fixed = dict.fromkeys(model.tags, 0.0) | dict(fixed)
    biases = bias_curves(found)
    errors = None
    spread = robust_spread(found.residuals)
    sigmas, sigma_m2 = _flat_sigma(model, spread, len(found.residuals))
    if LEAST_SPREAD_M < spread < LARGEST_SPREAD_M:
        described = described_errors(found)
        errors = error_model(model, found.residuals, described, found.blocks)
        if between_m is None:
            between_m = between_recordings(model, described, found.blocks, _between_pairs(found))
        errors = errors.between(between_m, _correction_std(found, delays_ns2, np.array(errors.lifted)))
        sigmas, sigma_m2 = sigma_curves(model, described.values, described.covariances["noise"])
    return Calibration(
        delays_ns={tag: float(found.delays[k]) for k, tag in zip(fitted, tags, strict=not of_pairs)} | dict(fixed),
        delays_std_ns={tag: std[k] for k, tag in zip(fitted, tags, strict=not of_pairs)} | dict.fromkeys(fixed, 0.0),
        loss=search.loss,
        scale_ns=search.scale_m / METRES_A_NS,
        lift=lift,
        alpha_dbm=alpha_dbm,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=_average(list(biases.values())),
        sigma_curve=_average(list(sigmas.values())),
        uncertainty=Uncertainty(
            tuple(tags),
            () if offsets else matrix_of(delays_ns2[np.ix_(fitted, fitted)]),
            matrix_of(_bias_covariance(found)),
            matrix_of(sigma_m2),
        ),
        pair_offsets=offsets,
        groups={name: TagGroup(tuple(own), biases[name], sigmas[name]) for name, own in groups.items()},
        errors=errors,
        antenna_delays=known_delays(model.ranges.antenna_delays, model.ranges.tags()),
    )


def _between_pairs(found: KnownDistances) -> float | None:
    """Return the standard deviation of offsets of pairs, in a session and from one to the next, in metres."""
    search = found.searches[0].optimum
    kinds = [kind for kind in ("offset of pair", "offset of pair in session") if kind in search.layout.where]
    return math.hypot(*map(search.priors.deviation, kinds)) if kinds else None


def bias_curves(found: KnownDistances) -> dict[str, Curve]:
    """Return the curve of each group, zero at the reference power where delays take its constant."""
    model = found.model
    if model.curve is None:
        return dict.fromkeys(model.groups or ("",), flat_curve(0.0, model.span))
    curves, knots = {}, tuple(model.curve.knots.tolist())
    for kind, gauged in zip(model.curve_kinds(), model.gauged, strict=True):
        values = found.values[kind]
        if gauged and model.reference is not None:
            # A row of the fit holds it there within a hundredth of a millimetre; splines sum to one everywhere.
            at = Spline.at(np.array([model.reference]), model.curve.knots)
            values = values - float(at.values[0] @ values[at.columns[0]])
        curves[kind.removeprefix("curve").strip()] = Curve(knots, tuple(values.tolist()), DEGREE, model.span)
    return curves


def sigma_curves(
    model: RangeModel, values: Mapping[str, Floats], covariance: Floats
) -> tuple[dict[str, Curve], Floats]:
    """Return the noise of direct ranges over power for each group, and the covariance of their average (m, m).

    `covariance` is that of level and curves of the logarithm of noise, side by side. The curves are splines through it.
    """
    level = float(values["noise level"][0])
    if model.noise is None:
        flat = max(math.exp(level), SIGMA_FLOOR_M)
        curve = flat_curve(flat, model.span)
        return dict.fromkeys(model.groups or ("",), curve), np.full((DEGREE + 1,) * 2, flat**2 * covariance[0, 0])
    knots = model.noise.knots
    lifted = np.linspace(knots[0], knots[-1], 8 * model.noise.size)
    at = Spline.at(lifted, knots)
    splines = np.zeros((len(lifted), model.noise.size))
    np.put_along_axis(splines, at.columns, at.values, axis=1)
    through, names = np.linalg.pinv(splines), list(model.groups) or [""]
    curves, slope = {}, np.zeros((model.noise.size, len(covariance)))
    for k, name in enumerate(names):
        sigma = np.exp(level + splines @ values[f"noise curve {name}".strip()])
        coefficients = np.maximum(through @ sigma, SIGMA_FLOOR_M)
        curves[name] = Curve(
            tuple(knots.tolist()), tuple(coefficients.tolist()), DEGREE, (float(knots[0]), float(knots[-1]))
        )
        slope[:, 0] += through @ sigma / len(names)
        own = slice(1 + k * model.noise.size, 1 + (k + 1) * model.noise.size)
        slope[:, own] += through @ (sigma[:, None] * splines) / len(names)
    return curves, np.asarray(slope @ covariance @ slope.T)


def _flat_sigma(model: RangeModel, sigma: float, count: int) -> tuple[dict[str, Curve], Floats]:
    value = max(sigma, SIGMA_FLOOR_M)
    curve = flat_curve(value, model.span)
    return dict.fromkeys(model.groups or ("",), curve), np.full((DEGREE + 1,) * 2, value**2 / (2 * count))


def _correction_std(found: KnownDistances, delays_ns2: Floats, lifted: Floats) -> Floats:
    """Return the standard deviation of the correction at lifted powers (nodes,), in metres: the root mean square over
    the fitted pairs.

    The correction of a pair has half of both delays, times the speed of light, and the curve.
    """
    model = found.model
    if model.constants == "pair":
        of_pairs = METRES_A_NS**2 * np.diag(delays_ns2)
    else:
        delays = np.sum(model.pairs.ends[:, :, None] == np.array(model.tags), axis=1) * METRES_A_NS / 2
        of_pairs = np.sum(delays @ delays_ns2 * delays, axis=1)
    variance = np.full(len(lifted), float(np.mean(of_pairs)))
    if model.curve is not None:
        at = Spline.at(lifted, model.curve.knots)
        known = _bias_covariance(found)[at.columns[:, :, None], at.columns[:, None, :]]
        variance += np.einsum("ki,kij,kj->k", at.values, known, at.values)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _bias_covariance(found: KnownDistances) -> Floats:
    """Return the covariance of the coefficients of the average of the groups' curves."""
    if found.model.curve is None:
        return np.zeros((DEGREE + 1,) * 2)
    count = len(found.model.curve_kinds())
    average = np.kron(np.full((1, count), 1 / count), np.eye(found.model.curve.size))
    return np.asarray(average @ found.covariances["curve"] @ average.T)


def _average(curves: list[Curve]) -> Curve:
    """Return the mean of curves over the same knots."""
    mean = np.mean([curve.coefficients for curve in curves], axis=0)
    return Curve(curves[0].knots, tuple(mean.tolist()), curves[0].degree, curves[0].range)
