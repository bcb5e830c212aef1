"""Share, length and life of reflections, on residuals by a generator of this file, which shares nothing with any model.

States alternate: a pair is direct for a while and reflected for a while, whiles are drawn from gamma distributions of
shape two (nobody draws anything anew at random instants), and within a while the detour is not constant but breathes.
"""

import numpy as np
import pytest

from uwblink import PROTOCOLS, Exchanges, Tag
from uwbsim.twins.flight import TwinFlight, effective_size, lag_one, lasting, some_rows
from uwbsim.twins.range_errors import fit_range_errors


def alternating(rng, time_s, direct_s, reflected_s):
    """Return which times are reflected, and how far into which spell they are."""
    begins, reflected, at = [], [], -10 * (direct_s + reflected_s)
    while at < time_s[-1]:
        begins.append(at)
        reflected.append(len(begins) % 2 == 0)
        at += rng.gamma(2.0, (reflected_s if reflected[-1] else direct_s) / 2)
    spell = np.searchsorted(begins, time_s, side="right") - 1
    return np.array(reflected)[spell], spell, time_s - np.array(begins)[spell]


def residuals(rng, time_s, direct_s, reflected_s, core_m=0.04, mean_m=0.4):
    reflected, spell, into = alternating(rng, time_s, direct_s, reflected_s)
    detours = rng.exponential(mean_m, spell.max() + 1)[spell]
    breath = 1 + 0.2 * np.sin(7 * into + spell)
    return np.where(reflected, detours * breath, 0.0) + rng.normal(0, core_m, len(time_s)), reflected


def flight(time_s, pair, error):
    count = len(time_s)
    pairs = tuple((1, 2 + k) for k in range(pair.max() + 1))
    tags = tuple(Tag(k, f"b{k}", (0.0, 0.0, 0.0)) for k in range(1, len(pairs) + 2))
    return TwinFlight(
        where="made",
        tags=tags,
        row=PROTOCOLS["ss"],
        exchanges=Exchanges.from_arrays(
            np.full(count, 1), 2 + pair, tx1=np.zeros(count, int), rx1=1, tx2=2, rx2=3, time_ns=np.rint(1e9 * time_s)
        ),
        origin_ns=0,
        time_s=time_s,
        ends=np.array([np.zeros(count, int), 1 + pair]),
        pair=pair,
        pairs=pairs,
        distance_m=np.full(count, 5.0),
        towards=np.zeros((2, count, 3)),
        residual_m=error,
        ratio_ppm=np.full(count, np.nan),
    )


@pytest.fixture(scope="module")
def made():
    """Six pairs: two that are reflected often, and four that are less."""
    return several(77, [(1.2, 0.6), (1.2, 0.6), (3.0, 0.5), (3.0, 0.5), (4.0, 0.4), (4.0, 0.4)])


def several(seed, whiles):
    """Return a flight of pairs at 20 Hz each for 300 s, which ranges are reflected, and the mean shares of pairs."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0, 300, 0.05)
    parts = [residuals(rng, time_s + 0.005 * k, *pair) for k, pair in enumerate(whiles)]
    times = np.concatenate([time_s + 0.005 * k for k in range(len(whiles))])
    pair = np.repeat(np.arange(len(whiles)), len(time_s))
    order = np.argsort(times, kind="stable")
    error, state = (np.concatenate([part[k] for part in parts])[order] for k in (0, 1))
    return flight(times[order], pair[order], error), state, [r / (d + r) for d, r in whiles]


@pytest.fixture(scope="module")
def found(made):
    return fit_range_errors(made[0], np.zeros(len(made[0])))


def test_shares_are_found_of_all_and_of_pairs(made, found):
    """The flight's own shares, which a pair's 60 to 170 spells leave 3 points from those that were asked for."""
    whole, state, asked = made
    assert found.share == pytest.approx(np.mean(state), abs=0.02)
    own = [np.mean(state[whole.pair == k]) for k in range(6)]
    assert found.pair_share == pytest.approx(own, abs=0.03)
    assert np.corrcoef(found.pair_share, asked)[0, 1] > 0.95
    assert np.std(found.pair_share) > 0.04


def test_the_tail_and_the_core_are_found(found):
    assert found.mean_excess_m == pytest.approx(0.4, rel=0.1)
    assert found.direct_std_m == pytest.approx(0.04, rel=0.05)
    assert np.mean(list(found.delays_ns.values())) == pytest.approx(0.0, abs=0.02)


def test_the_life_is_that_of_the_states(made, found):
    """The states' own integral of the autocorrelation, which no fit and no drawing at random instants is in."""
    whole, state, _ = made
    pairs = [state[whole.pair == k].astype(float) for k in range(6)]
    lives = [integral_s(one - one.mean(), 0.05) for one in pairs]
    assert found.life_s == pytest.approx(np.average(lives, weights=list(map(np.var, pairs))), rel=0.2)


