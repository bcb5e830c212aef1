"""What is known beside ranges and poses, tapes and heights; and flights that are not what a fit takes them for."""

import re
from itertools import product
from typing import Any

import numpy as np
import pytest

import calib
from calib.trajectories.samples import tapes_of
from tests.calib.trajectories.sines import DELAYS_NS, flight, scores
from uwblink import Arrangement, KnownDistance

pytestmark = pytest.mark.slow

CEILING = [[3.5, 3.5, 2.6], [-3.5, 3.5, 2.6], [-3.5, -3.5, 2.6], [3.5, -3.5, 2.6]]
CORNERS = [[3.5, 3.5, 0.3], [-3.5, 3.5, 2.6], [-3.5, -3.5, 0.5], [3.5, -3.5, 2.5]]
KNOWN_START: dict[str, Any] = {"poses_until_s": 6.0, "heading_std_deg": 0.0}


def common(result):
    """Return the mean error of all delays and its standard error, in ns."""
    found = result.calibration
    error = np.mean([found.delays_ns[tag] - delay for tag, delay in DELAYS_NS.items()])
    return float(error), float(np.sqrt(np.mean(found.uncertainty.delays_ns2)))


def by_tape(flown, first, second, off_m=0.0, std_m=0.005):
    """Return the distance of two tags while all bodies stood still, wrong by `off_m`."""
    ends = [flown.antennas(np.array([tag]), np.array([1.0])) for tag in (first, second)]
    return KnownDistance(first, second, float(np.linalg.norm(ends[0] - ends[1])) + off_m, std_m, "0..4")


def test_a_tape_tells_what_delays_have_in_common_and_without_it_the_interval_is_wide():
    flown = flight(seconds=12.0, standing_s=4.0)
    given: dict[str, Any] = {"poses_until_s": 0.0, "heading_std_deg": 0.0, "minimum_norm": True}
    without = calib.fit_from_ranges(flown, **given)
    error, std = common(without)
    assert abs(error) < 1.96 * std
    assert without.calibration.provenance["undetermined"] == [list(DELAYS_NS)]
    assert float(re.findall(r"in common is known to ± ([\d.]+) ns", without.warnings[0])[0]) == pytest.approx(
        1.96 * std, abs=0.01
    )
    result = calib.fit_from_ranges(flown, distances=[by_tape(flown, 1, 3)], **given)
    error, std = common(result)
    # 26 ranges of the pair while both stood, of 4 cm each and some of them reflected, leave 0.1 ns of both delays.
    assert std < 0.15
    assert abs(error) < 3 * std
    truth = flown.distance_m[np.searchsorted(flown.exchanges.time_ns, result.ranges.time_ns)]
    assert abs(np.mean(result.ranges.truth_m - truth)) < 0.05
    assert result.calibration.provenance["rests_on"]["distances"] == 1


def test_a_tape_that_was_misread_is_named_and_others_are_not():
    flown = flight(seconds=8.0, standing_s=4.0)
    # Nothing says when the bodies of a distance without an arrangement stood still.
    tapes = [by_tape(flown, 1, 3, 0.3), by_tape(flown, 2, 5), KnownDistance(2, 3, 2.0, 0.02)]
    result = calib.fit_from_ranges(flown, distances=tapes, **KNOWN_START)
    named = [warning for warning in result.warnings if "measure it again" in warning]
    assert len(named) == 1
    assert named[0].startswith("the distance of tags 1 and 3, 3.952 m, is ")
    # Thirty centimetres, as far as 16 ranges of the pair and known places of 2 cm tell.
    assert 25 < float(named[0].split(" is ")[1].split()[0]) < 35
    assert " more than " in named[0]
    assert [text for text in result.warnings if "tags 2 and 3 is not used" in text]
    assert result.calibration.provenance["rests_on"]["distances"] == 2


