"""Clocks: reading and its inverse at any hour, and noise as an outside authority measures it (allantools)."""

import allantools
import numpy as np
import pytest

from tests.uwbsim.simulation.test_protocols import bench
from uwbsim.world.clocks import LONGEST_RUN_S, SUBTICKS, SUBTICKS_PER_SECOND, Clocks

BOTH = np.array([0, 1])
NOMINAL = {
    "white_ppm_sqrt_s": lambda tau: 0.01e-6 / np.sqrt(tau),
    "flicker_ppm": lambda tau: np.full_like(tau, 0.01e-6),
    "drift_ppm_per_sqrt_s": lambda tau: 0.01e-6 * np.sqrt(tau / 3),
}
NOISY = dict.fromkeys(NOMINAL, 0.01)
SHORT, LONG = np.array([1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0]), np.array([2.0, 10.0, 30.0, 100.0, 300.0])


def clocks(duration=10.0, skews=(0.0, 0.0), seed=1, ids=(1, 2), **noise):
    scenario = bench(skews=skews, seed=seed)
    tags = tuple(scenario.tags[k % 2].model_copy(update={"id": own} | noise) for k, own in enumerate(ids))
    settings = scenario.run.model_copy(update={"duration_s": duration})
    return Clocks.of(scenario.model_copy(update={"tags": tags, "run": settings}))


def subticks(seconds):
    return np.rint(np.asarray(seconds) * SUBTICKS_PER_SECOND).astype(np.int64)


def ahead_s(clock, time, tag):
    """By how much a clock is ahead of true time since its start."""
    which = np.full(len(time), tag)
    return (clock.read(which, time) - time - clock.offset[tag]) / SUBTICKS_PER_SECOND


def test_skew_and_a_ramp_are_what_readings_gain():
    gained = [ahead_s(clocks(skews=(12.0, -7.0), duration=50.0), subticks([50]), k)[0] for k in (0, 1)]
    np.testing.assert_allclose(gained, [600e-6, -350e-6], atol=1e-13)
    ramp = ahead_s(clocks(20_000.0, ramp_ppm_per_s=0.001), subticks([20_000]), 0)[0]
    assert ramp == pytest.approx(0.5 * 0.001e-6 * 20_000**2, rel=1e-4)


@pytest.mark.parametrize(("duration", "begin_s", "noise"), [(10.0, 0, NOISY), (31 * 3600.0, 30 * 3600, {})])
def test_when_inverts_read_to_the_subtick(duration, begin_s, noise):
    c = clocks(duration, (12.0, -7.0), **noise)
    time = begin_s * SUBTICKS_PER_SECOND + np.random.default_rng(1).integers(0, 10 * SUBTICKS_PER_SECOND, 5000)
    which = np.arange(5000) % 2
    assert np.abs(c.when(which, c.read(which, time)) - time).max() <= 1
    assert (LONGEST_RUN_S + 3600) * SUBTICKS_PER_SECOND + 2**40 * SUBTICKS < 2**63


def test_noise_depends_neither_on_what_else_is_asked_nor_on_how_long_the_run_is():
    time, tag = np.random.default_rng(1).integers(0, 10 * SUBTICKS_PER_SECOND, 100), np.arange(100) % 2
    short, long = clocks(**NOISY), clocks(100.0, **NOISY)
    whole = short.read(tag, time)
    one_by_one = [short.read(tag[k : k + 1], time[k : k + 1])[0] for k in range(99, -1, -1)][::-1]
    np.testing.assert_array_equal(whole, one_by_one)
    np.testing.assert_array_equal(whole, long.read(tag, time))


