"""Rows of other distributions: installed by pip into a folder of their own, and used through the commands."""

import json
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint

import pytest

from tests import processes
from uwblink.errors import ArgumentError, PluginWarning
from uwblink.plugins import Registry

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "strange-ranging"
version = "1.0"

[project.entry-points."uwbcal.protocols"]
strange = "strange_ranging:PROTOCOL"
broken = "strange_ranging:NOTHING"

[project.entry-points."uwbcal.importers"]
strange = "strange_ranging:IMPORTERS"

[project.entry-points."uwbcal.losses"]
welsch = "strange_ranging.losses:WELSCH"
bad = "strange_ranging.losses:BAD"

[tool.hatch.build.targets.wheel]
packages = ["strange_ranging"]
"""
MODULE = """
import numpy as np

from uwblink import Contents, Exchanges
from uwblink.importers import Importer
from uwblink.protocols.table import ProtocolMessage, RangingProtocol


def flight_ticks(t):
    return (t.dt41 * t.dt53 / t.dt64 - t.dt32) / 2


def delay_weights(t):
    return t.dt53 / t.dt64 / 2, np.full_like(t.dt41, 0.5)


PROTOCOL = RangingProtocol(
    "strange-ds",
    "DS-TWR of a stranger",
    (
        ProtocolMessage("initiator", "", "at once"),
        ProtocolMessage("target", "rx1", "at once"),
        ProtocolMessage("target", "tx2", "scheduled"),
    ),
    flight_ticks,
    delay_weights,
)


def read(source, _map):
    columns = np.loadtxt(source, dtype=np.int64, unpack=True, ndmin=2)
    names = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
    stamps = dict(zip(names, columns[2:], strict=True))
    return Contents(exchanges=Exchanges.from_arrays(*columns[:2], **stamps, protocol="strange-ds"))


IMPORTERS = [Importer("eight", (".eight",), read, "Import eight numbers a line.")]
"""
LOSSES = """
import numpy as np
from calib.estimator.losses import RobustLoss


def weights(u):
    weight = np.exp(-(u**2) / 2)
    return weight, weight * (1 - u**2)


WELSCH = RobustLoss("welsch", weights)
BAD = RobustLoss("bad", lambda u: (u, u))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The environment of a process that has the distribution."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    (source / "strange_ranging").mkdir()
    (source / "pyproject.toml").write_text(PROJECT)
    (source / "strange_ranging" / "__init__.py").write_text(MODULE)
    (source / "strange_ranging" / "losses.py").write_text(LOSSES)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    pip += ["--disable-pip-version-check", "--target", str(site), str(source)]
    subprocess.run(pip, check=True, capture_output=True, text=True)
    return os.environ | {"PYTHONPATH": str(site)}


@pytest.fixture
def run(installed):
    """Runs a command in a process that finds the distribution."""
    return partial(processes.run, env=installed, timeout=300)


WARNING = (
    "warning: plug-in 'broken' of strange-ranging (group uwbcal.protocols) is left out: "
    "AttributeError: module 'strange_ranging' has no attribute 'NOTHING'\n"
)


def test_protocol_and_loss_of_another_distribution_are_simulated_and_fitted_with(run, tmp_path):
    flight = tmp_path / "f.uwb"
    settings = ("--set", "ranging.protocol=strange-ds", "--set", "run.duration_s=30")
    done = run("uwbsim", "run", "scenarios/noiseless.toml", "-o", flight, *settings)
    assert (done.returncode, done.stderr) == (0, WARNING)
    done = run("calib", "fit", flight, "-o", tmp_path / "c.json", "--loss", "welsch")
    assert done.returncode == 0, done.stderr
    assert "'bad' of strange-ranging (group uwbcal.losses) is left out" in done.stderr
    document = json.loads((tmp_path / "c.json").read_text())
    assert document["loss"] == "welsch"
    found = document["delays_ns"]
    planted = {"1": -0.36, "2": -0.01, "3": 0.24, "4": -0.36}
    assert {tag: found[tag] for tag in planted} == pytest.approx(planted, abs=5e-3)


@pytest.mark.slow
def test_workers_in_other_processes_know_it_too(run, tmp_path):
    (tmp_path / "s.toml").write_text(
        '[sweep]\nscenario = "noiseless"\nprotocols = ["strange-ds"]\n'
        "ranges = 1000\nseeds = [1, 2]\n[vary]\n'radio.rx_noise_ps' = [100.0, 200.0]\n"
    )
    done = run("uwbsim", "sweep", tmp_path / "s.toml", "-o", tmp_path / "out", "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "results.csv").read_text().count("strange-ds") == 4


def test_the_importer_of_another_distribution_is_a_command_and_without_it_its_recordings_say_so(run, tmp_path):
    (tmp_path / "t.eight").write_text("1 2 0 5 1005 3000 99005 101000\n")
    done = run("uwblink", "import", "eight", tmp_path / "t.eight", "-o", tmp_path / "t.uwb")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 't.uwb'}: 1 exchanges\n"), done.stderr
    shown = json.loads(run("uwblink", "show", tmp_path / "t.uwb", "--json").stdout)
    assert shown["protocols"] == {"strange-ds": 1}
    told = processes.refuse("uwblink", "show", tmp_path / "t.uwb")
    assert told.startswith(f"error: {tmp_path / 't.uwb'}: exchanges of an unknown protocol; known are ss, ")


@pytest.mark.parametrize("command", ["uwblink", "uwbsim", "calib"])
def test_help_loads_no_plug_in(run, command):
    done = run(command, "--help")
    assert (done.returncode, done.stderr) == (0, "")


@dataclass(frozen=True)
class Row:
    name: str
    value: int = 0


def check(row):
    if not isinstance(row, Row):
        raise ArgumentError(f"row: found {row!r}, expected a Row")


@pytest.fixture
def table(monkeypatch):
    """A table with one row of its own, and entry points that name rows, a list of them, and mistakes."""
    entries = [EntryPoint(f"e{k}", f"tests.test_plugins:{name}", "g") for k, name in enumerate(ENTRIES)]
    asked = []

    def entry_points(*, group):
        asked.append(group)
        return entries

    monkeypatch.setattr("importlib.metadata.entry_points", entry_points)
    table: Registry[Row] = Registry("row", "g", [Row("own")], check)
    return table, asked


ONE = Row("one")
MANY = [Row("two"), Row("three")]
TWICE = Row("one", 2)
MINE = Row("own", 2)
STRANGE = "text"
ENTRIES = ("ONE", "MANY", "TWICE", "MINE", "STRANGE", "ABSENT")


def test_entry_points_are_loaded_once_and_only_when_they_are_needed(table):
    registry, asked = table
    assert (registry["own"].value, [row.name for row in registry.known()], asked) == (0, ["own"], [])
    with pytest.warns(PluginWarning) as caught:
        assert list(registry) == ["own", "one", "two", "three"]
    texts = [str(w.message) for w in caught]
    assert len(texts) == 4
    assert all(text.count("\n") == 0 and "(group g) is left out: " in text for text in texts)
    assert "'one': is registered already" in texts[0]
    assert "'own': is one of the project's own" in texts[1]
    assert "row: found 'text', expected a Row" in texts[2]
    assert "AttributeError: " in texts[3]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "nothing" not in registry
        assert len(registry) == 4
    assert asked == ["g"]


def test_a_name_that_is_not_among_the_known_is_looked_for(table):
    registry, asked = table
    with pytest.warns(PluginWarning):
        assert registry["three"] is MANY[1]
    assert asked == ["g"]
