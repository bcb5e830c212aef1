"""The doctor on recordings of boards that stand still: contradictions of a survey are named, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.standing import standing_boards
from calib.checks.examine import examine
from calib.data.samples import stamped
from tests.calib.surveys.test_surveying import FOUR
from uwblink import Arrangement, Contents, KnownDistance

HELD_NS = 70_000_000_000


def save(world, path, known="line", distances=(), power_dbm=None):
    """Write a world as a recording of double-sided exchanges, with its arrangements."""
    r, count = world.ranges, len(world.places)
    power = r.fpp1_dbm if power_dbm is None else np.full(len(r), power_dbm)
    x = stamped(r.time_ns, np.column_stack([r.initiator, r.target]), r.raw_m, np.stack([power, power]))
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
    return replace(world, ranges=replace(r, raw_m=r.raw_m + 0.2 * (late & ((r.initiator == 4) | (r.target == 4)))))


def faults(path):
    return {finding.fault: finding for finding in examine(path)}


TAPES = KnownDistance(1, 3, 2.1 + 0.3, 0.005, "A"), KnownDistance(2, 4, 2.7, 0.005, "A")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "tapes", "evidence"),
    [
        (world_of, (), {}),
        (crooked, (), {"arrangement not as stated": "C: the boards are not on a line"}),
        (moved, (), {"board moved within an arrangement": "C: board 4 was moved 2"}),
        (world_of, TAPES, {"wrong known distance": "the known distance of 1 and 3 in A differs from the ranges by +"}),
    ],
    ids=["sound", "crooked", "moved", "a wrong tape"],
)
def test_contradictions_of_a_survey_are_named(tmp_path, world, tapes, evidence):
    found = faults(save(world(), tmp_path / "a.uwb", distances=tapes))
    assert found.keys() == evidence.keys()
    assert all(found[fault].evidence.startswith(text) for fault, text in evidence.items())


@pytest.mark.slow
def test_powers_that_hardly_vary_are_named(tmp_path):
    assert list(faults(save(world_of(places=FOUR[:3]), tmp_path / "a.uwb", power_dbm=-80.0))) == [
        "powers that hardly vary"
    ]


def test_arrangements_that_determine_nothing_are_named(tmp_path):
    world = standing_boards(5, "space", boards=5, arrangements=1, bias_size_m=0.02)
    assert "survey determines nothing" in faults(save(world, tmp_path / "a.uwb", known=""))
