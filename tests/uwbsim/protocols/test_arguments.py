"""What the workbench takes, and what it refuses: parameters by name, in one line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import uwbsim
from uwblink import PROTOCOLS
from uwbsim.protocols.comparison import compare, optimum

NOISELESS = Path(__file__).parents[3] / "scenarios" / "noiseless.toml"
SHORT = uwbsim.load(NOISELESS, {"run.duration_s": 2.0, "radio.rx_noise_ps": 100.0})


def test_protocols_are_names_rows_or_all():
    row = replace(PROTOCOLS["ds"], name="ds-again")
    found = compare(SHORT, ["ds", row, PROTOCOLS["ds"]], count=500)
    assert [one.protocol for one in found.outcomes] == ["ds", "ds-again"]
    np.testing.assert_array_equal(found.samples["ds"], found.samples["ds-again"])
    assert [one.protocol for one in compare(SHORT, count=10).outcomes] == list(PROTOCOLS)
    assert optimum(SHORT, row).delay_s == optimum(SHORT, "ds").delay_s
    said = uwbsim.predict_state(uwbsim.State(protocol=row))
    assert said.std_m == uwbsim.predict_state(uwbsim.State(protocol="ds")).std_m


def test_a_scenario_may_be_a_file():
    assert optimum(NOISELESS, "ss").protocol == "ss"


def test_results_print_themselves():
    lines = repr(compare(SHORT, ["ss", "ds"], count=100)).splitlines()
    assert [line.split()[0] for line in lines] == ["protocol", "ss", "ds"]
    assert max(map(len, lines)) <= 100
    assert repr(optimum(SHORT, "ds")).startswith("ds: best delay ")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: compare(SHORT, ["tdoa"]), "`protocols`: found 'tdoa', allowed: ss, ss-cfo, ds"),
        (lambda: compare(SHORT, []), "`protocols`: found none, allowed"),
        (lambda: compare(SHORT, ["ss"], count=0), "`count`: found 0, expected 1 to 50000000"),
        (lambda: optimum(SHORT, "tdoa"), "`protocol`: found 'tdoa'"),
        (lambda: optimum(SHORT, "ds", -1e-3), "`overhead_s`: found -0.001, expected seconds, 0 or more"),
        (lambda: optimum(SHORT, "ds", float("nan")), "`overhead_s`: found nan"),
        (lambda: uwbsim.predict_state(uwbsim.State(protocol="x")), "`protocol`: found 'x'"),
        (lambda: uwbsim.predict_state(uwbsim.State(skew_ppm=float("inf"))), "`skew_ppm`: found inf, expected a number"),
        (lambda: uwbsim.predict_state(uwbsim.State(distance_m=-1)), "`distance_m`: found -1, expected 0 or more"),
        (
            lambda: uwbsim.predict_state(uwbsim.State(final_delay_us=0.5)),
            "`final_delay_us`: found 0.5, expected",
        ),
    ],
)
def test_arguments_that_cannot_be(call, message):
    with pytest.raises(uwbsim.ParameterError) as caught:
        call()
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
    assert "--" not in str(caught.value)


@pytest.mark.parametrize("call", [lambda world: compare(world, ["ds"], count=10), lambda world: optimum(world, "ds")])
def test_a_scenario_that_plans_no_exchange_is_refused(call):
    with pytest.raises(uwbsim.ScenarioError, match=r"run\.duration_s"):
        call(uwbsim.load(NOISELESS, {"run.duration_s": 0.001}))
