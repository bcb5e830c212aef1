"""The loop through the wire: bytes change nothing, and served boards calibrate like simulated ones."""

from pathlib import Path

import numpy as np

import calib
import uwbsim
from tests.boards import served
from tests.processes import succeed
from uwblink.boards.listeners import Progress
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.record import record
from uwblink.importers import add_poses
from uwblink.recording.file import Recording
from uwblink.recording.schema import load_places
from uwbsim.scenario.loading import load

ROOT = Path(__file__).parents[2]
TRAIN = ROOT / "scenarios" / "icra2023" / "train.toml"


def test_a_flight_through_encode_and_decode_calibrates_to_the_same_bytes(tmp_path):
    for name, more in (("direct", []), ("wire", ["--through-wire"])):
        (tmp_path / name).mkdir()
        flight = tmp_path / name / "flight.uwb"
        succeed("uwbsim", "run", TRAIN, "-o", flight, "--set", "run.duration_s=20", *more)
        succeed("calib", "fit", flight, "-o", tmp_path / name / "c.json")
    assert (tmp_path / "direct" / "c.json").read_bytes() == (tmp_path / "wire" / "c.json").read_bytes()
    succeed("uwblink", "replay", tmp_path / "wire" / "flight.uwb", "-o", tmp_path / "wire" / "again.uwb")


def test_served_boards_calibrate_like_simulated_ones(tmp_path):
    scenario = load(TRAIN, ["run.duration_s=25"])
    tags, _ = load_places(TRAIN)
    counts = Progress()
    with served(uwbsim.Server.extended(scenario, 300.0)) as server:
        server.write_poses(tmp_path / "poses.csv")
        # As many exchanges as 7.5 s give at this rate, however long a busy machine takes for them.
        record(
            server.names.values(),
            tmp_path / "boards.uwb",
            RangingPlan(tags=tags, rate_hz=160.0),
            duration_s=240,
            listeners=[counts],
            stop=lambda: counts.exchanges >= 1200,
        )
    added = add_poses(tmp_path / "boards.uwb", tmp_path / "poses.csv")
    assert added.covered > 0.98 * added.exchanges > 1000
    succeed("uwbsim", "run", TRAIN, "-o", tmp_path / "simulated.uwb", "--set", "run.duration_s=7.5")
    fits = [calib.fit(tmp_path / f"{name}.uwb").calibration for name in ("boards", "simulated")]
    delays = [np.array([c.delays_ns[t.tag] for t in tags]) for c in fits]
    stds = [np.array([c.delays_std_ns[t.tag] for t in tags]) for c in fits]
    # A shift common to all is the constant of the curve, over powers that differ between two short flights.
    apart = [d - d.mean() for d in delays]
    score = (apart[0] - apart[1]) / np.hypot(*stds)
    # Six scores within three and a half sigma: one run in 400 would fail by chance, and the seeds are fixed.
    assert np.abs(score).max() < 3.5
    # 0.12 ns for 1900 exchanges, and more for fewer by the root of their number.
    assert np.abs(apart[0] - apart[1]).max() < 0.15


def test_a_flight_in_which_nothing_is_received_goes_through_the_wire(tmp_path):
    short = ["--set", "run.duration_s=1", "--set", "radio.sensitivity_dbm=0"]
    succeed("uwbsim", "run", TRAIN, "-o", tmp_path / "f.uwb", "--through-wire", *short)
    with Recording.open(tmp_path / "f.uwb") as recording:
        assert recording.count("exchanges") == 0 < recording.count("faults")
