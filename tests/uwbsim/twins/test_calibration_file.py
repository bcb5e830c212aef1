"""The simulator's own reader of calibrations says what the package that writes them says, which it does not import."""

import json

import numpy as np
import pytest

import uwbsim
from calib import Calibration, Ranges
from tests.uwbsim.twins.worlds import known, world
from uwbsim.twins.calibration_file import read_calibration

CURVE = {"knots": [0.01] * 4 + [1.8] * 4, "coefficients": [-0.07, 0.32, -0.18, -0.08], "degree": 3}


@pytest.fixture(scope="module")
def exchanges():
    tables = world(4.0, radio={"first_path_at_1m_dbm": -76.0, "power_noise_db": 3.0})
    return uwbsim.simulate(tables, contention=False).exchanges


@pytest.mark.parametrize(
    "kind",
    [
        {"schema_version": 1, "power_at": "exchange", "lift": "mean-of-lifted"},
        {"schema_version": 1, "power_at": "exchange", "lift": "lift-of-mean"},
        {"schema_version": 3, "power_at": "reception", "lift": "mean-of-lifted"},
        {"schema_version": 3, "power_at": "reception", "lift": "mean-of-lifted", "alpha_dbm": -85.0},
    ],
)
def test_ranges_are_corrected_alike(exchanges, kind):
    delays = {"11": -0.31, "12": 0.12, "13": 0.4}
    table = known(world()) | {"delays_ns": delays, "bias_curve": CURVE | {"range": [0.01, 1.8]}} | kind
    whole = table | {
        "delays_std_ns": dict.fromkeys(delays, 0.0),
        "loss": "cauchy",
        "scale_ns": 0.1,
        "sigma_curve": table["bias_curve"],
        "provenance": {},
    }
    calibration = Calibration.from_json(json.dumps(whole))
    expected = calibration.apply(Ranges.from_exchanges(exchanges)).corrected_m
    for source in (table, calibration):
        assert np.max(np.abs(read_calibration(source).corrected_m(exchanges) - expected)) < 1e-9
    assert np.ptp(expected - exchanges.range_m) > 0.1
