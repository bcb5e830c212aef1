"""Simulated ranges against what theory says of skew, noise and the firmware's grids (docs/theory.md)."""

import numpy as np
import pytest

from uwblink.ticks import METRES_PER_TICK, SPEED_OF_LIGHT, elapsed
from uwblink.twr import delay_weights, intervals, raw_range
from uwbsim import simulate
from uwbsim.scenario.model import Scenario


def bench(protocol="ds", skews=(0.0, 0.0), reply_us=305.0, delay=1500, n=400, delays=(0.0, 0.0), seed=1, **radio):
    """Two tags 3.1234 m apart that do not move."""
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
            "tags": [{"id": k + 1, "body": "ab"[k], "skew_ppm": skews[k], "delay_ns": delays[k]} for k in range(2)],
        }
    )


def calibrated_error_m(scenario):
    result = simulate(scenario)
    e = result.exchanges
    assert len(e) > 0
    planted = [scenario.planted()["delays_ns"][k] * 1e-9 for k in ("1", "2")]
    weights = delay_weights(e)
    correction = SPEED_OF_LIGHT * sum(w * d for w, d in zip(weights, planted, strict=True))
    return raw_range(e) + correction - result.truth_m


@pytest.mark.parametrize("protocol", ["ds", "ds-alt"])
@pytest.mark.parametrize("skews", [(0.0, 0.0), (20.0, -20.0), (-20.0, 20.0), (3.3, 9.9)])
def test_noiseless_double_sided_is_true_within_a_tick(protocol, skews):
    scenario = bench(protocol, skews, delays=(-0.36, 0.24))
    assert np.abs(calibrated_error_m(scenario)).max() < METRES_PER_TICK


def test_noiseless_single_sided_is_true_within_a_tick_without_skew():
    assert np.abs(calibrated_error_m(bench("ss", delays=(-0.36, 0.24)))).max() < METRES_PER_TICK


@pytest.mark.parametrize(
    ("skews", "delay"), [((20.0, -20.0), 293), ((-20.0, 20.0), 1500), ((10.0, 0.0), 4875), ((0.0, 7.5), 1500)]
)
def test_single_sided_bias_follows_the_relative_skew(skews, delay):
    # 20 ps of jitter dithers the rounding to ticks; 2000 ranges leave 0.1 mm of it in the mean.
    scenario = bench("ss", skews, delay=delay, n=2000, rx_noise_ps=20.0)
    result = simulate(scenario)
    reply_s = intervals(result.exchanges).dt32.mean() / 63.8976e9
    expected = SPEED_OF_LIGHT / 2 * (skews[0] - skews[1]) * 1e-6 * reply_s
    assert np.mean(raw_range(result.exchanges) - result.truth_m) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("skews", "reply_us"), [((20.0, -20.0), 300.0), ((-20.0, 20.0), 1500.0), ((10.0, 0.0), 5000.0)]
)
def test_double_sided_bias_stays_below_a_millimetre(skews, reply_us):
    # At 5 ms the third message costs r^2 = 10 times the variance: 20 ps keep the mean's error at 0.3 mm.
    scenario = bench("ds", skews, reply_us=reply_us, delay=1500, n=2000, rx_noise_ps=20.0)
    result = simulate(scenario)
    assert abs(np.mean(raw_range(result.exchanges) - result.truth_m)) < 1e-3


@pytest.mark.parametrize("protocol", ["ss", "ds"])
@pytest.mark.parametrize("noise_ps", [(150.0, 150.0), (150.0, 0.0), (0.0, 150.0)])
def test_standard_deviation_follows_the_formula(protocol, noise_ps):
    # 20 000 ranges know their standard deviation to 0.5 %, so 2 % is four sigma; rounding adds 0.1 %.
    scenario = bench(protocol, n=20_000, tx_noise_ps=noise_ps[0], rx_noise_ps=noise_ps[1], seed=5)
    e = simulate(scenario).exchanges
    spans = intervals(e)
    r = (spans.dt32 / spans.dt53).mean() if protocol == "ds" else 0.0
    variance = (noise_ps[0] ** 2 + noise_ps[1] ** 2) / 2 * (1 + r + r**2) * 1e-24
    assert np.std(raw_range(e)) == pytest.approx(SPEED_OF_LIGHT * np.sqrt(variance), rel=0.02)


def test_the_firmware_s_grids_hold_to_the_tick():
    for delay in (280, 1500, 6500):
        e = simulate(bench("ds", (12.0, -7.0), delay=delay, delays=(-0.3, 0.2), rx_noise_ps=116.0)).exchanges
        for stamp in (e.tx1, e.tx2, e.tx3):
            assert set((stamp % 512).tolist()) == {52}
        assert set(elapsed(e.tx3, e.tx2).tolist()) == {65536 * delay + 16384}
    e = simulate(bench("ss", (12.0, -7.0), rx_noise_ps=116.0)).exchanges
    expected = (1500 * 65536 + 16436) - ((e.rx1 + 1500 * 65536) % 512)
    np.testing.assert_array_equal(elapsed(e.tx2, e.rx1), expected)
    assert not e.tx3.any()
    assert not e.rx3.any()


def test_same_seed_same_columns_and_another_seed_others():
    first, again, other = (simulate(bench(seed=s, rx_noise_ps=116.0)).exchanges for s in (1, 1, 2))
    np.testing.assert_array_equal(first.rx2, again.rx2)
    assert np.any(first.rx2 != other.rx2)
