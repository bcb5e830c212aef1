"""Poses in step with the boards' time, as long as they are served."""

import time

import numpy as np
import pytest

import uwbsim
from tests.boards import bench_scenario, served
from uwblink.boards.board import Board
from uwblink.importers.poses import read_poses
from uwbsim.boards.server import LivePoses, Server
from uwbsim.world.world import World

EPOCH_NS = 1_700_000_000_000_000_000


def flight(**mocap):
    """Boards of which one flies."""
    box = {"box_min_m": [-2.0, -2.0, 0.5], "box_max_m": [2.0, 2.0, 2.0]}
    motion = {"model": "random-flight", "speed_mps": 1.0} | box
    tables = bench_scenario().model_dump(mode="json") | {"mocap": {"rate_hz": 120.0, **mocap}}
    return uwbsim.load(tables, {"bodies.0.motion": motion})


def written(world, path, steps):
    poses = LivePoses(world, path, EPOCH_NS)
    for step in steps:
        poses.write_until(round(step * 1e9))
    poses.close()
    return read_poses(path, None)


def test_the_file_holds_every_pose_up_to_now_and_none_after(tmp_path):
    world = World(flight(latency_ms=20.0))
    poses = LivePoses(world, tmp_path / "p.csv", EPOCH_NS)
    for now_s in (0.5, 0.5, 0.7031, 7.0):
        poses.write_until(round(now_s * 1e9))
        found = read_poses(tmp_path / "p.csv", None)
        late = (found.time_ns - EPOCH_NS) * 1e-9
        # Three bodies; what is seen at t is told at t + 20 ms.
        assert len(found) == 3 * (int((now_s - 0.02) * 120) + 1)
        assert now_s - 1 / 120 < late.max() <= now_s
    poses.close()


def test_poses_are_those_of_the_world_and_do_not_depend_on_the_pieces(tmp_path):
    world = World(flight(position_noise_m=0.001, attitude_noise_rad=0.01, gaps_per_min=20.0))
    one = written(world, tmp_path / "one.csv", [30.0])
    many = written(world, tmp_path / "many.csv", np.arange(0.1, 30.01, 0.1))
    np.testing.assert_array_equal(one.time_ns, many.time_ns)
    mine = one.body == "b1"
    true = world.trajectories["b1"].position_m((one.time_ns[mine] - EPOCH_NS) * 1e-9)
    error = one.position_m[mine] - true
    assert error.std() == pytest.approx(0.001, rel=0.05)
    # 20 gaps a minute of half a second each: a seventh of the time between them is blind.
    seen = np.count_nonzero(mine) / (30 * 120)
    assert 0.6 < seen < 0.95
    assert np.diff(one.time_ns[mine]).max() == pytest.approx(0.5e9, rel=0.1)


def test_served_poses_go_on_after_the_scenario_s_duration(tmp_path):
    scenario = flight(rate_hz=20.0)  # few enough that a busy machine keeps up with twenty times the boards' time
    short = scenario.model_copy(update={"run": scenario.run.model_copy(update={"duration_s": 1.0})})
    with served(short, speed=20.0) as server:
        server.write_poses(tmp_path / "p.csv")
        for _ in range(200):
            # The file may grow between two looks at it, so only its complete lines count.
            complete = (tmp_path / "p.csv").read_text().rpartition("\n")[0].splitlines()[1:]
            served_s = (int(complete[-1].partition(",")[0]) - server.epoch_ns) * 1e-9
            if served_s > 5.0:
                break
            time.sleep(0.05)
        assert served_s > 5.0


def test_a_step_ends_though_poses_take_longer_to_write_than_they_last(tmp_path):
    # A tenth of a second of the boards is 5 us of the wall clock: the next poses are due before these are written.
    server = Server(flight(rate_hz=0.2), speed=2e4)
    try:
        server.write_poses(tmp_path / "p.csv")
        for _ in range(3):
            server.step()
    finally:
        server.close()
    assert len((tmp_path / "p.csv").read_text().splitlines()) > 1


def test_poses_that_cannot_be_written_end_and_the_serving_goes_on(tmp_path):
    told: list[str] = []
    with served(flight(), tell=told.append) as server:
        server.write_poses(tmp_path / "p.csv")
        # The first file is closed after the serving, which may be writing to it now.
        first, server._poses._file = server._poses._file, open("/dev/full", "w", encoding="utf-8")  # noqa: SIM115 - closed by the server
        for _ in range(100):
            with Board.open(server.names[2]) as board:
                assert board.id == 2
            if told:
                break
    first.close()
    assert told == ["the poses end here: No space left on device"]
