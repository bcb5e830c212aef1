"""Simulated ranges compared with theory: skew, noise and the grids of the firmware (docs/theory.md)."""

import numpy as np
import pytest

from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S, elapsed
from uwblink.twr import delay_weights, intervals, raw_range
from uwbsim import Scenario, load, simulate
from uwbsim.random_streams import stream
from uwbsim.scenario.radio import Radio
from uwbsim.scenario.ranging import after_marker_s, before_marker_s, exchange_air_s, frame_s
from uwbsim.simulation import air
from uwbsim.simulation.air import schedule
from uwbsim.simulation.timestamps import draw
from uwbsim.world.clocks import SUBTICKS_PER_SECOND


def bench(
    protocol="ds", skews=(0.0, 0.0), reply_us=305.0, delay=1500, n=400, delays=(0.0, 0.0), seed=1, tag=None, **radio
):
    """Return two tags 3.1234 m apart that do not move."""
    quiet = {"rx_noise_ps": 0.0, "skew_noise_ppm": 0.0, "skew_bias_ppm": 0.0, "quantize": False}
    return Scenario.model_validate(
        {
            "run": {"seed": seed, "duration_s": n / 100},
            "ranging": {
                "protocol": protocol,
                "rate_hz": 100.0,
                "response_delay_uus": delay,
                "reply": {"model": "fixed", "delay_us": reply_us},
            },
            "radio": quiet | radio,
            "bodies": [
                {"name": "a", "motion": {"model": "static", "position_m": (0, 0, 1)}},
                {"name": "b", "motion": {"model": "static", "position_m": (3.1234, 0, 1)}},
            ],
            "tags": [
                {"id": k + 1, "body": "ab"[k], "skew_ppm": skews[k], "delay_ns": delays[k]} | (tag or {})
                for k in range(2)
            ],
        }
    )


def calibrated_error_m(scenario):
    """Return the errors (n,) of the ranges of a flight without its planted delays."""
    flight = simulate(scenario)
    e, planted = flight.exchanges, flight.planted["delays_ns"]
    delay_m = np.array([planted.get(str(tag), 0.0) for tag in range(7)]) * 1e-9 * SPEED_OF_LIGHT
    first, second = delay_weights(e)
    return raw_range(e) + first * delay_m[e.initiator] + second * delay_m[e.target] - flight.truth_m


SKEWS = [(0.0, 0.0), (20.0, -20.0), (-20.0, 20.0), (3.3, 9.9)]


@pytest.mark.parametrize(
    ("protocol", "skews"), [("ss", SKEWS[0]), *((name, skews) for name in ("ds", "ds-alt") for skews in SKEWS)]
)
def test_noiseless_ranges_are_true_within_a_tick(protocol, skews):
    assert np.abs(calibrated_error_m(bench(protocol, skews, delays=(-0.36, 0.24)))).max() < METRES_PER_TICK


@pytest.mark.parametrize(
    ("protocol", "skews", "reply_us", "delay"),
    [
        *(("ss", skews, 305.0, delay) for skews, delay in
          (((20.0, -20.0), 293), ((-20.0, 20.0), 1500), ((10.0, 0.0), 4875), ((0.0, 7.5), 1500))),
        *(("ds", skews, reply_us, 1500) for skews, reply_us in
          (((20.0, -20.0), 300.0), ((-20.0, 20.0), 1500.0), ((10.0, 0.0), 5000.0))),
    ],
)  # fmt: skip
def test_the_relative_skew_biases_single_sided_ranges_alone(protocol, skews, reply_us, delay):
    # 20 ps of jitter dithers the rounding to ticks; 2000 ranges have an error of 0.1 mm of it in the mean. At 5 ms, the
    # third message causes r^2 = 10 times the variance: the error of the mean is 0.3 mm.
    result = simulate(bench(protocol, skews, reply_us=reply_us, delay=delay, n=2000, rx_noise_ps=20.0))
    reply_s = intervals(result.exchanges).dt32.mean() / 63.8976e9 if protocol == "ss" else 0.0
    expected = SPEED_OF_LIGHT / 2 * (skews[0] - skews[1]) * 1e-6 * reply_s
    assert np.mean(raw_range(result.exchanges) - result.truth_m) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("protocol", ["ss", "ds"])
