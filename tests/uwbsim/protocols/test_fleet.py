"""Predictions for fleets, compared with simulated broadcasts and exchanges, and by hand."""

import json

import numpy as np
import pytest

import uwbsim
from tests import pages, processes
from uwblink import raw_range
from uwblink.pages import figures
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S, elapsed
from uwbsim.protocols.conditions import calibrated, conditions_of
from uwbsim.protocols.prediction import broadcast_variances_m2

PLACES = {1: (0.0, 0.0, 0.5), 2: (5.0, 0.3, 0.0), 3: (1.0, 6.0, 1.0), 4: (4.5, 5.5, 2.0), 5: (-3.0, 4.0, 1.0)}
LISTENER = (2.0, 2.5, 1.5)


def fleet_world(white_ppm_sqrt_s=0.0, duration_s=20.0, **ranging):
    """Return five tags that broadcast in turn and one that listens, without motion, with noise of stamps."""
    places = PLACES | {9: LISTENER}
    world = {
        "run": {"seed": 8, "duration_s": duration_s},
        "ranging": {"plan": "broadcast", "rate_hz": 100.0, "sync_error_ms": 0.0} | ranging,
        "radio": {"rx_noise_ps": 100.0, "tx_noise_ps": 60.0},
        "bodies": [{"name": str(k), "motion": {"model": "static", "position_m": p}} for k, p in places.items()],
        "tags": [
            {"id": k, "body": str(k), "skew_ppm": float(k), "white_ppm_sqrt_s": white_ppm_sqrt_s, "passive": k == 9}
            for k in places
        ],
    }
    fastest = uwbsim.load(world).ranging.fastest_hz(128, len(PLACES))
    return uwbsim.load(world, {"ranging.rate_hz": 0.9999 * fastest} if not ranging else {})


def differences_m(heard):
    """Return the differences of arrival of one listener, minus the true ones."""
    h, places = heard, {k: np.array(p) for k, p in PLACES.items()}
    rate = elapsed(h["rx3"], h["rx2"], 40) / elapsed(h["tx3_n"], h["tx2_n"], 40)
    ticks = elapsed(h["rx2"], h["rx1"], 40) - rate * elapsed(h["tx2_n"], h["rx1_n"], 40)
    i, j = (np.array([places[k] for k in h[end].tolist()]) for end in ("initiator", "target"))
    way = np.linalg.norm(j - i, axis=1) + np.linalg.norm(j - LISTENER, axis=1) - np.linalg.norm(i - LISTENER, axis=1)
    return ticks * (TICK_S * SPEED_OF_LIGHT) - way


@pytest.mark.parametrize(
    ("white", "seconds", "part"),
    [
        (0.003, 4.0, 0.045),
        *(pytest.param(white, 20.0, 0.02, marks=pytest.mark.slow) for white in (0.0, 0.003)),
    ],
)
def test_broadcasts_and_differences_err_as_predicted(white, seconds, part):
    """20 s have 25,000 frames of five tags, a tenth as many for each pair: deviations are known to 1 %, from 4 s to 2
    %.
    """
    scenario = fleet_world(white, seconds)
    flight = uwbsim.simulate(scenario)
    found = {one.method: one for one in uwbsim.compare(scenario, ["ds"], 1).fleet}
    assert list(found) == ["ds", "broadcast", "tdoa"]
    assert np.std(raw_range(flight.exchanges) - flight.truth_m) == pytest.approx(found["broadcast"].std_m, rel=part)
    assert found["broadcast"].rmse_m == pytest.approx(found["broadcast"].std_m, rel=0.01)
    heard = {name: column[flight.overheard["listener"] == 9] for name, column in flight.overheard.items()}
    assert np.std(differences_m(heard)) == pytest.approx(found["tdoa"].std_m, rel=part)
    # Differences of neighbours in the round only: the reply is one of five slots.
    reply = elapsed(heard["tx2_n"], heard["rx1_n"], 40) * TICK_S
    slot = 1 / scenario.ranging.rate_hz
    near = {name: column[reply < 1.5 * slot] for name, column in heard.items()}
    world = calibrated(conditions_of(scenario, 100))
    expected = np.sqrt(broadcast_variances_m2(world, slot, 5 * slot)[1].mean())
    assert np.std(differences_m(near)) == pytest.approx(expected, rel=part)
    # Ten pairs per round; a range needs the next round.
    assert len(flight.exchanges) / seconds == pytest.approx(10 * found["broadcast"].update_hz, rel=0.02 / seconds)
    assert found["tdoa"].update_hz == found["broadcast"].update_hz


