"""Clocks: reading and its inverse, skew, drift, and exactness at any hour."""

import numpy as np
import pytest

from tests.uwbsim.simulation.test_protocols import bench
from uwbsim.world.clocks import LONGEST_RUN_S, SUBTICKS, SUBTICKS_PER_SECOND, Clocks

NOISY = {"white_ppm_sqrt_s": 0.01, "flicker_ppm": 0.01, "drift_ppm_per_sqrt_s": 0.01}


def clocks(skews=(12.0, -7.0), drift=0.01, duration=100.0, **more):
    scenario = bench(skews=skews)
    tags = tuple(t.model_copy(update={"drift_ppm_per_sqrt_s": drift} | more) for t in scenario.tags)
    settings = scenario.run.model_copy(update={"duration_s": duration})
    return Clocks.of(scenario.model_copy(update={"tags": tags, "run": settings}))


def noisy_clocks(duration=10.0, **more):
    return clocks(duration=duration, **(NOISY | more))


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


@pytest.mark.parametrize(
    ("made", "begin_s"),
    [
        (lambda: clocks(duration=31 * 3600.0, drift=0.0), 0),
        (lambda: clocks(duration=31 * 3600.0, drift=0.0), 30 * 3600),
        (noisy_clocks, 0),
    ],
)
def test_when_inverts_read_to_the_subtick(made, begin_s):
    c = made()
    time = begin_s * SUBTICKS_PER_SECOND + np.random.default_rng(1).integers(0, 10 * SUBTICKS_PER_SECOND, 5000)
    for tag in (0, 1):
        which = np.full(len(time), tag)
        assert np.abs(c.when(which, c.read(which, time)) - time).max() <= 1


def test_noise_depends_neither_on_what_else_is_asked_nor_on_how_long_the_run_is():
    time = np.random.default_rng(1).integers(0, 10 * SUBTICKS_PER_SECOND, 100)
    tag = np.arange(100) % 2
    short, long = noisy_clocks(), noisy_clocks(duration=100.0)
    whole = short.read(tag, time)
    one_by_one = [short.read(tag[k : k + 1], time[k : k + 1])[0] for k in range(99, -1, -1)][::-1]
    np.testing.assert_array_equal(whole, one_by_one)
    np.testing.assert_array_equal(whole, long.read(tag, time))


def test_noisy_clocks_begin_at_their_offset_and_never_stand_still():
    c = noisy_clocks(clock_offset_s=1.0)
    which = np.array([0, 1])
    np.testing.assert_array_equal(c.read(which, np.zeros(2, dtype=np.int64)), c.offset)
    fine = 3 * SUBTICKS_PER_SECOND + np.arange(0, 100_000_000, 1_000_000)
    assert np.diff(c.read(np.zeros(len(fine), dtype=np.int64), fine)).min() > 0.999 * 1_000_000


def test_the_noises_of_two_clocks_have_nothing_to_do_with_each_other():
    c = noisy_clocks(duration=100.0, drift_ppm_per_sqrt_s=0.0)
    time = (np.arange(0, 100, 0.001) * SUBTICKS_PER_SECOND).astype(np.int64)
    steps = [np.diff(c.noise.phase(np.full(len(time), k), time)) for k in (0, 1)]
    # 100 000 independent pairs know a correlation to 0.003.
    assert abs(np.corrcoef(*steps)[0, 1]) < 0.015


def test_the_walk_goes_on_to_its_last_step_and_stands_from_there():
    c = clocks(skews=(0.0, 0.0), drift=0.1, duration=5.0)
    tenth = SUBTICKS_PER_SECOND // 10
    last = c.walk_rate.shape[1] - 2
    assert last == 50 + 20 - 1, "two seconds beyond the run: the last exchange may end after it"
    steps = np.arange(last + 30)
    which = np.zeros(len(steps), dtype=np.int64)
    expected = c.walk_rate[0, np.minimum(steps, last)]
    np.testing.assert_array_equal(c.rate(which, steps * tenth + tenth // 2), expected)
    assert len(np.unique(expected)) == last + 1, "every step has a rate of its own"
    # The clock's reading is the integral of it, across the end, too; before the run it is as at its first step.
    read = c.read(which, steps * tenth) - c.offset[0] - steps * tenth
    np.testing.assert_allclose(np.diff(read), expected[:-1] * tenth, atol=2)
    assert c.rate(which[:1], np.array([-5 * tenth]))[0] == c.walk_rate[0, 0]


def test_offsets_are_any_reading_of_the_counter_and_any_part_of_a_tick():
    scenario = bench()
    many = tuple(scenario.tags[0].model_copy(update={"id": k}) for k in range(1, 65))
    c = Clocks.of(scenario.model_copy(update={"tags": many}))
    ticks, parts = np.divmod(c.offset, SUBTICKS)
    assert 0 <= ticks.min() < 2**36
    assert 2**39 < ticks.max() < 2**40
    assert len(np.unique(parts)) > 50
    given = tuple(t.model_copy(update={"clock_offset_s": 1.0}) for t in scenario.tags)
    assert (Clocks.of(scenario.model_copy(update={"tags": given})).offset // SUBTICKS).tolist() == [63_897_600_000] * 2


@pytest.mark.parametrize("span_s", [130e-6, 0.1])
def test_the_rate_of_a_noisy_clock_is_what_its_reading_gains_over_a_preamble_or_an_exchange(span_s):
    c = noisy_clocks(drift_ppm_per_sqrt_s=0.0)
    span = round(span_s * SUBTICKS_PER_SECOND)
    time = np.random.default_rng(1).integers(SUBTICKS_PER_SECOND, 10 * SUBTICKS_PER_SECOND, 500)
    which = np.arange(500) % 2
    gained = (c.read(which, time) - c.read(which, time - span)) / span - 1
    found = c.rate(which, time, span_s)
    # A reading is rounded to a sub-tick at either end.
    np.testing.assert_allclose(found, gained, rtol=0, atol=1.01 / span)
    assert np.std(found[which == 0]) > 2 / span, "there is noise in it"


def test_runs_may_last_as_long_as_63_bits_count_subticks():
    assert LONGEST_RUN_S == 129_600
    assert (LONGEST_RUN_S + 3600) * SUBTICKS_PER_SECOND + 2**40 * SUBTICKS < 2**63