@pytest.mark.parametrize("noise_ps", [(150.0, 150.0), (150.0, 0.0), (0.0, 150.0)])
def test_standard_deviation_follows_the_formula(protocol, noise_ps):
    # 20,000 ranges determine their standard deviation to 0.5 %, so 2 % is four sigma; rounding adds 0.1 %.
    scenario = bench(protocol, n=20_000, tx_noise_ps=noise_ps[0], rx_noise_ps=noise_ps[1], seed=5)
    e = simulate(scenario, contention=False).exchanges
    spans = intervals(e)
    r = (spans.dt32 / spans.dt53).mean() if protocol == "ds" else 0.0
    variance = (noise_ps[0] ** 2 + noise_ps[1] ** 2) / 2 * (1 + r + r**2) * 1e-24
    assert np.std(raw_range(e)) == pytest.approx(SPEED_OF_LIGHT * np.sqrt(variance), rel=0.02)


# Plans: order and times of exchanges, and their success.


def ring(**ranging):
    """Return six tags on a circle, each of which ranges with the next."""
    angle = np.pi / 3 * np.arange(6)
    places = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), np.ones(6)]).tolist()
    return Scenario.model_validate(
        {
            "run": {"seed": 5, "duration_s": 20.0},
            "ranging": {"rate_hz": 60.0, "pairs": [(k, (k + 1) % 6) for k in range(6)], **ranging},
            "bodies": [{"name": str(k), "motion": {"model": "static", "position_m": p}} for k, p in enumerate(places)],
            "tags": [{"id": k, "body": str(k)} for k in range(6)],
        }
    )


@pytest.mark.parametrize("plan", ["round-robin", "tdma", "common-list"])
def test_turns_come_in_order_at_the_rate(plan):
    found = schedule(ring(plan=plan, sync_error_ms=0.0))
    assert (len(found.start), found.initiator[:7].tolist()) == (1200, [0, 1, 2, 3, 4, 5, 0])
    np.testing.assert_allclose(np.diff(found.start) / SUBTICKS_PER_SECOND, 1 / 60, rtol=1e-9)


def test_aloha_is_random_at_the_rate():
    found = schedule(ring(plan="aloha"))
    gaps = np.diff(found.start) / SUBTICKS_PER_SECOND
    # A Poisson count of 1200 has a deviation of 35; its gaps have a deviation equal to their mean.
    assert len(found.start) == pytest.approx(1200, abs=140)
    assert np.std(gaps) == pytest.approx(np.mean(gaps), rel=0.15)


def success(plan, rate=60.0, **more):
    result = simulate(ring(plan=plan, rate_hz=rate, **more))
    return len(result.exchanges) / (len(result.exchanges) + len(result.faults))


def test_turns_do_not_collide_and_random_talk_does_the_more_the_more_there_is():
    assert success("round-robin") == success("common-list") == 1.0
    assert success("tdma", sync_error_ms=0.05) == 1.0
    assert success("tdma", rate=200.0, sync_error_ms=4.0) < 0.97, "slots are badly synchronised"
    shares = [success("aloha", rate=rate) for rate in (20.0, 60.0, 180.0)]
    assert shares[0] > shares[1] > shares[2]
    # An exchange takes 2.0 ms. If all starts of the 5/6 x 60 Hz others within one exchange before or after were fatal,
    # exp(-50 Hz x 4.0 ms) = 0.82 would survive; if only those during it were, exp(-50 Hz x 2.0 ms) = 0.90.
    assert 0.82 - 0.03 < shares[1] < 0.90 + 0.03


