"""A protocol registered at run time works with every command, and is exact without noise."""

import json

import numpy as np
import pytest

from tests import pages, processes
from tests.uwblink.test_register_protocol import SYMMETRIC, TARGETS
from tests.uwbsim.simulation.test_protocols import bench
from uwblink import PROTOCOLS, SPEED_OF_LIGHT, load, register_protocol
from uwblink.twr import delay_weights, raw_range
from uwbsim import simulate
from uwbsim.protocols.conditions import Conditions, range_errors_m
from uwbsim.protocols.prediction import predict

SCENARIO = "scenarios/noiseless.toml"


def command(*words):
    """Run a command in this process, which has registered the protocol; return its output."""
    return processes.succeed(*words).stdout


@pytest.fixture(params=[SYMMETRIC, TARGETS], ids=lambda row: row.name)
def row(request):
    register_protocol(request.param)
    yield request.param
    PROTOCOLS.remove(request.param.name)


@pytest.mark.parametrize("delays", [(0.0, 0.0), (0.8, 0.0), (0.0, -0.5)])
def test_simulated_ranges_are_exact_up_to_skew_and_planted_delays(row, delays):
    result = simulate(bench(row.name, (5.0, -5.0), delays=delays, n=200))
    weights = delay_weights(result.exchanges)
    calibrated = raw_range(result.exchanges) + SPEED_OF_LIGHT * 1e-9 * (weights[0] * delays[0] + weights[1] * delays[1])
    assert len(result.exchanges) == 200
    # Whole ticks of 4.7 mm, with weights up to 1.2, partly averaged; a flight of 10 ns is longer by 5e-14 s by its
    # skew.
    assert np.abs(calibrated - result.truth_m).max() < 0.012
    assert abs(np.mean(calibrated - result.truth_m)) < 0.0015


def test_prediction_and_monte_carlo_agree_with_each_other_and_with_the_formula(row):
    one = Conditions.single(
        flight=5 / SPEED_OF_LIGHT, rate=(5e-6, -5e-6), at_once=305e-6, scheduled=1538.7e-6,
        quantize=False,
    )  # fmt: skip
    quiet = predict(row, one)
    assert abs(quiet.mean_m[0]) < 5e-5
    assert range_errors_m(row, one, 1, 1)[0] == pytest.approx(quiet.mean_m[0], abs=1e-6)
    noisy = one.with_columns(rx_std=150e-12)[np.zeros(16_384, dtype=np.int64)]
    errors = range_errors_m(row, noisy, 2, 200_000)
    # 200,000 errors determine their standard deviation to 0.16 %.
    assert errors.std() == pytest.approx(np.sqrt(predict(row, noisy).variance_m2[0]), rel=0.01)


def test_run_show_and_fit(row, tmp_path):
    flight, fitted = tmp_path / "flight.uwb", tmp_path / "c.json"
    settings = ["--set", f"ranging.protocol={row.name}", "--set", "run.duration_s=60", "--no-contention"]
    command("uwbsim", "run", SCENARIO, "-o", flight, *settings)
    assert set(json.loads(command("uwblink", "show", flight, "--json"))["protocols"]) == {row.name}
    command("calib", "fit", flight, "-o", fitted)
    flown = load(flight)
    assert set(flown.exchanges.protocol.tolist()) == {row.name}
    # The scenario has no bias; 60 s of noiseless stamps leave a picosecond, and a small variation of the spline.
    assert json.loads(fitted.read_text())["delays_ns"] == pytest.approx(flown.meta["planted"]["delays_ns"], abs=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("row", [SYMMETRIC], indirect=True)
def test_compare_optimum_and_predict_support_a_new_protocol(row, tmp_path, monkeypatch):
    monkeypatch.setattr("uwblink.pages.figures.drawn", pages.outline)
    compared = json.loads(command("uwbsim", "compare", SCENARIO, "-o", tmp_path / "out", "-n", 256, "--json"))
    assert [line["protocol"] for line in compared["protocols"]] == list(PROTOCOLS)
    page = (tmp_path / "out" / "compare.html").read_text()
    assert row.title in page or row.name in page
    best = json.loads(command("uwbsim", "optimum", SCENARIO, "--json"))
    assert [line["protocol"] for line in best] == list(PROTOCOLS)
    said = json.loads(command("uwbsim", "predict", "--protocol", row.name, "--json"))
    assert (said["title"], said["std_m"] > 0) == (row.title, True)


def test_schema_and_summary_contain_the_new_protocol(row):
    assert row.name in json.loads(command("uwbsim", "schema"))["$defs"]["Ranging"]["properties"]["protocol"]["enum"]
    assert row.title in command("uwbsim", "validate", SCENARIO, "--set", f"ranging.protocol={row.name}")
