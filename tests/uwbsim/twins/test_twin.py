"""A twin of a simulated recording finds what was planted, can be saved, and refuses what has none."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import uwbsim
from calib import Calibration
from tests import processes
from tests.uwbsim.twins.worlds import known, world
from uwblink import Poses, UwblinkError, load
from uwbsim.cli.commands import _print_table, app
from uwbsim.pages import TWIN_COLUMNS
from uwbsim.scenario.radio import Radio
from uwbsim.twins import TWIN_LEVEL
from uwbsim.twins.range_errors import read_calibration
from uwbsim.world.radio import reception_bias_s


@pytest.fixture(scope="module")
def flight():
    return uwbsim.simulate(world(), contention=False)


@pytest.fixture(scope="module")
def found(flight):
    return uwbsim.twin(flight, known(world()))


def centred(values):
    return np.asarray(values) - np.mean(values)


def test_broadcasts_have_no_twin():
    """Their replies wait for slots, for longer than boards can."""
    flight = uwbsim.simulate(uwbsim.load("broadcast", {"run.duration_s": 3.0}))
    with pytest.raises(uwbsim.ScenarioError, match=r"waits 30\.\d ms in its exchanges.*broadcasts"):
        uwbsim.twin(flight, known(world()))


def test_rates_and_noises_are_found(found):
    """2250 ratios with 0.12 ppm each tell a rate to some 4e-3 ppm, and noise to 1.5 %."""
    planted = [tag["skew_ppm"] for tag in world()["tags"]]
    assert centred([tag.skew_ppm for tag in found.scenario.tags]) == pytest.approx(centred(planted), abs=0.01)
    # Whole ticks add their twelfth to the noise of stamps.
    assert found.found["receive_noise_ps"] == pytest.approx(np.hypot(95.0, 15.65 / np.sqrt(12)), rel=0.05)
    assert found.found["carrier_noise_ppm"] == pytest.approx(0.2, rel=0.05)
    assert found.found["carrier_bias_ppm"] == pytest.approx(-0.13, abs=0.01)


def test_reflections_are_found(found):
    """Three pairs that are drawn anew every 0.25 s, 720 times in all, with a share of 0.2: 1.5 points of chance."""
    assert found.found["reflected_share"] == pytest.approx(0.2, abs=0.02)
    assert found.found["reflection_life_s"] == pytest.approx(0.25, rel=0.2)
    assert found.found["mean_excess_m"] == pytest.approx(0.45, rel=0.2)
    assert found.found["reflection_loss_db"] == pytest.approx(6.0, abs=0.5)
    assert found.found["mean_delay_ns"] == pytest.approx(0.0, abs=0.01)
    assert found.found["direct_std_m"] < 0.01


def test_powers_are_found(found):
    assert found.found["path_loss_exponent"] == pytest.approx(2.4, abs=0.1)
    # Which ranges are reflected is not known for certain, and what is not known looks like fading.
    assert found.found["fading_db"] < 0.4
    assert [tag.tx_power_db for tag in found.scenario.tags] == pytest.approx([0.0] * 3, abs=0.3)


def test_of_a_long_flight_blocks_all_over_it_are_taken(found):
    whole = found.measured
    rows = whole.some(4000)
    part = whole[rows]
    assert len(part) == 4000
    assert np.count_nonzero(np.diff(rows) > 1) == 1
    assert part.time_s[-1] == whole.time_s[-1]
    assert part.exchanges.rx2.tolist() == whole.exchanges.rx2[rows].tolist()
    assert np.array_equal(whole.some(9000), np.arange(9000))


def test_the_schedule_is_found(found):
    ranging = found.scenario.ranging
    assert ranging.plan == "round-robin"
    assert ranging.rate_hz == pytest.approx(150.0, rel=1e-3)
    assert ranging.response_delay_uus == 1500
    assert list(ranging.pairs) == [(11, 12), (11, 13), (12, 13)]


def test_a_saved_twin_flies_the_same_ways(found, flight, tmp_path):
    found.save(tmp_path / "t.toml")
    again = uwbsim.simulate(tmp_path / "t.toml", contention=False)
    assert len(again.exchanges) == len(flight.exchanges)
    # Poses of a motion capture at 100 Hz lie 1.5 cm apart; between them a cubic is followed.
    assert np.max(np.abs(again.truth_m - flight.truth_m)) < 1e-3
    with pytest.raises(UwblinkError, match="exists already"):
        found.save(tmp_path / "t.toml")


def test_a_twin_of_a_twin_is_alike(found):
    compared = {one.name: one for one in found.compare(1)}
    assert compared["sum of both carrier readings"].verdict == "alike"
    assert compared["residual of calibrated ranges"].verdict == "alike"
    assert compared["reply dt32"].to_dict()["probability"] > 0.01


def test_what_persists_differently_is_not_alike(found):
    """The same values at other instants: their distribution is alike, their autocorrelation is not."""
    shuffled = np.random.default_rng(4).permutation(len(found.measured))
    moved = replace(found.measured, residual_m=found.measured.residual_m[shuffled])
    one = {c.name: c for c in replace(found, measured=moved).compare(1)}["residual of calibrated ranges"]
    assert one.probability > TWIN_LEVEL / 2
    assert one.lag1_probability < TWIN_LEVEL / 2
    assert one.verdict == "differ"


def test_the_command_writes_a_scenario_and_a_page(tmp_path, monkeypatch):
    uwbsim.simulate(world(4.0), contention=False).save(tmp_path / "f.uwb")
    (tmp_path / "c.json").write_text(json.dumps(known(world())))
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["twin", "f.uwb", "-c", "c.json", "-o", "t.toml", "--seeds", "1"])
    assert done.exit_code == 0, done.output
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.json", "f.uwb", "t.html", "t.poses.uwb", "t.toml"]
    page = (tmp_path / "t.html").read_text()
    assert "What the recording does not determine" in page
    assert "residual of calibrated ranges" in page
    assert uwbsim.load(tmp_path / "t.toml").run.name == "twin of f"


WRONG = {
    "poses": (lambda f: replace(f, poses=Poses.from_arrays([], "", (0.0, 0.0, 0.0))), "holds no poses"),
    "powers": (
        lambda f: replace(f, exchanges=replace(f.exchanges, fpp1_dbm=np.full(len(f.exchanges), np.nan))),
        "no exchange has both first-path powers",
    ),
    "length": (lambda f: replace(f, exchanges=f.exchanges[:99]), "99 exchanges, a twin needs 100 or more"),
    "tags": (lambda f: replace(f, tags=f.tags[:2]), "on which body tag 13 sits"),
}


@pytest.mark.parametrize("what", WRONG)
def test_recordings_without_a_twin(flight, what):
    change, message = WRONG[what]
    with pytest.raises(uwbsim.ScenarioError, match=message):
        uwbsim.twin(change(flight), known(world()))


def test_a_recording_that_says_too_little_ends_with_status_1(tmp_path):
    uwbsim.simulate(uwbsim.load("noiseless", {"run.duration_s": 0.2})).save(tmp_path / "short.uwb")
    (tmp_path / "c.json").write_text(json.dumps(known(world())))
    done = processes.run("uwbsim", "twin", "short.uwb", "-c", "c.json", "-o", "twin.toml", cwd=tmp_path)
    assert done.returncode == 1
    assert "exchanges, a twin needs 100 or more" in done.stderr


CURVE = known(world())["bias_curve"]


@pytest.mark.parametrize("alpha_dbm", [-82.0, -85.0])
def test_the_scenario_has_the_curve_of_the_calibration_at_any_level_of_lifting(flight, alpha_dbm, tmp_path):
    curve = {"knots": [0.01] * 4 + [1.8] * 4, "coefficients": [-0.07, 0.32, -0.18, -0.08], "degree": 3}
    table = known(world()) | {"alpha_dbm": alpha_dbm, "bias_curve": curve | {"range": [0.01, 1.8]}}
    (tmp_path / "c.json").write_text(json.dumps(table))
    calibration, power = Calibration.from_json(json.dumps(table)), np.linspace(-100.0, -78.0, 50)
    expected = calibration.bias_curve(10 ** ((power - alpha_dbm) / 10))
    for source in (table, tmp_path / "c.json", calibration):
        found = reception_bias_s(Radio(bias=read_calibration(source).bias), power) * 299_702_547.0
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.ptp(expected) > 0.1


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"delays_ns": {"11": 0.0}, "delays_std_ns": {"11": 0.0}}, "tag 12, 13"),
        ({"delays_ns": {"x": 0.0}}, "delays_ns"),
        ({"delays_ns": {"11": None}}, "delays_ns: 11"),
        (
            {"schema_version": 2, "groups": {"a": {"tags": [11, 12, 13], "bias_curve": CURVE, "sigma_curve": CURVE}}},
            "groups",
        ),
        ({"schema_version": 4, "pair_offsets": {"11-12": {"offset_m": 0.1, "std_m": 0.0}}}, "pair_offsets"),
        ({"schema_version": 9}, "9"),
        ({"lift": "none"}, "lift"),
        ({"alpha_dbm": "x"}, "alpha_dbm"),
        ({"speed_of_light": 1.0}, "speed_of_light"),
        ({"bias_curve": {"knots": [0, 1], "coefficients": [0], "degree": 3, "range": [0, 1]}}, "bias_curve"),
    ],
)
def test_calibrations_without_a_twin_are_refused_by_place(flight, change, place):
    with pytest.raises(uwbsim.ScenarioError, match=f"^calibration: .*{place}"):
        uwbsim.twin(flight, known(world()) | change)


def test_nothing_is_written_where_something_is_wrong(flight, tmp_path):
    flight.save(tmp_path / "f.uwb")
    (tmp_path / "c.json").write_text("{}")
    (tmp_path / "t.html").write_text("mine")
    for output, message in (("t.toml", "exists already"), ("u.txt", "found .txt"), ("u.toml", "no schema_version")):
        command = ["twin", str(tmp_path / "f.uwb"), "-c", str(tmp_path / "c.json"), "-o", str(tmp_path / output)]
        done = CliRunner().invoke(app, command)
        assert message in str(done.exception)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.json", "f.uwb", "t.html"]
    assert len(load(tmp_path / "f.uwb").poses) > 0


def test_a_terminal_of_80_columns_loses_no_figure(found, capsys, monkeypatch):
    rows = [list(TWIN_COLUMNS), *([show(one) for show in TWIN_COLUMNS.values()] for one in found.compare(1))]
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    _print_table(rows)
    printed = set(capsys.readouterr().out.split())
    words = {word for row in rows[1:] for cell in row for word in cell.split()}
    assert {word for word in words if word[-1].isdigit() and "/" not in word} <= printed
