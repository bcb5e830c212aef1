"""Paths between antennas: shadows, echoes, impulse responses, unequal ends, fading, outages, antennas of tags."""

import numpy as np
import pytest

import uwbsim
from uwblink import PROTOCOLS, SPEED_OF_LIGHT, Board, raw_range
from uwbsim.protocols.conditions import conditions_of
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.radio import Radio
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import BEFORE, EDGE_TO_PEAK, TAP_M, TAP_S, Paths, accumulate, detect
from uwbsim.world.world import SampledWorld, World

ROOM = {"min_m": [-4.0, -4.0, 0.0], "max_m": [8.0, 4.0, 3.0], "reflection_loss_db": 6.0}
LOSS_DB = 36.0
ZERO, ONE = np.array([0]), np.array([1])


def scenario(places=((0.0, 0.0, 1.0), (4.0, 0.0, 1.0)), tags=(), overrides=(), **more):
    """Return a scenario of tags without motion and noise, with more keys, tables and bodies."""
    quiet = {"rx_noise_ps": 0.0, "power_noise_db": 0.0, "quantize": False, "first_path_at_1m_dbm": -70.0}
    bodies = [{"name": f"b{k}", "motion": {"model": "static", "position_m": p}} for k, p in enumerate(places)]
    base = {
        "run": {"duration_s": 1.0, "seed": 2},
        "ranging": {"rate_hz": 40.0, "pairs": [[1, 2]]} | more.pop("ranging", {}),
        "radio": quiet | more.pop("radio", {}),
        "bodies": bodies + more.pop("bodies", []),
        "tags": [{"id": k + 1, "body": f"b{k}"} | tag for k, tag in enumerate(tags or [{}] * len(places))],
    }
    return uwbsim.load(base | more, overrides)


def autocorrelation(values, lag):
    centred = values - values.mean()
    return np.mean(centred[lag:] * centred[:-lag]) / np.mean(centred**2)


def link(world, now=5_000_000):
    return World(world).link(ZERO, ONE, np.array([now]))


def sampled(world, now=5_000_000):
    """Return the same link with all its paths."""
    return SampledWorld(World(world)).from_sender(0, now)[ONE]


def first_path_dbm(row):
    """Return the power of the first path by the formula of the chip, from printed taps (User Manual, 4.7.1)."""
    taps = np.array(row.magnitudes, dtype=float)[int(row.first_path_index) + np.arange(1, 4)]
    return 10 * np.log10(np.sum(taps**2) / 118**2) - 121.74


def post(loss_db_per_m):
    shadow = {"semi_axes_m": [0.3, 0.3, 0.3], "loss_db_per_m": loss_db_per_m}
    return {"name": "post", "motion": {"model": "static", "position_m": [2.0, 0.0, 1.0]}, "shadow": shadow}


BOX = {"min_m": [1.7, -0.3, 0.5], "max_m": [2.3, 0.3, 1.5], "material": {"loss_db_per_m": LOSS_DB / 0.6}}


def test_a_body_in_the_way_lets_the_chip_take_a_reflection_for_the_first_path():
    free, shadowed, blocked = (
        link(scenario(room=ROOM, **more)) for more in ({}, {"bodies": [post(LOSS_DB / 0.6)]}, {"obstacles": [BOX]})
    )
    # The floor is a metre below: 4.47 m instead of 4 m.
    assert (free.excess_m[0], shadowed.excess_m[0]) == (0, pytest.approx(np.hypot(4, 2) - 4, abs=1e-9))
    assert shadowed.excess_m[0] == pytest.approx(blocked.excess_m[0], abs=1e-9)
    assert shadowed.power_dbm[0] == pytest.approx(blocked.power_dbm[0], abs=1e-9)
    extra = [float(x.total_dbm[0] - x.power_dbm[0]) for x in (free, shadowed, blocked)]
    assert extra[1] == pytest.approx(extra[2], abs=0.01)
    assert extra[1] - extra[0] > 1, "the power lies in later paths"


