"""Units leave a scenario at its models."""

import pytest

from uwbsim.scenario.devices import Tag
from uwbsim.scenario.model import Mocap
from uwbsim.scenario.radio import Radio
from uwbsim.scenario.ranging import FixedReply, Ranging


def test_the_models_give_si():
    tag = Tag(id=1, body="a", tx_delay_ns=2.0, rx_delay_ns=-3.0, skew_ppm=4.0, drift_ppm_per_sqrt_s=0.5)
    assert tag.antenna_delays_s == pytest.approx((2e-9, -3e-9), rel=1e-15)
    assert (tag.skew, tag.drift_per_sqrt_s) == pytest.approx((4e-6, 0.5e-6), rel=1e-15)
    noisy = Tag(id=1, body="a", white_ppm_sqrt_s=0.25, ramp_ppm_per_s=-2.0)
    assert (noisy.white_sqrt_s, noisy.ramp_per_s) == pytest.approx((0.25e-6, -2e-6), rel=1e-15)
    radio = Radio(tx_noise_ps=7.0, rx_noise_ps=116.0)
    assert (radio.tx_noise_s, radio.rx_noise_s) == pytest.approx((7e-12, 116e-12), rel=1e-15)
    ranging = Ranging(rate_hz=1.0, sync_error_ms=0.2, list_timeout_ms=10.0)
    assert (ranging.sync_error_s, ranging.list_timeout_s) == pytest.approx((0.2e-3, 0.01), rel=1e-15)
    assert FixedReply(model="fixed", delay_us=300.0).delay_s == pytest.approx(3e-4, rel=1e-15)
    assert Mocap(latency_ms=-4.0).latency_s == pytest.approx(-4e-3, rel=1e-15)
