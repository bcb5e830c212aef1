"""Where the air's rules begin and end, and what chance decides: shares and moments of what is drawn."""

import numpy as np
import pytest

from tests.uwbsim.simulation.test_air import DS, US, columns, played, slot
from tests.uwbsim.simulation.test_protocols import bench
from uwblink.ticks import TICK_S, elapsed
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import after_marker_s, before_marker_s
from uwbsim.simulation import air
from uwbsim.simulation.run import simulate
from uwbsim.simulation.timestamps import draw, draw_reply_s
from uwbsim.world.clocks import SUBTICKS_PER_SECOND


def paused(number, at_us, pause_us):
    return slot(number, at_us, 0, 1, pause_us=pause_us)


def test_a_pause_is_waited_before_the_poll_and_a_slot_not_before_its_time():
    outcome = played([[paused(0, 0, 0), paused(1, 5000, 250)]])
    assert outcome.start[0] / US == pytest.approx(before_marker_s(128) * 1e6, abs=0.01)
    assert (outcome.start[1] - outcome.start[0]) / US == pytest.approx(5250, abs=0.01)
    late = played([[slot(0, 0, 0, 1), slot(1, 10, 0, 1)]])
    # The final's marker, its end, the turnaround, and the next preamble.
    took_us = 305 + 1538 + after_marker_s(28) * 1e6 + 1000 + before_marker_s(128) * 1e6
    assert np.diff(late.start)[0] / US == pytest.approx(took_us, abs=0.5)


@pytest.mark.parametrize(("margin_db", "reason"), [(6.0, ""), (5.99, air.COLLIDED)])
def test_a_frame_is_captured_from_six_decibels_on(margin_db, reason):
    powers = np.full((8, 8), -80.0)
    powers[2, :2] = powers[3, :2] = -80.0 - margin_db
    assert played([[slot(0, 0, 0, 1)], [slot(1, 50, 2, 3)]], powers).reason[0] == reason


@pytest.mark.parametrize(("power_dbm", "reason"), [(-100.0, air.COLLIDED), (-100.01, "")])
def test_a_frame_at_the_sensitivity_disturbs_and_one_below_it_does_not(power_dbm, reason):
    powers = np.full((8, 8), power_dbm)
    powers[0, 1] = powers[1, 0] = -97.0
    assert played([[slot(0, 0, 0, 1)], [slot(1, 50, 2, 3)]], powers).reason[0] == reason


def test_frames_that_ended_before_the_receiver_listened_do_not_come_in_the_place_of_an_answer():
    # The second poll is over before the first exchange begins to wait for anything.
    powers = np.full((8, 8), -80.0)
    outcome = played([[slot(0, 1000, 0, 1)], [slot(1, 0, 2, 3, (False, True, True))]], powers)
    assert outcome.reason == ["", air.WEAK]


def test_progress_is_told_for_every_500th_slot_as_a_share_of_all_hosts():
    told: list[float] = []
    hosts = [[slot(k, 3000 * k, 0, 1) for k in range(501)], [slot(501, 0, 4, 5)]]
    powers = np.full((8, 8), -120.0)
    powers[:2, :2] = powers[4:6, 4:6] = -80.0
    rules = air.Rules(sensitivity_dbm=-100.0, capture_db=6.0, preamble_symbols=128)
    slots, numbers = columns(hosts)
    outcome = air.run(DS, slots, numbers, 8, lambda sender, _: powers[sender], rules, told.append)
    assert set(outcome.lost) == {-1}
    assert told == [0.0, 0.0, 500 / 502]


def with_replies(reply):
    document = bench().model_dump(mode="json")
    document["ranging"]["reply"] = reply
    return Scenario.model_validate(document)