def test_reflections_have_the_lengths_of_their_two_legs():
    """By the image method by hand: walls at x = -4 and 8 m, y = -4 and 4 m, floor and ceiling at z = 0 and 3 m."""
    found = sampled(scenario(places=((0.0, 1.0, 1.0), (4.0, 1.0, 1.0)), room=ROOM))
    expected = [4.0, 12.0, 12.0, np.hypot(4, 10), np.hypot(4, 6), np.hypot(4, 2), np.hypot(4, 4)]
    np.testing.assert_allclose(found.paths_m[0], expected, atol=1e-9)
    powers = -70 - 20 * np.log10(expected) - 6 * (np.arange(7) > 0)
    np.testing.assert_allclose(found.paths_dbm[0], powers, atol=1e-9)
    assert found.total_dbm[0] == pytest.approx(10 * np.log10(np.sum(10 ** (powers / 10))), abs=1e-9)


def test_echoes_have_the_gains_of_their_own_directions():
    """One dipole above the other: the direct path is in both nulls, the path by a wall is not."""
    found = sampled(scenario(places=((0.0, 0.0, 0.5), (0.0, 0.0, 2.5)), room=ROOM, radio={"antenna": "dipole"}))
    assert found.paths_dbm[0, 0] == pytest.approx(-70 - 20 * np.log10(2) + 2 * (1.76 - 20), abs=1e-9)
    wall = np.hypot(2, 8)  # by the wall at x = -4 m; the sine to the axis is 8/hypot(2, 8)
    gain = 1.76 + 20 * np.log10(8 / wall)
    assert found.paths_m[0, 1] == pytest.approx(wall, abs=1e-9)
    assert found.paths_dbm[0, 1] == pytest.approx(-70 - 20 * np.log10(wall) + 2 * gain - 6, abs=1e-9)


def test_echoes_go_through_obstacles_and_bodies_as_the_direct_path_does():
    plate = {"min_m": [-4.0, -4.0, 0.4], "max_m": [8.0, 4.0, 0.5], "material": {"loss_db_per_m": 100.0, "index": 2.0}}
    free, covered = (sampled(scenario(room=ROOM, **more)) for more in ({}, {"obstacles": [plate]}))
    # The path by the floor crosses the plate twice, 0.1 m times 4.47/2 each.
    crossed = 2 * 0.1 * np.hypot(4, 2) / 2
    assert free.paths_dbm[0, 5] - covered.paths_dbm[0, 5] == pytest.approx(100 * crossed, abs=1e-9)
    assert covered.paths_m[0, 5] - free.paths_m[0, 5] == pytest.approx(crossed, abs=1e-9)
    np.testing.assert_allclose(covered.paths_dbm[0, 6], free.paths_dbm[0, 6], atol=1e-9)
    low = post(50.0) | {"motion": {"model": "static", "position_m": [1.0, 0.0, 0.5]}}
    low["shadow"] = {"semi_axes_m": [0.1, 0.1, 0.1], "loss_db_per_m": 50.0}
    behind = sampled(scenario(room=ROOM, bodies=[low]))
    assert free.paths_dbm[0, 0] == pytest.approx(behind.paths_dbm[0, 0]), "not in the direct way"
    assert free.paths_dbm[0, 5] - behind.paths_dbm[0, 5] == pytest.approx(50 * 0.2, abs=1e-9), "in that by the floor"


@pytest.mark.parametrize("at_1m_dbm", [-70.0, -76.0, -82.0])
def test_impulse_responses_follow_the_power_of_the_link(at_1m_dbm):
    flight = uwbsim.simulate(scenario(radio={"first_path_at_1m_dbm": at_1m_dbm}, ranging={"get_cir": True}))
    # Diffuse paths, the firmware's estimate of magnitudes and the positions of the taps cause scatter.
    found = np.median([first_path_dbm(row) for row in flight.cirs])
    assert found == pytest.approx(flight.exchanges.fpp2_dbm[0], abs=1.5)


