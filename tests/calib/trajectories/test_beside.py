"""What is known beside ranges and poses: single distances by a tape, heights; planted, and each with its errors."""

import re
from typing import Any

import numpy as np
import pytest

import calib
from calib.trajectories.samples import heights_of, tapes_of
from tests.calib.trajectories.sines import DELAYS_NS, flight
from uwblink import Arrangement, KnownDistance

CEILING = [[3.5, 3.5, 2.6], [-3.5, 3.5, 2.6], [-3.5, -3.5, 2.6], [3.5, -3.5, 2.6]]
BODIES = {1: "a", 2: "a", 3: "b", 11: "c", 12: "d"}


def common(result):
    """What all delays have in common is wrong by, and its standard error, in ns."""
    found = result.calibration
    error = np.mean([found.delays_ns[tag] - delay for tag, delay in DELAYS_NS.items()])
    return float(error), float(np.sqrt(np.mean(found.uncertainty.delays_ns2)))


def by_tape(flown, first, second, seconds):
    when = np.array([seconds])
    return float(np.linalg.norm(flown.antennas(np.array([first]), when) - flown.antennas(np.array([second]), when)))


def test_nothing_is_claimed_where_nothing_is_known_and_a_tape_says_what_delays_have_in_common():
    flown = flight(seconds=16.0, standing_s=4.0)
    given: dict[str, Any] = {"poses_until_s": 0.0, "heading_std_deg": 0.0}
    with pytest.raises(calib.UnanswerableError, match="what all have in common") as raised:
        calib.fit_from_ranges(flown, **given)
    assert float(re.findall(r"in common is known to ± ([\d.]+) ns", str(raised.value))[0]) == pytest.approx(
        2.1, rel=0.1
    )
    assert raised.value.undetermined == [list(DELAYS_NS)]
    error, std = common(calib.fit_from_ranges(flown, minimum_norm=True, **given))
    # Distances are 33 cm short, 1.1 ns: more than the 0.74 ns that linear propagation has for 95 %, less than is said.
    assert 0.74 < abs(error) < 1.96 * std
    tape = KnownDistance(1, 3, by_tape(flown, 1, 3, 1.0), 0.005, "0..4")
    result = calib.fit_from_ranges(flown, distances=[tape], minimum_norm=True, **given)
    error, std = common(result)
    # 26 ranges of the pair while both stood, of 4 cm each and some of them reflected, leave 0.1 ns of both delays.
    assert std < 0.15
    assert abs(error) < 3 * std
    truth = flown.distance_m[np.searchsorted(flown.exchanges.time_ns, result.ranges.time_ns)]
    # Without it distances are 33 cm short.
    assert abs(np.mean(result.ranges.truth_m - truth)) < 0.05
    assert result.calibration.provenance["rests_on"]["distances"] == 1


def test_heights_tell_on_which_side_of_anchors_in_one_plane_bodies_are():
    flown = flight(seconds=8.0, rate=120, anchors=CEILING, height_off_m=0.05, arm_m=0.0)
    given: dict[str, Any] = {"poses_until_s": 0.0, "attitudes": "none", "minimum_norm": True}
    without = calib.fit_from_ranges(flown, heights="ignored", **given)
    result = calib.fit_from_ranges(flown, **given)
    assert any("a second solution" in warning for warning in without.warnings)
    assert not any("a second solution" in warning for warning in result.warnings)
    assert common(result)[1] < 0.75 * common(without)[1]
    assert abs(common(result)[0]) < 3 * common(result)[1]
    assert result.calibration.provenance["rests_on"]["heights"] == ["robot0", "robot1", "robot2"]


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (KnownDistance(1, 7, 2.0, 0.01), "found tag 7, the tags that range are 1, 2, 3, 11, 12"),
        (KnownDistance(1, 2, 2.0, 0.01), "tags 1 and 2 are on one body"),
        (KnownDistance(1, 3, -2.0, 0.01), "found -2.0 as the distance of tags 1 and 3"),
        (KnownDistance(1, 3, 2.0, 0.0), "found 0.0 as the standard error of tags 1 and 3"),
        (KnownDistance(1, 3, 2.0, 0.01, "desk"), "found the arrangement 'desk', the recording has floor"),
    ],
)
def test_a_distance_that_cannot_be_used_is_named(stated, said):
    with pytest.raises(calib.BadInputError, match=said) as raised:
        tapes_of([stated], [Arrangement("floor", 0, 10**9)], BODIES, {"c", "d"}, 0, 20.0)
    assert raised.value.parameter == "distances"


