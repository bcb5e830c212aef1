"""Sparse and dense linear algebra of the estimator give the same."""

import numpy as np
import pytest
from scipy import sparse

from calib.estimator import rows, unknowns
from calib.estimator.inverse import SparseInverse, inverse_of, trace_of_product
from calib.estimator.optimize import maximize
from calib.estimator.rows import NormalRows
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown


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
    """A random walk of 200 steps of 0.5 m, seen with 0.1 m of noise."""
    for module in (rows, unknowns):
        monkeypatch.setattr(module, "MOST_DENSE", most)
    rng = np.random.default_rng(1)
    walk = np.cumsum(rng.normal(0, 0.5, 200))
    seen = walk + rng.normal(0, 0.1, 200)
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
