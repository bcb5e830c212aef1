"""The loop through the wire: bytes change nothing. tests/test_readme.py calibrates served boards."""

from pathlib import Path

from tests.processes import succeed
from uwblink.recording.file import Recording

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


def test_a_flight_in_which_nothing_is_received_goes_through_the_wire(tmp_path):
    short = ["--set", "run.duration_s=1", "--set", "radio.sensitivity_dbm=0"]
    succeed("uwbsim", "run", TRAIN, "-o", tmp_path / "f.uwb", "--through-wire", *short)
    with Recording.open(tmp_path / "f.uwb") as recording:
        assert recording.count("exchanges") == 0 < recording.count("faults")