def test_a_ranges_own_detour_brings_its_echoes_nearer():
    """With a detour of the first path, echoes come sooner after it."""
    world = World(scenario(room=ROOM))
    (plain,), (late,) = (world.paths(ZERO, ONE, ZERO, np.array([detour_m])) for detour_m in (0.0, 0.3))
    assert late.delay_s[0] == pytest.approx(plain.delay_s[0] - 0.3 / SPEED_OF_LIGHT)
    room = ROOM | {"max_m": [8.0, 4.0, 40.0], "min_m": [-60.0, -60.0, -0.5], "reflection_loss_db": 0.0}
    radio = {"multipath": {"probability": 1.0, "mean_excess_m": 0.2}}
    flight = uwbsim.simulate(scenario(room=room, radio=radio, ranging={"get_cir": True}))
    excess = raw_range(flight.exchanges) - flight.truth_m
    way = 3.0  # by the floor, 1.5 m below: 5 m instead of 4 m
    for row, own in zip(flight.cirs, excess.tolist(), strict=True):
        taps, peak = np.array(row.magnitudes), row.first_path_index + EDGE_TO_PEAK
        echo = peak + (np.hypot(4, way) - 4.0 - own) / SPEED_OF_LIGHT / TAP_S
        if echo > peak + 1.2:
            assert taps[round(echo)] > 0.3 * taps[round(peak)]


def test_tags_may_send_stronger_and_read_too_high():
    world = scenario(tags=({"tx_power_db": 3.0}, {"power_offset_db": -1.5}))
    plain, flight = uwbsim.simulate(scenario()), uwbsim.simulate(world)
    # Tag 1 sends the poll and tag 2 reads it; the response is the other way round.
    np.testing.assert_allclose(flight.exchanges.fpp1_dbm - plain.exchanges.fpp1_dbm, 3.0 - 1.5, atol=1e-9)
    np.testing.assert_allclose(flight.exchanges.fpp2_dbm, plain.exchanges.fpp2_dbm, atol=1e-9)
    report = Board(uwbsim.VirtualPorts(world).port(1)).range(2)
    x = flight.exchanges
    assert (report.fpp1_dbm, report.fpp2_dbm) == pytest.approx((x.fpp1_dbm[0], x.fpp2_dbm[0]), abs=2e-4)


def test_weak_transmitters_are_not_received():
    radio = {"sensitivity_dbm": -85.0, "power_noise_db": 0.0}
    weak = {"tx_power_db": -10.0}
    for place, tags in enumerate([(weak, {}), ({}, weak)]):
        flight = uwbsim.simulate(scenario(tags=tags, radio=radio))
        assert len(flight.exchanges) == 0
        assert {fault.detail.split("message ")[1][0] for fault in flight.faults} == {str(place + 1)}
    assert len(uwbsim.simulate(scenario(radio=radio)).exchanges) == 40


def still_flight(radio, second=None, duration_s=400.0, **ranging):
    world = scenario(
        ((0.0, 0.0, 2.0), (3.0, 4.0, 2.0)),
        ({}, second or {}),
        run={"duration_s": duration_s, "seed": 4},
        ranging={"rate_hz": 50.0} | ranging,
        radio={"first_path_at_1m_dbm": -80.0, "skew_noise_ppm": 0.0} | radio,
    )
    return uwbsim.simulate(world, contention=False)


def test_fading_has_the_set_spread_and_lifetime():
    x = still_flight({"fading": {"std_db": 2.0, "life_s": 0.1}}).exchanges
    # 4000 draws: the standard error of the spread is 1.1 %, that of an autocorrelation 0.02.
    assert np.std(x.fpp1_dbm) == pytest.approx(2.0, rel=0.05)
    assert autocorrelation(x.fpp1_dbm, 5) == pytest.approx(np.exp(-1), abs=0.06)
    assert np.mean(np.isclose(x.fpp1_dbm, x.fpp2_dbm)) > 0.95


def test_outages_lose_a_share_of_exchanges_in_bursts_and_change_no_power():
    run = still_flight({"outages": {"share": 0.2, "life_s": 0.2}})
    lost = np.zeros(20_000, dtype=bool)
    lost[[round(fault.time_ns * 50e-9) for fault in run.faults]] = True
    assert np.mean(lost) == pytest.approx(0.2, abs=0.03)
    assert autocorrelation(lost.astype(float), 5) == pytest.approx(np.exp(-0.5), abs=0.06)
    assert np.ptp(run.exchanges.fpp2_dbm) < 1e-9


