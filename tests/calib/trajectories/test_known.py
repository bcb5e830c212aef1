"""Known facts in addition to ranges and poses, such as measured distances and heights; and flights that contradict
them.
"""

import re
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest

import calib
import uwbsim
from calib.trajectories.samples import tapes_of
from calib.trajectories.scene import scene_from
from calib.trajectories.start import interpolated, resolve_headings
from tests.calib.synthetic import largest_score
from tests.calib.trajectories.sines import CEILING, CORNERS, DELAYS_NS, distance_errors, flight, scores
from tests.shared_data import miluv
from uwblink import Arrangement, KnownDistance, importers

pytestmark = pytest.mark.slow


KNOWN_START: dict[str, Any] = {"poses_until_s": 6.0, "heading_std_deg": 0.0}


def common(result):
    """Return the mean error of all delays and its standard error, in ns."""
    found, planted = result.calibration, [*DELAYS_NS.values()]
    error = np.mean([found.delays_ns[tag] for tag in DELAYS_NS]) - np.mean(planted)
    return float(error), float(np.sqrt(np.mean(found.uncertainty.delays_ns2)))


def by_tape(flown, first, second, off_m=0.0, std_m=0.005):
    """Return the distance of two tags while all bodies stood still, wrong by `off_m`."""
    ends = [flown.antennas(np.array([tag]), np.array([1.0])) for tag in (first, second)]
    return KnownDistance(first, second, float(np.linalg.norm(ends[0] - ends[1])) + off_m, std_m, "0..4")


def test_a_measured_distance_determines_the_common_delay():
    flown = flight(seconds=12.0, standing_s=4.0)
    given: dict[str, Any] = {"poses_until_s": 0.0, "heading_std_deg": 0.0, "minimum_norm": True}
    without = calib.fit_from_ranges(flown, **given)
    error, std = common(without)
    assert abs(error) < 1.96 * std
    assert without.calibration.provenance["undetermined"] == [list(DELAYS_NS)]
    told_ns = re.findall(r"common part is known to ± ([\d.]+) ns", without.warnings[0])
    assert list(map(float, told_ns)) == [pytest.approx(1.96 * std, abs=0.01)]
    result = calib.fit_from_ranges(flown, distances=[by_tape(flown, 1, 3)], **given)
    error, std = common(result)
    # 26 ranges of the pair while both stood still, with 4 cm each and some reflected, leave 0.1 ns of both delays.
    assert abs(error) / 3 < std < 0.15
    assert abs(np.mean(distance_errors(result, flown))) < 0.05
    assert result.calibration.provenance["geometry"]["distances"] == 1


def test_a_wrong_measured_distance_is_named():
    flown = flight(seconds=8.0, standing_s=4.0)
    # A distance without an arrangement does not state when the bodies stood still.
    tapes = [by_tape(flown, 1, 3, 0.3), by_tape(flown, 2, 5), KnownDistance(2, 3, 2.0, 0.02)]
    result = calib.fit_from_ranges(flown, distances=tapes, **KNOWN_START)
    (named,) = [one for one in result.findings if one.fault == "wrong known distance"]
    # Thirty centimetres, within the accuracy of 16 ranges of the pair and known positions of 2 cm.
    size = r"(2[5-9]|3[0-4])(\.\d+)?"
    assert re.match(rf"the distance of tags 1 and 3, 3\.952 m, is {size} .* more than ", named.evidence)
    assert named.p_value == pytest.approx(0, abs=1e-4)
    assert [text for text in result.warnings if "tags 2 and 3 is not used" in text]
    assert result.calibration.provenance["geometry"]["distances"] == 2


def test_the_weight_of_a_distance_is_independent_of_its_duration():
    bodies, floor = {1: "a", 2: "a", 3: "b", 11: "c", 12: "d"}, Arrangement("floor", 10**9, 3 * 10**9)
    stated = [
        KnownDistance(11, 12, 4.0, 0.01),
        KnownDistance(1, 3, 2.0, 0.01, "floor"),
        KnownDistance(2, 3, 2.0, 0.02, "5..5.9"),
    ]
    found = tapes_of(stated, [floor], bodies, {"c", "d"}, 0, 20.0)
    assert found.time_s == pytest.approx([np.nan, 1.2, 1.6, 2.0, 2.4, 2.8, 5.225, 5.675], nan_ok=True)
    assert found.number.tolist() == [0, *[1] * 5, *[2] * 2]
    weights = np.bincount(found.number, found.std_m**-2.0)
    assert weights == pytest.approx([one.sigma_m**-2.0 for one in stated])
    assert found.between(10.0, 12.0).number.tolist() == [0]


