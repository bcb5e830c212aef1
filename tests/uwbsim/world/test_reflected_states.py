"""Reflections that last: planted shares and lives by pair, and their trace, wherever frames are received."""

import numpy as np
import pytest

import uwbsim
from tests.uwbsim.world.helpers import autocorrelation, served
from uwblink import PROTOCOLS, raw_range
from uwbsim.protocols.conditions import conditions_of
from uwbsim.protocols.prediction import predict
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import TAP_S
from uwbsim.world.world import World

PLACES = {"a": (0.0, 0.0, 1.0), "b": (4.0, 0.5, 1.2), "c": (1.5, 3.0, 0.8)}
EXPECTED = {(1, 2): (0.1, 0.3), (1, 3): (0.5, 1.0), (2, 3): (0.3, 0.5)}
"""Share and life in seconds of each pair; those of the last are the model's."""

FIRST_DB, TOTAL_DB = 9.0, 2.5
# A gamma of shape 8 has no excess so small that it could be taken for none.
MODEL = {
    "model": "two-state",
    "share": 0.3,
    "life_s": 0.5,
    "mean_excess_m": 0.8,
    "excess_shape": 8.0,
    "first_path_loss_db": FIRST_DB,
    "loss_std_db": 0.0,
    "total_loss_db": TOTAL_DB,
    "rise_ns": 20.0,
}


def scenario(duration_s=10.0, rate_hz=150.0, get_cir=False, passive=(), who=tuple(EXPECTED), **model):
    quiet = {"rx_noise_ps": 0.0, "skew_noise_ppm": 0.0, "quantize": False, "first_path_at_1m_dbm": -72.0}
    return uwbsim.load(
        {
            "run": {"duration_s": duration_s, "seed": 8},
            "ranging": {"rate_hz": rate_hz, "pairs": [list(p) for p in who], "get_cir": get_cir},
            "radio": quiet | {"multipath": MODEL | model},
            "mocap": {"rate_hz": 2.0},
            "bodies": [{"name": n, "motion": {"model": "static", "position_m": p}} for n, p in PLACES.items()],
            "tags": [{"id": k + 1, "body": n, "passive": k + 1 in passive} for k, n in enumerate(PLACES)],
        }
    )


def by_pair(flight, pair):
    rows = (flight.exchanges.initiator == pair[0]) & (flight.exchanges.target == pair[1])
    return rows, (raw_range(flight.exchanges) - flight.truth_m)[rows]


@pytest.fixture(scope="module")
def long_flight():
    """Each pair 20 times a second for an hour."""
    known = [{"tags": [1, 2], "share": 0.1, "life_s": 0.3}, {"tags": [3, 1], "share": 0.5, "life_s": 1.0}]
    return uwbsim.simulate(scenario(3600.0, 60.0, pairs=known), contention=False)


@pytest.mark.parametrize("pair", EXPECTED)
def test_pairs_have_their_own_shares(long_flight, pair):
    share, life_s = EXPECTED[pair]
    reflected = by_pair(long_flight, pair)[1] > 0.1
    # An hour holds 3600/(2 life) independent looks.
    error = np.sqrt(share * (1 - share) * 2 * life_s / 3600)
    assert np.mean(reflected) == pytest.approx(share, abs=3 * error)


@pytest.mark.parametrize("pair", EXPECTED)
def test_residuals_and_states_forget_with_their_life(long_flight, pair):
    life_s, residual = EXPECTED[pair][1], by_pair(long_flight, pair)[1]
    for lag in (1, 4, 10, 20):
        expected = np.exp(-lag * 0.05 / life_s)
        # A thousandth of the hour each: autocorrelations are known to 0.03.
        assert autocorrelation(residual, lag) == pytest.approx(expected, abs=0.08), lag
        assert autocorrelation((residual > 0.1).astype(float), lag) == pytest.approx(expected, abs=0.08), lag


def test_reflections_show_in_first_path_power(long_flight):
    rows, residual = by_pair(long_flight, (2, 3))
    reflected = residual > 0.1
    for name in ("fpp1_dbm", "fpp2_dbm"):
        power = getattr(long_flight.exchanges, name)[rows]
        assert np.ptp(power[~reflected]) < 1e-9
        # An exchange in the middle of which the path changes has one power of each.
        assert np.median(power[~reflected]) - np.median(power[reflected]) == pytest.approx(FIRST_DB, abs=1e-9)


def test_excess_is_that_of_the_scenario(long_flight):
    residual = by_pair(long_flight, (2, 3))[1]
    excess = residual[residual > 0.1]
    # 2000 reflections of a shape of 8 know their mean to 1 %.
    assert excess.mean() == pytest.approx(0.8, rel=0.04)
    assert excess.std() == pytest.approx(0.8 / np.sqrt(8), rel=0.08)