def test_a_tag_has_an_antenna_of_its_own():
    coefficients = (0.5, 0.0, 0.0, 2.0)  # everywhere, and along x by sqrt(3) times the cosine
    x = still_flight({}, {"pattern_db": coefficients}, duration_s=0.1).exchanges
    bare = still_flight({}, duration_s=0.1).exchanges
    # From the second tag, the first is in the direction (-0.6, -0.8, 0).
    assert x.fpp1_dbm - bare.fpp1_dbm == pytest.approx(0.5 - 0.6 * 2 * np.sqrt(3))
    assert x.fpp2_dbm - bare.fpp2_dbm == pytest.approx(0.5 - 0.6 * 2 * np.sqrt(3))


def test_replies_follow_the_quantiles_that_are_given():
    table = [300.0, 301.0, 305.0, 400.0]
    x = still_flight({}, reply={"model": "quantiles", "delays_us": table}).exchanges
    dt32_us = np.asarray((x.tx2 - x.rx1) % 2**32) / 63897.6
    # Replies are sent at the next multiple of 8 ns.
    assert np.quantile(dt32_us, [0, 1 / 3, 2 / 3, 1]) == pytest.approx(table, rel=0.01)


def test_direct_paths_scatter_and_a_pair_has_its_own_excess():
    model = {"model": "two-state", "share": 0.0, "life_s": 0.1, "direct_std_m": 0.05}
    run = still_flight({"multipath": model})
    assert np.std(error_of(run)) == pytest.approx(0.05, rel=0.05)
    run = still_flight({"multipath": model | {"share": 1.0, "pairs": [{"tags": [1, 2], "mean_excess_m": 1.0}]}})
    assert np.mean(error_of(run)) == pytest.approx(1.0, rel=0.1)


def error_of(run):
    return raw_range(run.exchanges) - run.truth_m


# Readings of a chip from a response, compared with sums of paths here, and with geometry by hand.


SENSING = (Radio(dynamic_range_db=15.0, sensitivity_dbm=-105.0), 1 / 12)
WIDTH_TAPS, EDGE_TAPS = 1.2, 1.5


def arrivals(*ways):
    """Return one link with paths (detour in metres, power in dBm, phase)."""
    detour, power, phase = np.array(ways).T
    return Paths(detour_m=detour[None], amplitude=(10 ** (power / 20) * np.exp(1j * phase))[None])


def test_responses_are_sums_of_pulses():
    rng = np.random.default_rng(2)
    detour, amplitude = rng.uniform(0, 14, (3, 40)), rng.normal(size=(3, 40, 2)) @ np.array([1, 1j])
    taps = np.arange(64)
    expected = [
        sum(
            a * np.exp(-(((taps - BEFORE - EDGE_TAPS - d / TAP_M) / WIDTH_TAPS) ** 2))
            for d, a in zip(*link, strict=True)
        )
        for link in zip(detour, amplitude, strict=True)
    ]
    real, imaginary = accumulate(Paths(detour_m=detour, amplitude=amplitude))
    # Paths are at multiples of a 128th of a tap.
    np.testing.assert_allclose(real + 1j * imaginary, expected, atol=0.04)


@pytest.mark.parametrize("power_dbm", [-70.0, -85.0, -95.0, -104.0])
def test_a_path_alone_is_found_where_it_is_with_the_power_that_it_has(power_dbm):
    found = detect(arrivals((0.0, power_dbm, 0.3)), *SENSING)
    assert found.excess_m[0] == pytest.approx(0.0, abs=1e-12)
    assert [found.power_dbm[0], found.total_dbm[0]] == pytest.approx([power_dbm, power_dbm], abs=1e-9)


@pytest.mark.parametrize(("below_db", "first"), [(10.0, True), (13.0, True), (17.0, False), (40.0, False)])
def test_a_direct_path_counts_down_to_the_threshold_and_no_further(below_db, first):
    """The reflection by a wall 3 m beside two antennas 4 m apart takes 7.2 m.

    Taps may be half a tap beside a peak, where it has 1.5 dB less: near the threshold, either result is possible.
    """
    detour = np.hypot(4.0, 6.0) - 4.0
    found = detect(arrivals((0.0, -80.0 - below_db, 0.0), (detour, -80.0, 1.0)), *SENSING)
    assert found.excess_m[0] == pytest.approx(0.0 if first else detour, abs=0.003)
    if below_db == 10:
        assert found.power_dbm[0] == pytest.approx(-90.0, abs=0.3)
    assert found.total_dbm[0] == pytest.approx(-80.0 + 10 * np.log10(1 + 10 ** (-below_db / 10)), abs=0.05)


