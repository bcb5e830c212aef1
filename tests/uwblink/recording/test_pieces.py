"""A recording in pieces: each row once, in order of time over all tables, for any size of the pieces."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from uwblink import Contents, Exchanges, Poses, Recording, exporters
from uwblink.exporters import export_recording, mcap
from uwblink.recording.contents import exchanges_with_poses, pieces
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Fault, Tag

COUNT = 400
SPAN_NS = 40_000_000_000
TAGS = [Tag(1, "drone", (0.1, 0.0, 0.0)), Tag(2, "mast", (0.0, 0.0, 2.0)), Tag(3, "car two", (0.0, 0.2, 0.0))]


def contents(seed=1):
    """Rows of all tables with a time, not in order of time unless that is required."""
    rng = np.random.default_rng(seed)
    pairs = np.array([(1, 2), (2, 3), (3, 1)])[rng.integers(0, 3, COUNT)]
    time = rng.integers(0, SPAN_NS, COUNT)
    stamps = rng.integers(0, 2**32, (4, COUNT))
    x = Exchanges.from_arrays(
        *pairs.T,
        time_ns=time,
        range_m=rng.normal(3, 1, COUNT),
        tx1=stamps[0],
        rx1=stamps[1],
        tx2=stamps[2],
        rx2=stamps[3],
    )
    count = 900
    quaternion = rng.normal(size=(count, 4))
    poses = Poses.from_arrays(
        np.append(rng.integers(0, SPAN_NS, count - 1), 5),
        np.append(np.array(["drone", "car two"])[rng.integers(0, 2, count - 1)], "mast"),
        rng.normal(size=(count, 3)),
        quaternion / np.linalg.norm(quaternion, axis=1)[:, None],
    )
    some = np.sort(rng.integers(0, SPAN_NS, 300))
    bodies = np.full(300, "drone")
    ends = {"time_ns": x.time_ns, "initiator": x.initiator, "target": x.target}
    nothing = dict.fromkeys(
        ("sigma_m", "sigma_total_m", "mean_error_m", "tail_share", "tail_probability"), x.range_m * 0
    )
    flags = dict.fromkeys(("clamped", "outlier"), np.zeros(COUNT, dtype=bool))
    return Contents(
        exchanges=x,
        tags=TAGS,
        poses=poses,
        imu={
            "time_ns": some,
            "body": bodies,
            **{n: rng.normal(size=300) for n in ("wx", "wy", "wz", "ax", "ay", "az")},
        },
        height={"time_ns": some, "body": bodies, "height_m": rng.normal(size=300)},
        temperature={"time_ns": some, "tag": np.full(300, 1), "temperature_c": some * 1e-9, "supply_v": some * 0.0},
        corrected=ends | {"raw_m": x.range_m, "corrected_m": x.range_m - 0.1} | nothing | flags,
        faults=[Fault(int(t), "1", "time-out", f"at {t}") for t in rng.integers(0, SPAN_NS, 50)],
    )


@pytest.fixture
def path(tmp_path):
    contents().save(tmp_path / "r.uwb")
    return tmp_path / "r.uwb"


def test_corrections_of_other_exchanges_are_left_out(tmp_path):
    held = contents()
    target = held.exchanges.target.copy()
    target[7] = 9
    held = replace(held, corrected={**held.corrected, "target": target})
    held.save(tmp_path / "r.uwb")
    with Recording.open(tmp_path / "r.uwb") as recording:
        assert all(not held.corrected for held in pieces(recording, 50))


@pytest.mark.parametrize(
    ("to", "module"), [("mcap", mcap), ("tum", exporters), pytest.param("rosbag2", mcap, marks=pytest.mark.slow)]
)
def test_an_export_does_not_depend_on_the_pieces(path, tmp_path, monkeypatch, to, module):
    as_one = export_recording(path, tmp_path / "one", to=to)
    monkeypatch.setattr(module, "pieces", partial(pieces, rows=120))
    assert export_recording(path, tmp_path / "many", to=to) == as_one
    files = [sorted(p for p in (tmp_path / name).rglob("*") if p.is_file()) for name in ("one", "many")]
    assert len(files[0]) == len(files[1]) > 0
    for one, other in zip(*files, strict=True):
        assert one.name == other.name
        if one.suffix != ".yaml":
            assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("rows", [23, 399])
def test_exchanges_come_with_the_poses_that_they_need(path, monkeypatch, rows):
    monkeypatch.setattr(Recording, "exchange_blocks", _in_blocks_of(rows))
    with Recording.open(path) as recording:
        x, poses = recording.exchanges(), recording.poses()
        parts = [
            distances_m(around, TAGS, part.initiator, part.target, part.time_ns)
            for part, around in exchanges_with_poses(recording)
        ]
    assert len(parts) >= COUNT // rows
    np.testing.assert_array_equal(np.concatenate(parts), distances_m(poses, TAGS, x.initiator, x.target, x.time_ns))


def _in_blocks_of(rows):
    blocks = Recording.exchange_blocks
    return lambda recording: blocks(recording, rows)


def test_a_recording_without_exchanges_has_no_stretches(tmp_path):
    with Recording.create(tmp_path / "empty.uwb") as recording:
        assert recording.dividing_times("exchanges", 50) == []
    with Recording.open(tmp_path / "empty.uwb") as recording:
        assert recording.show().span_s == 0.0
