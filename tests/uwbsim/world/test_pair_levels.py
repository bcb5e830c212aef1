"""Fading, outages and antennas of single tags: what was asked for shows in powers, and nowhere else."""

import numpy as np
import pytest

import uwbsim
from tests.uwbsim.world.helpers import autocorrelation
from uwblink import raw_range

PLAIN = {
    "first_path_at_1m_dbm": -80.0,
    "power_noise_db": 0.0,
    "quantize": False,
    "rx_noise_ps": 0.0,
    "skew_noise_ppm": 0.0,
}


def flight(radio, second=None, duration_s=400.0, **ranging):
    still = [{"model": "static", "position_m": place} for place in ([0.0, 0.0, 2.0], [3.0, 4.0, 2.0])]
    return uwbsim.simulate(
        {
            "run": {"duration_s": duration_s, "seed": 4},
            "ranging": {"rate_hz": 50.0} | ranging,
            "radio": PLAIN | radio,
            "bodies": [{"name": f"b{k}", "motion": motion} for k, motion in enumerate(still)],
            "tags": [{"id": 1, "body": "b0"}, {"id": 2, "body": "b1"} | (second or {})],
        },
        contention=False,
    )


def test_fading_has_the_spread_and_the_life_that_were_asked_for():
    x = flight({"fading": {"std_db": 2.0, "life_s": 0.1}}).exchanges
    # 4000 draws: the standard error of the spread is 1.1 %, that of an autocorrelation 0.02.
    assert np.std(x.fpp1_dbm) == pytest.approx(2.0, rel=0.05)
    assert autocorrelation(x.fpp1_dbm, 5) == pytest.approx(np.exp(-1), abs=0.06)
    assert np.mean(np.isclose(x.fpp1_dbm, x.fpp2_dbm)) > 0.95


def test_outages_lose_a_share_of_exchanges_in_bursts_and_change_no_power():
    run = flight({"outages": {"share": 0.2, "life_s": 0.2}})
    lost = np.zeros(20_000, dtype=bool)
    lost[[round(fault.time_ns * 50e-9) for fault in run.faults]] = True
    assert np.mean(lost) == pytest.approx(0.2, abs=0.03)
    assert autocorrelation(lost.astype(float), 5) == pytest.approx(np.exp(-0.5), abs=0.06)
    assert np.ptp(run.exchanges.fpp2_dbm) < 1e-9


def test_a_tag_has_an_antenna_of_its_own():
    coefficients = (0.5, 0.0, 0.0, 2.0)  # everywhere, and along x by sqrt(3) times the cosine
    x = flight({}, {"pattern_db": coefficients}, duration_s=0.1).exchanges
    bare = flight({}, duration_s=0.1).exchanges
    # From the second tag the first is in the direction (-0.6, -0.8, 0).
    assert x.fpp1_dbm - bare.fpp1_dbm == pytest.approx(0.5 - 0.6 * 2 * np.sqrt(3))
    assert x.fpp2_dbm - bare.fpp2_dbm == pytest.approx(0.5 - 0.6 * 2 * np.sqrt(3))


def test_a_pattern_of_another_size_is_refused():
    with pytest.raises(
        uwbsim.ScenarioError, match=r"tags\[1\].pattern_db: found 5 coefficients, expected 1, 4, 9, 16, 25"
    ):
        flight({}, {"pattern_db": [1.0] * 5})


def test_replies_follow_the_quantiles_that_are_given():
    table = [300.0, 301.0, 305.0, 400.0]
    x = flight({}, reply={"model": "quantiles", "delays_us": table}).exchanges
    dt32_us = np.asarray((x.tx2 - x.rx1) % 2**32) / 63897.6
    # Replies leave at the next multiple of 8 ns.
    assert np.quantile(dt32_us, [0, 1 / 3, 2 / 3, 1]) == pytest.approx(table, rel=0.01)
    with pytest.raises(uwbsim.ScenarioError, match=r"reply.delays_us: .* must not decrease"):
        flight({}, reply={"model": "quantiles", "delays_us": [302.0, 301.0]})


def test_direct_paths_scatter_and_a_pair_has_its_own_excess():
    model = {"model": "two-state", "share": 0.0, "life_s": 0.1, "direct_std_m": 0.05}
    run = flight({"multipath": model})
    error = error_of(run)
    assert np.std(error) == pytest.approx(0.05, rel=0.05)
    known = {"tags": [1, 2], "mean_excess_m": 1.0}
    run = flight({"multipath": model | {"share": 1.0, "pairs": [known]}})
    assert np.mean(error_of(run)) == pytest.approx(1.0, rel=0.1)


def error_of(run):
    return raw_range(run.exchanges) - run.truth_m