def test_paths_below_sensitivity_are_no_first_paths():
    weak = arrivals((0.0, -106.0, 0.0), (2.0, -98.0, 0.0))
    assert detect(weak, *SENSING).excess_m[0] == pytest.approx(2.0, abs=0.005)
    keener = Radio(dynamic_range_db=15.0, sensitivity_dbm=-108.0)
    assert detect(weak, keener, 0.1).excess_m[0] == pytest.approx(0.0, abs=0.02)


def test_paths_nearer_than_the_pulse_fade_by_their_phase():
    """Half a wavelength apart they cancel, in phase they add; the edge moves by less than the path."""
    near = 0.01
    powers = [detect(arrivals((0.0, -80.0, 0.0), (near, -86.02, p)), *SENSING).power_dbm[0] for p in (0.0, np.pi)]
    np.testing.assert_allclose(powers, -80 + 20 * np.log10([1.5, 0.5]), atol=0.2)
    moved = [detect(arrivals((0.0, -80.0, 0.0), (0.3, -86.0, p)), *SENSING).excess_m[0] for p in np.linspace(0, 6, 13)]
    assert np.ptp(moved) > 0.02
    assert np.all(np.abs(moved) < 0.3)


def test_noise_of_the_edge_is_that_of_a_crossing_at_half_height():
    """Draw noise on the edge and find the crossing again: its spread is as predicted, for a known peak height."""
    rng = np.random.default_rng(4)
    for power_dbm in (-85.0, -97.0):
        said = detect(arrivals((0.0, power_dbm, 0.0)), *SENSING).noise_s[0]
        peak = 10 ** (power_dbm / 20)
        # The strongest taps are half a tap beside the peak.
        threshold = max(peak * np.exp(-((0.5 / WIDTH_TAPS) ** 2)) * 10 ** (-15 / 20), 10 ** (-105 / 20))
        taps = np.linspace(-4, 0, 4001)
        # The noise is nearly constant along the edge: in phase with the pulse it moves it up and down.
        noise = rng.normal(0, threshold / 12, 4000)
        crossing = np.interp(peak / 2 - noise, peak * np.exp(-((taps / WIDTH_TAPS) ** 2)), taps)
        assert said == pytest.approx(np.std(crossing) * 1.0016e-9, rel=0.05)


def test_the_edge_is_at_half_the_height_of_the_first_peak():
    """A weaker path overlaps with a stronger one: the half height is found here on a fine grid."""
    ways = arrivals((0.0, -84.0, 0.0), (0.35, -80.0, 0.6))
    detour, amplitude = ways.detour_m[0] / TAP_M, ways.amplitude[0]
    taps = np.linspace(-4, 6, 100_001)
    height = np.abs(np.exp(-(((taps[:, None] - detour) / WIDTH_TAPS) ** 2)) @ amplitude)
    expected = (taps[np.argmax(height >= height.max() / 2)] + WIDTH_TAPS * np.sqrt(np.log(2))) * TAP_M
    # The taps sample it a nanosecond apart.
    assert detect(ways, *SENSING).excess_m[0] == pytest.approx(expected, abs=0.02)
    assert 0.05 < expected < 0.35


# Reflections that last: planted shares and durations by pair, and their effects, wherever frames are received.


PLACES = {"a": (0.0, 0.0, 1.0), "b": (4.0, 0.5, 1.2), "c": (1.5, 3.0, 0.8)}
EXPECTED = {(1, 2): (0.1, 0.3), (1, 3): (0.5, 1.0), (2, 3): (0.3, 0.5)}
"""Share and duration in seconds of each pair; those of the last are the model's."""

FIRST_DB, TOTAL_DB = 9.0, 2.5
# A gamma distribution of shape 8 has practically no excess near zero.
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


def states_world(duration_s=10.0, rate_hz=150.0, who=tuple(EXPECTED), **model):
    return scenario(
        tuple(PLACES.values()),
        run={"duration_s": duration_s, "seed": 8},
        ranging={"rate_hz": rate_hz, "pairs": [list(pair) for pair in who]},
        radio={"skew_noise_ppm": 0.0, "first_path_at_1m_dbm": -72.0, "multipath": MODEL | model},
        mocap={"rate_hz": 2.0},
    )


