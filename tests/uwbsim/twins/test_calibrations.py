"""What a twin takes from a calibration: the scenario's curve is the calibration's, at any level of lifting."""

import json

import numpy as np
import pytest

from calib import Calibration
from tests.uwbsim.twins.worlds import known, world
from uwbsim.scenario.radio import Radio
from uwbsim.twins.range_errors import read_calibration
from uwbsim.world.radio import reception_bias_s

CURVE = {"knots": [0.01] * 4 + [1.8] * 4, "coefficients": [-0.07, 0.32, -0.18, -0.08], "degree": 3}
LIGHT_M_PER_S = 299_702_547.0


@pytest.mark.parametrize("alpha_dbm", [-82.0, -85.0])
def test_the_scenario_has_the_curve_of_the_calibration(alpha_dbm, tmp_path):
    table = known(world()) | {"alpha_dbm": alpha_dbm, "bias_curve": CURVE | {"range": [0.01, 1.8]}}
    (tmp_path / "c.json").write_text(json.dumps(table))
    power = np.linspace(-100.0, -78.0, 50)
    expected = Calibration.from_json(json.dumps(table)).bias_curve(10 ** ((power - alpha_dbm) / 10))
    for source in (table, tmp_path / "c.json", Calibration.from_json(json.dumps(table))):
        found = reception_bias_s(Radio(bias=read_calibration(source).bias), power) * LIGHT_M_PER_S
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.ptp(expected) > 0.1