def test_tapes_between_given_anchors_are_compared_with_their_positions():
    flown = flight(seconds=4.0, anchors=CORNERS)
    true_m = float(np.linalg.norm(np.array(CORNERS[0]) - CORNERS[1]))
    tapes = [KnownDistance(11, 12, true_m + off_m, 0.005) for off_m in (0.0, 0.2)]
    result = calib.fit_from_ranges(flown, distances=tapes, poses_until_s=3.0, heading_std_deg=0.0)
    (named,) = [warning for warning in result.warnings if "measure it again" in warning]
    assert f"{true_m + 0.2:.3f} m, is 20 cm more" in named


@pytest.mark.parametrize(
    ("stated", "named"),
    [
        (KnownDistance(1, 7, 2.0, 0.01), "tag 7"),
        (KnownDistance(1, 2, 2.0, 0.01), "tags 1 and 2"),
        (KnownDistance(1, 3, -2.0, 0.01), "-2.0"),
        (KnownDistance(1, 3, 2.0, 0.0), "0.0"),
        (KnownDistance(1, 3, 2.0, 0.01, "desk"), "'desk'"),
    ],
)
def test_a_distance_that_cannot_be_used_is_named(stated, named):
    with pytest.raises(calib.BadInputError, match=f"^`distances`: .*{named}"):
        calib.fit_from_ranges(flight(seconds=1.0), distances=[stated])


def test_heights_resolve_the_mirror_image_of_anchors_in_a_plane():
    flown = flight(seconds=6.0, rate=120, anchors=CEILING, height_off_m=0.05, arm_m=0.0)
    given: dict[str, Any] = {"poses_until_s": 0.0, "attitudes": "none", "minimum_norm": True}
    without = calib.fit_from_ranges(flown, heights="ignored", **given)
    # Readings of a sensor above a table get less weight for that time, and those that are not numbers none.
    read, time_s = flown.height["height_m"], flown.height["time_ns"] * 1e-9
    read[(time_s > 2.0) & (time_s < 2.4)] -= 0.7
    read[::97] = np.nan
    result = calib.fit_from_ranges(flown, **given)
    assert ["a second solution" in " ".join(one.warnings) for one in (without, result)] == [True, False]
    error, std = common(result)
    assert abs(error) / 3 < std < 0.75 * common(without)[1]
    assert result.calibration.provenance["geometry"]["heights"] == ["robot0", "robot1", "robot2"]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"shaken": (0.05, 4.0)}, "bodies move too fast for control points every 0.1 s"),
        ({"late_m": {(1, 3): 0.3}}, "pair 1-3: "),
    ],
    ids=["too quick", "a pair reflected all along"],
)
def test_faults_of_a_flight_are_named_and_saved(wrong, said):
    flown = flight(seconds=9.0, **wrong)
    result = calib.fit_from_ranges(flown, **KNOWN_START)
    assert [warning for warning in result.warnings if said in warning]
    assert result.calibration.provenance["warnings"] == result.warnings
    assert np.abs(scores(result)).max() < 3.5
    with pytest.raises(calib.UnanswerableError, match="robot0"):  # it has no inertial readings
        calib.fit_from_ranges(flown, attitudes="imu")


