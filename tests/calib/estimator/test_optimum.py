"""The end of a search: the same from wherever near it a search starts."""

import numpy as np
import pytest

import calib
from benchmarks.worlds import FIRST_REPORTED, Recipe, make
from calib.estimator.known_distances import fit_known_distances
from calib.estimator.optimize import maximize
from calib.estimator.unknowns import Priors
from tests.calib.overhearing import flight


def world():
    return calib.load_ranges(make(Recipe(seconds=60, share=(0, 0.5)), FIRST_REPORTED).ranges)


def listeners():
    return calib.load_ranges(flight(7100, reflected=0.15, bias_m=0.1)[0])


@pytest.mark.parametrize("ranges", [world, listeners])
def test_a_search_ends_at_one_optimum_of_unknowns_and_weights(ranges):
    found = fit_known_distances(ranges(), calib.FitSettings())
    search, optimum = found.searches[0], found.searches[0].optimum
    rows = [own for own in (search.rows, search.heard, *search.gauge) if own is not None]
    asked = optimum.layout.indices([unknown.kind for unknown in found.model.unknowns])
    std = np.sqrt(np.diag(found.covariances["delay"]))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        known = zip(optimum.priors.weights, optimum.priors.all, strict=True)
        weights = [w if prior.bounds is None else w * np.exp(rng.normal()) for w, (_, prior) in known]
        # By a standard error each, logarithms by a half at most: farther away there may be other optima.
        away = np.minimum(np.sqrt(np.diag(np.asarray(optimum.covariance))), 0.5) * rng.normal(size=len(optimum.x))
        again = maximize(rows, Priors(optimum.layout, weights), optimum.x + away, asked=asked)
        assert again.success
        assert again.steps < 25
        # Searches end where a step promises 0.01 of log likelihood, a tenth of a standard error at most: both of two.
        assert np.abs((again.of("delay") - optimum.of("delay")) / std).max() < 0.2
