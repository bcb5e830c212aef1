"""Sparse and dense linear algebra of the estimator give equal results."""

import numpy as np
import pytest
from scipy import sparse

import calib
from benchmarks.worlds import FIRST_REPORTED, Recipe, make
from calib.estimator import rows, unknowns
from calib.estimator.inverse import SparseInverse, inverse_of, trace_of_product
from calib.estimator.known_distances import fit_known_distances
from calib.estimator.optimize import maximize
from calib.estimator.rows import NormalRows
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown
from tests.calib.overhearing import flight


def test_an_arrow_is_inverted_as_the_dense_matrix_is():
    rng = np.random.default_rng(0)
    columns = np.column_stack([np.arange(600)[:, None] // 6 + np.arange(4), rng.integers(103, 107, (600, 2))])
    entries = sparse.csr_matrix((rng.normal(size=3600), columns.ravel(), np.arange(601) * 6), shape=(600, 107))
    matrix = sparse.csc_matrix(entries.T @ entries)
    free = np.flatnonzero(np.arange(107) != 50)
    found, dense = inverse_of(matrix, free), inverse_of(matrix.toarray(), free)
    assert isinstance(found, SparseInverse)
    assert found[:, :] == pytest.approx(dense, rel=1e-6, abs=1e-9)
    assert found[3:9, 3:9] == pytest.approx(dense[3:9, 3:9], rel=1e-6, abs=1e-9)
    right = rng.normal(size=(107, 2))
    assert found @ right == pytest.approx(dense @ right, rel=1e-6, abs=1e-9)
    assert trace_of_product(found, matrix) == pytest.approx(106, rel=1e-2)


@pytest.mark.parametrize("most", [0, 400])
def test_a_search_ends_at_least_squares_and_finds_the_weight_of_its_prior(most, monkeypatch):
    """A random walk of 200 steps of 0.5 m, measured with 0.1 m of noise."""
    for module in (rows, unknowns):
        monkeypatch.setattr(module, "MOST_DENSE", most)
    rng = np.random.default_rng(1)
    seen = np.cumsum(rng.normal(0, 0.5, 200)) + rng.normal(0, 0.1, 200)
    steps = sparse.csr_matrix(np.eye(199, 200, 1) - np.eye(199, 200))
    prior = Prior(weight=1.0, structure=sparse.csc_matrix(steps.T @ steps), rows=199, bounds=(1e-3, 1e3))
    layout = Layout((Unknown(kind="path", names=("",) * 200, start=np.zeros(200), priors=(prior,)),))
    every = NormalRows(value=seen, std=np.full(200, 0.1), entries=np.ones((200, 1)), columns=np.arange(200)[:, None])
    priors = Priors(layout)
    found = maximize([every], priors, layout.start(), tolerance=1e-6)
    assert found.success
    assert priors.deviation("path") == pytest.approx(0.5, rel=0.15)
    precision = priors.weights[0] * (steps.T @ steps).toarray() + np.eye(200) / 0.01
    assert found.x == pytest.approx(np.linalg.solve(precision, seen / 0.01), abs=1e-4)


# The end of a search is the same for different starts near it.


@pytest.mark.parametrize(
    "data",
    [
        lambda: make(Recipe(seconds=60, share=(0, 0.5)), FIRST_REPORTED).ranges,
        pytest.param(lambda: flight(7100, reflected=0.15, bias_m=0.1)[0], marks=pytest.mark.slow),
    ],
    ids=["world", "listeners"],
)
def test_a_search_ends_at_one_optimum_of_unknowns_and_weights(data):
    found = fit_known_distances(calib.load_ranges(data()), calib.FitSettings())
    search, optimum = found.searches[0], found.searches[0].optimum
    rows = [own for own in (search.rows, search.heard, *search.gauge) if own is not None]
    asked = optimum.layout.indices([unknown.kind for unknown in found.model.unknowns])
    std = np.sqrt(np.diag(found.covariances["delay"]))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        known = zip(optimum.priors.weights, optimum.priors.all, strict=True)
        weights = [w if prior.bounds is None else w * np.exp(rng.normal()) for w, (_, prior) in known]
        # Starts differ by a standard error, in logarithms by a half at most: farther away, there may be other optima.
        away = np.minimum(np.sqrt(np.diag(np.asarray(optimum.covariance))), 0.5) * rng.normal(size=len(optimum.x))
        again = maximize(rows, Priors(optimum.layout, weights), optimum.x + away, asked=asked)
        assert again.success
        assert again.steps < 25
        # A search ends if a step gains less than 0.01 in log likelihood, at most a tenth of a standard error, for both
        # searches.
        assert np.abs((again.of("delay") - optimum.of("delay")) / std).max() < 0.2