def by_pair(flight, pair):
    rows = (flight.exchanges.initiator == pair[0]) & (flight.exchanges.target == pair[1])
    return rows, (raw_range(flight.exchanges) - flight.truth_m)[rows]


@pytest.fixture(scope="module")
def long_flight():
    """Each pair 20 times a second for an hour."""
    known = [{"tags": [1, 2], "share": 0.1, "life_s": 0.3}, {"tags": [3, 1], "share": 0.5, "life_s": 1.0}]
    return uwbsim.simulate(states_world(3600.0, 60.0, pairs=known), contention=False)


@pytest.mark.parametrize("pair", EXPECTED)
def test_pairs_have_their_own_shares_and_forget_with_their_own_life(long_flight, pair):
    (share, life_s), residual = EXPECTED[pair], by_pair(long_flight, pair)[1]
    # An hour has 3600/(2 life) independent samples.
    share_std = np.sqrt(share * (1 - share) * 2 * life_s / 3600)
    assert np.mean(residual > 0.1) == pytest.approx(share, abs=3 * share_std)
    for lag in (1, 4, 10, 20):
        expected = np.exp(-lag * 0.05 / life_s)
        # Lags of a thousandth of the hour: autocorrelations are known to 0.03.
        assert autocorrelation(residual, lag) == pytest.approx(expected, abs=0.08), lag
        assert autocorrelation((residual > 0.1).astype(float), lag) == pytest.approx(expected, abs=0.08), lag


def test_reflections_show_in_first_path_power(long_flight):
    rows, residual = by_pair(long_flight, (2, 3))
    reflected = residual > 0.1
    for name in ("fpp1_dbm", "fpp2_dbm"):
        power = getattr(long_flight.exchanges, name)[rows]
        assert np.ptp(power[~reflected]) < 1e-9
        # If the path changes during an exchange, it has one power of each state.
        assert np.median(power[~reflected]) - np.median(power[reflected]) == pytest.approx(FIRST_DB, abs=1e-9)


def test_excess_is_that_of_the_scenario(long_flight):
    residual = by_pair(long_flight, (2, 3))[1]
    excess = residual[residual > 0.1]
    # 2000 reflections of a shape of 8 determine their mean to 1 %.
    assert excess.mean() == pytest.approx(0.8, rel=0.04)
    assert excess.std() == pytest.approx(0.8 / np.sqrt(8), rel=0.08)


def test_the_rise_of_a_response_is_the_later_paths():
    world = World(states_world(share=1.0))
    ends = np.array([0]), np.array([1])
    (paths,) = world.paths(*ends, np.array([SUBTICKS_PER_SECOND]), np.zeros(1))
    delay_s, share = paths.delay_s[-1], paths.amplitude[-1]
    (expected,) = world.states.at(ends, np.array([1.0]))[3]
    assert delay_s == pytest.approx(expected, rel=1e-6)
    assert 20 * np.log10(share) == pytest.approx(10 * np.log10(10 ** ((FIRST_DB - TOTAL_DB) / 10) - 1), abs=1e-6)
    assert TAP_S < 1e-8


def test_the_workbench_counts_them_as_errors():
    world = states_world(200.0, 60.0, who=((1, 2),))
    found = predict(PROTOCOLS["ds"], conditions_of(world))
    flight = uwbsim.simulate(world)
    assert found.pooled()[0] == pytest.approx(np.mean(raw_range(flight.exchanges) - flight.truth_m), abs=0.002)


def test_shares_and_lifetimes_of_pairs_have_the_set_spread():
    tags = [{"id": k, "body": "ab"[k % 2], "lever_arm_m": [0.1 * k, 0, 0]} for k in range(40)]
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
    assert (shares.mean(), shares.std()) == (pytest.approx(0.2, abs=0.015), pytest.approx(0.1, rel=0.12))


def test_a_longer_run_continues_the_same_reflections():
    places, time = (np.zeros(100, dtype=np.int64), np.ones(100, dtype=np.int64)), np.linspace(0, 9, 100)
    short, long = (World(states_world(duration)).states.at(places, time) for duration in (10.0, 1000.0))
    np.testing.assert_array_equal(short, long)
