"""Clocks: reading and its inverse, skew, drift, and exactness at any hour."""

import numpy as np
import pytest

from tests.uwbsim.simulation.test_protocols import bench
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, Clocks


def clocks(skews=(12.0, -7.0), drift=0.01, duration=100.0):
    scenario = bench(skews=skews)
    tags = tuple(t.model_copy(update={"drift_ppm_per_sqrt_s": drift}) for t in scenario.tags)
    settings = scenario.run.model_copy(update={"duration_s": duration})
    return Clocks.of(scenario.model_copy(update={"tags": tags, "run": settings}))


@pytest.mark.parametrize("hour", [0, 30])
def test_when_inverts_read_to_the_subtick(hour):
    c = clocks(duration=31 * 3600.0, drift=0.0)
    time = hour * 3600 * SUBTICKS_PER_SECOND + np.arange(1000) * 987_654_321
    for tag in (0, 1):
        which = np.full(len(time), tag)
        assert np.abs(c.when(which, c.read(which, time)) - time).max() <= 1


def test_skew_is_the_rate():
    c = clocks(drift=0.0)
    which = np.array([0, 1])
    start, end = (c.read(which, np.full(2, t * SUBTICKS_PER_SECOND)) for t in (0, 50))
    rate = (end - start) / (50 * SUBTICKS_PER_SECOND) - 1
    np.testing.assert_allclose(rate, [12e-6, -7e-6], atol=1e-15)


def test_drift_is_a_continuous_random_walk():
    c = clocks(skews=(0.0, 0.0), drift=0.1, duration=1000.0)
    time = (np.arange(10_000) * 0.1 * SUBTICKS_PER_SECOND).astype(np.int64)
    which = np.zeros(len(time), dtype=np.int64)
    rate = c.rate(which, time) * 1e6
    steps = np.diff(rate)
    # 10 000 steps know their deviation to 0.7 %; four sigma of it.
    assert np.std(steps) == pytest.approx(0.1 * np.sqrt(0.1), rel=0.03)
    fine = time[500] + np.arange(-50, 50)
    assert np.abs(np.diff(c.read(np.zeros(100, dtype=np.int64), fine)) - 1).max() <= 1
