"""Plans: who ranges when, and how often it works."""

import numpy as np
import pytest

from uwbsim import simulate
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.air import schedule
from uwbsim.world.clocks import SUBTICKS_PER_SECOND


def ring(count=6, **ranging):
    angle = 2 * np.pi * np.arange(count) / count
    places = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), np.ones(count)]).tolist()
    pairs = [(k, (k + 1) % count) for k in range(count)]
    return Scenario.model_validate(
        {
            "run": {"seed": 5, "duration_s": 20.0},
            "ranging": {"rate_hz": 60.0, "pairs": pairs, **ranging},
            "bodies": [{"name": str(k), "motion": {"model": "static", "position_m": p}} for k, p in enumerate(places)],
            "tags": [{"id": k, "body": str(k)} for k in range(count)],
        }
    )


@pytest.mark.parametrize("plan", ["round-robin", "tdma", "common-list"])
def test_turns_come_in_order_at_the_rate(plan):
    found = schedule(ring(plan=plan, sync_error_ms=0.0))
    assert len(found.start) == 1200
    assert found.initiator[:7].tolist() == [0, 1, 2, 3, 4, 5, 0]
    np.testing.assert_allclose(np.diff(found.start) / SUBTICKS_PER_SECOND, 1 / 60, rtol=1e-9)


def test_aloha_is_random_at_the_rate():
    found = schedule(ring(plan="aloha"))
    gaps = np.diff(found.start) / SUBTICKS_PER_SECOND
    # A Poisson count of 1200 has a deviation of 35; its gaps have a deviation equal to their mean.
    assert len(found.start) == pytest.approx(1200, abs=140)
    assert np.std(gaps) == pytest.approx(np.mean(gaps), rel=0.15)


def success(plan, count=6, rate=60.0, **more):
    result = simulate(ring(count, plan=plan, rate_hz=rate, **more))
    return len(result.exchanges) / (len(result.exchanges) + len(result.faults))


def test_turns_do_not_collide_and_random_talk_does_the_more_the_more_there_is():
    assert success("round-robin") == success("common-list") == 1.0
    assert success("tdma", sync_error_ms=0.05) == 1.0
    shares = [success("aloha", rate=rate) for rate in (20.0, 60.0, 180.0)]
    assert shares[0] > shares[1] > shares[2]
    # An exchange takes 2.0 ms. Were every start of the 5/6 x 60 Hz others within one of them before or after fatal,
    # exp(-50 Hz x 4.0 ms) = 0.82 would survive; were only those that begin in it, exp(-50 Hz x 2.0 ms) = 0.90.
    assert 0.82 - 0.03 < shares[1] < 0.90 + 0.03


def test_badly_synchronised_slots_collide():
    assert success("tdma", rate=200.0, sync_error_ms=4.0) < 0.97


def test_a_list_waits_for_who_cannot_hear_the_one_before():
    pairs = [(0, 1), (3, 4)]  # 5.2 m from the target of one to the initiator of the next, 3 m between neighbours
    near = ring(plan="common-list", rate_hz=10.0, pairs=pairs, list_timeout_ms=50.0)
    far = near.model_copy(update={"radio": near.radio.model_copy(update={"first_path_at_1m_dbm": -92.0})})
    gaps = [np.diff(simulate(world).exchanges.time_ns[:101]) * 1e-9 for world in (near, far)]
    np.testing.assert_allclose(gaps[0], 0.1, atol=1e-4)
    # -106.3 dBm at 5.2 m are below the sensitivity: each but the first begins 50 ms later than planned.
    np.testing.assert_allclose(gaps[1], [0.15] + [0.1] * 99, atol=1e-4)


def test_a_plan_from_a_file(tmp_path):
    (tmp_path / "plan.csv").write_text("time_s,initiator,target\n0.5,3,1\n0.1,1,2\n")
    slots = ((0.5, 3, 1), (0.1, 1, 2))
    e = simulate(ring(plan={"file": "plan.csv", "slots": slots})).exchanges
    assert e.initiator.tolist() == [1, 3]
    np.testing.assert_allclose(e.time_ns * 1e-9, [0.1, 0.5], atol=0.001)
