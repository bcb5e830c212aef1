"""Curves by name: what a range has is what the curve says."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from tests.uwbsim.simulation.test_protocols import bench
from uwblink import PROTOCOLS
from uwbsim.protocols.conditions import conditions_of
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.radio import SIGMA, Radio
from uwbsim.world.radio import lifted


@pytest.mark.parametrize("name", [name for name in SIGMA if name != "none"])
def test_a_double_sided_range_has_the_standard_deviation_of_the_named_curve(name):
    # The scheduled delay of the boards: replies of 305 us and 1539 us.
    world = bench(sigma=Radio(sigma=name).sigma, first_path_at_1m_dbm=-78.0)
    conditions = conditions_of(world)
    curve = world.radio.sigma
    x = float(lifted(conditions.power_dbm[:1])[0])
    expected = float(BSpline(np.array(curve.knots), np.array(curve.coefficients), curve.degree)(x))
    assert np.sqrt(predict(PROTOCOLS["ds"], conditions).parts_m2["receive noise"][0]) == pytest.approx(
        expected, rel=2e-3
    )