def test_a_tape_counts_as_much_whether_it_holds_for_long_or_short():
    bodies = {1: "a", 2: "a", 3: "b", 11: "c", 12: "d"}
    stated = [
        KnownDistance(11, 12, 4.0, 0.01),
        KnownDistance(1, 3, 2.0, 0.01, "floor"),
        KnownDistance(2, 3, 2.0, 0.02, "5..5.9"),
    ]
    found = tapes_of(stated, [Arrangement("floor", 10**9, 3 * 10**9)], bodies, {"c", "d"}, 0, 20.0)
    assert np.isnan(found.time_s[found.number == 0]).tolist() == [True]
    assert found.time_s[found.number == 1] == pytest.approx([1.2, 1.6, 2.0, 2.4, 2.8])
    assert found.time_s[found.number == 2] == pytest.approx([5.225, 5.675])
    for number, one in enumerate(stated):
        assert np.sum(found.std_m[found.number == number] ** -2.0) == pytest.approx(one.sigma_m**-2.0)
    assert found.between(10.0, 12.0).number.tolist() == [0]


def test_tapes_between_given_anchors_are_compared_with_their_positions():
    flown = flight(seconds=4.0, anchors=CORNERS)
    true_m = float(np.linalg.norm(np.array(CORNERS[0]) - CORNERS[1]))
    tapes = [KnownDistance(11, 12, true_m + off_m, 0.005) for off_m in (0.0, 0.2)]
    result = calib.fit_from_ranges(flown, distances=tapes, poses_until_s=3.0, heading_std_deg=0.0)
    named = [warning for warning in result.warnings if "measure it again" in warning]
    assert len(named) == 1
    assert f"{true_m + 0.2:.3f} m, is 20 cm more" in named[0]


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
    with pytest.raises(calib.BadInputError, match=named) as raised:
        calib.fit_from_ranges(flight(seconds=1.0), distances=[stated])
    assert raised.value.parameter == "distances"


def test_heights_tell_on_which_side_of_anchors_in_one_plane_bodies_are():
    flown = flight(seconds=6.0, rate=120, anchors=CEILING, height_off_m=0.05, arm_m=0.0)
    given: dict[str, Any] = {"poses_until_s": 0.0, "attitudes": "none", "minimum_norm": True}
    without = calib.fit_from_ranges(flown, heights="ignored", **given)
    # A sensor that sees a table for a while counts less then, and readings that are not numbers not at all.
    read, time_s = flown.height["height_m"], flown.height["time_ns"] * 1e-9
    read[(time_s > 2.0) & (time_s < 2.4)] -= 0.7
    read[::97] = np.nan
    result = calib.fit_from_ranges(flown, **given)
    assert any("a second solution" in warning for warning in without.warnings)
    assert not any("a second solution" in warning for warning in result.warnings)
    assert common(result)[1] < 0.75 * common(without)[1]
    assert abs(common(result)[0]) < 3 * common(result)[1]
    assert result.calibration.provenance["rests_on"]["heights"] == ["robot0", "robot1", "robot2"]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"shaken": (0.05, 4.0)}, "bodies move faster than control points every 0.1 s follow"),
        ({"late_m": {(1, 3): 0.3}}, "pair 1-3: "),
    ],
    ids=["too quick", "a pair reflected all along"],
)
def test_what_is_wrong_with_a_flight_is_named_and_saved(wrong, said):
    result = calib.fit_from_ranges(flight(seconds=9.0, **wrong), **KNOWN_START)
    assert [warning for warning in result.warnings if said in warning]
    assert result.calibration.provenance["warnings"] == result.warnings
    assert np.abs(scores(result)).max() < 3.5


@pytest.mark.parametrize("between_m", [0.0, 0.05])
def test_walls_between_bodies_are_named_and_in_the_intervals(between_m):
    rng = np.random.default_rng(1)
    late: dict[tuple[int, int], float] = {}
    for robot, anchor in product(range(3), range(4)):
        offset = rng.normal(0, between_m)
        late |= {(2 * robot + own, 11 + anchor): offset for own in (1, 2)}
    flown = flight(seconds=6.0, rate=120, anchors=CORNERS, late_m=late)
    result = calib.fit_from_ranges(flown, poses_until_s=4.0, heading_std_deg=0.0)
    assert bool([text for text in result.warnings if text.startswith("errors belong to places")]) == (between_m > 0)
    found = result.calibration
    errors = [found.delays_ns[int(tag)] - delay for tag, delay in flown.planted["delays_ns"].items()]
    assert np.abs(np.array(errors) / list(found.delays_std_ns.values())).max() < 2.5
    # Walls of 5 cm put delays off by some 100 ps; without them they are known to half of that.
    assert (np.max(np.abs(errors)) > 0.08) == (between_m > 0)
