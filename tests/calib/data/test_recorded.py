"""Ranges of a recording are those of its exchanges and poses, of two reports of an exchange one."""

from dataclasses import replace
from hashlib import sha256

import numpy as np

from calib.data.ranges import Ranges
from calib.data.samples import sample_flight
from calib.data.sources import load_ranges
from uwblink import Contents
from uwblink.recording import AntennaDelay
from uwblink.recording.contents import exchanges_with_poses
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.summary import single_reports
from uwblink.twr import Exchanges

ROWS = 300


def written(path, exchanges, poses, tags):
    Contents(exchanges=exchanges, poses=poses, tags=tags, meta={"planted": {"delays_ns": {"1": 0.1}}}).save(path)
    return path


def awkward():
    """A flight with everything that makes a difference between all poses and some of them."""
    flight = sample_flight(ROWS, seed=3)
    rng = np.random.default_rng(5)
    first, last = int(flight.poses.time_ns[0]), int(flight.poses.time_ns[-1])
    time_s = (flight.poses.time_ns - first) * 1e-9
    body = np.array(sorted(set(flight.poses.body.tolist())))
    gap = (flight.poses.body == body[0]) & (time_s > 0.2 * time_s[-1]) & (time_s < 0.5 * time_s[-1])
    short = (flight.poses.body == body[1]) & (time_s > 0.6 * time_s[-1])
    poses = flight.poses[~gap & ~short]
    still = Poses(
        np.array([last + 10**12]), np.array(["post"]), np.array([[3.0, 2.0, 1.0]]), np.array([[0.0, 0, 0, 1]])
    )
    poses = Poses.concatenate([poses, still])
    tags = [tag if tag.tag != 3 else Tag(3, "post", (0.1, 0.0, 0.0)) for tag in flight.tags]
    exchanges = flight.exchanges[np.argsort(rng.random(ROWS) + np.arange(ROWS) / 20)]
    fpp1 = exchanges.fpp1_dbm.copy()
    fpp2 = exchanges.fpp2_dbm.copy()
    fpp1[::7], fpp2[::14] = np.nan, np.nan
    truth = np.where(np.arange(ROWS) % 11 == 0, 2.5, np.nan)
    protocol = np.where(np.arange(ROWS) < ROWS // 2, exchanges.protocol, "ss")
    return replace(exchanges, fpp1_dbm=fpp1, fpp2_dbm=fpp2, truth_m=truth, protocol=protocol), poses, tags


def test_bodies_with_one_pose_do_not_split_what_is_read(tmp_path):
    """A hundred anchors have a pose each: thousands of exchanges are read in one part, not one by one."""
    flight = sample_flight(3000)
    path = written(tmp_path / "it.uwb", flight.exchanges, flight.poses, flight.tags)
    with Recording.open(path, update=True) as recording:
        time_ns, names = np.full(100, int(flight.poses.time_ns[0])), np.array([f"anchor{k}" for k in range(100)])
        recording.append_poses(Poses(time_ns, names, np.ones((100, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))))
    with Recording.open(path) as recording:
        parts = [len(part) for part, _ in exchanges_with_poses(recording)]
    assert parts == [3000]


def both_ends(exchanges, poses, tags):
    """The same with a second report, some time later, of two in three, in no order of time; some of them alone."""
    rng = np.random.default_rng(8)
    again = exchanges[np.flatnonzero(rng.random(ROWS) < 0.67)]
    second = replace(
        again, time_ns=again.time_ns + rng.integers(0, 50_000_000, len(again)), reporter=again.target.copy()
    )
    whole = Exchanges.concatenate([exchanges[np.flatnonzero(np.arange(ROWS) % 10 > 0)], second])
    return whole[np.argsort(whole.time_ns + rng.integers(0, 10**9, len(whole)))], poses, tags


def test_of_two_reports_one_counts(tmp_path):
    path = written(tmp_path / "it.uwb", *both_ends(*awkward()))
    with Recording.open(path) as recording:
        reports = single_reports(recording.exchanges())
        alone = reports.exchanges
        whole = Ranges.from_exchanges(alone, poses=recording.poses(), tags=recording.tags()).usable()
    found = load_ranges(path)
    assert reports.repeated > ROWS / 3
    assert found.excluded["no true distance"] > 5
    assert found.excluded["no power"] > 5
    assert (found.excluded, found.left_skew) == (whole.excluded, whole.left_skew)
    for name, column in whole.to_dict().items():
        np.testing.assert_array_equal(getattr(found, name), column, err_msg=name)
    assert found.planted == {"delays_ns": {"1": 0.1}}
    assert found.antenna_delays == {None: AntennaDelay()}
    fingerprint = sha256(alone.time_ns.tobytes() + alone.range_m.tobytes()).hexdigest()[:32]
    assert found.recordings == (("it.uwb", fingerprint),)
