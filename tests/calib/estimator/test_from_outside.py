"""The estimator by what a contributor writes: an unknown, a part and a kind of row of one's own, and an oracle."""

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.worlds import CLEAN, make
from calib.estimator.known_distances import fit_likelihood, model_of, robust_fit
from calib.estimator.optimize import maximize
from calib.estimator.range_rows import RESIDUAL, Part
from calib.estimator.rows import normal_terms
from calib.estimator.unknowns import Prior, Priors, Unknown
from calib.settings import FitSettings

PER_KELVIN_M = 0.004


@dataclass(frozen=True)
class Thermostat:
    """A kind of row: what a data sheet says of an unknown."""

    value: float
    std: float
    column: int

    def terms(self, x):
        yield normal_terms(np.array([self.value - x[self.column]]), np.array([self.std]), np.ones((1, 1)),
                           np.array([[self.column]]))  # fmt: skip


@pytest.fixture(scope="module")
def warmed():
    model = model_of(make(CLEAN["short, 30 s"], 12_001).ranges, FitSettings())
    warmer = 10 * np.sin(model.ranges.time_ns * 2e-9)
    error = model.ranges.raw_m - model.ranges.truth_m + PER_KELVIN_M * warmer
    pilot = robust_fit(model, error, "cauchy", None, ("delay", *model.curve_kinds()))
    return model, error, warmer, fit_likelihood(model, error, pilot)


def climbed(warmed, *rows_of_others):
    model, error, warmer, start = warmed
    mixture, unknowns, parts = model.error_model(start.residuals)
    warmth = Unknown(kind="warmth", names=("m/K",), start=np.zeros(1), priors=(Prior.of_deviation(0.02),))
    part = Part(parameter=RESIDUAL, kind="warmth", columns=np.zeros((len(error), 1), np.int64), values=-warmer[:, None])
    layout, rows = model.build(error, mixture, [*unknowns, warmth], [*parts, part])
    x = layout.start()
    for kind, where in start.optimum.layout.where.items():
        x[layout.where[kind]] = start.optimum.x[where]
    others = [make_row(layout.where["warmth"].start) for make_row in rows_of_others]
    asked = layout.indices(["warmth", *(block.kind for block in model.unknowns)])
    found = maximize([rows, *model.gauge_rows(layout), *others], Priors(layout), x, asked=asked)
    assert found.success
    at = layout.where["warmth"].start
    return found.of("warmth")[0], float(np.sqrt(found.covariance[at, at]))


def test_one_more_unknown_is_one_unknown_and_one_part(warmed):
    value, std = climbed(warmed)
    assert std < 0.0003
    assert value == pytest.approx(PER_KELVIN_M, abs=4 * std)


def test_one_more_kind_of_row_is_one_class(warmed):
    alone, std = climbed(warmed)
    value, both = climbed(warmed, lambda column: Thermostat(0.003, std, column))
    # As well known from the sheet as from ranges: halfway, and better by the root of two.
    assert value == pytest.approx((alone + 0.003) / 2, abs=0.2 * std)
    assert both == pytest.approx(std / np.sqrt(2), rel=0.1)


def test_least_squares_with_delays_alone_is_numpys():
    model = model_of(make(CLEAN["short, 30 s"], 12_002).ranges, FitSettings(delays_only=True))
    error = model.ranges.raw_m - model.ranges.truth_m
    found = robust_fit(model, error, "l2", None, ("delay",))
    weights = [(model.ranges.initiator[:, None] == model.tags) * model.ranges.weight_initiator[:, None],
               (model.ranges.target[:, None] == model.tags) * model.ranges.weight_target[:, None]]  # fmt: skip
    expected = -np.linalg.lstsq(sum(weights) * 0.299702547, error, rcond=None)[0]
    np.testing.assert_allclose(found.optimum.of("delay"), expected, atol=2e-6)
