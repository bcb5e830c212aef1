"""Turns the parameters of a fit into a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.parts import Matrix, PairOffset, TagGroup, Uncertainty
from calib.calibration.power_curves import DEGREE, Curve
from calib.error_mixture import fit_error_mixture
from calib.estimation.error_model import error_model
from calib.estimation.flat import no_bias, sigma_of
from calib.estimation.problem import Problem
from calib.estimation.solver import Solved
from calib.long_columns import computed, let_go
from uwblink.arrays import Floats
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT


def calibration_of(
    problem: Problem,
    found: Solved,
    covariance: Floats,
    loss: str,
    lift: str,
    alpha_dbm: float,
    fixed: dict[int, float],
    groups: Mapping[str, tuple[int, ...]],
) -> Calibration:
    """Turn stated parameters into a calibration, and draw sigma about the centre of the core of the errors."""
    delays = problem.directions @ found.parameters[: problem.rank]
    std = _standard_errors(problem, covariance)
    if problem.unknowns.of_pairs:
        offsets, tags = _offsets(problem, delays, std), []
        fixed = dict.fromkeys(problem.ranges.tags(), 0.0) | fixed
    else:
        offsets, tags = {}, problem.tags
    biases = _bias_curves(problem, found)
    core = found.residuals
    mixture = fit_error_mixture(core, problem.bins.number, len(problem.bins.count))
    let_go(core, problem.bins.number)
    centred = computed(len(core), lambda rows: core[rows] - mixture.location_m)
    sigma = sigma_of(problem, centred, mixture)
    del centred
    return Calibration(
        delays_ns=dict(zip(tags, delays.tolist(), strict=not offsets)) | fixed,
        delays_std_ns=dict(zip(tags, std, strict=not offsets)) | dict.fromkeys(fixed, 0.0),
        loss=loss,
        scale_ns=found.scale / SPEED_OF_LIGHT * 1e9,
        lift=lift,
        alpha_dbm=alpha_dbm,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=_average(list(biases.values())),
        sigma_curve=_average(list(sigma.curves.values())),
        uncertainty=Uncertainty(
            tuple(tags),
            () if offsets else _rows(covariance),
            _rows(_bias_covariance(problem, found)),
            _rows(sigma.covariance),
        ),
        pair_offsets=offsets,
        groups={name: TagGroup(tuple(tags), biases[name], sigma.curves[name]) for name, tags in groups.items()},
        errors=error_model(problem, found.residuals, found.mixture),
        antenna_delays=known_delays(problem.ranges.antenna_delays, problem.ranges.tags()),
    )


def _offsets(problem: Problem, delays: Floats, std: list[float]) -> dict[tuple[int, int], PairOffset]:
    """Return the constants of pairs: what is added to their ranges, in ns, is what they are too short by."""
    metres = SPEED_OF_LIGHT * 1e-9
    values = zip(problem.pairs.ends.tolist(), delays.tolist(), std, strict=True)
    return {(low, high): PairOffset(-metres * delay, metres * error) for (low, high), delay, error in values}


def _bias_curves(problem: Problem, found: Solved) -> dict[str, Curve]:
    if not problem.unknowns.curve:
        return no_bias(problem)
    knots = tuple(problem.knots.tolist())
    return {
        name: Curve(knots, tuple(found.parameters[columns].tolist()), DEGREE, problem.span)
        for name, columns in problem.curves()
    }


def _standard_errors(problem: Problem, covariance: Floats) -> list[float]:
    """Standard errors of the delays (tags,) in ns, infinite where the data leave one free."""
    free = {tag for group in problem.free for tag in group}
    std = np.sqrt(np.maximum(np.diag(covariance), 0)).tolist()
    return [math.inf if tag in free else value for tag, value in zip(problem.tags, std, strict=True)]


def _bias_covariance(problem: Problem, found: Solved) -> Floats:
    """Covariance of the coefficients of the plain curve, which is the groups' average."""
    each = problem.centres.shape[1]
    if not each:
        return np.zeros((DEGREE + 1,) * 2)
    average = np.zeros((each, len(found.parameters)))
    for _, columns in problem.curves():
        average[:, columns] = np.eye(each) / len(problem.groups)
    return np.asarray(average @ found.covariance @ average.T)


def _average(curves: list[Curve]) -> Curve:
    """Return the mean of curves over the same knots."""
    mean = np.mean([curve.coefficients for curve in curves], axis=0)
    return Curve(curves[0].knots, tuple(mean.tolist()), curves[0].degree, curves[0].range)


def _rows(matrix: Floats) -> Matrix:
    return tuple(tuple(row) for row in matrix.tolist())
