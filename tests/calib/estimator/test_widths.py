"""What intervals of a fit are made of, part by part."""

import numpy as np
import pytest
from scipy.stats import t as student

from benchmarks.worlds import CLEAN, Recipe, make
from calib.estimator import known_distances
from calib.estimator.covariance import Kept, sandwich
from calib.estimator.known_distances import fit_known_distances, model_of, robust_fit
from calib.estimator.time_blocks import time_blocks
from calib.settings import FitSettings


def fitted(recipe, seed=12_003, **settings):
    return fit_known_distances(make(recipe, seed).ranges, FitSettings(**settings))


@pytest.fixture(scope="module")
def squares():
    model = model_of(make(CLEAN["short, 30 s"], 12_004).ranges[:400], FitSettings(delays_only=True))
    found = robust_fit(model, model.ranges.raw_m - model.ranges.truth_m, "l2", None, ("delay",))
    return model, found, found.optimum.layout.indices(["delay"])


def test_few_ranges_of_a_pair_have_students_intervals(squares):
    model, found, delays = squares
    blocks = time_blocks(model.ranges.time_ns, model.ranges.session)
    (few, (last,)), (many, _) = (
        sandwich(found.optimum, found.rows, [Kept.delays(delays, each)], blocks) for each in (4, 1e9)
    )
    assert last.freedom > 3
    assert np.sqrt(np.diag(few) / np.diag(many)) == pytest.approx(student.ppf(0.975, 3) / last.quantile95, rel=1e-6)


def test_what_a_fit_uses_of_the_data_is_given_back(squares):
    model, found, delays = squares
    blocks = time_blocks(model.ranges.time_ns, model.ranges.session)
    whole, (lasting,) = sandwich(found.optimum, found.rows, [Kept.delays(delays, 1e9)], blocks)
    # With NumPy alone: scores summed by block, the residual's share of degrees of freedom, and how long errors last.
    tags, ranges = np.array(model.tags), model.ranges
    weights = ((ranges.initiator, ranges.weight_initiator), (ranges.target, ranges.weight_target))
    matrix = sum((ids[:, None] == tags) * weight[:, None] for ids, weight in weights) * 0.299702547
    scores = matrix * found.residuals[:, None]
    sums = np.array([scores[blocks.number == k].sum(axis=0) for k in range(blocks.count)])
    inverse = np.linalg.inv(matrix.T @ matrix)
    plain = inverse @ sums.T @ sums @ inverse * len(ranges) / (len(ranges) - len(tags))
    np.testing.assert_allclose(whole, plain * lasting.factor * (lasting.quantile95 / 1.959964) ** 2, rtol=2e-3)


def test_reflections_of_another_shape_are_in_the_intervals(monkeypatch):
    shape = known_distances._of_another_shape
    traces = {}
    for added in (False, True):
        monkeypatch.setattr(known_distances, "_of_another_shape", shape if added else lambda *_: 0.0)
        for share in (0.001, 0.3):
            found = fitted(Recipe(share=(share, share), seconds=60))
            traces[share, added] = np.trace(found.covariances["delay"])
    few, many = (traces[share, True] - traces[share, False] for share in (0.001, 0.3))
    assert few >= 0
    assert many > 20 * max(few, 1e-9)
    assert many > 0.1 * traces[0.3, False]


def test_offsets_of_pairs_are_unknowns_where_anything_tells_them_from_delays():
    assert "offset of pair" in fitted(CLEAN["short, 30 s"]).values
    assert "offset of pair" not in fitted(Recipe(tags=3, seconds=20)).values
    assert "offset of pair" not in fitted(CLEAN["short, 30 s"], constants="pair").values
