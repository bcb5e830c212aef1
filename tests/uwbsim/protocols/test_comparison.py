"""Commands that compare protocols: their output, their files, and their errors."""

import json

import numpy as np
import pytest

from tests import processes
from tests.shared_data import ROOT
from uwblink import PROTOCOLS, SPEED_OF_LIGHT
from uwbsim import load, simulate
from uwbsim.protocols.comparison import compare, costs, optimum, over_reply, over_skew
from uwbsim.protocols.conditions import calibrated, conditions_of, range_errors_m
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.ranging import TURNAROUND_S

TEST1 = ROOT / "scenarios" / "icra2023" / "test1.toml"
ROWS = list(PROTOCOLS.values())


def run(*words):
    return processes.run("uwbsim", *words)


@pytest.fixture(scope="module")
def scenario():
    return load(TEST1)


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
    calm = load(TEST1, settings)
    fastest = calm.ranging.fastest_hz(calm.radio.preamble_symbols)
    crowded = load(TEST1, [*settings, f"ranging.rate_hz={0.999 * fastest}"])
    time_ns = simulate(crowded).exchanges.time_ns
    said = compare(crowded, [name], 1000).outcomes[0].rate_hz
    assert said == pytest.approx(fastest, rel=1e-9)
    # Immediate replies take 4 us longer on average than in the median, and a second has whole exchanges.
    assert 1e9 * (len(time_ns) - 1) / np.ptp(time_ns) == pytest.approx(said, rel=0.004)


def test_predict_and_optimum_answer_in_words_and_json(tmp_path):
    done = run("predict", "--protocol", "ss", "--skew-ppm", 10, "--reply-delay-us", 300, "--json")
    assert json.loads(done.stdout)["bias_m"] == pytest.approx(0.4495, abs=0.0005)
    assert "standard deviation" in run("predict", "--protocol", "ds").stdout
    done = run("optimum", TEST1, "--protocols", "ds", "-o", tmp_path / "o", "--json")
    assert json.loads(done.stdout)[0]["delay_s"] == pytest.approx(932e-6, rel=0.02)
    assert (tmp_path / "o" / "optimum-ds.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (["compare", TEST1, "-o", "out", "--protocols", "ss,tdoa"], ["tdoa", "ss-cfo", "ds-sym"]),
        (["compare", TEST1, "-o", "out", "--protocols", ","], ["found none"]),
        (["compare", TEST1, "-o", "out", "-n", "0"], ["-n", "expected 1 to"]),
        (["compare", TEST1, "-o", "no/out"], ["does not exist"]),
        (["predict", "--protocol", "aloha"], ["aloha", "allowed"]),
        (["predict", "--skew-ppm", "nan"], ["--skew-ppm", "nan"]),
        (["predict", "--final-delay-us", "0"], ["--final-delay-us", "1 or more"]),
        (["optimum", "no.toml"], ["no such"]),
        (["sweep", "no.toml", "-o", "out"], ["no such"]),
        (["run", TEST1, "-o", "o.uwb", "--through-wire", "--set", "ranging.protocol=ds-sym"], ["ds-sym", "boards"]),
    ],
)
def test_wrong_arguments_of_comparisons_are_one_line(tmp_path, words, fragments):
    processes.refuse("uwbsim", *words, cwd=tmp_path, naming=fragments)
    assert not list(tmp_path.iterdir())
