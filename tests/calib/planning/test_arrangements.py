"""Plans of boards that stand still, compared with counting degrees of freedom and with surveys."""

import itertools
import json
import math

import numpy as np
import pytest

import calib
from benchmarks import standing, surveys
from calib.planning.surveys import PLANNED_CURVE_STD_M, POWER_AT_1_M_DBM, delay_information, predict
from tests.processes import succeed


def given(boards, on="line", **settings):
    return calib.SurveyPlanSettings(tags=tuple(range(1, boards + 1)), on=on, **settings)


def in_orders(*orders):
    """Return arrangements on a line by the order of their tags, a metre apart."""
    return surveys.planned(np.array([[[order.index(tag), 0, 0] for tag in sorted(order)] for order in orders], float))


def information(inputs, one):
    """Return the information on the delays, in units of a pair's error."""
    return delay_information(inputs, one)[0] * (0.02 / standing.C_M_PER_NS) ** 2


def test_the_information_of_boards_in_a_row_agrees_with_counting():
    """r12 + r23 - r13 is twice half of the middle board's delay: its variance is that of three pairs."""
    values, vectors = np.linalg.eigh(information(given(3), *in_orders((1, 2, 3))))
    assert np.count_nonzero(values > 1e-6 * values[-1]) == 1
    assert np.abs(vectors[:, -1]) == pytest.approx([0, 1, 0], abs=1e-9)
    assert values[-1] == pytest.approx(1 / 3)
    # Four boards determine the delay of each inner board and nothing else. So eight orders, in which each of four is an
    # inner board four times, determine delays to sqrt(2 / 4) of a pair's error at best.
    assert information(given(4), *in_orders((3, 1, 4, 2))) == pytest.approx(np.diag([0.5, 0, 0, 0.5]), abs=1e-6)


def test_information_of_a_known_place_is_that_of_its_coordinates():
    found = information(given(2, "plane", anchors=(1, 2), anchor_sigma_m=1e-6), *in_orders((1, 2)))
    assert found == pytest.approx(np.full((2, 2), 0.25), rel=1e-3)


@pytest.mark.parametrize(
    ("boards", "on", "count", "each", "common"), [(4, "line", 8, 0.71, 0.35), (6, "plane", 10, 0.58, 0.24)]
)
def test_plans_agree_with_counting(boards, on, count, each, common):
    """Random arrangements: 0.76 and 0.38 on a line, 0.78 and 0.30 in a plane; chosen ones are slightly better."""
    found = calib.plan(boards, on=on, arrangements=count)
    # Intervals include Student's factor of the degrees of freedom, about 1.05.
    unit = 1.96 * found.pair_error_m / standing.C_M_PER_NS * 1.05
    assert np.sqrt(np.mean(np.square(list(found.half_ns.values())))) / unit == pytest.approx(each, rel=0.08)
    assert found.common_ns / unit == pytest.approx(common, rel=0.1)
    # The default number of arrangements stops at small gains.
    assert on == "plane" or 5 <= len(calib.plan(boards, on=on).arrangements) < 12


@pytest.mark.parametrize(
    ("boards", "settings", "undetermined"),
    [
        (3, {"arrangements": 1}, (1, 3)),
        (3, {"arrangements": 3}, ()),
        (3, {"arrangements": 1, "taped": 2}, ()),
        (6, {"on": "space", "arrangements": 2, "anchors": [1, 2, 3, 4]}, ()),
    ],
)
def test_delays_are_undetermined_without_known_facts(boards, settings, undetermined):
    found = calib.plan(boards, **settings)
    assert found.undetermined == undetermined
    assert all(half < 0.4 for tag, half in found.half_ns.items() if tag not in undetermined)


def test_one_arrangement_of_eight_in_space_hardly_determines_a_delay():
    found = calib.plan(8, on="space", arrangements=1)
    best = found.next_best[0]
    assert (len(found.undetermined) >= 7, best.what[:26]) == (True, "an arrangement with 1 at (")
    assert best.mean_ns < best.instead_of_ns


def test_the_gain_of_a_measured_distance_is_as_predicted():
    without, with_it = (calib.plan(5, on="plane", arrangements=3, taped=taped) for taped in (0, 1))
    tape = next(best for best in without.next_best if "a measured distance" in best.what)
    mean = math.sqrt(np.mean(np.square(list(with_it.half_ns.values()))))
    assert pytest.approx(tape.mean_ns, rel=0.05) == mean < tape.instead_of_ns
    # It has the weight of its own sigma.
    common = [
        calib.plan(3, arrangements=2, taped=2, tape_sigma_m=sigma, pair_error_m=0.02).common_ns
        for sigma in (0.002, 0.02, 0.2)
    ]
    assert common[0] < 0.9 * common[1] < 0.7 * common[2]


