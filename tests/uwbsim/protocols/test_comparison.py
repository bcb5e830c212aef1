"""Comparisons of protocols and of fleets: their output and their files; test_bad_input.py has their errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

import uwbsim
from tests import pages, processes
from tests.errors import one_line
from tests.uwbsim.simulation.test_protocols import bench
from uwblink import PROTOCOLS, SPEED_OF_LIGHT, Board, raw_range
from uwblink.pages import figures
from uwblink.ticks import TICK_S, elapsed
from uwblink.twr import COLUMNS
from uwbsim.protocols.comparison import compare, costs, optimum, over_reply, over_skew
from uwbsim.protocols.conditions import Conditions, calibrated, conditions_of, range_errors_m
from uwbsim.protocols.prediction import broadcast_variances_m2, predict
from uwbsim.scenario.radio import SIGMA, Radio
from uwbsim.scenario.ranging import TURNAROUND_S

TEST1 = "icra2023/test1"


@pytest.fixture(scope="module")
def scenario():
    return uwbsim.load(TEST1)


def test_predictions_agree_with_simulations(scenario):
    found = compare(scenario, None, 300_000)
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


# The Monte Carlo simulation compared with the event loop with its integer stamps, and with theory.


NAMES = list(PROTOCOLS)
SOME_SLOW = [pytest.param(name, marks=[] if name in ("ss", "ds") else pytest.mark.slow) for name in NAMES]


def world(count=16_384, **values):
    """Return a world of five metres, clocks 10 ppm apart, and the boards' delays; `values` change that."""
    start = {"flight": 5 / SPEED_OF_LIGHT, "rate": (5e-6, -5e-6), "at_once": 305e-6}
    plain = {k: values.pop(k) for k in list(values) if k in ("quantize", "multipath", "detour_s", "carrier_std_ppm")}
    one = Conditions.single(**(start | {"scheduled": 1538.7e-6} | values), **plain)
    return one[np.zeros(count, dtype=np.int64)]


@pytest.mark.parametrize("name", NAMES)
def test_without_contention_the_stamps_are_those_of_the_event_loop(name):
    settings = [f"ranging.protocol={name}", "ranging.rate_hz=100", "run.duration_s=10"]
    scenario = uwbsim.load("icra2023/train", settings)
    loop, columns = uwbsim.simulate(scenario), uwbsim.simulate(scenario, contention=False)
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(loop.exchanges, column), getattr(columns.exchanges, column), column)
    np.testing.assert_array_equal(loop.truth_m, columns.truth_m)


@pytest.mark.parametrize("name", SOME_SLOW)
def test_means_and_variances_are_those_of_integer_stamps(name):
    settings = [f"ranging.protocol={name}", "ranging.rate_hz=100", "run.duration_s=300", "radio.tx_noise_ps=40"]
    scenario = uwbsim.load("icra2023/test1", settings)
    flight = uwbsim.simulate(scenario, contention=False)
    exact = raw_range(flight.exchanges) - flight.truth_m
    # The same 30,000 states, so only the noise differs: 300,000 ranges each.
    states = conditions_of(scenario, 30_000)
    fast = range_errors_m(PROTOCOLS[name], states, 7, 300_000)
    within = predict(PROTOCOLS[name], states).variance_m2.mean()
    assert abs(exact.mean() - fast.mean()) < 4 * np.sqrt(within * (1 / len(exact) + 1 / len(fast)))
    # The variance of 30,000 heavy-tailed errors is known to 1.5 %.
    assert exact.var() == pytest.approx(fast.var(), rel=0.06)


