"""What people write and send: misspelt keys, numbers that cannot be, FIFOs, and names of other kinds of files."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import BadInputError
from tests import processes
from uwblink import Contents

ROOT = Path(__file__).parents[1]


def refused(done, *fragments):
    assert done.returncode == 2, done
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    for fragment in fragments:
        assert fragment in done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("strangers")
    flight = calib.sample_flight()
    Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(place / "f.uwb")
    calib.fit(place / "f.uwb").calibration.save(place / "c.json")
    for name in ("p.json", "p.uwb", "p.csv", "p.toml", "p.mcap"):
        os.mkfifo(place / name)
    return place


@pytest.mark.parametrize(
    "line",
    [
        "calib show p.json",
        "calib evaluate f.uwb -c p.json",
        "calib fit p.uwb -o o.json",
        "calib fit f.uwb -o o.json --group p.toml",
        "calib survey f.uwb -o o.json --known p.toml",
        "calib import miluv p.json -o o.json",
        "uwblink show p.uwb",
        "uwblink import csv p.csv -o o.uwb",
        "uwblink import csv p.csv --map p.toml -o o.uwb",
        "uwblink import guess p.csv",
        "uwblink import bag p.mcap -o o.uwb",
        "uwblink poses f.uwb --from p.csv",
        "uwblink stream f.uwb -c p.json --speed inf",
        "uwbsim run p.toml -o o.uwb",
        "uwbsim sweep p.toml -o o",
    ],
)
def test_no_fifo_is_opened(folder, line):
    before = set(folder.iterdir())
    refused(processes.run(*line.split(), cwd=folder, timeout=60), "p.", "FIFO")
    assert set(folder.iterdir()) == before


@pytest.mark.parametrize(
    "line",
    [
        "calib export c.json --to csv --force -o",
        "calib fit f.uwb --force -o",
        "calib apply f.uwb -c c.json --force -o",
        "uwblink import guess c.csv --force -o",
    ],
)
def test_no_fifo_or_device_is_replaced(folder, line):
    (folder / "c.csv").write_text("from,to,range_m\n1,2,3.0\n")
    os.mkfifo(folder / "there")
    refused(processes.run(*line.split(), "there", cwd=folder, timeout=60), "there", "FIFO")
    assert (folder / "there").is_fifo()
    (folder / "there").unlink()


def test_a_folder_with_something_else_in_it_is_not_replaced(folder):
    """`--force` of an export deletes what was exported before, and nothing else."""
    export = ["uwblink", "export", "f.uwb", "--to", "csv", "--force", "-o", "out"]
    assert processes.run(*export, cwd=folder).returncode == 0
    assert processes.run(*export, cwd=folder).returncode == 0
    (folder / "out" / "deep").mkdir()
    (folder / "out" / "deep" / "thesis.txt").write_text("mine")
    before = {path: path.stat().st_mtime_ns for path in (folder / "out").rglob("*")}
    refused(processes.run(*export, cwd=folder), "out", "deep")
    assert {path: path.stat().st_mtime_ns for path in (folder / "out").rglob("*")} == before


@pytest.mark.parametrize(
    "line",
    [
        "uwbsim validate deep.toml",
        "uwbsim run noiseless -o o.uwb --set run.seed=" + "[" * 3000,
        "uwbsim sweep deep.toml -o o",
        "uwbsim serve noiseless --faults deep.toml",
        "uwblink import csv c.csv --map deep.toml -o o.uwb",
        "calib survey f.uwb --known deep.toml -o o.json",
    ],
)
def test_toml_that_is_nested_too_deeply_is_refused(folder, line):
    (folder / "c.csv").write_text("from,to,range_m\n1,2,3.0\n")
    (folder / "deep.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    refused(processes.run(*line.split(), cwd=folder, timeout=60), "deep.toml" if "deep" in line else "run.seed")


@pytest.mark.parametrize("line", ["fit f.uwb f.uwb -o o.json", "evaluate g.uwb f.uwb -c c.json"])
def test_a_recording_given_twice_is_refused(folder, line):
    """It would count as twice the evidence, under another name, too."""
    (folder / "g.uwb").write_bytes((folder / "f.uwb").read_bytes())
    refused(processes.run("calib", *line.split(), cwd=folder), "f.uwb")
    assert not (folder / "o.json").exists()


@pytest.mark.parametrize(
    "line",
    [
        "calib apply f.uwb -c c.json -o c.csv",
        "calib sample -o c.parquet",
        "uwbsim run noiseless -o c.mcap",
        "uwblink import csv f.csv -o c.csv",
    ],
)
def test_a_recording_is_not_written_under_the_name_of_a_table(folder, line):
    before = set(folder.iterdir())
    refused(processes.run(*line.split(), cwd=folder), "c.", "c.uwb")
    assert set(folder.iterdir()) == before


TAGS = "[[tags]]\nid = 1\nbody = 'robot1'\n"
KEYS = {
    "tags": ("uwblink poses f.uwb --from poses.csv --tags @", TAGS + "lever_arm = [0.1, 0.0, 0.0]\n", "lever_arm"),
    "anchors": (
        "uwblink poses f.uwb --from poses.csv --tags @",
        TAGS + "[[anchors]]\nid = 2\nposition_m = [0.0, 0.0, 1.0]\nsigma_m = 0.1\n",
        "sigma_m",
    ),
    "tables beside tags": ("uwblink poses f.uwb --from poses.csv --tags @", TAGS + "[[anchor]]\nid = 2\n", "anchor"),
    "plan": ("uwblink record none -o o.uwb --plan @", TAGS + "lever_arm = [0.1, 0.0, 0.0]\n", "lever_arm"),
    "head of a plan": ("uwblink record none -o o.uwb --plan @", "rate = 3\n" + TAGS, "rate"),
    "knowledge": ("calib survey f.uwb -o o.json --known @", "[[distances]]\nbetwen = [1, 2]\n", "betwen"),
    "head of knowledge": ("calib survey f.uwb -o o.json --known @", "shape = 'line'\n", "shape"),
    "map": ("uwblink import csv f.csv -o o.uwb --map @", "[columns]\nfrom = 'a'\n", "from"),
    "delays of a map": ("uwblink import csv f.csv -o o.uwb --map @", "[antenna_delays]\ntransmit = 3\n", "transmit"),
    "groups": ("calib fit f.uwb -o o.json --group @", "[groups]\na = [1]\n[group]\nb = [2]\n", "groups"),
    "sweep": ("uwbsim sweep @ -o o", "[sweep]\nscenario = 'noiseless'\nseed = 3\n", "seed"),
    "list of a sweep": (
        "uwbsim sweep @ -o o",
        "sweep = {scenario = 'noiseless', design = 'list', protocols = ['ds'], ranges = 10}\n"
        "[[list]]\n'radio.rx_noise_ps' = 50.0\n[[list]]\n'radio.rx_noise' = 50.0\n",
        "rx_noise",
    ),
    "scenario": ("uwbsim run @ -o o.uwb", "@tag.lever_arm", "lever_arm"),
    "faults": ("uwbsim serve noiseless --faults @", "faults = [{kind = 'unplug', tag = 1, at = 1.0}]\n", "at"),
}


@pytest.mark.parametrize("case", KEYS)
def test_misspelt_keys_are_refused_and_named(folder, case):
    line, text, key = KEYS[case]
    if text == "@tag.lever_arm":
        text = (ROOT / "scenarios" / "noiseless.toml").read_text().replace("lever_arm_m", "lever_arm", 1)
    (folder / "own.toml").write_text(text)
    (folder / "f.csv").write_text("time_s,from_id,to_id,range_m\n0.0,1,2,3.0\n")
    (folder / "poses.csv").write_text("time_s,body,x,y,z,qx,qy,qz,qw\n0.0,robot1,0,0,0,0,0,0,1\n")
    before = set(folder.iterdir())
    done = processes.run(*line.replace("@", "own.toml").split(), cwd=folder, timeout=60)
    refused(done, "own.toml", key)
    assert set(folder.iterdir()) == before


def changed(text, path, value):
    """Return a calibration's JSON with another value at a path of keys."""
    table = json.loads(text)
    *outer, last = path.split("/")
    inner = table
    for key in outer:
        inner = inner[int(key) if isinstance(inner, list) else key]
    inner[int(last) if isinstance(inner, list) else last] = value
    return json.dumps(table)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("speed_of_light", 0),
        ("speed_of_light", 3e5),
        ("delays_std_ns/2", -0.05),
        ("delays_ns/2", 9.2e18),
        ("delays_std_ns/2", 9.2e18),
        ("scale_ns", -1.0),
        ("alpha_dbm", 4000.0),
        ("bias_curve/coefficients/0", 1e30),
        ("sigma_curve/coefficients/0", -0.5),
        ("errors/outlier_share", 1.5),
        ("errors/outlier_m", -3.0),
        ("errors/scale", 0.0),
        ("errors/detour_m", -0.1),
        ("errors/levels/0/0", 2.0),
        ("uncertainty/delays_ns2/0/0", -0.01),
    ],
)
def test_numbers_that_no_calibration_can_have_are_refused_and_named(folder, path, value):
    text = (folder / "c.json").read_text()
    with pytest.raises(BadInputError) as caught:
        calib.Calibration.from_json(changed(text, path, value), "own.json")
    assert str(caught.value).startswith("own.json: ")
    assert path.split("/")[1 if "errors/" in path else 0] in str(caught.value)
    assert calib.Calibration.from_json(text) == calib.load_calibration(folder / "c.json")


