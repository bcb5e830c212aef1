"""Simulated ranges compared with theory: skew, noise and the grids of the firmware (docs/theory.md)."""

import numpy as np
import pytest

from uwblink.ticks import METRES_PER_TICK, SPEED_OF_LIGHT
from uwblink.twr import delay_weights, intervals, raw_range
from uwbsim import Scenario, simulate
from uwbsim.simulation.air import schedule
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
    result = simulate(scenario)
    e = result.exchanges
    assert len(e) > 0
    planted = [scenario.planted()["delays_ns"][k] * 1e-9 for k in ("1", "2")]
    correction = SPEED_OF_LIGHT * sum(w * d for w, d in zip(delay_weights(e), planted, strict=True))
    return raw_range(e) + correction - result.truth_m


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


def test_same_seed_same_columns_and_another_seed_others():
    first, again, other = (simulate(bench(seed=s, rx_noise_ps=116.0)).exchanges for s in (1, 1, 2))
    np.testing.assert_array_equal(first.rx2, again.rx2)
    assert np.any(first.rx2 != other.rx2)


# Plans: order and times of exchanges, and their success.


def ring(count=6, **ranging):
    angle = 2 * np.pi * np.arange(count) / count
    places = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), np.ones(count)]).tolist()
    return Scenario.model_validate(
        {
            "run": {"seed": 5, "duration_s": 20.0},
            "ranging": {"rate_hz": 60.0, "pairs": [(k, (k + 1) % count) for k in range(count)], **ranging},
            "bodies": [{"name": str(k), "motion": {"model": "static", "position_m": p}} for k, p in enumerate(places)],
            "tags": [{"id": k, "body": str(k)} for k in range(count)],
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


def success(plan, count=6, rate=60.0, **more):
    result = simulate(ring(count, plan=plan, rate_hz=rate, **more))
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