@pytest.mark.parametrize("name", SOME_SLOW)
@pytest.mark.parametrize(
    "values",
    [
        {"rx_std": 150e-12},
        {"tx_std": 80e-12},
        {"rx_std": 100e-12, "tx_std": 60e-12, "quantize": True},
        {"rx_std": 100e-12, "multipath": 0.2, "detour_s": 1e-9},
        {"rx_std": 50e-12, "carrier_std_ppm": 0.2},
        {"rx_std": 50e-12, "tx_delay": (0.3e-9, 0.0), "rx_delay": (0.0, -0.5e-9), "late": 0.2e-9},
        {"rx_std": 50e-12, "flight_rate": 5e-9, "drift": (1e-6, 0.0)},
    ],
    ids=lambda v: "+".join(v),
)
def test_the_prediction_holds(name, values):
    c = world(**values)
    errors = range_errors_m(PROTOCOLS[name], c, 11, 250_000)
    mean, variance = predict(PROTOCOLS[name], c).pooled()
    assert abs(errors.mean() - mean) < 4 * np.sqrt(variance / 250_000) + 2e-6
    # The variance of normal errors is known to 0.3 %, that of exponential detours to 1 %; two sigma of that.
    assert errors.var() == pytest.approx(variance, rel=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_the_prediction_is_exact(name):
    c = world(
        1, tx_delay=(0.3e-9, -0.1e-9), rx_delay=(-0.2e-9, 0.0), late=0.4e-9,
        flight_rate=4e-9, drift=(2e-6, -1e-6),
    )  # fmt: skip
    (error,) = range_errors_m(PROTOCOLS[name], c, 1, 1)
    # Half a nanometre: the rounding of floats of a second at a millisecond.
    assert predict(PROTOCOLS[name], c).mean_m[0] == pytest.approx(error, abs=1e-6)


BOTH = {"rx_std": 1e-10, "tx_std": 1e-10}
ONE_SIDED_M2 = (SPEED_OF_LIGHT * 1e-10) ** 2


@pytest.mark.parametrize(
    ("name", "values", "mean_m", "variance_m2"),
    [
        # Half the reply times the error of the reading.
        (
            "ss-cfo",
            {"carrier_std_ppm": 0.2},
            pytest.approx(0, abs=1e-4),
            pytest.approx((0.5 * SPEED_OF_LIGHT * 1538.7e-6 * 0.2e-6) ** 2, rel=1e-5),
        ),
        ("ss", {"scheduled": 300e-6, "carrier_std_ppm": 0.2}, pytest.approx(0.4495, abs=0.0005), 0),
        *((name, {"scheduled": 300e-6}, pytest.approx(0, abs=0.001), 0) for name in ("ds", "ds-alt", "ds-sym")),
        ("ss", BOTH | {"rate": (0, 0)}, pytest.approx(0, abs=1e-6), pytest.approx(ONE_SIDED_M2, rel=1e-3)),
        # ICRA 2023: 1 + r + r^2 times the variance of single-sided ranging, r = dt32/dt53; receive noise alone is half.
        *(
            (
                "ds",
                noise | {"at_once": r * 1538.7e-6},
                pytest.approx(0, abs=0.001),
                pytest.approx(part * ONE_SIDED_M2 * (1 + r + r**2), rel=1e-3),
            )
            for r in (0.05, 0.2, 1.0)
            for noise, part in ((BOTH, 1), ({"rx_std": 1e-10}, 0.5))
        ),
        # Neirynck: equal replies halve the weight of each stamp, so 3/4 of the single-sided variance (four stamps with
        # half the weight, two with all, for both), and the bias is the flight times the mean skew.
        (
            "ds-sym",
            BOTH | {"rate": (12e-6, 4e-6)},
            pytest.approx(5 * 8e-6, rel=1e-3),
            pytest.approx(0.75 * ONE_SIDED_M2, rel=1e-3),
        ),
    ],
)
def test_bias_and_variance_are_those_of_the_papers(name, values, mean_m, variance_m2):
    found = predict(PROTOCOLS[name], world(1, **values))
    assert found.mean_m[0] == mean_m
    assert found.variance_m2[0] == variance_m2


@pytest.mark.parametrize("name", [name for name in SIGMA if name != "none"])
def test_a_double_sided_range_has_the_standard_deviation_of_the_named_curve(name):
    # The scheduled delay of the boards: replies of 305 us and 1539 us.
    world = bench(sigma=Radio(sigma=name).sigma, first_path_at_1m_dbm=-78.0)
    conditions, curve = conditions_of(world), world.radio.sigma
    lifted = 10 ** ((conditions.power_dbm[0] + 82) / 10)
    expected = float(BSpline(np.array(curve.knots), np.array(curve.coefficients), curve.degree)(lifted))
    found = np.sqrt(predict(PROTOCOLS["ds"], conditions).parts_m2["receive noise"][0])
    assert found == pytest.approx(expected, rel=2e-3)


def test_pieces_do_not_depend_on_how_many_are_asked_for():
    c = world(1000, rx_std=1e-10, carrier_std_ppm=0.2, quantize=True, multipath=0.1, detour_s=1e-9)
    few, many = (range_errors_m(PROTOCOLS["ss-cfo"], c, 5, n) for n in (2500, 9000))
    np.testing.assert_array_equal(few, many[:2500])


def test_protocols_see_the_same_noise():
    c = world(4096, rx_std=1e-10)
    errors = [range_errors_m(PROTOCOLS[name], c, 5, 4096) for name in ("ss", "ss-cfo", "ds")]
    assert np.corrcoef(errors[0], errors[1])[0, 1] > 0.9999
    assert np.corrcoef(errors[0], errors[2])[0, 1] > 0.85
    assert abs(np.corrcoef(errors[0], range_errors_m(PROTOCOLS["ss"], c, 6, 4096))[0, 1]) < 0.08


def test_a_world_of_many_states_meets_each_in_turn():
    c = replace(world(3), flight=np.array([1.0, 2.0, 3.0]) / SPEED_OF_LIGHT, late=np.array([0.0, 1e-9, 2e-9]))
    errors = range_errors_m(PROTOCOLS["ds"], c, 1, 7)
    np.testing.assert_allclose(errors, np.array([0, 1, 2, 0, 1, 2, 0]) * 1e-9 * SPEED_OF_LIGHT, atol=1e-4)


# Accepted and refused arguments of comparisons: parameters by name, in one line.


SHORT = uwbsim.load("noiseless", {"run.duration_s": 2.0, "radio.rx_noise_ps": 100.0})
WITHOUT_EXCHANGES = uwbsim.load("noiseless", {"run.duration_s": 0.001})


def test_protocols_are_names_rows_or_all_and_scenarios_may_be_files():
    row = replace(PROTOCOLS["ds"], name="ds-again")
    found = uwbsim.compare(SHORT, ["ds", row, PROTOCOLS["ds"]], count=500)
    assert [one.protocol for one in found.outcomes] == ["ds", "ds-again"]
    np.testing.assert_array_equal(found.samples["ds"], found.samples["ds-again"])
    assert [one.protocol for one in uwbsim.compare(SHORT, count=10).outcomes] == list(PROTOCOLS)
    assert uwbsim.optimum(SHORT, row).delay_s == uwbsim.optimum(SHORT, "ds").delay_s
    assert uwbsim.optimum(uwbsim.shipped_scenarios()["noiseless"], "ss").protocol == "ss"
    said = uwbsim.predict_state(uwbsim.State(protocol=row))
    assert said.std_m == uwbsim.predict_state(uwbsim.State(protocol="ds")).std_m


def test_results_print_themselves():
    lines = repr(uwbsim.compare(SHORT, ["ss", "ds"], count=100)).splitlines()
    assert [line.split()[0] for line in lines] == ["protocol", "ss", "ds"]
    assert max(map(len, lines)) <= 100
    assert repr(uwbsim.optimum(SHORT, "ds")).startswith("ds: best delay ")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: uwbsim.compare(SHORT, ["tdoa"]), "`protocols`: found 'tdoa', allowed: ss, ss-cfo, ds"),
        (lambda: uwbsim.compare(SHORT, []), "`protocols`: found none, allowed"),
        (lambda: uwbsim.compare(SHORT, ["ss"], count=0), "`count`: found 0, expected 1 to 50000000"),
        (lambda: uwbsim.optimum(SHORT, "tdoa"), "`protocol`: found 'tdoa'"),
        (lambda: uwbsim.optimum(SHORT, "ds", -1e-3), "`overhead_s`: found -0.001, expected seconds, 0 or more"),
        (lambda: uwbsim.optimum(SHORT, "ds", float("nan")), "`overhead_s`: found nan"),
        (lambda: uwbsim.predict_state(uwbsim.State(protocol="x")), "`protocol`: found 'x'"),
        (lambda: uwbsim.predict_state(uwbsim.State(skew_ppm=float("inf"))), "`skew_ppm`: found inf, expected a number"),
        (lambda: uwbsim.predict_state(uwbsim.State(distance_m=-1)), "`distance_m`: found -1, expected 0 or more"),
        (lambda: uwbsim.predict_state(uwbsim.State(final_delay_us=0.5)), "`final_delay_us`: found 0.5, expected"),
        (lambda: uwbsim.compare(WITHOUT_EXCHANGES, ["ds"], count=10), "run.duration_s"),
        (lambda: uwbsim.optimum(WITHOUT_EXCHANGES, "ds"), "run.duration_s"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    refused = uwbsim.ScenarioError if message.startswith("run.") else uwbsim.ParameterError
    with pytest.raises(refused, match=one_line(message)) as caught:
        call()
    assert "--" not in str(caught.value)


# Effect of white noise of clock rates on protocols: flights, Monte Carlo and prediction compared with closed forms.


WHITE = 0.01e-6
REPLY_S, UUS_S = 305e-6, 512 / 499.2e6


def with_white_noise(protocol):
    return bench(protocol, n=3000, seed=3, tag={"white_ppm_sqrt_s": WHITE * 1e6})


def closed_form_m(protocol):
    """Return the standard deviation from phases that change independently over the intervals of the formulas, without
    flights.
    """
    wait = 1500 * UUS_S
    if protocol == "ss":
        # Half of the difference that two clocks gather over the reply.
        return SPEED_OF_LIGHT * WHITE * np.sqrt(2 * wait) / 2
    # dt41 - K dt32: both clocks over the reply, and both over the interval that determines K = dt64/dt53.
    return SPEED_OF_LIGHT * WHITE * np.sqrt(2 * REPLY_S * (1 + REPLY_S / wait)) / 2


@pytest.mark.parametrize("protocol", ["ds", "ss", "ss-cfo", "ds-alt", "ds-sym"])
def test_closed_form_prediction_monte_carlo_and_flight_agree(protocol):
    world = with_white_noise(protocol)
    conditions = conditions_of(world)
    prediction = predict(PROTOCOLS[protocol], conditions)
    predicted = np.sqrt(prediction.pooled()[1])
    if protocol in ("ds", "ss"):
        assert np.sqrt(prediction.parts_m2["clocks"]) == pytest.approx(closed_form_m(protocol), rel=2e-3)
    assert np.std(range_errors_m(PROTOCOLS[protocol], conditions, 1, 20_000)) == pytest.approx(predicted, rel=0.03)
    flight = uwbsim.simulate(world, contention=False)
    assert np.std(raw_range(flight.exchanges) - flight.truth_m) == pytest.approx(predicted, rel=0.06)


@pytest.mark.slow
def test_served_boards_lose_as_much():
    first = Board(uwbsim.VirtualPorts(with_white_noise("ds")).port(1))
    ranges = [first.range(2).range_m for _ in range(200)]
    # 200 exchanges determine a deviation to 5 %, which includes whole ticks and the grid.
    assert np.std(ranges) == pytest.approx(closed_form_m("ds"), rel=0.15)
