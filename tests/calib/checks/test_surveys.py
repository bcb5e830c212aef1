"""The doctor on recordings of boards that stood still: what contradicts a survey is named, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.standing import standing_boards
from calib.checks.examine import examine
from tests.calib.surveys.test_surveying import FOUR
from uwblink import Arrangement, Contents, Exchanges
from uwblink.recording.schema import KnownDistance
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S

REPLY = 20_000_000
HELD_NS = 70_000_000_000


def save(world, path, known="line", distances=(), power_dbm=None):
    """Write a world as a recording of double-sided exchanges, its arrangements marked."""
    r = world.ranges
    flight = r.raw_m / SPEED_OF_LIGHT / TICK_S
    start = np.arange(len(r)) * 1_000_000 % 2**31
    rx1, rx2 = (np.rint(start + k).astype(np.int64) for k in (flight, 2 * flight + REPLY))
    tx2 = rx1 + REPLY
    x = Exchanges.from_arrays(
        r.initiator, r.target, tx1=start, rx1=rx1, tx2=tx2, rx2=rx2, tx3=tx2 + REPLY, rx3=rx2 + REPLY,
        time_ns=r.time_ns, fpp1_dbm=r.fpp1_dbm if power_dbm is None else power_dbm,
        fpp2_dbm=r.fpp1_dbm if power_dbm is None else power_dbm,
    )  # fmt: skip
    count = len(world.places)
    marks = [Arrangement("ABCDEFGH"[k], HELD_NS * k, HELD_NS * (k + 1) - 5 * 10**9, known) for k in range(count)]
    Contents(exchanges=x, arrangements=marks, known_distances=list(distances)).save(path)
    return path


def world_of(seed=9, **settings):
    return standing_boards(seed, **{"places": FOUR[:5], "pair_error_m": 0.01, "bias_size_m": 0.02} | settings)


def crooked():
    places = [p.copy() for p in FOUR[:5]]
    places[2][3, 1] = 1.2
    return world_of(places=places)


def moved():
    world = world_of()
    r = world.ranges
    late = (r.time_ns > 2 * HELD_NS + 25e9) & (r.time_ns < 3 * HELD_NS - 5e9)
    mine = late & ((r.initiator == 4) | (r.target == 4))
    return replace(world, ranges=replace(r, raw_m=r.raw_m + 0.2 * mine))


def faults(path):
    return {finding.fault: finding for finding in examine(path)}


@pytest.mark.slow
def test_nothing_is_said_of_a_sound_survey(tmp_path):
    assert faults(save(world_of(), tmp_path / "a.uwb")) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "fault", "evidence"),
    [
        (crooked, "arrangement not as it is said to be", "C is said to be a line and is none"),
        (moved, "board moved within an arrangement", "C: board 4 was moved 2"),
    ],
)
def test_what_contradicts_a_survey_is_named(tmp_path, world, fault, evidence):
    found = faults(save(world(), tmp_path / "a.uwb"))
    assert list(found) == [fault]
    assert found[fault].evidence.startswith(evidence)


@pytest.mark.slow
def test_a_wrong_tape_is_named(tmp_path):
    tape = [KnownDistance(1, 3, 2.1 + 0.3, 0.005, "A"), KnownDistance(2, 4, 2.7, 0.005, "A")]
    found = faults(save(world_of(), tmp_path / "a.uwb", distances=tape))
    assert list(found) == ["wrong known distance"]
    assert found["wrong known distance"].evidence.startswith("the known distance of 1 and 3 in A is +")


def test_powers_that_hardly_vary_are_named(tmp_path):
    assert list(faults(save(world_of(), tmp_path / "a.uwb", power_dbm=-80.0))) == ["powers that hardly vary"]


def test_arrangements_that_determine_nothing_are_named(tmp_path):
    world = standing_boards(5, "space", boards=5, arrangements=1, bias_size_m=0.02)
    assert "survey determines nothing" in faults(save(world, tmp_path / "a.uwb", known=""))