def test_replies_are_drawn_from_two_modes_a_shoulder_and_a_tail():
    micro = draw_reply_s(with_replies({"model": "boards"}), stream(1, "reply"), 400_000) * 1e6
    # 400 000 draws know a share to 0.0008.
    for below_us, share in ((304.1, 0.207), (305.9, 0.635), (308.3, 0.885), (310.0, 0.9096), (348.25, 0.955)):
        assert np.mean(micro < below_us) == pytest.approx(share, abs=0.003), below_us
    assert micro.min() == pytest.approx(303.4, abs=1e-6)
    assert 386.0 < micro.max() < 386.5
    assert np.std(micro[(micro > 303.5) & (micro < 304.7)]) == pytest.approx(0.28, abs=0.03)
    shoulder = micro[(micro > 308.5) & (micro < 310.0)]
    assert len(shoulder) / len(micro) == pytest.approx(0.05 * 0.38, abs=0.002)


def test_detours_have_the_share_and_the_mean_of_the_scenario_and_noise_is_standard():
    scenario = bench(multipath={"probability": 0.2, "mean_excess_m": 0.5})
    drawn = draw(scenario, 100_000, 3)
    hit = drawn.excess_m > 0
    assert hit.mean() == pytest.approx(0.2, abs=0.005)
    assert drawn.excess_m[hit].mean() == pytest.approx(0.5, rel=0.03)
    for noise in (drawn.transmit, drawn.receive):
        assert noise.shape == (3, 100_000)
        assert abs(noise.mean()) < 0.01
        assert noise.std() == pytest.approx(1.0, rel=0.01)
        assert abs(np.corrcoef(noise)[0, 1]) < 0.015
    some = drawn[np.array([5, 7])]
    np.testing.assert_array_equal(some.reply_s, drawn.reply_s[[5, 7]])
    np.testing.assert_array_equal(some.transmit, drawn.transmit[:, [5, 7]])
    assert SUBTICKS_PER_SECOND == 1024 * 63_897_600_000
    quiet = draw(bench(), 100, 3)
    assert not quiet.excess_m.any()
    assert set(quiet.reply_s.tolist()) == {305e-6}


def test_a_target_keeps_to_its_exchange_though_nobody_hears_its_answer():
    outcome = played([[slot(0, 0, 0, 1, (True, False, True))], [slot(1, 900, 2, 1)]])
    assert outcome.reason == [air.WEAK, air.BUSY]


def test_a_board_that_sends_hears_nothing():
    powers = np.full((8, 8), -120.0)
    powers[:3, :3] = -80.0
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 50, 1, 2)]], powers)
    assert outcome.reason[0] == air.BUSY


def test_behind_one_that_is_too_weak_another_frame_collides_all_the_same():
    powers = np.full((8, 8), -80.0)
    powers[2, 1] = -120.0
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 40, 2, 3)], [slot(2, 60, 4, 5)]], powers)
    assert outcome.reason[0] == air.COLLIDED


def test_an_initiator_that_is_busy_waits_until_its_exchange_ends_at_any_hour():
    outcome = played([[slot(0, 50_000, 0, 1)], [slot(1, 50_600, 1, 2)]])
    assert outcome.lost == [-1, -1]
    free_us = 305 + 1538 + after_marker_s(28) * 1e6 + before_marker_s(128) * 1e6
    assert (outcome.start[1] - outcome.start[0]) / US == pytest.approx(free_us, abs=0.5)


def test_an_answer_leaves_at_the_first_grid_point_after_its_latency():
    e = simulate(bench("ds", reply_us=305.0)).exchanges
    late = elapsed(e.tx2, e.rx1) - round(305e-6 / TICK_S)
    assert late.min() >= 0
    assert late.max() < 512


def test_replies_by_quantiles_have_those_quantiles():
    scenario = with_replies({"model": "quantiles", "delays_us": [300.0, 310.0, 400.0]})
    found = draw_reply_s(scenario, stream(1, "reply"), 100_000) * 1e6
    for share, us in ((0.25, 305.0), (0.5, 310.0), (0.75, 355.0)):
        assert np.quantile(found, share) == pytest.approx(us, abs=0.5)