def test_a_list_waits_for_who_cannot_hear_the_one_before():
    pairs = [(0, 1), (3, 4)]  # 5.2 m from the target of one to the initiator of the next, 3 m between neighbours
    near = ring(plan="common-list", rate_hz=10.0, pairs=pairs, list_timeout_ms=50.0)
    far = near.model_copy(update={"radio": near.radio.model_copy(update={"first_path_at_1m_dbm": -92.0})})
    gaps = [np.diff(simulate(world).exchanges.time_ns[:101]) * 1e-9 for world in (near, far)]
    np.testing.assert_allclose(gaps[0], 0.1, atol=1e-4)
    # -106.3 dBm at 5.2 m are below the sensitivity: each but the first starts 50 ms later than planned.
    np.testing.assert_allclose(gaps[1], [0.15] + [0.1] * 99, atol=1e-4)


# Frames in the air: durations, collisions, capture, busy boards, and waits.


US = SUBTICKS_PER_SECOND // 1_000_000
DS = PROTOCOLS["ds"]


@pytest.mark.parametrize(("length", "us"), [(11, 177.37), (8, 174.29), (28, 194.81), (100, 280.96)])
def test_frames_last_as_long_as_on_the_boards(length, us):
    assert frame_s(length, 128) * 1e6 == pytest.approx(us, abs=0.01)
    assert before_marker_s(128) * 1e6 == pytest.approx(138.397, abs=0.001)
    assert exchange_air_s(DS, 128) * 1e6 == pytest.approx(177.37 + 174.29 + 194.81, abs=0.02)


def slot(number, at_us, initiator, target, heard=(True, True, True), final_us=1538, pause_us=0):
    return number, at_us * US, initiator, target, pause_us * US, heard, (0, 305 * US, final_us * US)


def played(hosts, powers=None, progress=None):
    table = np.full((8, 8), -80.0) if powers is None else powers
    rules = Radio(sensitivity_dbm=-100.0, capture_db=6.0, preamble_symbols=128)
    rows = sorted((*row, number) for number, host in enumerate(hosts) for row in host)
    assert [row[0] for row in rows] == list(range(len(rows)))
    _, start, initiator, target, pause, heard, delay, number = map(np.array, zip(*rows, strict=True))
    slots = air.Slots(air.Schedule(start, initiator, target, number), pause, heard.T, delay.T)
    return air.Air(DS, slots, lambda sender, _time: table[sender], rules).execute(progress)


def with_powers(*changes, everywhere=-80.0):
    """Return powers by sender and receiver, equal except for some."""
    powers = np.full((8, 8), everywhere)
    for sender, receiver, power_dbm in changes:
        powers[sender, receiver] = power_dbm
    return powers


WEAKER = with_powers((2, slice(None), -95.0), (2, 3, -80.0))
"""The second initiator is 15 dB weaker everywhere except at its own target."""

APART = with_powers(([[0], [1]], [2, 3], -120.0), ([[2], [3]], [0, 1], -120.0))
CHAIN = with_powers(([[0], [1], [2]], [0, 1, 2], -80.0), everywhere=-120.0)
TWO = [[slot(0, 0, 0, 1)], [slot(1, 50, 2, 3)]]
"""A second exchange that starts 50 us after the first."""