def test_reflections_show_in_total_less_first_path_power():
    world = World(scenario(300.0))
    time = (np.linspace(0, 300, 2000) * SUBTICKS_PER_SECOND).astype(np.int64)
    link = world.link(np.zeros(2000, dtype=np.int64), np.ones(2000, dtype=np.int64), time)
    reflected = link.excess_m > 0
    assert 0.1 < reflected.mean() < 0.6
    np.testing.assert_allclose((link.total_dbm - link.power_dbm)[reflected], FIRST_DB - TOTAL_DB, atol=1e-9)
    np.testing.assert_allclose((link.total_dbm - link.power_dbm)[~reflected], 0.0, atol=1e-9)


def test_the_rise_of_a_response_is_the_later_paths():
    world = World(scenario(share=1.0))
    ends = np.array([0]), np.array([1])
    (paths,) = world.paths(*ends, np.array([SUBTICKS_PER_SECOND]), np.zeros(1))
    delay_s, share = paths.delay_s[-1], paths.amplitude[-1]
    (expected,) = world.states.at(ends, np.array([1.0]))[3]
    assert delay_s == pytest.approx(expected, rel=1e-6)
    later_db = 10 * np.log10(10 ** ((FIRST_DB - TOTAL_DB) / 10) - 1)
    assert 20 * np.log10(share) == pytest.approx(later_db, abs=1e-6)
    assert TAP_S < 1e-8


def test_served_boards_and_listeners_meet_the_same_paths_as_flights():
    """One path for the whole run: what differs from a world without is the same wherever one looks."""
    always, never = (scenario(1.0, 20.0, who=((1, 2),), passive=(3,), share=s, life_s=1e4) for s in (1.0, 0.0))
    flights = [uwbsim.simulate(world) for world in (always, never)]
    (excess,) = World(always).states.at((np.array([0]), np.array([1])), np.array([0.5]))[1]
    lengths = [np.mean(raw_range(flight.exchanges)) for flight in flights]
    assert lengths[0] - lengths[1] == pytest.approx(excess, abs=0.005)
    heard = [flight.overheard for flight in flights]
    for name in ("fpp1_dbm", "fpp2_dbm"):
        np.testing.assert_allclose(heard[1][name] - heard[0][name], FIRST_DB, atol=1e-9)
    reports, passive = zip(*(served(world) for world in (always, never)), strict=True)
    assert reports[0].range_m - reports[1].range_m == pytest.approx(excess, abs=0.01)
    assert reports[1].fpp1_dbm - reports[0].fpp1_dbm == pytest.approx(FIRST_DB, abs=2e-4)
    assert passive[1].fpp2_dbm - passive[0].fpp2_dbm == pytest.approx(FIRST_DB, abs=2e-4)


def test_the_workbench_counts_them_as_errors():
    world = scenario(200.0, 60.0, who=((1, 2),))
    found = predict(PROTOCOLS["ds"], conditions_of(world))
    flight = uwbsim.simulate(world)
    assert found.pooled()[0] == pytest.approx(np.mean(raw_range(flight.exchanges) - flight.truth_m), abs=0.002)


def test_pairs_shares_and_lives_spread_as_asked_for():
    count = 40
    tags = [{"id": k, "body": "ab"[k % 2], "lever_arm_m": [0.1 * k, 0, 0]} for k in range(count)]
    bodies = [{"name": n, "motion": {"model": "static", "position_m": PLACES[n]}} for n in "ab"]
    model = MODEL | {"share": 0.2, "share_std": 0.1, "life_s": 0.05}
    world = uwbsim.load(
        {
            "run": {"duration_s": 10.0},
            "ranging": {"rate_hz": 10.0},
            "radio": {"multipath": model},
            "bodies": bodies,
            "tags": tags,
        }
    )
    states = World(world).states
    which = np.searchsorted(np.arange(1, 780) * states.span_s, states.begin, side="right")
    shares = np.bincount(which, weights=states.values[0]) / np.bincount(which)
    # 780 pairs with 1400 paths each.
    assert shares.mean() == pytest.approx(0.2, abs=0.015)
    assert shares.std() == pytest.approx(0.1, rel=0.12)


def test_a_longer_run_continues_the_same_reflections():
    places, time = (np.zeros(100, dtype=np.int64), np.ones(100, dtype=np.int64)), np.linspace(0, 9, 100)
    short, long = (World(scenario(duration)).states.at(places, time) for duration in (10.0, 1000.0))
    np.testing.assert_array_equal(short, long)


@pytest.mark.parametrize(
    ("change", "fragment"),
    [
        ({"share_std": 0.5}, "share_std: found 0.5, with a mean of 0.3 it is below 0.458"),
        ({"total_loss_db": 20.0}, "total_loss_db: found 20, at most first_path_loss_db"),
        ({"pairs": [{"tags": [1, 1]}]}, "tags: found .1, 1., give two tags"),
        ({"pairs": [{"tags": [1, 2]}, {"tags": [2, 1]}]}, "each pair once"),
        ({"pairs": [{"tags": [1, 9]}]}, "found tag 9, the tags are 1, 2, 3"),
        ({"model": "three-state"}, "model"),
        ({"life_s": 0.0}, "life_s"),
    ],
)
def test_models_that_cannot_be_are_refused(change, fragment):
    with pytest.raises(uwbsim.ScenarioError, match=fragment):
        scenario(**change)
