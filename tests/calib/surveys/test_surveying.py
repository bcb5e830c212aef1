"""Surveys of boards that stand still: planted delays and positions, undetermined ones, and wrong known facts."""

import json
import math
import re
import tomllib
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import typer
from scipy.stats import norm
from scipy.stats import t as student

import calib
import uwblink
from benchmarks.standing import C_M_PER_NS, standing_boards
from calib.cli.commands import app
from calib.data.samples import ANCHOR_DELAYS_NS, stamped
from calib.surveys.knowledge import load_knowledge
from tests import processes
from tests.calib.synthetic import largest_score
from uwblink.recording.schema import KnownDistance, load_places


def in_order(*orders):
    """Return positions on a line (boards, 3) in a given order of boards, with uneven steps."""
    steps = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [2.1, 0.0, 0.0], [3.6, 0.0, 0.0]])
    return [steps[np.argsort(order)] for order in orders]


FOUR = in_order((1, 2, 3, 4), (2, 1, 4, 3), (3, 1, 4, 2), (2, 4, 1, 3), (4, 3, 2, 1), (1, 3, 4, 2), (3, 2, 4, 1))


def spans(count):
    """Return the time of each arrangement of a world, by its number from 1."""
    return {str(k + 1): (70.0 * k, 70.0 * k + 60) for k in range(count)}


def moved(by_m, arrangements, **settings):
    """Return a world in which board 4 is moved during the third arrangement."""
    world = standing_boards(9, places=FOUR[:arrangements], pair_error_m=0.01, **settings)
    r, place = world.ranges, world.places[2][:, 0]
    late = (r.time_ns > 2 * 70e9 + 25e9) & (r.time_ns < 3 * 70e9 - 5e9) & ((r.initiator == 4) | (r.target == 4))
    away = place[3] - place[r.initiator + r.target - 5]
    return replace(world, ranges=replace(r, raw_m=r.raw_m + late * (np.abs(away + by_m) - np.abs(away))))


def crooked():
    off = np.zeros((5, 4, 3))
    off[2, 3, 1] = 1.2
    return standing_boards(9, places=[*np.array(FOUR[:5]) + off], pair_error_m=0.01, bias_size_m=0.02)


def saved(world, path, known="line", distances=(), power_dbm=None):
    """Write a world as a recording of double-sided exchanges, with its arrangements A, B and on."""
    r, power = world.ranges, world.ranges.fpp1_dbm if power_dbm is None else np.full(len(world.ranges), power_dbm)
    x = stamped(r.time_ns, np.column_stack([r.initiator, r.target]), r.raw_m, np.stack([power, power]))
    at_ns = np.arange(len(world.places)) * 70 * 10**9
    marks = [uwblink.Arrangement("ABCDEFGH"[k], ns, ns + 65 * 10**9, known) for k, ns in enumerate(at_ns.tolist())]
    uwblink.Contents(exchanges=x, arrangements=marks, known_distances=list(distances)).save(path)
    return path


def test_without_noise_delays_and_places_are_exact():
    """Delays have the weights of either end: 0.7 for the lower tag, 0.3 for the other one."""
    world = standing_boards(1, places=FOUR[:4], pair_error_m=0.0, noise_m=0.0)
    taped = calib.Knowledge(shape="line", distances=(KnownDistance(1, 3, 2.1, 0.01, "1"),))
    r, delay = world.ranges, np.array([0.0, *world.delays_ns.values()])
    low, high, count = np.minimum(r.initiator, r.target), np.maximum(r.initiator, r.target), np.ones(len(r))
    raw = r.raw_m - uwblink.SPEED_OF_LIGHT * 0.2e-9 * (delay[low] - delay[high])
    weights: Any = {"weight_initiator": 0.7 * count, "weight_target": 0.3 * count}
    result = calib.survey(replace(r, initiator=low, target=high, raw_m=raw, **weights), known=taped)
    # A tenth of a millimetre, 3e-4 ns: also in ranges without noise, one may be reflected by less than its noise.
    assert result.calibration.delays_ns == pytest.approx(world.delays_ns, abs=3e-4)
    for k, one in enumerate(result.arrangements):
        found = np.array([board.position_m[0] for board in one.boards])
        place = world.places[k][:, 0] - world.places[k][0, 0]
        assert found == pytest.approx(place * np.sign(place[1]), abs=1e-4)
    assert (result.findings, result.second_best) == ((), None)