@pytest.mark.parametrize(
    ("hosts", "powers", "reasons"),
    [
        pytest.param([[slot(0, 0, 0, 1), slot(1, 5000, 1, 2)]], None, ["", ""], id="alone"),
        pytest.param(TWO, None, [air.COLLIDED] * 2, id="two polls at equal power"),
        pytest.param(TWO, WEAKER, ["", air.COLLIDED], id="stronger and earlier"),
        # The receiver is locked to the other one.
        pytest.param([[slot(0, 50, 0, 1)], [slot(1, 0, 2, 3)]], WEAKER, [air.COLLIDED, None], id="stronger but later"),
        pytest.param(TWO, APART, ["", ""], id="too far away"),
        pytest.param([[slot(0, 0, 0, 1)], [slot(1, 900, 2, 1)]], None, [None, air.BUSY], id="target in an exchange"),
        pytest.param(
            [[slot(0, 0, 0, 1, (True, False, True))], [slot(1, 900, 2, 1)]],
            None,
            [air.WEAK, air.BUSY],
            id="a target keeps to its exchange though nobody hears its answer",
        ),
        pytest.param([[slot(0, 0, 0, 1, final_us=6900)]], None, [air.LATE], id="a final after the preamble timeout"),
        # The second poll ends before the first exchange waits for a frame.
        pytest.param(
            [[slot(0, 1000, 0, 1)], [slot(1, 0, 2, 3, (False, True, True))]], None, ["", air.WEAK], id="ended before"
        ),
        pytest.param([[slot(0, 0, 0, 1)], [slot(1, 50, 1, 2)]], CHAIN, [air.BUSY, None], id="who sends hears nothing"),
        pytest.param(
            [[slot(0, 0, 0, 1)], [slot(1, 40, 2, 3)], [slot(2, 60, 4, 5)]],
            with_powers((2, 1, -120.0)),
            [air.COLLIDED, None, None],
            id="behind one that is too weak another collides",
        ),
        # The second poll is between response and final of the first exchange.
        pytest.param([[slot(0, 0, 0, 1)], [slot(1, 800, 2, 3)]], None, [air.FOREIGN, None], id="the first that comes"),
        pytest.param(TWO, with_powers(([[2], [3]], [0, 1], -86.0)), ["", None], id="captured from 6 dB on"),
        pytest.param(TWO, with_powers(([[2], [3]], [0, 1], -85.99)), [air.COLLIDED, None], id="not captured below"),
        pytest.param(
            TWO, with_powers(([0, 1], [1, 0], -97.0), everywhere=-100.0), [air.COLLIDED, None], id="at the sensitivity"
        ),
        pytest.param(TWO, with_powers(([0, 1], [1, 0], -97.0), everywhere=-100.01), ["", None], id="below it"),
    ],
)
def test_colliding_exchanges_end_as_planned(hosts, powers, reasons):
    outcome = played(hosts, powers)
    named = [found if reason is not None else None for found, reason in zip(outcome.reason, reasons, strict=True)]
    assert named == reasons
    assert [bool(reason) for reason in outcome.reason] == [lost >= 0 for lost in outcome.lost]


def test_the_message_that_is_lost_is_named():
    assert [played([[slot(0, 0, 0, 1)], [slot(1, at, 2, 3)]]).lost[0] for at in (50, 800)] == [0, 2]


FINAL_US = 305 + 1538 + after_marker_s(28) * 1e6 + before_marker_s(128) * 1e6
"""From the marker of a poll to that of the next, started just after the end of the final."""


@pytest.mark.parametrize(
    ("hosts", "between_us"),
    [
        ([[slot(0, 0, 0, 1), slot(1, 5000, 1, 2)]], 5000),
        # The rest of the poll, the end of reception, the wait, the next command, its preamble.
        ([[slot(0, 0, 0, 1, (True, False, True)), slot(1, 100, 0, 1)]], 39 + 40 + 6521 + 1000 + 138.4),
        ([[slot(0, 0, 0, 1), slot(1, 5000, 0, 1, pause_us=250)]], 5250),
        ([[slot(0, 0, 0, 1), slot(1, 10, 0, 1)]], FINAL_US + 1000),
        # An initiator that is a target at that time waits until it is free.
        ([[slot(0, 0, 0, 1)], [slot(1, 600, 1, 2)]], FINAL_US),
        ([[slot(0, 50_000, 0, 1)], [slot(1, 50_600, 1, 2)]], FINAL_US),
    ],
)
def test_exchanges_start_when_they_should(hosts, between_us):
    outcome = played(hosts)
    assert (outcome.lost[1], np.diff(outcome.start)[0] / US) == (-1, pytest.approx(between_us, abs=2))


def test_progress_is_reported_every_500_slots_as_a_share_of_all_hosts():
    told: list[float] = []
    hosts = [[slot(k, 3000 * k, 0, 1) for k in range(501)], [slot(501, 0, 4, 5)]]
    powers = np.full((8, 8), -120.0)
    powers[:2, :2] = powers[4:6, 4:6] = -80.0
    assert (set(played(hosts, powers, told.append).lost), told) == ({-1}, [500 / 502])


