"""What is promised where pairs are reflected, or a curve over power is fitted along."""

import math

import numpy as np
import pytest

import calib
from benchmarks import surveys
from benchmarks.standing import places_of, standing_boards
from calib.planning import SurveyPlanSettings
from calib.planning.predicted import (
    CURVE_M,
    POWER_AT_1_M_DBM,
    Layout,
    delay_information,
    on_line,
    predict,
)


def given(boards, on="line", **settings):
    return SurveyPlanSettings(tags=tuple(range(1, boards + 1)), on=on, **settings)


def test_without_reflections_and_curve_it_is_the_inverse_of_the_information():
    layouts = [on_line(order, 4.0) for order in ((0, 1, 2, 3), (1, 0, 3, 2), (2, 0, 3, 1))]
    covariance = np.linalg.inv(sum(delay_information(given(4), layout) for layout in layouts))
    last = predict(given(4), layouts)[-1]
    assert last.each == pytest.approx(np.sqrt(np.diag(covariance)))
    assert last.common == pytest.approx(math.sqrt(covariance.mean()))
    centre = np.eye(4) - 0.25
    assert last.apart == pytest.approx(np.sqrt(np.diag(centre @ covariance @ centre)))
    assert np.isinf(predict(given(4), layouts)[0].common)


def test_three_in_a_row_say_nothing_where_one_of_their_pairs_is_mostly_reflected():
    """All three are straight with 0.9^3 = 0.73 and 0.7^3 = 0.34; then the middle delay is what it always is."""
    row = [on_line((0, 1, 2), 2.0)]
    middle = 0.02 * math.sqrt(3) / surveys.C_M_PER_NS
    assert predict(given(3, reflected=0.1), row)[0].each[1] == pytest.approx(middle)
    assert np.isinf(predict(given(3, reflected=0.3), row)[0].each[1])


def test_reflected_pairs_cost_what_their_loss_costs():
    """Beside draws of one's own over the same arrangements: as if there were no such pairs."""
    rng = np.random.default_rng(5)
    places = [places_of(rng, 6, 2, 4.0, 0.4) for _ in range(6)]
    of_draws = []
    for _ in range(30):
        total = np.zeros((6, 6))
        for place in places:
            rows, steps = [], []
            for i in range(6):
                for j in range(i + 1, 6):
                    if rng.uniform() >= 0.1:
                        unit = (place[i] - place[j])[:2] / np.linalg.norm(place[i] - place[j])
                        step = np.zeros((6, 2))
                        step[i], step[j] = unit, -unit
                        steps.append(step.ravel())
                        rows.append(-0.5 * (np.eye(6)[i] + np.eye(6)[j]))
            wanted, others = np.array(rows), np.array(steps)
            left = wanted - others @ np.linalg.pinv(others) @ wanted
            total += left.T @ left / 0.02**2
        of_draws.append(np.diag(np.linalg.pinv(total)))
    expected = np.sqrt(np.mean(of_draws)) / surveys.C_M_PER_NS
    found = predict(given(6, "plane", reflected=0.1), [Layout(place, 2) for place in places])[-1].each
    assert np.sqrt(np.mean(found**2)) == pytest.approx(expected, rel=0.15)
    assert np.mean(found) > 1.05 * np.mean(predict(given(6, "plane"), [Layout(place, 2) for place in places])[-1].each)


def test_a_curve_costs_what_a_process_of_its_size_costs(monkeypatch):
    """The benchmark's own formula has the process itself where plan and survey have splines."""
    monkeypatch.setattr(surveys, "power_dbm", lambda length: POWER_AT_1_M_DBM - 20 * math.log10(length))
    world = standing_boards(3, "plane", boards=5, arrangements=5, size_m=6.0, each=5)
    expected = surveys.promised(world, 2, CURVE_M, 0.0)
    found = predict(given(5, "plane"), [Layout(place, 2) for place in world.places], curve=True)[-1].each
    assert found == pytest.approx(expected, rel=0.1)


def test_a_plan_says_what_reflections_and_a_curve_cost():
    plain, reflected = (calib.plan(4, on="line", arrangements=4, reflected=share) for share in (0.0, 0.1))
    assert "and 10 % of the pairs are reflected:" in str(reflected)
    assert max(reflected.half_ns.values()) > max(plain.half_ns.values())
    curved = plain.with_curve_ns
    assert curved.each > max(plain.half_ns.values())
    assert curved.each == pytest.approx(math.hypot(curved.apart, curved.common), rel=1e-6)
    assert f"what all share ± {curved.common:.3f} ns." in str(plain)
    assert reflected.to_dict()["with_curve_ns"]["common"] > plain.to_dict()["with_curve_ns"]["common"]
    with pytest.raises(ValueError, match="reflected"):
        calib.plan(4, reflected=0.4)


def test_a_tape_counts_by_its_own_sigma():
    common = [
        calib.plan(3, on="line", arrangements=2, taped=2, tape_sigma_m=sigma, pair_error_m=0.02).common_ns
        for sigma in (0.002, 0.02, 0.2)
    ]
    assert common[0] < 0.9 * common[1] < 0.7 * common[2]