def integral_s(centred, step_s, longest_s=3.0):
    lags = range(1, round(longest_s / step_s))
    correlation = [np.mean(centred[k:] * centred[:-k]) / np.mean(centred**2) for k in lags]
    first = next((k for k, value in enumerate(correlation) if value < 0.02), len(correlation))
    return step_s * (0.5 + sum(correlation[:first]))


def test_pairs_whose_reflections_last_longer_are_told_from_others():
    lives = fit_range_errors(several(78, [(0.6, 0.3)] * 2 + [(4.0, 2.0)] * 2)[0], np.zeros(24_000)).pair_life_s
    assert min(lives[2:]) > 3 * max(lives[:2])


def test_independent_reflections_have_no_life(made):
    rng = np.random.default_rng(5)
    whole = made[0]
    shuffled = flight(whole.time_s, whole.pair, rng.permutation(whole.residual_m))
    assert fit_range_errors(shuffled, np.zeros(len(shuffled))).life_s is None


def test_some_rows_are_of_all_pairs_that_take_turns():
    rows = some_rows(24_000, 4000)
    assert len(np.unique(rows)) == 4000
    assert np.bincount(rows % 12).min() > 4000 / 12 * 0.8
    assert np.array_equal(some_rows(10, 10), np.arange(10))


def autoregressive(steps, keep):
    """Each value is the share `keep` of the one before it, and a step that leaves the variance at one."""
    values, now = np.empty(len(steps)), 0.0
    for k, (share, step) in enumerate(zip(keep, steps, strict=True)):
        values[k] = now = share * now + np.sqrt(1 - share**2) * step
    return values


def test_values_are_worth_what_their_dependence_leaves():
    """An autoregressive sequence of coefficient a is worth (1 - a)/(1 + a) of its length."""
    value, group = autoregressive(np.random.default_rng(3).normal(size=60_000), [0.8] * 60_000), np.zeros(60_000, int)
    assert effective_size(value, group) / 60_000 == pytest.approx(0.2 / 1.8, rel=0.1)
    r, error = lag_one(value, group)
    assert r == pytest.approx(0.8, abs=0.02)
    # Bartlett: the error of the coefficient of such a sequence is sqrt((1 - a^2)/n).
    assert error == pytest.approx(np.sqrt((1 - 0.8**2) / 60_000), rel=0.15)


def test_a_life_is_found_below_noise_and_between_uneven_times():
    rng = np.random.default_rng(9)
    time_s = np.sort(rng.uniform(0, 2000, 40_000))
    value = autoregressive(rng.normal(size=len(time_s)), np.exp(-np.diff(time_s, prepend=0.0) / 0.7))
    noisy = value + rng.normal(0, 1.5, len(value))
    variance, life_s = lasting(time_s, np.zeros(len(time_s), dtype=np.int64), noisy)
    assert life_s == pytest.approx(0.7, rel=0.1)
    assert variance == pytest.approx(1.0, rel=0.1)