def test_replies_are_drawn_from_two_modes_a_shoulder_and_a_tail():
    boards = load("noiseless", {"ranging.reply": {"model": "boards"}})
    micro = boards.ranging.reply.draw_s(stream(1, "reply"), 400_000) * 1e6
    # 400,000 draws determine a share to 0.0008.
    for below_us, share in ((304.1, 0.207), (305.9, 0.635), (308.3, 0.885), (310.0, 0.9096), (348.25, 0.955)):
        assert np.mean(micro < below_us) == pytest.approx(share, abs=0.003), below_us
    assert (micro.min(), micro.max()) == (pytest.approx(303.4, abs=1e-6), pytest.approx(386.25, abs=0.25))
    assert np.std(micro[(micro > 303.5) & (micro < 304.7)]) == pytest.approx(0.28, abs=0.03)
    assert len(micro[(micro > 308.5) & (micro < 310.0)]) / len(micro) == pytest.approx(0.05 * 0.38, abs=0.002)


def test_detours_have_the_share_and_the_mean_of_the_scenario_and_noise_is_standard():
    drawn = draw(bench(multipath={"probability": 0.2, "mean_excess_m": 0.5}), 100_000, 3)
    detours = drawn.excess_m[drawn.excess_m > 0]
    assert len(detours) / drawn.excess_m.size == pytest.approx(0.2, abs=0.005)
    assert detours.mean() == pytest.approx(0.5, rel=0.03)
    # Six sequences of 100,000: their covariances are known to 0.003.
    noise = np.column_stack([drawn.transmit, drawn.receive]).T
    np.testing.assert_allclose(np.cov(noise), np.eye(6), atol=0.015)
    assert np.abs(noise.mean(axis=1)).max() < 0.015
    quiet = draw(bench(), 100, 3)
    assert (bool(quiet.excess_m.any()), set(quiet.reply_s.tolist())) == (False, {305e-6})


def test_an_answer_leaves_at_the_first_grid_point_after_its_latency():
    e = simulate(bench("ds", reply_us=305.0)).exchanges
    late = elapsed(e.tx2, e.rx1) - round(305e-6 / TICK_S)
    assert 0 <= late.min() <= late.max() < 512


@pytest.mark.parametrize(
    ("plan", "rate_hz", "sync_error_ms"),
    [pytest.param("aloha", 40.0, 0.0, marks=pytest.mark.slow), ("aloha", 150.0, 0.0), ("tdma", 120.0, 6.0)],
)
def test_what_is_one_event_ends_as_message_by_message(monkeypatch, plan, rate_hz, sync_error_ms):
    ranging = {"ranging.plan": plan, "ranging.rate_hz": rate_hz, "ranging.sync_error_ms": sync_error_ms}
    scenario = load("icra2023/train", {"run.duration_s": 10.0, "radio.sensitivity_dbm": -92.0} | ranging)
    quick, single, plain = simulate(scenario), 0, air.Air._alone

    def counted(self, number, begin):
        nonlocal single
        single += plain(self, number, begin)
        return False

    monkeypatch.setattr(air.Air, "_alone", counted)
    slow = simulate(scenario)
    assert quick.faults == slow.faults
    assert single > 0.2 * len(slow.exchanges)
    assert len(slow.faults) > 0.02 * len(slow.exchanges), "there is something to disturb exchanges"
    np.testing.assert_array_equal(quick.exchanges.time_ns, slow.exchanges.time_ns)
    np.testing.assert_array_equal(quick.exchanges.rx3, slow.exchanges.rx3)


# Frames that passive tags overhear, and impulse responses, compared with known geometry.


PLACES = {1: (0.0, 0.0, 0.0), 2: (4.0, 0.0, 0.0), 3: (1.0, 3.0, 0.0), 4: (60.0, 0.0, 0.0)}