def assert_sound(world, result):
    assert (len(result.arrangements), result.pair_error_m) == (len(world.places), pytest.approx(0.02, rel=0.4))
    assert largest_score(result, world.delays_ns) < 3.5
    assert np.mean([abs(d - world.delays_ns[t]) for t, d in result.calibration.delays_ns.items()]) < 0.1


@pytest.mark.parametrize(
    ("shape", "boards", "count"), [("line", 4, 7), pytest.param("space", 7, 5, marks=pytest.mark.slow)]
)
def test_planted_delays_lie_within_their_intervals(shape, boards, count):
    world = standing_boards(3, shape, boards=boards, arrangements=count)
    assert_sound(world, calib.survey(world.ranges, known="" if shape == "space" else shape))


@pytest.mark.slow
def test_intervals_of_delays_and_places_hold_in_the_stated_frame():
    world = standing_boards(40, "plane", boards=5, arrangements=5)
    result = calib.survey(world.ranges, known="plane")
    assert_sound(world, result)
    inside = []
    for k, one in enumerate(result.arrangements):
        a, b = world.places[k][:2, :2]
        x = (b - a) / np.linalg.norm(b - a)
        truth = (world.places[k][:, :2] - a) @ np.array([x, [-x[1], x[0]]]).T
        truth[:, 1] *= np.sign(next(v for v in truth[2:, 1] if abs(v) > 0.2 * np.abs(truth[2:, 1]).max()))
        for n, board in enumerate(one.boards[2:], start=2):
            away = np.array(board.position_m[:2]) - truth[n]
            cov = board.covariance_m2[:2, :2] + 1e-12 * np.eye(2)
            inside.append(float(away @ np.linalg.solve(cov, away)) < 5.99)
    assert np.mean(inside) > 0.8  # of 15, and those of one arrangement are dependent


def test_three_boards_in_a_row_determine_only_the_middle_delay():
    world = standing_boards(5, boards=3, places=in_order((1, 2, 3)), pair_error_m=0.005)
    result = calib.survey(world.ranges, known="line")
    assert list(result.calibration.delays_ns) == [2]
    assert abs(result.calibration.delays_ns[2] - world.delays_ns[2]) < 0.15
    (text,) = [one.evidence for one in result.findings if one.fault == "delays that a survey leaves open"]
    assert re.match(r"not determined.*left out: tags 1, 3$", text)
    assert result.verdict.named("delay") == ("1", "3")
    tapes = KnownDistance(1, 2, 0.9, 0.002), KnownDistance(2, 3, 1.2, 0.002)
    result = calib.survey(world.ranges, known=calib.Knowledge(shape="line", distances=tapes))
    assert list(result.calibration.delays_ns) == [1, 2, 3]
    assert largest_score(result, world.delays_ns) < 3


def test_one_arrangement_in_space_determines_nothing_and_names_the_boards(tmp_path):
    world = standing_boards(5, "space", boards=5, arrangements=1)
    with pytest.raises(
        calib.UnanswerableError, match=r"determine no delay: .* can change .*`calib plan survey`"
    ) as caught:
        calib.survey(world.ranges)
    assert caught.value.undetermined == [[1, 2, 3, 4, 5]]
    found = calib.examine(saved(world, tmp_path / "a.uwb", known=""))
    assert "survey determines nothing" in [one.fault for one in found]


@pytest.mark.slow
def test_a_curve_over_power_is_found_along_with_the_delays():
    world = standing_boards(2, "plane", boards=5, arrangements=6, bias_size_m=0.06, size_m=9.0, pair_error_m=0.01)
    result = calib.survey(world.ranges, known="plane")
    curve = result.calibration.bias_curve
    reference, low, high = curve(np.array([1.0, *curve.range]))
    assert reference == pytest.approx(0.0, abs=2e-3)
    assert largest_score(result, world.delays_ns) < 3.5
    # -77 dBm at a metre: from 0.4 m (-69) to 9 m (-96), the planted curve increases by 11 cm.
    assert low - high > 0.05