@pytest.mark.parametrize("between_m", [0.0, 0.05])
def test_walls_between_bodies_are_named_and_in_the_intervals(between_m):
    offset = np.random.default_rng(1).normal(0, between_m, (3, 4))
    late = {(tag, 11 + anchor): offset[(tag - 1) // 2, anchor] for tag, anchor in product(DELAYS_NS, range(4))}
    flown = flight(seconds=6.0, rate=120, anchors=CORNERS, late_m=late)
    result = calib.fit_from_ranges(flown, poses_until_s=4.0, heading_std_deg=0.0)
    assert bool([text for text in result.warnings if text.startswith("errors depend on places")]) == (between_m > 0)
    planted, found = flown.planted["delays_ns"], result.calibration.delays_ns
    assert largest_score(result, {int(tag): delay for tag, delay in planted.items()}) < 2.5
    # Walls of 5 cm shift delays by about 100 ps; without them they are known to half of that.
    assert (max(abs(found[int(tag)] - delay) for tag, delay in planted.items()) > 0.08) == (between_m > 0)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_intervals_of_four_bodies_include_walls_that_no_test_finds(seed):
    # Four bodies have six distances between them, of which delays absorb the errors of four.
    body = {tag: min((tag - 1) // 2, 3) for tag in [*DELAYS_NS, 11]}
    offset = np.random.default_rng(seed).normal(0, 0.02, (4, 4))
    late = {(a, b): offset[body[a], body[b]] for a, b in combinations(body, 2) if body[a] != body[b]}
    flown = flight(seconds=6.0, rate=120, seed=seed, anchors=CORNERS[:1], late_m=late)
    result = calib.fit_from_ranges(flown, poses_until_s=4.0, heading_std_deg=0.0)
    assert [one.fault for one in result.findings] == ["unknown offsets of bodies", "short recording"]
    assert np.abs(scores(result)).max() < 2.5
    # Also beside a given curve.
    given = calib.fit_from_ranges(flown, poses_until_s=4.0, heading_std_deg=0.0, curve_from=result.calibration)
    assert "unknown offsets of bodies" in [one.fault for one in given.findings]
    assert np.abs(scores(given)).max() < 2.5


def test_the_effect_of_unknown_walls_is_stated_for_delays_that_are_determined():
    flown = flight(seconds=8.0, rate=120, anchors=CORNERS[:2])
    result = calib.fit_from_ranges(flown, poses_until_s=4.0, heading_std_deg=0.0, anchors="sought")
    assert result.calibration.provenance["undetermined"] == [[11, 12]]
    (text,) = [one.evidence for one in result.findings if one.fault == "unknown offsets of bodies"]
    # 132 ps for the robots' tags; 1188 ps with the anchors' delays, whose standard errors are above 1 ns.
    assert float(re.findall(r"by (\d+) ps", text)[0]) < 200


@pytest.mark.parametrize("blocked", ["bodies", "pairs"])
def test_common_reflections_of_two_bodies_are_named(blocked):
    flown = flight(seconds=20.0, rate=120, seed=3, blocked=blocked)
    result = calib.fit_from_ranges(flown, poses_until_s=5.0, heading_std_deg=0.0, minimum_norm=True)
    assert bool([text for text in result.warnings if "are reflected together" in text]) == (blocked == "bodies")
    assert largest_score(result, DELAYS_NS) < 2.5


# A recorded flight (MILUV: three robots, six anchors, 317 exchanges), with little or none of its motion capture; and a
# simulated one whose tags range with anchors only.


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return importers.read_source(miluv(tmp_path_factory.mktemp("miluv")), importer="miluv")


def true_errors(found, flown):
    """Return errors of estimated distances (n,) in metres, by those of motion capture."""
    truth = calib.load_ranges(flown)
    return found.ranges.truth_m - truth.truth_m[np.searchsorted(truth.time_ns, found.ranges.time_ns)]


def joint_scores(found, flown):
    """Return differences from a fit with all of the motion capture divided by joint standard errors, of all boards."""
    whole, tags = calib.fit(flown, loss="cauchy").calibration, found.uncertainty.tags
    std = np.sqrt(np.diag(found.uncertainty.delays_ns2))
    differ = np.array([found.delays_ns[tag] - whole.delays_ns[tag] for tag in tags])
    return differ / np.hypot(std, [whole.delays_std_ns[tag] for tag in tags])


@pytest.mark.slow
def test_ten_seconds_of_motion_capture_an_imu_and_heights_follow_a_real_flight(flown):
    found = calib.fit_from_ranges(flown, poses_until_s=10.0, attitudes="imu")
    away = true_errors(found, flown)
    # Four ranges per second for three robots: accelerometer and height determine the motion between them.
    assert abs(np.median(away)) < 0.03
    assert np.median(np.abs(away)) < 0.1
    assert sum(map(np.isfinite, found.calibration.delays_std_ns.values())) >= 10
    scores = joint_scores(found.calibration, flown)
    assert np.sqrt(np.mean(scores**2)) < 1.5
    assert np.abs(scores).max() < 2.5


@pytest.mark.slow
def test_anchors_alone_give_wide_intervals(flown):
    found = calib.fit_from_ranges(flown, poses_until_s=0.0, minimum_norm=True)
    assert "the ranges determine no delay" in found.warnings[0]
    assert np.isinf(list(found.calibration.delays_std_ns.values())).all()
    assert np.abs(joint_scores(found.calibration, flown)).max() < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 6])
def test_tags_that_range_with_anchors_only_leave_delays_undetermined(seed):
    flown = uwbsim.simulate(uwbsim.load("anchors_and_tag/bipartite", {"run.duration_s": 10.0, "run.seed": seed}))
    given: dict[str, Any] = {"poses_until_s": 6.0, "delays_only": True}
    # The common part of all delays is not determined, either, and no value is given.
    words = r"ranges between two sides are known to ± [4-6] cm"
    with pytest.raises(calib.UnanswerableError, match=words) as raised:
        calib.fit_from_ranges(flown, **given)
    assert raised.value.undetermined == [[0, 1, 2, 3, 4, 5, 10, 11]]
    found = calib.fit_from_ranges(flown, minimum_norm=True, **given).calibration
    assert found.undetermined_splits == (((0, 1, 2, 3, 4, 5), (10, 11)),)
    assert np.isinf(list(found.delays_std_ns.values())).all()
    of_tags = found.delays_ns[10] + found.delays_ns[11]
    assert of_tags == pytest.approx(sum(found.delays_ns.values()) - of_tags, abs=0.01)


# Attitudes from gyroscopes, and a fit without other attitudes: flights of the simulator, which shares no code with it.


BOXES = {"a": -2.6, "b": 0.4}
"""Where the boxes begin in which two robots fly."""
IMU = {"grade": "consumer", "vibration_mps2": 1.0}


@pytest.fixture(scope="module")
def flown_with_imus():
    boxes = {name: {"box_min_m": [x, -2.6, 0.4], "box_max_m": [x + 2.2, -0.2, 2.6]} for name, x in BOXES.items()}
    bodies: list[Any] = [
        {"name": name, "motion": {"model": "random-flight"} | box, "imu": IMU} for name, box in boxes.items()
    ]
    bodies += [{"name": f"anchor{k}", "motion": {"model": "static", "position_m": at}} for k, at in enumerate(CORNERS)]
    arms = {1: ("a", 0.17), 2: ("a", -0.17), 3: ("b", 0.17), 4: ("b", -0.17)}
    tags = [{"id": t, "body": b, "lever_arm_m": [x, -x, -0.05], "delay_ns": 0.1 * t} for t, (b, x) in arms.items()]
    tags += [{"id": 11 + k, "body": f"anchor{k}", "delay_ns": -0.1 * k} for k in range(4)]
    ranging = {"rate_hz": 160.0, "pairs": "between-bodies"}
    return uwbsim.simulate({"run": {"duration_s": 16.0, "seed": 5}, "ranging": ranging, "bodies": bodies, "tags": tags})


def angles_off(found, known, time_s):
    """Return rotation vectors (bodies, n, 3) in degrees between the attitudes of two scenes."""
    turns = [found.attitudes[body].at(time_s) * known.attitudes[body].at(time_s).inv() for body in BOXES]
    return np.degrees([turn.as_rotvec() for turn in turns])


@pytest.mark.slow
def test_attitudes_by_gyroscope_stay_near_those_of_motion_capture(flown_with_imus):
    # This bias would cause 20 degrees after ten seconds; it is determined from the first four.
    imu = flown_with_imus.imu | {axis: flown_with_imus.imu[axis] + np.radians(2.0) for axis in ("wx", "wy", "wz")}
    scene, known = (
        scene_from(replace(flown_with_imus, imu=imu), calib.FlightSettings(poses_until_s=until_s, attitudes=attitudes))
        for until_s, attitudes in ((4.0, "imu"), (16.0, "poses"))
    )
    assert np.abs(angles_off(scene, known, np.arange(0.5, 15.0, 0.5))).max() < 2
    assert np.mean(scene.inertial["a"].force_m_s2, axis=0) == pytest.approx([0, 0, 9.81], abs=0.5)


@pytest.mark.slow
def test_a_heading_wrong_by_a_right_angle_is_corrected(flown_with_imus):
    scene = scene_from(flown_with_imus, calib.FlightSettings(poses_until_s=0.0, attitudes="imu")).between(0.0, 4.0)
    known = scene_from(flown_with_imus, calib.FlightSettings(poses_until_s=4.0)).between(0.0, 4.0)

    def off(turned):
        return np.abs(angles_off(turned, known, np.array([2.0]))[:, 0, 2])

    # Integrated from an unknown heading; that of "b" starts a right angle off, as after a wrong first window.
    turn = np.radians([0.0, 90.0] - angles_off(scene, known, np.array([2.0]))[:, 0, 2])
    scene = scene.turned_by(dict(zip(BOXES, turn.tolist(), strict=True)))
    scene = replace(scene, attitudes={**scene.attitudes, "a": replace(scene.attitudes["a"], heading_known=True)})
    state = interpolated(known.places, np.arange(0.0, 4.0, 0.1), 2).state(scene, np.zeros((0, 3)))
    found, _, unsure = resolve_headings(scene, state)
    assert off(found).max() < 16 < 80 < off(scene).max()
    assert unsure == ""


@pytest.mark.slow
def test_inertial_readings_and_anchors_are_enough(flown_with_imus):
    found = calib.fit_from_ranges(flown_with_imus, poses_until_s=0.0, attitudes="imu")
    away = true_errors(found, flown_with_imus)
    # No position and no heading of a robot is given.
    assert np.std(away) < 0.03
    assert abs(np.mean(away)) < 0.01
    planted = np.array([flown_with_imus.planted["delays_ns"][str(tag)] for tag in found.calibration.delays_ns])
    assert np.std(np.array(list(found.calibration.delays_ns.values())) - planted) < 0.06
