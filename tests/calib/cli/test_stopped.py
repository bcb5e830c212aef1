"""A fit that stopped before it settled says so wherever its calibration goes, and does not end as if all were well."""

import json

import pytest
from typer.testing import CliRunner

import calib
from calib.cli.commands import app
from calib.estimator import optimize
from uwblink import Contents


@pytest.fixture
def flight(tmp_path):
    some = calib.sample_flight()
    Contents(exchanges=some.exchanges, poses=some.poses, tags=some.tags).save(tmp_path / "flight.uwb")
    return tmp_path / "flight.uwb"


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def stopped(flight, monkeypatch, tmp_path):
    monkeypatch.setattr(optimize, "MOST_STEPS", 2)
    return run("fit", flight, "-o", tmp_path / "c.json"), tmp_path / "c.json"


def test_the_command_writes_it_marks_it_and_ends_with_1(stopped, flight, tmp_path):
    done, path = stopped
    assert done.exit_code == 1
    assert "stopped after" in done.stdout
    assert "before it settled" in done.stderr
    assert json.loads(path.read_text())["provenance"]["converged"] is False
    assert "NOT SETTLED" in repr(calib.load_calibration(path))
    as_json = run("fit", flight, "-o", tmp_path / "d.json", "--json")
    assert as_json.exit_code == 1
    assert json.loads(as_json.stdout)["provenance"]["converged"] is False


def test_commands_that_use_it_warn(stopped, flight, tmp_path):
    path = stopped[1]
    for words in (
        ("apply", flight, "-c", path, "-o", tmp_path / "corrected.uwb"),
        ("evaluate", flight, "-c", path),
        ("export", path, "--to", "csv"),
        ("compare", path, path),
    ):
        done = run(*words)
        assert done.exit_code == 0, done.output
        assert "stopped before it settled" in done.stderr, words[0]
    assert "NOT SETTLED" in run("show", path).stdout


def test_a_fit_that_settled_is_quiet(flight, tmp_path):
    done = run("fit", flight, "-o", tmp_path / "c.json")
    assert done.exit_code == 0
    assert (
        "settled" not in done.stderr + run("apply", flight, "-c", tmp_path / "c.json", "-o", tmp_path / "d.uwb").stderr
    )
