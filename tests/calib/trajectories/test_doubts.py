"""Flights that are not what a fit takes them for: each is named, and the intervals hold all the same."""

from itertools import product
from typing import Any

import numpy as np
import pytest

import calib
from tests.calib.trajectories.sines import DELAYS_NS, flight
from tests.calib.trajectories.test_beside import by_tape
from uwblink import KnownDistance

CORNERS = [[3.5, 3.5, 0.3], [-3.5, 3.5, 2.6], [-3.5, -3.5, 0.5], [3.5, -3.5, 2.5]]
GIVEN: dict[str, Any] = {"poses_until_s": 6.0, "heading_std_deg": 0.0}


def scores(result):
    found = result.calibration
    return np.array([(found.delays_ns[tag] - delay) / found.delays_std_ns[tag] for tag, delay in DELAYS_NS.items()])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"shaken": (0.05, 4.0)}, "bodies move faster than control points every 0.1 s follow"),
        ({"late_m": {(1, 3): 0.3}}, "pair 1-3: "),
    ],
    ids=["too quick", "a pair reflected all along"],
)
def test_what_is_wrong_with_a_flight_is_named_and_saved(wrong, said):
    result = calib.fit_from_ranges(flight(seconds=12.0, **wrong), **GIVEN)
    assert [warning for warning in result.warnings if said in warning]
    assert result.calibration.provenance["warnings"] == result.warnings
    assert np.abs(scores(result)).max() < 3.5


def test_a_tape_that_was_misread_is_named_and_the_right_one_is_not():
    flown = flight(seconds=12.0, standing_s=4.0)
    read = {(1, 3): 0.3, (2, 5): 0.0}
    tapes = [KnownDistance(*ends, by_tape(flown, *ends, 1.0) + off, 0.005, "0..4") for ends, off in read.items()]
    result = calib.fit_from_ranges(flown, distances=tapes, **GIVEN)
    named = [warning for warning in result.warnings if "measure it again" in warning]
    assert len(named) == 1
    assert named[0].startswith("the distance of tags 1 and 3, 3.952 m, is ")
    # Thirty centimetres, as far as 16 ranges of the pair and known places of 2 cm tell.
    assert 25 < float(named[0].split(" is ")[1].split()[0]) < 35


@pytest.mark.parametrize("between_m", [0.0, 0.05])
def test_walls_between_bodies_are_named_and_in_the_intervals(between_m):
    rng = np.random.default_rng(1)
    late: dict[tuple[int, int], float] = {}
    for robot, anchor in product(range(3), range(4)):
        offset = rng.normal(0, between_m)
        late |= {(2 * robot + own, 11 + anchor): offset for own in (1, 2)}
    flown = flight(seconds=8.0, rate=120, anchors=CORNERS, late_m=late)
    result = calib.fit_from_ranges(flown, poses_until_s=4.0, heading_std_deg=0.0)
    assert bool([text for text in result.warnings if text.startswith("errors belong to places")]) == (between_m > 0)
    found = result.calibration
    errors = [found.delays_ns[int(tag)] - delay for tag, delay in flown.planted["delays_ns"].items()]
    assert np.abs(np.array(errors) / list(found.delays_std_ns.values())).max() < 2.5
    # Walls of 5 cm put delays off by some 100 ps; without them they are known to half of that.
    assert (np.max(np.abs(errors)) > 0.08) == (between_m > 0)
