"""Rows of other distributions: installed by pip into a separate folder, and used through the commands."""

import json
import os
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest

from tests import pages, processes
from tests.errors import one_line
from tests.uwblink.test_twr import SYMMETRIC, TARGETS
from tests.uwbsim.simulation.test_protocols import bench, calibrated_error_m
from uwblink import PROTOCOLS, SPEED_OF_LIGHT, Recording, load, register_protocol
from uwblink.errors import ArgumentError, PluginWarning
from uwblink.plugins import Registry
from uwbsim.protocols.conditions import Conditions, range_errors_m
from uwbsim.protocols.prediction import predict

# The example of CONTRIBUTING.md, and two rows with errors.
PROJECT, MODULE = (
    next(b.code for b in pages.blocks(pages.ROOT / "CONTRIBUTING.md") if b.language == language and word in b.code)
    for language, word in (("toml", "uwbcal.protocols"), ("python", "PROTOCOL = "))
)
PROJECT = PROJECT.replace("strange = ", 'broken = "strange_ranging:NOTHING"\nstrange = ', 1)
PROJECT = PROJECT.replace("welsch = ", 'bad = "strange_ranging:BAD"\nwelsch = ', 1)
MODULE += 'BAD = RobustLoss("bad", lambda u: (u, u))\n'


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Return the environment of a process with the distribution."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    (source / "strange_ranging").mkdir()
    (source / "pyproject.toml").write_text(PROJECT)
    (source / "strange_ranging" / "__init__.py").write_text(MODULE)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    pip += ["--disable-pip-version-check", "--target", str(site), str(source)]
    subprocess.run(pip, check=True, capture_output=True, text=True)
    return os.environ | {"PYTHONPATH": str(site)}


@pytest.fixture
def run(installed):
    """Return a function that runs a command, which must succeed, in a process with the distribution."""
    return partial(processes.succeed, env=installed, timeout=300)


WARNING = (
    "warning: plug-in 'broken' of strange-ranging (group uwbcal.protocols) is left out: "
    "AttributeError: module 'strange_ranging' has no attribute 'NOTHING'\n"
)


@pytest.mark.slow
def test_protocol_and_loss_of_another_distribution_are_simulated_and_fitted_with(run, tmp_path):
    flight = tmp_path / "f.uwb"
    settings = ("--set", "ranging.protocol=strange-ds", "--set", "run.duration_s=30")
    assert run("uwbsim", "run", "scenarios/noiseless.toml", "-o", flight, *settings).stderr == WARNING
    fitted = run("calib", "fit", flight, "-o", tmp_path / "c.json", "--loss", "welsch")
    assert "'bad' of strange-ranging (group uwbcal.losses) is left out" in fitted.stderr
    document = json.loads((tmp_path / "c.json").read_text())
    planted = {"1": -0.36, "2": -0.01, "3": 0.24, "4": -0.36}
    assert document["loss"] == "welsch"
    assert {tag: document["delays_ns"][tag] for tag in planted} == pytest.approx(planted, abs=5e-3)


def test_an_effect_of_another_distribution_applies_to_the_flights_of_the_command_and_is_recorded(run, tmp_path):
    settings = ("--set", "run.duration_s=1", "--set", "radio.quantize=false")
    powers, recorded = list[Any](), list[Any]()
    for command in (run, processes.succeed):
        flight = tmp_path / f"{len(powers)}.uwb"
        command("uwbsim", "run", "scenarios/noiseless.toml", "-o", flight, *settings)
        with Recording.open(flight) as opened:
            powers.append(opened.exchanges().fpp1_dbm)
            recorded.append(opened.meta().get("channel_effects"))
    assert recorded == [["rain"], None]
    assert powers[0] == pytest.approx(powers[1] - 3.0)


@pytest.mark.slow
def test_workers_in_other_processes_load_the_plugin(run, tmp_path):
    (tmp_path / "s.toml").write_text(
        '[sweep]\nscenario = "noiseless"\nprotocols = ["strange-ds"]\n'
        "ranges = 1000\nseeds = [1, 2]\n[vary]\n'radio.rx_noise_ps' = [100.0, 200.0]\n"
    )
    run("uwbsim", "sweep", tmp_path / "s.toml", "-o", tmp_path / "out", "--workers", "2")
    assert (tmp_path / "out" / "results.csv").read_text().count("strange-ds") == 4