def test_costs_are_those_of_the_frames():
    five, fifty = (
        {one.method: one for one in uwbsim.predict_fleet(uwbsim.State(rx_noise_ps=100.0), tags)} for tags in (5, 50)
    )
    # 138.4 us of preamble, 21.5 of header, and 41 bytes with 48 bits of parity.
    frame_s = 138.397e-6 + 21.538e-6 + (8 * 41 + 48) * 64 / 499.2e6
    cost = five["broadcast"].air_s, five["tdoa"].air_s, five["broadcast"].radio_on_s, five["tdoa"].radio_on_s
    assert cost == pytest.approx((frame_s / 2, frame_s * 5 / 4, frame_s * 5 / 2, frame_s * 5 / 4), rel=1e-4)
    assert five["broadcast"].update_hz == pytest.approx(1 / (5 * (frame_s + 300e-6)), rel=1e-4)
    # Pairs range in turn, so their updates decrease with the square of the fleet's size; those of broadcasts decrease
    # with the size and with the length of the frame: at most 127 bytes, with four blocks of parity.
    assert five["ds"].update_hz / fifty["ds"].update_hz == pytest.approx(50 * 49 / 20)
    longest_s = 138.397e-6 + 21.538e-6 + (8 * 127 + 4 * 48) * 64 / 499.2e6
    assert fifty["tdoa"].update_hz == pytest.approx(1 / (50 * (longest_s + 300e-6)), rel=1e-4)
    # Replies take a fifth or two of a round; frames of one tag have the weight 1 - 3/2 r^2 (1 - r^2), three others 1.
    metre_s = 100e-12 * SPEED_OF_LIGHT
    ratios = np.array([0.2, 0.4])
    saved = 1.5 * np.mean(ratios**2 - ratios**4)
    assert five["broadcast"].std_m == pytest.approx(metre_s * ((2 - saved) / 4) ** 0.5, rel=1e-3)
    assert five["tdoa"].std_m == pytest.approx(metre_s * (3 - saved) ** 0.5, rel=1e-9)
    assert {one.tags for one in fifty.values()} == {50}


@pytest.mark.slow
def test_predict_and_compare_print_the_fleet(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "drawn", pages.outline)
    words = ("predict", "--tags", "8", "--delay-initiator-ns", "3")
    found = json.loads(processes.succeed("uwbsim", *words, "--json").stdout)
    fleet = {row["method"]: row for row in found["fleet"]}
    assert list(fleet)[-2:] == ["broadcast", "tdoa"]
    assert fleet["ds"]["rmse_m"] == pytest.approx(fleet["ds"]["std_m"], rel=1e-3), "delays are calibrated"
    assert "tdoa" in processes.succeed("uwbsim", *words).stdout
    assert "fleet" not in json.loads(processes.succeed("uwbsim", "predict", "--json").stdout)
    processes.refuse("uwbsim", "predict", "--tags", "1", naming=["--tags"])
    with pytest.raises(uwbsim.UwbsimError, match="tags"):
        uwbsim.predict_fleet(uwbsim.State(), 300)
    done = processes.run("uwbsim", "compare", "broadcast", "-o", tmp_path / "c", "--protocols", "ds", "-n", "1000")
    assert "6 tags" in done.stdout
    assert "A fleet of 6 tags" in (tmp_path / "c" / "compare.html").read_text()