def test_a_distance_says_as_much_whether_it_holds_for_long_or_short():
    stated = [KnownDistance(11, 12, 4.0, 0.01), KnownDistance(1, 3, 2.0, 0.01, "floor"), KnownDistance(2, 3, 2.0, 0.02)]
    marked = [Arrangement("floor", 10**9, 3 * 10**9)]
    found = tapes_of(stated, marked, BODIES, {"c", "d"}, 0, 20.0)
    assert np.isnan(found.time_s[found.number == 0]).tolist() == [True]
    assert found.time_s[found.number == 1] == pytest.approx([1.2, 1.6, 2.0, 2.4, 2.8])
    for number, one in enumerate(stated):
        assert np.sum(found.std_m[found.number == number] ** -2.0) == pytest.approx(one.sigma_m**-2.0)
    assert found.between(10.0, 12.0).number.tolist() == [0]
    without = tapes_of(stated[2:], [], BODIES, {"c", "d"}, 0, 20.0)
    assert len(without) == 0
    assert "the distance of tags 2 and 3 is not used" in without.left_out[0]


def test_a_reading_that_sees_a_table_counts_less():
    time = np.arange(0, 20.0, 0.02)
    rng = np.random.default_rng(4)
    read = 1.0 + 0.02 * rng.normal(size=len(time)) - 0.7 * (np.floor(time) == 7)
    table = {"time_ns": (time * 1e9).astype(np.int64), "body": np.full(len(time), "a"), "height_m": read}
    found = heights_of(table, ["b", "a"], 0, 20.0)
    assert len(found.time_s) == 200
    assert set(found.body.tolist()) == {1}
    weighed = found.reweighted((found.height_m - 1.0) / found.std_m)
    table_m = (found.time_s > 7) & (found.time_s < 8)
    assert np.median(weighed.std_m[table_m]) > 3 * np.median(weighed.std_m[~table_m])


@pytest.mark.parametrize(
    ("off_m", "std_m"),
    # Three times the robust spread about zero, 1.4826 times the median size, but 2 cm at least and 1 m at most.
    [(0.05, 3 * 1.4826 * 0.05), (-0.05, 3 * 1.4826 * 0.05), (0.001, 0.02), (2.0, 1.0)],
)
def test_heights_count_by_how_far_they_are_off(off_m, std_m):
    # All are off by the same but one, which is off by ten times as much: about their median they do not scatter.
    off = np.full(101, off_m)
    off[50] *= 10
    table = {"time_ns": np.arange(101) * 10**8, "body": np.full(101, "a"), "height_m": 1.0 + off}
    found = heights_of(table, ["a"], 0, 20.0)
    weighed = found.reweighted((found.height_m - 1.0) / found.std_m).std_m
    usual = np.delete(weighed, 50)
    if abs(off_m) < 1:
        assert usual == pytest.approx(std_m, rel=1e-3)
        # Beyond two spreads its weight falls with its distance (Huber); a third of what is stated is the spread.
        assert weighed[50] == pytest.approx(std_m * np.sqrt(max(10 * abs(off_m) / (2 * std_m / 3), 1)), rel=1e-3)
    else:
        assert usual == pytest.approx(std_m * np.sqrt(off_m / (2 * std_m / 3)), rel=1e-3)