@pytest.mark.slow
def test_the_common_delay_is_within_its_interval_for_non_monotonic_curves():
    world = standing_boards(1002, boards=5, arrangements=8, wave_size_m=0.05, board_power_db=1.0)
    length = float(np.linalg.norm(world.places[0][0] - world.places[0][1]))
    taped = calib.Knowledge(shape="line", distances=(KnownDistance(1, 2, length, 0.005, "1"),))
    found = calib.survey(world.ranges, known=taped).calibration
    off = np.mean([found.delays_ns[tag] - planted for tag, planted in world.delays_ns.items()])
    assert abs(off) < 2 * math.sqrt(np.mean(found.uncertainty.delays_ns2)) < 0.2
    # Planted: 7.6 cm between these two powers.
    rise = np.diff(found.bias_curve(10 ** ((np.array([-82.0, -86.0]) + 82.0) / 10)))
    assert rise == pytest.approx(0.076, abs=0.045)


def test_spans_and_shape_of_a_file_make_arrangements(tmp_path):
    path = tmp_path / "known.toml"
    marks = (f"[[arrangements]]\nname = 'm{k}'\nstart_s = {70 * k}\nend_s = {70 * k + 60}\n" for k in range(3))
    path.write_text("known = 'line'\n" + "".join(marks))
    result = calib.survey(standing_boards(3, places=FOUR[:3]).ranges, known=path)
    assert [(one.name, one.known) for one in result.arrangements] == [(f"m{k}", "line") for k in range(3)]
    assert sorted(result.calibration.delays_ns) == [1, 2, 3, 4]


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("shape", ["", "line"])
def test_one_pair_determines_no_delay(shape, count):
    ranges = standing_boards(1, boards=2, arrangements=4).ranges
    with pytest.raises(calib.UnanswerableError, match="determine no delay"):
        calib.survey(ranges, known=calib.Knowledge(shape=shape, spans_s=spans(count)))


def test_files_of_known_facts_are_read(tmp_path):
    path = tmp_path / "known.toml"
    path.write_text(
        "known = 'line'\n"
        "[[distances]]\nbetween = [4, 1]\ndistance_m = 3.06\n"
        "[[distances]]\nbetween = [65535, 300]\ndistance_m = 2\nsigma_m = 0.02\narrangement = 'B'\n"
        "[[positions]]\ntag = 65535\nposition_m = [0.5, 5.2, 2.4]\n"
        "[[positions]]\ntag = 0\nposition_m = [1, 2, 3]\nsigma_m = 0.03\narrangement = 'A'\n"
        "[[arrangements]]\nname = 'B'\norder = [3, 1, 4, 2]\nstart_s = 70\nend_s = 130.5\n"
        "[[arrangements]]\nname = 'p'\nknown = 'plane'\n"
    )
    known = load_knowledge(path)
    assert known.distances == (KnownDistance(1, 4, 3.06, 0.005, ""), KnownDistance(300, 65535, 2.0, 0.02, "B"))
    assert known.positions == (
        calib.KnownPosition(65535, (0.5, 5.2, 2.4), 0.01, ""),
        calib.KnownPosition(0, (1.0, 2.0, 3.0), 0.03, "A"),
    )
    b, p = (uwblink.Arrangement(name, 0, 1) for name in "Bp")
    assert (known.spans_s, known.order_of(b)) == ({"B": (70.0, 130.5)}, (3, 1, 4, 2))
    # The general shape applies to arrangements without one.
    assert [known.shape_of(b), known.shape_of(p)] == ["line", "plane"]


def test_a_distance_for_all_arrangements_is_one_measurement():
    world = standing_boards(5, boards=3, places=in_order(*[(1, 2, 3)] * 4), pair_error_m=0.002)
    taped = tuple(KnownDistance(i, i + 1, d, 0.02) for i, d in ((1, 0.9), (2, 1.2)))
    known = calib.Knowledge(shape="line", spans_s=spans(4), distances=taped)
    found = calib.survey(world.ranges, known=known).calibration
    # r12 determines delays 1 and 2 together to 2 cm, 0.13 ns; delay 2 is that of the middle board.
    assert found.delays_std_ns[1] == pytest.approx(2 * 0.02 / 0.2997, rel=0.25)


def test_a_position_for_all_arrangements_is_one_measurement():
    world = standing_boards(5, "plane", boards=3, places=[standing_boards(5, "plane", boards=3).places[0]] * 4)
    at = tuple(calib.KnownPosition(tag, tuple(place.tolist()), 0.02) for tag, place in enumerate(world.places[0], 1))
    known = [calib.Knowledge(shape="plane", spans_s=spans(count), positions=at) for count in (1, 4)]
    stds = [calib.survey(world.ranges, known=one, pair_error_m=1e-4).verdict.std[0] for one in known]
    # The same positions four times are not known better.
    assert stds[1] == pytest.approx(stds[0], rel=0.1)


