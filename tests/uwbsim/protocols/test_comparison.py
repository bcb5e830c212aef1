"""Comparisons of protocols and of fleets: their output and their files; test_bad_input.py has their errors."""

import json

import numpy as np
import pytest

import uwbsim
from tests import pages, processes
from uwblink import PROTOCOLS, SPEED_OF_LIGHT, raw_range
from uwblink.pages import figures
from uwblink.ticks import TICK_S, elapsed
from uwbsim.protocols.comparison import compare, costs, optimum, over_reply, over_skew
from uwbsim.protocols.conditions import calibrated, conditions_of, range_errors_m
from uwbsim.protocols.prediction import broadcast_variances_m2, predict
from uwbsim.scenario.ranging import TURNAROUND_S

TEST1 = "icra2023/test1"
ROWS = list(PROTOCOLS.values())


@pytest.fixture(scope="module")
def scenario():
    return uwbsim.load(TEST1)


def test_predictions_agree_with_simulations(scenario):
    found = compare(scenario, ROWS, 300_000)
    outcomes, samples = found.outcomes, found.samples
    assert [o.protocol for o in outcomes] == list(PROTOCOLS)
    for o in outcomes:
        # Reflections: with a heavy tail, the mean is known to std/550 and the spread to 1 %.
        assert o.bias_m == pytest.approx(o.predicted_bias_m, abs=4 * o.std_m / np.sqrt(300_000))
        assert o.std_m == pytest.approx(o.predicted_std_m, rel=0.02)
        assert o.rmse_m == pytest.approx(np.hypot(o.bias_m, o.std_m))
        assert o.low_m < o.median_m < o.high_m
        assert len(samples[o.protocol]) == 200_000


def test_the_duration_of_an_exchange_is_the_sum_of_frames_and_replies(scenario):
    ss, ds, sym = (costs(scenario, PROTOCOLS[name], 1e-3) for name in ("ss", "ds", "ds-sym"))
    # A second round adds the boards' immediate reply; the symmetric one a whole scheduled reply.
    assert ds["duration_s"] - ss["duration_s"] == pytest.approx(305e-6, abs=1e-9)
    assert sym["duration_s"] - ds["duration_s"] == pytest.approx(1e-3 - 305e-6, abs=1e-9)
    assert ss["air_s"] < ds["air_s"] == sym["air_s"] < ds["duration_s"]
    assert ss["air_s"] < ss["radio_on_s"] < 2 * ss["duration_s"]


def test_tables_name_the_best_protocol(scenario):
    rows = compare(scenario, ["ss-cfo", "ds"], 100).winners
    # With short replies, the carrier integrator has little effect, and double-sided ranging loses its short third
    # interval.
    assert (rows[0]["rmse"], rows[-1]["rmse"]) == ("ss-cfo", "ds")
    # The mean error of carrier readings remains, however many ranges are averaged.
    assert {row["per_second"] for row in rows} == {"ds"}


def test_curves_follow_the_paper(scenario):
    curve = over_skew(scenario, PROTOCOLS["ss"], 4096)
    reply_s = scenario.ranging.response_delay_uus * 1.0256e-6
    np.testing.assert_allclose(curve.bias_m, 0.5 * SPEED_OF_LIGHT * curve.x * 1e-6 * reply_s, atol=0.02)
    spread = over_reply(scenario, PROTOCOLS["ds"], 16_384)
    np.testing.assert_allclose(spread.std_m, spread.predicted_std_m, rtol=0.04)
    r = 305e-6 / (spread.x * 1e-6)
    ratio = spread.predicted_std_m / np.sqrt(1 + r + r**2)
    assert np.ptp(ratio) < 0.03 * ratio.mean()


def test_the_optimum_is_where_nothing_near_is_better(scenario):
    found = optimum(scenario, PROTOCOLS["ds"])
    assert not found.on_edge
    assert found.second_rms_m**2 <= found.second_m2.min() * (1 + 1e-9)
    # (1 + r + r^2) (T + a), r = 305/T: its minimum, with the rest of the exchange a, by hand.
    delays = np.linspace(300e-6, 3e-3, 100_000)
    rest = costs(scenario, PROTOCOLS["ds"], 1e-3)["duration_s"] - 1e-3 + TURNAROUND_S
    r = 305e-6 / delays
    assert found.delay_s == pytest.approx(delays[np.argmin((1 + r + r**2) * (delays + rest))], rel=0.03)
    assert optimum(scenario, PROTOCOLS["ds-sym"]).on_edge
    assert optimum(scenario, PROTOCOLS["ds"], 2e-3).delay_s > 1.3 * found.delay_s, "overhead favours longer replies"