def test_the_importer_of_another_distribution_is_a_command_and_without_it_its_recordings_say_so(run, tmp_path):
    (tmp_path / "t.eight").write_text("1 2 0 5 1005 3000 99005 101000\n")
    done = run("uwblink", "import", "eight", tmp_path / "t.eight", "-o", tmp_path / "t.uwb")
    assert done.stdout == f"{tmp_path / 't.uwb'}: 1 exchanges\n"
    shown = json.loads(run("uwblink", "show", tmp_path / "t.uwb", "--json").stdout)
    assert shown["protocols"] == {"strange-ds": 1}
    naming = [f"{tmp_path / 't.uwb'}: ", "'strange-ds'", "uwbcal.protocols", "ss, ss-cfo, ds"]
    processes.refuse("uwblink", "show", tmp_path / "t.uwb", naming=naming)


def test_its_exporter_correction_and_evaluator_are_used(installed, run, tmp_path):
    flight = tmp_path / "f.uwb"
    run("calib", "sample", "-o", flight, "-n", 300)
    run("uwblink", "export", flight, "--to", "pairs", "-o", tmp_path / "out")
    written = (tmp_path / "out" / "pairs.txt").read_text().splitlines()
    assert (len(written), set(written)) == (300, {"1 2", "2 3", "3 1"})

    (tmp_path / "s.toml").write_text(
        '[sweep]\nscenario = "noiseless"\nkind = "count"\n[vary]\n"run.duration_s" = [1.0, 2.0]\n'
    )
    run("uwbsim", "sweep", tmp_path / "s.toml", "-o", tmp_path / "swept", "--workers", "1")
    header, *rows = [line.split(",") for line in (tmp_path / "swept" / "results.csv").read_text().splitlines()]
    counts = [int(row[header.index("exchanges")]) for row in rows]
    assert counts[1] == 2 * counts[0] > 0
    (tmp_path / "s.toml").write_text((tmp_path / "s.toml").read_text().replace("count", "cuont"))
    words = ("uwbsim", "sweep", tmp_path / "s.toml", "-o", tmp_path / "no", "--workers", "1")
    naming = ["sweep.kind: found 'cuont', expected calibrate, compare, count, or a name"]
    processes.refuse(*words, env=installed, naming=naming)
    assert not (tmp_path / "no").exists()

    (tmp_path / "offset.txt").write_text("100.0")
    streamed = run("uwblink", "stream", flight, "--speed", "inf", "-c", tmp_path / "offset.txt")
    rows = [json.loads(line) for line in streamed.stdout.splitlines()]
    assert len(rows) == 300
    assert [row["corrected_m"] for row in rows] == pytest.approx([row["range_m"] - 100.0 for row in rows], abs=1e-3)


@pytest.mark.parametrize("command", ["uwblink", "uwbsim", "calib"])
def test_help_loads_no_plug_in(run, command):
    assert run(command, "--help").stderr == ""


@dataclass(frozen=True)
class Row:
    name: str
    value: int = 0


def check(row):
    if not isinstance(row, Row):
        raise ArgumentError(f"row: found {row!r}, expected a Row")


@pytest.fixture
def table(monkeypatch):
    """A table with one built-in row, and entry points that name rows, a list of them, and errors."""
    entries = [EntryPoint(f"e{k}", f"tests.test_plugins:{name}", "g") for k, name in enumerate(ENTRIES)]
    asked = Mock(return_value=entries)
    monkeypatch.setattr("importlib.metadata.entry_points", asked)
    return Registry("row", "g", [Row("own")], check), asked


ONE = Row("one")
MANY = [Row("two"), Row("three")]
TWICE = Row("one", 2)
MINE = Row("own", 2)
STRANGE = "text"
ENTRIES = ("ONE", "MANY", "TWICE", "MINE", "STRANGE", "ABSENT")


def test_entry_points_are_loaded_once_and_only_when_they_are_needed(table):
    registry, asked = table
    assert (registry["own"].value, [row.name for row in registry.known()], asked.called) == (0, ["own"], False)
    with pytest.warns(PluginWarning) as caught:
        assert list(registry) == ["own", "one", "two", "three"]
    expected = (
        "'one': is already registered",
        "'own': this name is reserved",
        "row: found 'text', expected a Row",
        "AttributeError: ",
    )
    for warning, said in zip(caught, expected, strict=True):
        assert re.search(one_line("(group g) is left out: ", said), str(warning.message))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ("nothing" in registry, len(registry), asked.mock_calls) == (False, 4, [call(group="g")])


