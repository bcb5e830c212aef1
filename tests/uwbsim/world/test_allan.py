"""Simulated clocks against the Allan deviation that was asked for, by an outside authority (allantools)."""

import allantools
import numpy as np
import pytest

from tests.uwbsim.simulation.test_protocols import bench
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, WALK_STEP_S, Clocks

DURATION_S = 20_000.0


def phase_s(**clock):
    scenario = bench()
    tags = tuple(t.model_copy(update=clock) for t in scenario.tags)
    settings = scenario.run.model_copy(update={"duration_s": DURATION_S})
    clocks = Clocks.of(scenario.model_copy(update={"tags": tags, "run": settings}))
    time = (np.arange(0, DURATION_S, WALK_STEP_S) * SUBTICKS_PER_SECOND).astype(np.int64)
    which = np.zeros(len(time), dtype=np.int64)
    return (clocks.read(which, time) - time - clocks.offset[0]) / SUBTICKS_PER_SECOND


def allan(phase, taus):
    _, deviation, _, _ = allantools.oadev(phase, rate=1 / WALK_STEP_S, data_type="phase", taus=taus)
    return deviation


@pytest.mark.parametrize("taus", [[1.0, 3.0, 10.0, 30.0]])
def test_white_frequency_noise(taus):
    found = allan(phase_s(white_ppm_sqrt_s=0.01), taus)
    # 20 000 s hold 700 independent spans of 30 s: 4 %, and three times that.
    np.testing.assert_allclose(found, 0.01e-6 / np.sqrt(taus), rtol=0.12)


@pytest.mark.parametrize("taus", [[1.0, 3.0, 10.0, 30.0]])
def test_random_walk_of_frequency(taus):
    found = allan(phase_s(drift_ppm_per_sqrt_s=0.002), taus)
    np.testing.assert_allclose(found, 0.002e-6 * np.sqrt(np.array(taus) / 3), rtol=0.12)


def test_a_temperature_ramp_is_a_parabola_of_phase():
    phase = phase_s(ramp_ppm_per_s=0.001)
    time = np.arange(0, DURATION_S, WALK_STEP_S)
    np.testing.assert_allclose(phase[-1], 0.5 * 0.001e-6 * time[-1] ** 2, rtol=1e-4)