@pytest.mark.parametrize("name", ["ss", "ss-cfo", "ds", "ds-sym"])
def test_a_bias_does_not_average_away(scenario, name):
    """The mean of many simulated ranges of one state, compared with its prediction."""
    world = calibrated(conditions_of(scenario, 64))
    count = 400
    errors = range_errors_m(PROTOCOLS[name], world, 5, count * len(world)).reshape(count, len(world))
    predicted = predict(PROTOCOLS[name], world)
    # Squares of 64 means are known to 18 %, so their root to 9 %; much better if skew dominates.
    simulated = np.sqrt(np.mean(errors.mean(axis=0) ** 2))
    assert np.sqrt(predicted.mean_of(count)) == pytest.approx(simulated, rel=0.02 if name == "ss" else 0.25)
    assert np.sqrt(predicted.mean_of(1)) == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.03)
    assert (simulated > 10 * np.sqrt(predicted.mean_of(1) / count)) == (name == "ss")


@pytest.mark.parametrize("name", ["ss", "ds", "ds-sym"])
def test_compare_counts_as_many_exchanges_a_second_as_a_run_has(name):
    settings = ["run.duration_s=4", f"ranging.protocol={name}"]
    calm = uwbsim.load(TEST1, settings)
    fastest = calm.ranging.fastest_hz(calm.radio.preamble_symbols)
    crowded = uwbsim.load(TEST1, [*settings, f"ranging.rate_hz={0.999 * fastest}"])
    time_ns = uwbsim.simulate(crowded).exchanges.time_ns
    said = compare(crowded, [name], 1000).outcomes[0].rate_hz
    assert said == pytest.approx(fastest, rel=1e-9)
    # Immediate replies take 4 us longer on average than in the median, and a second has whole exchanges.
    assert 1e9 * (len(time_ns) - 1) / np.ptp(time_ns) == pytest.approx(said, rel=0.004)


def test_predict_and_optimum_answer_in_words_and_json(tmp_path):
    predicted = processes.succeed(
        "uwbsim", "predict", "--protocol", "ss", "--skew-ppm", 10, "--reply-delay-us", 300, "--json"
    )
    assert json.loads(predicted.stdout)["bias_m"] == pytest.approx(0.4495, abs=0.0005)
    assert "standard deviation" in processes.succeed("uwbsim", "predict", "--protocol", "ds").stdout
    best = processes.succeed("uwbsim", "optimum", TEST1, "--protocols", "ds", "-o", tmp_path / "o", "--json")
    assert json.loads(best.stdout)[0]["delay_s"] == pytest.approx(932e-6, rel=0.02)
    assert (tmp_path / "o" / "optimum-ds.png").read_bytes().startswith(b"\x89PNG")


# Predictions for fleets, compared with simulated broadcasts and exchanges, and by hand.


PLACES = {1: (0.0, 0.0, 0.5), 2: (5.0, 0.3, 0.0), 3: (1.0, 6.0, 1.0), 4: (4.5, 5.5, 2.0), 5: (-3.0, 4.0, 1.0)}
LISTENER = (2.0, 2.5, 1.5)


def fleet_world(white_ppm_sqrt_s, duration_s):
    """Return five tags that broadcast in turn and one that listens, without motion, with noise of stamps."""
    places = PLACES | {9: LISTENER}
    world = {
        "run": {"seed": 8, "duration_s": duration_s},
        "ranging": {"plan": "broadcast", "rate_hz": 100.0, "sync_error_ms": 0.0},
        "radio": {"rx_noise_ps": 100.0, "tx_noise_ps": 60.0},
        "bodies": [{"name": str(k), "motion": {"model": "static", "position_m": p}} for k, p in places.items()],
        "tags": [
            {"id": k, "body": str(k), "skew_ppm": float(k), "white_ppm_sqrt_s": white_ppm_sqrt_s, "passive": k == 9}
            for k in places
        ],
    }
    fastest = uwbsim.load(world).ranging.fastest_hz(128, len(PLACES))
    return uwbsim.load(world, {"ranging.rate_hz": 0.9999 * fastest})


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
    states = calibrated(conditions_of(scenario, 100))
    expected = np.sqrt(broadcast_variances_m2(states, slot, 5 * slot)[1].mean())
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
    with pytest.raises(uwbsim.UwbsimError, match="tags"):
        uwbsim.predict_fleet(uwbsim.State(), 300)
    compared = ("uwbsim", "compare", "broadcast", "-o", tmp_path / "c", "--protocols", "ds", "-n", "1000")
    assert "6 tags" in processes.succeed(*compared).stdout
    assert "A fleet of 6 tags" in (tmp_path / "c" / "compare.html").read_text()