def test_plans_agree_with_surveys():
    plan = calib.plan(4, on="line", arrangements=7)
    places = [np.array([a.place_m[t] for t in plan.tags]) for a in plan.arrangements]
    result = calib.survey(standing.standing_boards(3, places=places).ranges, known="line", pair_error_m=0.02)
    found = {tag: 1.96 * std for tag, std in result.calibration.delays_std_ns.items()}
    assert found == pytest.approx(dict(plan.half_ns), rel=0.1)


def test_the_command_prints_steps_and_json():
    done = succeed("calib", "plan", "survey", "7,12,3", "--on", "line", "--arrangements", "2")
    found = calib.plan([7, 12, 3], on="line", arrangements=2)
    assert done.stdout.startswith("\n".join(found.steps))
    assert found.steps[-1] == "4. Survey all recordings together, known to be on a line."
    for one, step in zip(found.arrangements, found.steps[1:], strict=False):
        order = list(map(str, sorted(one.place_m, key=lambda tag: one.place_m[tag])))
        assert f"boards in the order {' '.join(order)}." in step
        line = f"--arrangement {one.name} --known line --order {','.join(order)} --pairs all --rate 50 --duration 30"
        assert f"  uwblink record PORTS {line} -o {one.name}.uwb\n" in done.stdout
    assert done.stdout.endswith("  calib survey A.uwb B.uwb -o calibration.json\n")
    told = json.loads(succeed("calib", "plan", "survey", "1,2,5", "--arrangements", "1", "--json").stdout)
    assert (sorted(told["half_interval_ns"]), len(told["undetermined"])) == (["1", "2", "5"], 2)


def test_three_boards_in_a_row_are_not_used_if_a_pair_is_mostly_reflected():
    """All three pairs are direct with 0.9^3 = 0.73 and 0.7^3 = 0.34; then the middle delay is determined as usual."""
    row = in_orders((1, 2, 3))
    assert predict(given(3, reflected=0.1), row)[0].each[1] == pytest.approx(0.02 * math.sqrt(3) / standing.C_M_PER_NS)
    assert np.isinf(predict(given(3, reflected=0.3), row)[0].each[1])


def test_reflected_pairs_cost_the_information_of_missing_pairs():
    """Compared with draws over the same arrangements, in which reflected pairs are left out."""
    rng, pairs = np.random.default_rng(5), np.array(list(itertools.combinations(range(6), 2)))
    places = [standing.places_of(rng, 6, 2, 4.0, 0.4) for _ in range(6)]
    first, second = (np.eye(6)[pairs[:, end]] for end in (0, 1))
    of_draws = []
    for _ in range(30):
        total = np.zeros((6, 6))
        for place in places:
            apart = place[pairs[:, 0], :2] - place[pairs[:, 1], :2]
            apart /= np.linalg.norm(apart, axis=1, keepdims=True)
            seen = rng.uniform(size=len(pairs)) >= 0.1
            others = np.einsum("pb,pd->pbd", first - second, apart)[seen].reshape(seen.sum(), -1)
            left = (np.eye(seen.sum()) - others @ np.linalg.pinv(others)) @ (-0.5 * (first + second)[seen])
            total += left.T @ left / 0.02**2
        of_draws.append(np.diag(np.linalg.pinv(total)))
    found, plain = (
        predict(given(6, "plane", reflected=share), surveys.planned(places))[-1].each for share in (0.1, 0.0)
    )
    assert np.sqrt(np.mean(found**2)) == pytest.approx(np.sqrt(np.mean(of_draws)) / standing.C_M_PER_NS, rel=0.15)
    assert np.mean(found) > 1.05 * np.mean(plain)


def test_a_curve_costs_the_information_of_a_process_of_its_size(monkeypatch):
    """The formula of the benchmark has the process itself; plan and survey have splines."""
    monkeypatch.setattr(surveys, "power_dbm", lambda length: POWER_AT_1_M_DBM - 20 * math.log10(length))
    world = standing.standing_boards(3, "plane", boards=5, arrangements=5, size_m=6.0, each=5)
    expected = surveys.promised(world, 2, PLANNED_CURVE_STD_M, 0.0)
    found = predict(given(5, "plane"), surveys.planned(world.places), curve=True)[-1].each
    assert found == pytest.approx(expected, rel=0.1)


def test_a_plan_states_the_accuracy_lost_by_reflections_and_a_curve():
    plain, reflected = (calib.plan(4, on="line", arrangements=4, reflected=share) for share in (0.0, 0.1))
    assert "and 10 % of the pairs are reflected:" in str(reflected)
    curved = plain.with_curve_ns
    assert min(curved.each, max(reflected.half_ns.values())) > max(plain.half_ns.values())
    assert curved.each == pytest.approx(math.hypot(curved.apart, curved.common), rel=1e-6)
    assert f"common part ± {curved.common:.3f} ns." in str(plain)
    assert reflected.to_dict()["with_curve_ns"]["common"] > plain.to_dict()["with_curve_ns"]["common"]
