"""A simulation handed over in memory gives the calibration that its recording gives."""

from dataclasses import replace
from pathlib import Path

import calib
import uwbsim

ROOT = Path(__file__).parents[2]


def test_memory_and_file_give_the_same_calibration(tmp_path):
    settings = ["run.duration_s=5", "tags.0.passive=true"]
    flight = uwbsim.simulate(uwbsim.load(ROOT / "scenarios/icra2023/train.toml", settings))
    flight.save(tmp_path / "f.uwb")
    in_memory, from_file = calib.fit(flight).calibration, calib.fit(tmp_path / "f.uwb").calibration
    named = {"recordings": ["f.uwb"]}
    assert replace(in_memory, provenance=in_memory.provenance | named).to_json() == from_file.to_json()
    judged = [calib.evaluate(*both) for both in ((flight, in_memory), (tmp_path / "f.uwb", from_file))]
    assert [one.seen for one in judged] == [("memory",), ("f.uwb",)]
    assert len({str(one.to_dict() | {"seen_by_fit": []}) for one in judged}) == 1
    assert calib.evaluate(flight, in_memory).planted is not None
    assert calib.examine(flight) == calib.examine(tmp_path / "f.uwb")
    ours, theirs = (calib.run_campaign(data, loss="l2") for data in (flight, tmp_path / "f.uwb"))
    assert ours.heard == theirs.heard
    assert len(ours.heard) > 0
    assert [one.tracks["raw"].rmse_m for one in ours.tracks] == [one.tracks["raw"].rmse_m for one in theirs.tracks]
