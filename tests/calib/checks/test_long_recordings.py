"""A long recording is examined in stretches of time, and its faults are detected in them."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.flights import Plan, fly
from calib.checks import examined_part, recording_view
from calib.data.sources import RecordedSource
from uwblink import Contents, Recording
from uwblink.recording.distances import distances_m

PLAN = Plan(seconds=300, per_second=80)
EXAMINED_EXCHANGES, EXAMINED_STRETCHES = 6_000, 12


@pytest.fixture(autouse=True)
def short_stretches(monkeypatch):
    monkeypatch.setattr(recording_view, "EXAMINED_EXCHANGES", EXAMINED_EXCHANGES)
    monkeypatch.setattr(recording_view, "EXAMINED_STRETCHES", EXAMINED_STRETCHES)


def write(path, flight, late_ns=0):
    poses = replace(flight.poses, time_ns=flight.poses.time_ns + late_ns)
    Contents(exchanges=flight.exchanges, tags=flight.tags, poses=poses).save(path)
    return path


@pytest.fixture(scope="module")
def flight():
    return fly(PLAN, 51)


@pytest.fixture(scope="module")
def path(flight, tmp_path_factory):
    return write(tmp_path_factory.mktemp("long") / "long.uwb", flight)


def test_stretches_cover_the_recording_and_have_all_poses(flight, path):
    with Recording.open(path) as recording:
        looked = recording_view.select_part(RecordedSource(recording))
    x, every = looked.exchanges, flight.exchanges
    assert len(every) == 24_000
    assert len(x) == pytest.approx(EXAMINED_EXCHANGES, rel=0.02)
    assert np.count_nonzero(np.diff(x.time_ns) > 1_000_000_000) == EXAMINED_STRETCHES - 1
    assert (x.time_ns[0], x.time_ns[-1]) == (every.time_ns[0], every.time_ns[-1])
    ends = x.initiator, x.target, x.time_ns
    np.testing.assert_array_equal(
        distances_m(looked.poses, looked.tags, *ends), distances_m(flight.poses, flight.tags, *ends)
    )


def test_sound_recordings_have_no_finding_and_the_examined_part_is_stated(path):
    assert calib.examine(path) == []
    assert examined_part(24_000) == (
        "about 6000 of its 24000 exchanges were examined, in 12 stretches over all of its time"
    )


@pytest.mark.slow
def test_late_poses_are_found_with_their_delay(flight, tmp_path):
    (finding,) = calib.examine(write(tmp_path / "late.uwb", flight, 400_000_000))
    assert finding.fault == "pose time offset"
    assert "-0.400 s" in finding.evidence or "-0.39" in finding.evidence


def test_short_recordings_are_examined_completely(path, monkeypatch):
    monkeypatch.setattr(recording_view, "EXAMINED_EXCHANGES", 24_000)
    with Recording.open(path) as recording:
        assert len(recording_view.select_part(RecordedSource(recording)).exchanges) == 24_000
    assert examined_part(24_000) == ""
