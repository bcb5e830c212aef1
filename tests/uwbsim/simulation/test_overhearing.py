"""What passive tags overhear, and impulse responses, against known geometry."""

import numpy as np
import pytest

from uwblink.ticks import METRES_PER_TICK, elapsed
from uwbsim import simulate
from uwbsim.scenario.model import Scenario

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
    assert len(heard["rx1"]) == 100
    assert set(heard["listener"].tolist()) == {3}
    # rx2 - rx1 at the listener is rx2's way more: target's reply plus both flights, less the initiator's way.
    d12, d13, d23 = 4.0, np.hypot(1, 3), np.hypot(3, 3)
    reply = elapsed(heard["tx2_n"], heard["rx1_n"])
    rate = 1 + (1.0 - (-3.0)) * 1e-6  # of the listener's clock against the target's
    expected = reply * rate + (d12 + d23 - d13) / METRES_PER_TICK
    np.testing.assert_allclose(elapsed(heard["rx2"], heard["rx1"]), expected, atol=1.5)
    # The third message comes dt53 after the second, from the same tag: no geometry, only clocks.
    third = elapsed(heard["tx3_n"], heard["tx2_n"]) * rate
    np.testing.assert_allclose(elapsed(heard["rx3"], heard["rx2"]), third, atol=1.5)
    np.testing.assert_allclose(heard["skew1_ppm"], 1.0 - 2.0, atol=0.002)


def test_a_single_sided_exchange_has_no_third_reception():
    heard = flight("ss").overheard
    assert (heard["rx3"].any(), np.isnan(heard["fpp3_dbm"]).all()) == (False, True)


def test_who_is_too_far_hears_nothing_and_listening_changes_nothing_else():
    near, both = flight(), flight(passive=(3, 4), sensitivity_dbm=-105.0)
    deaf = flight(passive=(4,), sensitivity_dbm=-92.0)
    assert len(deaf.overheard["rx1"]) == 0
    np.testing.assert_array_equal(near.exchanges.rx2, both.exchanges.rx2)
    mine = both.overheard["listener"] == 3
    np.testing.assert_array_equal(both.overheard["rx1"][mine], near.overheard["rx1"])


def test_impulse_responses_agree_with_stamp_and_room():
    room = {"min_m": (-5, -5, -1.5), "max_m": (65, 5, 2.0), "reflection_loss_db": 3.0}
    result = flight(room=room, get_cir=True)
    assert len(result.cirs) == len(result.exchanges) == 100
    for row, stamp in zip(result.cirs, result.exchanges.rx3.tolist(), strict=True):
        index, taps = row.first_path_index, np.array(row.magnitudes)
        assert len(taps) == 1016
        assert index % 1 == pytest.approx(stamp % 64 / 64, abs=0.001)
        # The floor is 1.5 m below: 5 m instead of 4 m, 3.3 ns or taps later.
        echo = round(index + 1.5 + 1.0 / 0.299702547)
        # Half the amplitude of the first path, which diffuse ones of a quarter disturb.
        assert taps[echo - 1 : echo + 2].max() > taps.max() / 6
        assert taps[: int(index) - 6].max() < 400