def test_unknown_names_are_looked_up_in_plug_ins(table):
    registry, asked = table
    with pytest.warns(PluginWarning):
        assert registry["three"] is MANY[1]
    asked.assert_called_once_with(group="g")


# A protocol registered at run time works with every command, and is exact without noise.


SCENARIO = "scenarios/noiseless.toml"


def command(*words):
    """Run a command in this process, which has registered the protocol; return its output."""
    return processes.succeed(*words).stdout


@pytest.fixture(params=[SYMMETRIC, TARGETS], ids=lambda row: row.name)
def row(request):
    register_protocol(request.param)
    yield request.param
    PROTOCOLS.remove(request.param.name)


@pytest.mark.parametrize("delays", [(0.0, 0.0), (0.8, 0.0), (0.0, -0.5)])
def test_simulated_ranges_are_exact_up_to_skew_and_planted_delays(row, delays):
    error = calibrated_error_m(bench(row.name, (5.0, -5.0), delays=delays, n=200))
    assert len(error) == 200
    # Whole ticks of 4.7 mm, with weights up to 1.2, partly averaged; a flight of 10 ns is longer by 5e-14 s by its
    # skew.
    assert np.abs(error).max() < 0.012
    assert abs(np.mean(error)) < 0.0015


def test_prediction_and_monte_carlo_agree_with_each_other_and_with_the_formula(row):
    one = Conditions.single(
        flight=5 / SPEED_OF_LIGHT, rate=(5e-6, -5e-6), at_once=305e-6, scheduled=1538.7e-6,
        quantize=False,
    )  # fmt: skip
    quiet = predict(row, one)
    assert abs(quiet.mean_m[0]) < 5e-5
    assert range_errors_m(row, one, 1, 1)[0] == pytest.approx(quiet.mean_m[0], abs=1e-6)
    noisy = one.with_columns(rx_std=150e-12)[np.zeros(16_384, dtype=np.int64)]
    errors = range_errors_m(row, noisy, 2, 200_000)
    # 200,000 errors determine their standard deviation to 0.16 %.
    assert errors.std() == pytest.approx(np.sqrt(predict(row, noisy).variance_m2[0]), rel=0.01)


def test_run_show_and_fit(row, tmp_path):
    flight, fitted = tmp_path / "flight.uwb", tmp_path / "c.json"
    settings = ["--set", f"ranging.protocol={row.name}", "--set", "run.duration_s=60", "--no-contention"]
    command("uwbsim", "run", SCENARIO, "-o", flight, *settings)
    assert set(json.loads(command("uwblink", "show", flight, "--json"))["protocols"]) == {row.name}
    command("calib", "fit", flight, "-o", fitted)
    flown = load(flight)
    assert set(flown.exchanges.protocol.tolist()) == {row.name}
    # The scenario has no bias; 60 s of noiseless stamps leave a picosecond, and a small variation of the spline.
    assert json.loads(fitted.read_text())["delays_ns"] == pytest.approx(flown.meta["planted"]["delays_ns"], abs=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("row", [SYMMETRIC], indirect=True)
def test_compare_optimum_and_predict_support_a_new_protocol(row, tmp_path, monkeypatch):
    monkeypatch.setattr("uwblink.pages.figures.drawn", pages.outline)
    compared = json.loads(command("uwbsim", "compare", SCENARIO, "-o", tmp_path / "out", "-n", 256, "--json"))
    assert [line["protocol"] for line in compared["protocols"]] == list(PROTOCOLS)
    page = (tmp_path / "out" / "compare.html").read_text()
    assert row.title in page or row.name in page
    best = json.loads(command("uwbsim", "optimum", SCENARIO, "--json"))
    assert [line["protocol"] for line in best] == list(PROTOCOLS)
    said = json.loads(command("uwbsim", "predict", "--protocol", row.name, "--json"))
    assert (said["title"], said["std_m"] > 0) == (row.title, True)


def test_schema_and_summary_contain_the_new_protocol(row):
    assert row.name in json.loads(command("uwbsim", "schema"))["$defs"]["Ranging"]["properties"]["protocol"]["enum"]
    assert row.title in command("uwbsim", "validate", SCENARIO, "--set", f"ranging.protocol={row.name}")