def test_errors_that_last_within_an_arrangement_widen_intervals():
    r = standing_boards(5, places=FOUR[:4], pair_error_m=0.0).ranges
    slow, quick = 2 * np.pi * r.time_ns / 20e9 + r.initiator * r.target, np.arange(len(r)) * 2.4
    lasting, brief = (
        calib.survey(replace(r, raw_m=r.raw_m + 0.06 * np.sin(phase)), known="line", pair_error_m=1e-4).calibration
        for phase in (slow, quick)
    )
    assert lasting.delays_std_ns[2] > 1.5 * brief.delays_std_ns[2]


def test_few_arrangements_widen_intervals_by_students_quantile():
    result = calib.survey(standing_boards(5, boards=3, arrangements=3).ranges, known="line")
    # The prior of the pair error counts as three degrees of freedom (docs/theory.md).
    wider = student.ppf(0.975, result.calibration.provenance["geometry"]["freedom"] + 3) / norm.ppf(0.975)
    assert wider > 1.05
    expected = result.verdict.std[result.verdict.determined] * wider
    assert [*result.calibration.delays_std_ns.values()] == pytest.approx(expected, rel=1e-6)


def test_known_positions_give_the_frame():
    corners = np.array(
        [[0.0, 0.0, 1.0], [6.0, 0.0, 1.2], [6.0, 5.0, 0.9], [0.0, 5.0, 1.1], [2.5, 2.0, 2.4], [3.0, 4, 0.2]]
    )
    world = standing_boards(4, "space", boards=6, places=[corners], pair_error_m=0.01)
    known = tuple(calib.KnownPosition(tag, tuple(corners[tag - 1].tolist()), 0.005) for tag in (1, 2, 3, 4))
    (one,) = calib.survey(world.ranges, known=calib.Knowledge(positions=known)).arrangements
    assert one.frame == "that of the known positions"
    for board, corner in zip(one.boards, corners, strict=True):
        std = math.sqrt(np.diag(board.covariance_m2).max())
        assert board.position_m == pytest.approx(corner, abs=4 * std)


@pytest.mark.parametrize(("by_m", "chance"), [(0.10, 1e-6), (-0.25, 1e-50)])
def test_a_board_that_was_moved_is_named(by_m, chance):
    ranges, known = moved(by_m, 3).ranges, calib.Knowledge(shape="line", spans_s=spans(3))
    with pytest.raises(calib.UnanswerableError, match=r"^3: board 4 was moved 2\d s after the start"):
        calib.survey(ranges, known=known)
    (found,) = calib.survey(ranges, known=known, regardless=True).contradictions
    # Steps of single pairs exceed six standard deviations, and a longer step is less likely by chance.
    assert found.fault == "board moved within an arrangement"
    assert 0 < (found.p_value or 0) < chance