def test_a_published_calibration_is_held_to_the_same_bounds(tmp_path):
    curve = {"knots": [0.0] * 4 + [2.0] * 4, "coeffs": [0.1] * 4, "degree": 3}
    table = {"delays_ns": {"1": 0.1, "2": 1e12}, "bias_spline_m": curve, "std_spline_m": curve}
    (tmp_path / "m.json").write_text(json.dumps(table))
    done = processes.run("calib", "import", "miluv", tmp_path / "m.json", "-o", tmp_path / "c.json")
    refused(done, "m.json", "delays_ns")
    assert not (tmp_path / "c.json").exists()


def test_delays_without_standard_errors_are_not_taken_for_exact(folder, tmp_path):
    fitted = calib.load_calibration(folder / "c.json")
    curve = {"knots": [0.0] * 4 + [2.0] * 4, "coeffs": [0.1] * 4, "degree": 3}
    delays = {str(tag): delay + 0.3 * (tag == 2) for tag, delay in fitted.delays_ns.items()}
    table = {"delays_ns": delays, "bias_spline_m": curve, "std_spline_m": curve}
    (tmp_path / "m.json").write_text(json.dumps(table))
    assert processes.run("calib", "import", "miluv", tmp_path / "m.json", "-o", tmp_path / "c.json").returncode == 0
    words = ("calib", "compare", folder / "c.json", tmp_path / "c.json")
    found = json.loads(processes.run(*words, "--json").stdout)
    assert found["verdict"] == "unknown"
    assert found["probability"] is None
    assert set(found["std_ns"].values()) == {None}
    assert found["difference_ns"]["2"] - found["difference_ns"]["1"] == pytest.approx(0.3)
    assert "no verdict" in processes.run(*words).stdout
    assert "not stated" in processes.run("calib", "show", tmp_path / "c.json").stdout
    rows = processes.run("calib", "export", tmp_path / "c.json", "--to", "csv").stdout.splitlines()
    assert rows[1].endswith(",")