def test_noisy_clocks_begin_at_their_offset_and_never_stand_still():
    c = clocks(clock_offset_s=1.0, **NOISY)
    np.testing.assert_array_equal(c.read(BOTH, np.zeros(2, dtype=np.int64)), c.offset)
    assert (c.offset // SUBTICKS).tolist() == [63_897_600_000] * 2
    fine = 3 * SUBTICKS_PER_SECOND + np.arange(0, 100_000_000, 1_000_000)
    assert np.diff(c.read(np.zeros(len(fine), dtype=np.int64), fine)).min() > 0.999 * 1_000_000


def test_drawn_offsets_are_any_reading_of_the_counter_and_any_part_of_a_tick():
    ticks, parts = np.divmod(clocks(ids=range(1, 65)).offset, SUBTICKS)
    assert 0 <= ticks.min() < 2**36
    assert 2**39 < ticks.max() < 2**40
    assert len(np.unique(parts)) > 50


def test_the_noises_of_two_clocks_have_nothing_to_do_with_each_other():
    c, time = clocks(100.0, white_ppm_sqrt_s=0.01, flicker_ppm=0.01), subticks(np.arange(0, 100, 0.001))
    # 100 000 independent pairs know a correlation to 0.003.
    assert abs(np.corrcoef(*(np.diff(ahead_s(c, time, k)) for k in (0, 1)))[0, 1]) < 0.015


def test_the_walk_goes_on_to_its_last_step_and_stands_from_there():
    c, tenth = clocks(5.0, drift_ppm_per_sqrt_s=0.1), SUBTICKS_PER_SECOND // 10
    last = 50 + 20 - 1  # two seconds beyond the run: the last exchange may end after it
    steps = np.arange(last + 30)
    which = np.zeros(len(steps), dtype=np.int64)
    rate = c.rate(which, steps * tenth + tenth // 2)
    assert len(np.unique(rate)) == len(np.unique(rate[: last + 1])) == last + 1, "every step has a rate of its own"
    assert set(rate[last:]) == {rate[last]}
    # The clock's reading is the integral of it, across the end, too; before the run it is as at its first step.
    np.testing.assert_allclose(np.diff(ahead_s(c, steps * tenth, 0)), rate[:-1] * 0.1, atol=2 / SUBTICKS_PER_SECOND)
    assert c.rate(which[:1], np.array([-5 * tenth]))[0] == rate[0]


@pytest.mark.parametrize("span_s", [130e-6, 0.1])
def test_the_rate_of_a_noisy_clock_is_what_its_reading_gains_over_a_preamble_or_an_exchange(span_s):
    c, span = clocks(white_ppm_sqrt_s=0.01, flicker_ppm=0.01), round(span_s * SUBTICKS_PER_SECOND)
    time, which = (
        np.random.default_rng(1).integers(SUBTICKS_PER_SECOND, 10 * SUBTICKS_PER_SECOND, 500),
        np.arange(500) % 2,
    )
    gained = (c.read(which, time) - c.read(which, time - span)) / span - 1
    found = c.rate(which, time, span_s)
    # A reading is rounded to a sub-tick at either end.
    np.testing.assert_allclose(found, gained, rtol=0, atol=1.01 / span)
    assert np.std(found[which == 0]) > 2 / span, "there is noise in it"


# For the long ones 20 hours altogether: 240 independent spans of 300 s, known to 5 %.
@pytest.mark.parametrize(
    ("kinds", "long"), [([kind], long) for kind in NOMINAL for long in (False, True)] + [([*NOMINAL], False)]
)
def test_allan_deviations_are_nominal_and_add_up_in_variance(kinds, long):
    step_s, duration_s, taus, seeds = (2.0, 36_000.0, LONG, 1) if long else (0.5e-3, 30.0, SHORT, 3)
    time, squares = subticks(np.arange(0, duration_s, step_s)), []
    for seed in range(seeds):
        c = clocks(duration_s, seed=seed + 1, **dict.fromkeys(kinds, 0.01))
        phases = [ahead_s(c, time, k) for k in (0, 1)]
        squares += [allantools.oadev(p, rate=1 / step_s, data_type="phase", taus=taus)[1] ** 2 for p in phases]
    expected = np.sqrt(sum(NOMINAL[kind](taus) ** 2 for kind in kinds))
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=0)), expected, rtol=0.10)