STRAIGHT = standing_boards(9, places=FOUR[:5], pair_error_m=0.01, bias_size_m=0.02)
TAPES = KnownDistance(1, 3, 2.1 + 0.3, 0.005, "A"), KnownDistance(2, 4, 2.7, 0.005, "A")
"""A measured distance that is 30 cm off, and one that is right."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "tapes", "fault", "evidence", "shapes"),
    [
        (STRAIGHT, (), "", "", "l l l l l"),
        (
            STRAIGHT,
            TAPES,
            "wrong known distance",
            r"the known distance of 1 and 3 in A differs from the ranges by \+\d+ cm",
            "l l l l l",
        ),
        (crooked(), (), "arrangement not as stated", "C: the boards are not on a line", "l l p l l"),
        (
            moved(0.2, 5, bias_size_m=0.02),
            (),
            "board moved within an arrangement",
            r"C: board 4 was moved 2\d s",
            "l l l l l",
        ),
    ],
    ids=["sound", "a wrong tape", "crooked", "moved"],
)
def test_contradictions_are_named_by_a_survey_and_by_the_doctor(tmp_path, world, tapes, fault, evidence, shapes):
    path = saved(world, tmp_path / "a.uwb", distances=tapes)
    result = calib.survey(path, regardless=True)
    for found in (result.contradictions, calib.examine(path)):
        assert [one.fault for one in found] == [fault] * bool(fault)
        assert all(re.match(evidence, one.evidence) for one in found)
        assert [one.p_value for one in found] == [pytest.approx(0.005, abs=0.005)] * bool(fault)
    assert largest_score(result, world.delays_ns) < 4
    assert " ".join(one.known[0] for one in result.arrangements) == shapes


@pytest.mark.slow
def test_exchanged_labels_of_known_positions_are_named():
    """Six boards on a table with four known positions, and the labels of two exchanged."""
    world = standing_boards(8, "plane", boards=6, arrangements=3, pair_error_m=0.01)
    places = zip((2, 1, 3, 4), world.places[0].tolist(), strict=False)
    said = tuple(calib.KnownPosition(tag, tuple(place), 0.01, "1") for tag, place in places)
    result = calib.survey(world.ranges, known=calib.Knowledge(shape="plane", positions=said), regardless=True)
    (found,) = result.contradictions
    assert (found.fault, "if 1 and 2 are exchanged" in found.evidence) == ("exchanged labels", True)
    assert found.p_value == pytest.approx(0.005, abs=0.005)
    assert largest_score(result, world.delays_ns) < 4


@pytest.mark.slow
def test_powers_that_hardly_vary_are_named_by_the_doctor(tmp_path):
    path = saved(standing_boards(9, places=FOUR[:3], pair_error_m=0.01), tmp_path / "a.uwb", power_dbm=-80.0)
    assert [one.fault for one in calib.examine(path)] == ["powers that hardly vary"]


def test_a_known_delay_stays_and_the_others_follow():
    world = standing_boards(5, boards=3, places=in_order((1, 2, 3), (2, 1, 3)), pair_error_m=0.005)
    found = calib.survey(world.ranges, known="line", fixed_ns={3: world.delays_ns[3]}).calibration
    assert found.delays_ns[3] == pytest.approx(world.delays_ns[3], abs=1e-3)
    assert (found.delays_std_ns[3], set(found.delays_ns)) == (0.0, {1, 2, 3})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("known = 'ring'", "known: found 'ring'"),
        ("knwn = 'line'", "knwn: unknown key"),
        ("[[distances]]\nbetween = [1, 1]\ndistance_m = 2.0", r"distances\[0\].between"),
        ("[[distances]]\nbetween = [1, 2]\ndistance_m = -2.0", r"distances\[0\].distance_m"),
        ("[[distances]]\nbetween = [1, 2]", r"distances\[0\].distance_m"),
        ("[[distances]]\nbetween = [1, 2]\ndistance_m = 2\nsigma_m = 0", r"distances\[0\].sigma_m"),
        ("[[positions]]\ntag = 65536\nposition_m = [1, 2, 3]", r"positions\[0\].tag"),
        ("[[positions]]\ntag = 3\nposition_m = [1, 2]", r"positions\[0\].position_m"),
        ("[[arrangements]]\nname = 'a'\nstart_s = 3", "start_s and end_s"),
        ("[[arrangements]]\nname = 'a'\nstart_s = -1e300\nend_s = 2", r"arrangements\[0\].start_s"),
        ("[[arrangements]]\nname = 'a'\nstart_s = 3\nend_s = 2", "end_s"),
        ("[[arrangements]]\nname = 'a'\n[[arrangements]]\nname = 'a'", "each name once"),
        ("[[arrangements]]\nknown = 'line'", "name"),
        ("[[arrangements]]\nname = 'a'\norder = [3, 3]", r"arrangements\[0\].order"),
        ("[[arrangements]]\nname = 'a'\norder = [3]", r"arrangements\[0\].order"),
        ("[[arrangements]]\nname = 'a'\norder = '3 1'", r"arrangements\[0\].order"),
        ("[[arrangements]]\nname = 'a'\norder = [3, 1]\nknown = 'plane'", 'known = "line"'),
        ("distances = 3", "distances"),
        ("known = ", "not valid TOML"),
        ("known = 3", "known: found 3, allowed: line, plane$"),
    ],
)
def test_errors_in_files_of_known_facts_are_one_line(tmp_path, text, message):
    path = tmp_path / "known.toml"
    path.write_text(text)
    with pytest.raises(calib.BadInputError, match=message) as caught:
        load_knowledge(path)
    assert "\n" not in str(caught.value) or "TOML" in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"known": 3}, "known"),
        ({"known": "nowhere.toml"}, "no such file of known facts"),
        ({"known": calib.Knowledge(shape="ring")}, "ring"),
        ({"known": calib.Knowledge(shapes={"9": "line"})}, "contains an unknown arrangement '9'"),
        ({"known": calib.Knowledge(distances=(KnownDistance(1, 9, 1.0, 0.1),))}, "have no ranges"),
        ({"known": calib.Knowledge(distances=(KnownDistance(1, 1, 1.0, 0.1),))}, "two different tags"),
        ({"known": calib.Knowledge(distances=(KnownDistance(1, 2, math.nan, 0.1),))}, "more than 0"),
        ({"known": calib.Knowledge(distances=(KnownDistance(1, 2, 1.0, 1e300),))}, "or more"),
        ({"known": calib.Knowledge(distances=(KnownDistance(1, 2, 1.0, 1e-300),))}, "or more"),
        ({"known": calib.Knowledge(distances=(KnownDistance(1, 2, 1e200, 0.1),))}, r"up to 1e\+06 m"),
        ({"known": calib.Knowledge(positions=(calib.KnownPosition(9, (0, 0, 0)),))}, "have no ranges"),
        ({"known": calib.Knowledge(positions=(calib.KnownPosition(1, (0, 0)),))}, "or more"),  # type: ignore[arg-type]
        ({"known": calib.Knowledge(spans_s={"0": (0.0, math.inf)})}, "start and end"),
        *(({"pair_error_m": wrong}, "pair_error_m") for wrong in (-1.0, 1e-300, 1e300)),
        ({"fixed_ns": {9: 0.1}}, "fixed_ns"),
        ({"fixed_ns": {1: math.nan}}, "fixed_ns"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(settings, message):
    with pytest.raises(calib.BadInputError, match=message):
        calib.survey(calib.sample_arrangements(2), **settings)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The arrangements of the sample, each as a recording with its mark."""
    folder, ranges = tmp_path_factory.mktemp("sample"), calib.sample_arrangements(4)
    paths = [str(folder / f"{k}.uwb") for k in range(4)]
    for k, path in enumerate(paths):
        r = ranges[ranges.time_ns // 40_000_000_000 == k]
        x = stamped(r.time_ns, np.column_stack([r.initiator, r.target]), r.raw_m, np.full((2, len(r)), np.nan))
        mark = uwblink.Arrangement("ABCD"[k], int(r.time_ns[0]), int(r.time_ns[-1]) + 1, "line")
        uwblink.Contents(exchanges=x, arrangements=[mark]).save(path)
    return paths


@pytest.fixture(scope="module")
def surveyed(recording):
    return calib.survey(recording)


def test_the_command_accepts_a_recording_per_arrangement(recording, tmp_path):
    out, anchors = tmp_path / "c.json", tmp_path / "anchors.toml"
    words = ["survey", *recording, "-o", out, "--save-anchors", f"B={anchors}", "--json"]
    told = json.loads(processes.succeed("calib", *words).stdout)
    assert [(one["name"], one["known"]) for one in told["arrangements"]] == [(name, "line") for name in "ABCD"]
    known = calib.load_calibration(out)
    assert known.provenance["recipe"] == "survey"
    assert known.provenance["geometry"]["arrangements"][1] == {"name": "B", "known": "line", "tags": [1, 2, 3, 4]}
    assert known.delays_ns == pytest.approx({tag: ANCHOR_DELAYS_NS[tag] for tag in (1, 2, 3, 4)}, abs=0.2)
    rows = {row["id"]: row for row in tomllib.loads(anchors.read_text())["anchors"]}
    assert list(rows) == sorted(load_places(anchors)[1]) == [1, 2, 3, 4]
    places = [row["position_m"] for row in rows.values()]
    assert places == [one["position_m"] for one in told["arrangements"][1]["boards"]]
    assert places[0] == [0.0, 0.0, 0.0]
    first, *others = np.sqrt([row["covariance_m2"][0] for row in rows.values()])
    assert first == 0
    assert others == pytest.approx([others[0]] * 3, rel=0.8)
    # It makes a corrected recording like any other calibration.
    assert calib.apply(recording[0], known, tmp_path / "corrected.uwb").count == 600


def test_positions_are_written_for_ros_and_as_a_figure(surveyed, tmp_path):
    surveyed.save_anchors(tmp_path / "a.yaml", arrangement="A")
    surveyed.save_picture(tmp_path / "places.svg")
    text, drawn = ((tmp_path / name).read_text() for name in ("a.yaml", "places.svg"))
    # One panel each.
    found = text.count("ids: [1, 2, 3, 4]"), text.count("covariance: ["), drawn.count('id="axes_')
    assert found == (1, 4, 4)


@pytest.mark.parametrize(
    ("write", "name", "message"),
    [
        (calib.SurveyResult.save_anchors, "b.yaml", "there are A, B, C, D"),
        (partial(calib.SurveyResult.save_anchors, arrangement="A"), "b.txt", r"expected .toml or .yaml"),
        (calib.SurveyResult.save_picture, "places.gif", r"expected .svg, .png or .pdf"),
    ],
)
def test_positions_are_not_written_in_other_forms(surveyed, tmp_path, write, name, message):
    with pytest.raises(calib.BadInputError, match=message):
        write(surveyed, tmp_path / name)


def test_undetermined_surveys_are_refused_with_the_reason(recording, tmp_path):
    done = processes.run("calib", "survey", recording[0], "-o", tmp_path / "c.json", "--json", "--known", "plane")
    assert (done.returncode, json.loads(done.stdout)["undetermined"]) == (1, [[1, 2, 3, 4]])
    assert not (tmp_path / "c.json").exists()


def test_two_arrangements_of_one_name_are_refused_by_flags_that_the_command_has(recording):
    words = ("calib", "survey", recording[0], recording[0], "-o", "c.json")
    told = processes.refuse(*words, naming=["two arrangements have the name 'A'"])
    commands: Any = typer.main.get_command(app)
    options = {option for one in commands.commands["survey"].params for option in one.opts}
    assert set(re.findall(r"--[a-z-]+", told)) <= options


def test_a_recording_that_is_given_twice_is_refused_under_any_name(recording, tmp_path):
    paths = [tmp_path / name for name in ("one.uwb", "other.uwb")]
    for path in paths:
        uwblink.Contents(exchanges=uwblink.load(recording[0]).exchanges).save(path)
    with pytest.raises(calib.BadInputError, match=r"^other\.uwb: contains the same exchanges as one\.uwb"):
        calib.survey(paths)


def test_a_curve_is_used_if_powers_do_not_vary():
    # Boards about 2.5 m apart: powers within 3 dB, and a bias of several cm that delays would absorb.
    corners = np.array([[0.0, 0.0, 0.0], [2.3, 0.0, 0.0], [1.1, 2.1, 0.0], [1.2, 0.7, 1.9]])
    near = [corners, corners[[1, 2, 3, 0]]]

    def seen(places):
        """Return ranges of boards, and the measured distances of all pairs."""
        apart = (
            (i + 1, j + 1, float(np.linalg.norm(place[i] - place[j])), 0.003, str(k))
            for k, place in enumerate(places, 1)
            for i, j in combinations(range(4), 2)
        )
        known = calib.Knowledge(spans_s=spans(2), distances=tuple(KnownDistance(*one) for one in apart))
        return standing_boards(8, boards=4, places=places, bias_size_m=0.1, pair_error_m=0.005), known

    # The curve of the same boards, from a survey in which distances vary and are known.
    wide, taped = seen([0.6 * near[0], 3.0 * near[1]])
    known = calib.survey(wide.ranges, known=taped).calibration
    assert not known.bias_curve.flat
    world, taped = seen(near)
    alone = calib.survey(world.ranges, known=taped, delays_only=True).calibration
    result = calib.survey(world.ranges, known=taped, curve_from=known)
    found = result.calibration
    assert found.bias_curve == known.bias_curve
    without, off = (np.mean([c.delays_ns[t] - d for t, d in world.delays_ns.items()]) for c in (alone, found))
    assert abs(off) < 0.5 * abs(without)
    assert largest_score(result, world.delays_ns) < 3.5
    # Intervals include the errors of the curve.
    sure = calib.survey(world.ranges, known=taped, curve_from=replace(known, uncertainty=None)).calibration
    assert all(sure.delays_std_ns[t] < std for t, std in found.delays_std_ns.items())


def test_boards_whose_delays_are_all_known_get_places():
    known = {1: -0.3, 2: 0.1, 3: -0.1, 4: 0.2}
    result = calib.survey(calib.sample_arrangements(2), known="line", fixed_ns=known)
    assert result.calibration.delays_ns == known
    place = {board.tag: board.position_m[0] for board in result.arrangements[0].boards}
    # The seed places these neighbours 1.45 m apart; a pair has an error of 1 cm.
    assert place[2] - place[1] == pytest.approx(1.45, abs=0.04)
    assert all(0 < board.within_m < 0.1 for board in result.arrangements[0].boards[1:])


def test_unusable_curves_are_refused(surveyed):
    ranges, flight = calib.sample_arrangements(2), calib.fit(calib.sample_flight()).calibration
    for refused, settings, message in (
        (calib.BadInputError, {"curve_from": surveyed.calibration}, "it has no curve"),
        (calib.UnanswerableError, {"curve_from": flight}, "some pairs have no power"),
        (calib.BadInputError, {"curve_from": flight, "delays_only": True}, "cannot be used with `delays_only`"),
        (calib.BadInputError, {"curve_from": replace(flight, alpha_dbm=-80.0)}, "its power is"),
        (calib.BadInputError, {"curve_from": replace(flight, power_at="reception")}, "a curve of each reception"),
    ):
        with pytest.raises(refused, match=message):
            calib.survey(ranges, known="line", **settings)


# The errors of ranges of other recordings, of boards that move: drawn by NumPy from the planted values.


@pytest.mark.slow
def test_a_survey_states_the_errors_of_ranges_of_other_recordings():
    share, detour_m, noise_m, between_m = 0.05, 0.3, 0.03, 0.05
    pairs, found = np.array(list(combinations(range(1, 5), 2))), []
    delays_ns = np.array([0.0, *(ANCHOR_DELAYS_NS[tag] for tag in range(1, 5))])
    for seed in range(1, 9):
        rng = np.random.default_rng(seed)

        def detours(count, rng=rng):
            return np.where(rng.random(count) < share, rng.exponential(detour_m, count), 0.0)

        surveyed = calib.sample_arrangements(6, seed=seed)
        surveyed = replace(surveyed, raw_m=surveyed.raw_m + detours(len(surveyed)))
        calibration = calib.survey(surveyed, known="line").calibration
        stated, pair = calibration.errors, np.arange(4000) % len(pairs)
        assert stated is not None
        true_m = rng.uniform(1, 6, len(pair))
        constant_m = rng.normal(0, between_m, len(pairs)) - 0.5 * C_M_PER_NS * delays_ns[pairs].sum(axis=1)
        raw_m = true_m + constant_m[pair] + noise_m * rng.normal(size=len(pair)) + detours(len(pair))
        initiator, target = pairs[pair].T
        others = calib.Ranges.from_arrays(raw_m, initiator=initiator, target=target, truth_m=true_m)
        judged = calib.evaluate(others, calibration).overall
        shapes = stated.shapes(np.ones(1), initiator[:1], target[:1])
        # The uncertainty of the delays is a part of the noise.
        sums_m = [0.5 * C_M_PER_NS * calibration.std_of_sum_ns(pair) for pair in pairs.tolist()]
        noise = math.sqrt(stated.within_m(shapes.noise_m)[0] ** 2 - np.mean(np.square(sums_m)))
        found.append([stated.tail_share[0], stated.mean_m(shapes)[0], noise, judged.inside_95, judged.total_std])
    shares, means, noise, inside, total = np.mean(found, axis=0)
    assert noise == pytest.approx(noise_m, rel=0.05)
    # 3600 ranges determine a share to 0.4 percentage points, eight surveys to 0.13; short detours count as noise.
    assert shares == pytest.approx(share, abs=0.006)
    assert means == pytest.approx(share * detour_m, rel=0.1)
    # Constants of six pairs, and delays of one survey, are common to ranges: shares of surveys vary by 4 percentage
    # points, standard deviations by 13 %; the tolerance is twice that of their mean.
    assert inside == pytest.approx(0.95, abs=0.03)
    assert total == pytest.approx(1.0, abs=0.1)


def test_errors_of_other_recordings_contain_the_uncertainty_of_delays():
    pairs, sizes = list(combinations(range(1, 5), 2)), []
    for pair_error_m in (0.01, 0.05):
        found = calib.survey(calib.sample_arrangements(), known="line", pair_error_m=pair_error_m).calibration
        sums_m = [0.5 * C_M_PER_NS * found.std_of_sum_ns(pair) for pair in pairs]
        sizes.append((np.mean(np.square(sums_m)), found.errors.noise_m[0] ** 2))
    (less, alone), (more, both) = sizes
    # At pair errors of 1 cm the noise of a range is 3 cm.
    assert more > 0.02**2
    assert both - alone == pytest.approx(more - less, rel=0.02)