def test_localizing_without_powers_says_so(tmp_path):
    flight = calib.sample_flight(anchors=True)
    known = calib.fit(flight).calibration
    known.save(tmp_path / "c.json")
    nothing = np.full(len(flight.exchanges), np.nan)
    silent = replace(flight.exchanges, fpp1_dbm=nothing, fpp2_dbm=nothing)
    Contents(exchanges=silent, poses=flight.poses, tags=flight.tags).save(tmp_path / "f.uwb")
    words = ("calib", "localize", tmp_path / "f.uwb", "-c", tmp_path / "c.json", "--model", "constant-velocity")
    done = processes.run(*words)
    assert done.returncode == 1, done
    assert "f.uwb" in done.stderr
    assert "no power" in done.stderr
    calib.fit(tmp_path / "f.uwb", delays_only=True).calibration.save(tmp_path / "d.json")
    assert processes.run(*words[:4], tmp_path / "d.json", *words[5:]).returncode == 0


def test_evaluating_ranges_of_the_first_calibrated_tags_only(tmp_path):
    """A simulation plants delays of tags that do not range in the part that is evaluated."""
    flight = calib.sample_flight(anchors=True)
    known = calib.fit(flight).calibration
    planted = {"knots": [0.0] * 4 + [2.0] * 4, "coefficients": [0.0, 0.01, 0.02, 0.03], "degree": 3}
    ranges = calib.load_ranges(flight)
    ranges = replace(ranges, planted={**(ranges.planted or {}), "bias_curve": planted})
    some = ranges[(ranges.initiator <= 2) & (ranges.target <= 2)]
    full = calib.evaluate(ranges, known).planted
    assert calib.evaluate(some, known).planted.delay_error_ns == full.delay_error_ns


def test_a_delay_that_the_protocol_does_not_have_is_refused():
    for name in ("ds-sym", "ss", "ss-cfo"):
        refused(
            processes.run("uwbsim", "predict", "--protocol", name, "--final-delay-us", "500"), name, "--final-delay"
        )
    quick, usual = (
        json.loads(processes.run("uwbsim", "predict", "--protocol", "ds-alt", "--json", *more).stdout)["std_m"]
        for more in (("--final-delay-us", "300"), ())
    )
    assert quick != usual