def flight(protocol="ds", passive=(3,), room=None, get_cir=False, **radio):
    quiet = {"rx_noise_ps": 0.0, "skew_noise_ppm": 0.0, "skew_bias_ppm": 0.0, "first_path_at_1m_dbm": -78.0}
    return simulate(
        Scenario.model_validate(
            {
                "run": {"seed": 2, "duration_s": 2.0},
                "ranging": {"protocol": protocol, "rate_hz": 50.0, "pairs": [(1, 2)], "get_cir": get_cir},
                "radio": quiet | radio,
                **({"room": room} if room else {}),
                "bodies": [{"name": str(k), "motion": {"model": "static", "position_m": p}} for k, p in PLACES.items()],
                "tags": [
                    {"id": k, "body": str(k), "skew_ppm": [2.0, -3.0, 1.0, 0.0][k - 1], "passive": k in passive}
                    for k in PLACES
                ],
            }
        )
    )


def test_a_listener_measures_the_differences_of_distance():
    heard = flight().overheard
    assert (len(heard["rx1"]), set(heard["listener"].tolist())) == (100, {3})
    # rx2 - rx1 at the listener: the target's reply plus both flights and the response's path, minus the poll's path.
    d12, d13, d23 = 4.0, np.hypot(1, 3), np.hypot(3, 3)
    reply = elapsed(heard["tx2_n"], heard["rx1_n"])
    rate = 1 + (1.0 - (-3.0)) * 1e-6  # of the listener's clock relative to the target's
    expected = reply * rate + (d12 + d23 - d13) / METRES_PER_TICK
    np.testing.assert_allclose(elapsed(heard["rx2"], heard["rx1"]), expected, atol=1.5)
    # The third message comes dt53 after the second, from the same tag: independent of geometry.
    third = elapsed(heard["tx3_n"], heard["tx2_n"]) * rate
    np.testing.assert_allclose(elapsed(heard["rx3"], heard["rx2"]), third, atol=1.5)
    np.testing.assert_allclose(heard["skew1_ppm"], 1.0 - 2.0, atol=0.002)


def test_a_single_sided_exchange_has_no_third_reception():
    heard = flight("ss").overheard
    assert (heard["rx3"].any(), np.isnan(heard["fpp3_dbm"]).all()) == (False, True)


def test_far_listeners_receive_nothing_and_listening_has_no_effect():
    near, both = flight(), flight(passive=(3, 4), sensitivity_dbm=-105.0)
    assert len(flight(passive=(4,), sensitivity_dbm=-92.0).overheard["rx1"]) == 0
    np.testing.assert_array_equal(near.exchanges.rx2, both.exchanges.rx2)
    np.testing.assert_array_equal(both.overheard["rx1"][both.overheard["listener"] == 3], near.overheard["rx1"])


def test_boxes_have_no_effect_on_exchanges_that_nobody_receives():
    settings = {"run.duration_s": 0.5, "ranging.get_cir": True, "radio.sensitivity_dbm": 0.0}
    result = simulate(load("office/office", settings))
    assert (len(result.exchanges), len(result.cirs)) == (0, 0)
    assert result.faults


def test_impulse_responses_agree_with_stamp_and_room():
    result = flight(room={"min_m": (-5, -5, -1.5), "max_m": (65, 5, 2.0), "reflection_loss_db": 3.0}, get_cir=True)
    assert len(result.cirs) == len(result.exchanges) == 100
    for row, stamp in zip(result.cirs, result.exchanges.rx3.tolist(), strict=True):
        index, taps = row.first_path_index, np.array(row.magnitudes)
        assert (len(taps), index % 1) == (1016, pytest.approx(stamp % 64 / 64, abs=0.001))
        # The floor is 1.5 m below: 5 m instead of 4 m, 3.3 ns or taps later.
        echo = round(index + 1.5 + 1.0 / 0.299702547)
        # Half of the amplitude of the first path, with diffuse paths of a quarter.
        assert taps[echo - 1 : echo + 2].max() > taps.max() / 6
        assert taps[: int(index) - 6].max() < 400
