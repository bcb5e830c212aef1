"""Plans: what counting degrees of freedom says, what a survey then finds, and what cannot be planned."""

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

import calib
from benchmarks.standing import standing_boards
from calib.cli.commands import app
from calib.planning import SurveyPlanSettings
from calib.planning.predicted import Layout, delay_information, on_line

C_M_PER_NS = 0.299702547


def test_three_in_a_row_give_the_middle_delay_by_what_was_counted_by_hand():
    """r12 + r23 - r13 is twice half the middle's delay: its variance is that of three pairs."""
    information = delay_information(SurveyPlanSettings(tags=(1, 2, 3), on="line"), on_line((0, 1, 2), 2.0))
    values, vectors = np.linalg.eigh(information)
    assert np.count_nonzero(values > 1e-6 * values[-1]) == 1
    assert np.abs(vectors[:, -1]) == pytest.approx([0, 1, 0], abs=1e-9)
    assert C_M_PER_NS / math.sqrt(values[-1]) == pytest.approx(0.02 * math.sqrt(3))


def test_four_in_a_row_say_of_each_board_inside_its_own_delay_and_nothing_else():
    """So eight orders, in which each of four stands inside four times, leave sqrt(2 / 4) of a pair's error, at best."""
    information = delay_information(SurveyPlanSettings(tags=(1, 2, 3, 4), on="line"), on_line((2, 0, 3, 1), 3.0))
    unit = (C_M_PER_NS / 0.02) ** 2
    assert information == pytest.approx(np.diag([0.5, 0, 0, 0.5]) * unit, abs=1e-6 * unit)


def in_pair_errors(boards, on, count):
    found = calib.plan(boards, on=on, arrangements=count)
    half = np.array(list(found.half_ns.values()))
    # Student's factor of the degrees of freedom is in the intervals.
    factor = C_M_PER_NS / 1.96 / found.pair_error_m
    return found, float(np.sqrt(np.mean(half**2))) * factor, found.common_ns * factor


@pytest.mark.parametrize(
    ("boards", "on", "count", "each", "common"), [(4, "line", 8, 0.71, 0.35), (6, "plane", 10, 0.58, 0.24)]
)
def test_a_plan_promises_what_counting_says(boards, on, count, each, common):
    """Random arrangements: 0.76 and 0.38 on a line, 0.78 and 0.30 in a plane; chosen ones are a little better."""
    _, found, shared = in_pair_errors(boards, on, count)
    assert found == pytest.approx(each * 1.05, rel=0.08)
    assert shared == pytest.approx(common * 1.05, rel=0.1)


def test_one_arrangement_of_eight_in_space_says_nothing_useful():
    found = calib.plan(8, on="space", arrangements=1)
    assert len(found.undetermined) >= 7
    assert found.next_best[0].what.startswith("an arrangement with 1 at (")
    assert found.next_best[0].mean_ns < found.next_best[0].instead_of_ns


def test_the_ends_of_a_row_are_undetermined_until_they_stand_inside_or_are_taped():
    assert calib.plan(3, on="line", arrangements=1).undetermined == (1, 3)
    assert calib.plan(3, on="line", arrangements=3).undetermined == ()
    assert calib.plan(3, on="line", arrangements=1, taped=2).undetermined == ()


def test_a_taped_distance_brings_what_it_is_said_to_bring():
    without = calib.plan(5, on="plane", arrangements=3)
    tape = next(best for best in without.next_best if "by tape" in best.what)
    with_it = calib.plan(5, on="plane", arrangements=3, taped=1)
    mean = math.sqrt(np.mean(np.square(list(with_it.half_ns.values()))))
    assert mean == pytest.approx(tape.mean_ns, rel=0.05)
    assert mean < tape.instead_of_ns


def test_anchors_at_known_places_settle_a_room_at_once():
    found = calib.plan(6, on="space", arrangements=2, anchors=[1, 2, 3, 4])
    assert found.undetermined == ()
    assert max(found.half_ns.values()) < 0.4


def test_what_was_promised_is_what_a_survey_says():
    plan = calib.plan(4, on="line", arrangements=7)
    places = [np.array([a.place_m[t] for t in plan.tags]) for a in plan.arrangements]
    world = standing_boards(3, places=places)
    result = calib.survey(world.ranges, known="line", pair_error_m=0.02)
    found = np.array([1.96 * result.calibration.delays_std_ns[t] for t in plan.tags])
    assert found == pytest.approx(np.array([plan.half_ns[t] for t in plan.tags]), rel=0.1)


def test_without_a_number_it_stops_when_more_are_not_worth_it():
    found = calib.plan(4, on="line")
    assert 5 <= len(found.arrangements) <= 12
    assert found.undetermined == ()


def test_steps_say_where_boards_stand_and_what_a_survey_is_told():
    found = calib.plan([7, 12, 3], on="line", arrangements=2)
    assert found.steps[-1] == "4. Survey all recordings together, known to be on a line."
    for one, step in zip(found.arrangements, found.steps[1:], strict=False):
        assert f"boards in the order {' '.join(map(str, one.order()))}." in step


def test_the_command_prints_steps_and_json():
    done = CliRunner().invoke(app, ["plan", "survey", "3", "--on", "line", "--arrangements", "2"])
    assert done.exit_code == 0
    line = "--arrangement A --known line --order 1,2,3 --pairs all --rate 50 --duration 30 -o A.uwb"
    assert f"  uwblink record PORTS {line}\n" in done.stdout
    assert done.stdout.endswith("  calib survey A.uwb B.uwb -o calibration.json\n")
    told = json.loads(CliRunner().invoke(app, ["plan", "survey", "1,2,5", "--arrangements", "1", "--json"]).stdout)
    assert sorted(told["half_interval_ns"]) == ["1", "2", "5"]
    assert len(told["undetermined"]) == 2


@pytest.mark.parametrize(
    ("boards", "settings", "message"),
    [
        (1, {}, "boards"),
        ([1, 1], {}, "boards"),
        (4, {"on": "ring"}, "on"),
        (4, {"arrangements": 0}, "arrangements"),
        (4, {"size_m": (1.0, 2.0)}, "size_m"),
        (4, {"taped": -1}, "taped"),
        (4, {"tape_sigma_m": 0.0}, "tape_sigma_m"),
        (4, {"pair_error_m": math.nan}, "pair_error_m"),
        (4, {"on": "plane", "anchors": [9]}, "anchors"),
        (4, {"on": "line", "anchors": [1]}, "anchors"),
        (4, {"rate_hz": 0.0}, "rate_hz"),
        (30, {"on": "plane", "size_m": (0.5, 0.5)}, "find no room"),
    ],
)
def test_what_cannot_be_planned_is_refused(boards, settings, message):
    with pytest.raises(ValueError, match=message):
        calib.plan(boards, **settings)


def test_information_of_a_known_place_is_that_of_its_coordinates():
    inputs = SurveyPlanSettings(tags=(1, 2), on="plane", anchors=(1, 2), anchor_sigma_m=1e-6)
    place = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    information = delay_information(inputs, Layout(place, 2)) * (0.02 / C_M_PER_NS) ** 2
    assert information == pytest.approx(np.full((2, 2), 0.25), rel=1e-3)
