"""Simulated clocks against the Allan deviation that was asked for, by an outside authority (allantools)."""

import allantools
import numpy as np
import pytest

from tests.uwbsim.simulation.test_protocols import bench
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, Clocks

NOMINAL = {
    "white_ppm_sqrt_s": lambda tau: 0.01e-6 / np.sqrt(tau),
    "flicker_ppm": lambda tau: np.full_like(tau, 0.01e-6),
    "drift_ppm_per_sqrt_s": lambda tau: 0.01e-6 * np.sqrt(tau / 3),
}
SHORT, LONG = np.array([1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3]), np.array([1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0])


def phases_s(step_s, duration_s, seed=1, **clock):
    """What both tags' clocks are ahead of true time, sampled evenly."""
    scenario = bench(seed=seed)
    tags = tuple(t.model_copy(update=clock) for t in scenario.tags)
    settings = scenario.run.model_copy(update={"duration_s": duration_s})
    clocks = Clocks.of(scenario.model_copy(update={"tags": tags, "run": settings}))
    time = np.rint(np.arange(0, duration_s, step_s) * SUBTICKS_PER_SECOND).astype(np.int64)
    which = np.zeros(len(time), dtype=np.int64)
    return [(clocks.read(which + k, time) - time - clocks.offset[k]) / SUBTICKS_PER_SECOND for k in (0, 1)]


def allan(step_s, duration_s, taus, seeds, **clock):
    """The root mean square, over clocks, of their Allan deviations."""
    squares = []
    for seed in seeds:
        for phase in phases_s(step_s, duration_s, seed, **clock):
            _, deviation, _, _ = allantools.oadev(phase, rate=1 / step_s, data_type="phase", taus=taus)
            squares.append(deviation**2)
    return np.sqrt(np.mean(squares, axis=0))


@pytest.mark.parametrize("kind", NOMINAL)
def test_deviations_are_nominal_from_a_millisecond_on(kind):
    found = allan(0.5e-3, 30.0, SHORT, range(3), **{kind: 0.01})
    np.testing.assert_allclose(found, NOMINAL[kind](SHORT), rtol=0.10)


@pytest.mark.parametrize("kind", NOMINAL)
def test_deviations_are_nominal_up_to_a_thousand_seconds(kind):
    # Two days and a half altogether: 200 independent spans of 1000 s, known to 5 %.
    found = allan(0.5, 109_000.0, LONG, [1], **{kind: 0.01})
    np.testing.assert_allclose(found, NOMINAL[kind](LONG), rtol=0.10)


def test_several_kinds_of_noise_add_up_in_variance():
    found = allan(0.5e-3, 30.0, SHORT, range(3), **dict.fromkeys(NOMINAL, 0.01))
    np.testing.assert_allclose(found, np.sqrt(sum(f(SHORT) ** 2 for f in NOMINAL.values())), rtol=0.10)


def test_a_temperature_ramp_is_a_parabola_of_phase():
    duration = 20_000.0
    phase = phases_s(0.1, duration, ramp_ppm_per_s=0.001)[0]
    time = np.arange(0, duration, 0.1)
    np.testing.assert_allclose(phase[-1], 0.5 * 0.001e-6 * time[-1] ** 2, rtol=1e-4)
