"""What ranges tell on average, by the model, beside squares of the slopes of many ranges drawn from it."""

from dataclasses import replace

import numpy as np
import pytest

from calib.estimator.range_rows import RESIDUAL, Mixture, Part, RangeRows
from calib.estimator.rows import sum_rows
from calib.estimator.unknowns import Layout, Unknown

VALUES = {"noise": np.log(0.04), "odds": -2.0, "detour": np.log(0.3), "least": np.log(0.02), "outliers": -8.0}


@pytest.fixture(scope="module")
def drawn():
    rng = np.random.default_rng(1)
    kinds = VALUES | {"long": -30.0, RESIDUAL: 0.0}
    layout = Layout(tuple(Unknown(kind=kind, names=("",), start=np.array([at])) for kind, at in kinds.items()))
    count, one = 40_000, np.zeros((1, 1), dtype=np.int64)
    reflected = rng.random(count) < 1 / (1 + np.exp(2.0))
    error = 0.04 * rng.normal(size=count) + reflected * (0.02 + rng.exponential(0.3, count))
    parts = [Part(parameter=kind, kind=kind, columns=one) for kind in kinds]
    return layout, RangeRows.of(error, np.zeros(count, dtype=np.int64), parts, Mixture(), layout)


def test_the_model_tells_on_average_what_squares_of_slopes_do(drawn):
    layout, rows = drawn
    squares = sum_rows([rows], layout.start())
    expected = sum_rows([replace(rows, errors=Mixture(expected=True))], layout.start())
    k = layout.where[RESIDUAL].start
    assert expected.gradient == pytest.approx(squares.gradient)
    assert expected.information[k, k] == pytest.approx(squares.information[k, k], rel=0.03)
    for other in ("noise", "odds", "detour"):
        j = layout.where[other].start
        size = np.sqrt(squares.information[k, k] * squares.information[j, j])
        assert expected.information[k, j] == pytest.approx(squares.information[k, j], abs=0.03 * size)


def test_noise_is_larger_by_the_share_that_other_unknowns_use_up(drawn):
    layout, rows = drawn
    plain, used = (
        sum_rows([replace(rows, errors=Mixture(used=share))], layout.start()).gradient[layout.where["noise"].start]
        for share in (0.0, 0.1)
    )
    assert used - plain == pytest.approx(0.1 * len(rows))
