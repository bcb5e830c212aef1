"""Ranging plans: files, turns, and what is wrong with them."""

import pytest

from uwblink.boards.ranging_plan import RangingPlan, load_plan
from uwblink.errors import PlanError
from uwblink.recording.schema import Tag, load_places


def written(tmp_path, text):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    return path


def test_a_whole_plan(tmp_path):
    plan = load_plan(
        written(
            tmp_path,
            "pairs = [[1, 2], [3, 1]]\nrate_hz = 50\nprotocol = 'ss'\ntarget_reports = true\nget_cir = true\n"
            "[[tags]]\nid = 1\nbody = 'a'\nlever_arm_m = [0.1, 0, -1]\n",
        )
    )
    tags = (Tag(1, "a", (0.1, 0.0, -1.0)),)
    expected = RangingPlan(((1, 2), (3, 1)), rate_hz=50, protocol="ss", target_reports=True, get_cir=True, tags=tags)
    assert plan == expected
    assert plan.turns([1, 2, 3]) == ((1, 2), (3, 1))


def test_all_leaves_out_pairs_on_one_body():
    tags = (Tag(1, "a", (0, 0, 0)), Tag(2, "a", (1, 0, 0)), Tag(3, "b", (0, 0, 0)))
    assert RangingPlan(tags=tags).turns([3, 1, 2]) == ((1, 3), (2, 3))
    assert RangingPlan().turns([3, 1, 2]) == ((1, 2), (1, 3), (2, 3))


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("rate = 5", "rate: unknown key"),
        ("rate_hz = -1", "rate_hz: found -1"),
        ("rate_hz = 'fast'", "rate_hz"),
        ("protocol = 'tdoa'", "expected ds or ss"),
        ("pairs = [[1, 1]]", "pairs: found ((1, 1),), expected"),
        ("pairs = [[1]]", "pairs"),
        ("pairs = []", "pairs"),
        ("pairs = [[1, 999]]", "pairs"),
        ("get_cir = 1", "get_cir"),
        ("tags = 3", "tags"),
        ("[[tags]]\nid = 1", "body"),
        ("[[tags]]\nid = 1\nbody = 'a'\n[[tags]]\nid = 1\nbody = 'b'", "tags[1].id: found 1"),
        ("[[tags]]\nid = 1\nbody = 'a'\nlever_arm_m = [1, 2]", "lever_arm_m"),
        ("pairs = [", "not valid TOML"),
    ],
)
def test_plans_that_cannot_be_played(tmp_path, text, fragment):
    with pytest.raises(PlanError, match=r"plan\.toml") as caught:
        load_plan(written(tmp_path, text))
    assert fragment in str(caught.value)


def test_an_absent_tag_is_named():
    with pytest.raises(PlanError, match="names 9, but the boards at the ports are 1, 2"):
        RangingPlan(((1, 9),)).turns([1, 2])
    with pytest.raises(PlanError, match="no two boards"):
        RangingPlan().turns([1])


def test_tags_come_from_a_scenario_too(tmp_path):
    assert load_places(written(tmp_path, "[run]\nseed = 1\n[[tags]]\nid = 4\nbody = 'x'\nskew_ppm = 3\n"))[0] == (
        Tag(4, "x", (0.0, 0.0, 0.0)),
    )


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"rate_hz": 0}, "rate_hz: found 0, expected a positive number"),
        ({"rate_hz": float("nan")}, "rate_hz: found nan"),
        ({"protocol": "tdoa"}, "protocol: found 'tdoa', expected ds or ss"),
        ({"pairs": ((1, 1),)}, r"pairs: found \(\(1, 1\),\), expected"),
        ({"pairs": ((1, 300),)}, "pairs: found"),
        ({"pairs": "some"}, "pairs: found 'some'"),
    ],
)
def test_plans_that_cannot_be_are_refused_where_they_are_made(given, text):
    with pytest.raises(PlanError, match=text):
        RangingPlan(**given)
