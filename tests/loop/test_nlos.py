"""Ranges that went by a detour: a classifier of ten lines learns them in simulated rooms, and knows them elsewhere."""

import numpy as np
import pytest

from benchmarks.nlos import DETOUR_M, FLIGHT, auc, classifier, of_real_flight, of_rooms
from tests.shared_data import shared


@pytest.fixture(scope="module")
def trained():
    found, detours = of_rooms(range(8), 8.0)
    assert 0.03 < detours.mean() < 0.3
    return classifier().fit(found, detours)


def test_it_separates_simulated_rooms_that_it_has_not_seen(trained):
    found, detours = of_rooms(range(12, 20), 8.0)
    assert 0.03 < detours.mean() < 0.3
    assert auc(trained, found, detours) >= 0.85


def test_both_features_weigh_for_a_detour(trained):
    assert np.all(trained[-1].coef_ > 0)


def test_it_says_something_of_a_real_flight(trained):
    """Better than chance: with 27 detours of 265 ranges, 0.5 has a standard error of 0.06."""
    shared("miluv_published_calibration.json")
    found, residual = of_real_flight(shared(FLIGHT).parent)
    detours = residual > DETOUR_M
    assert 20 < detours.sum() < 40
    assert auc(trained, found, detours) > 0.7
