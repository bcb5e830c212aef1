"""The command line names options where the library names parameters, and makes the fit's options of its settings."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer

import calib
from calib.calibration.power_curves import ALPHA_DBM, LIFTS
from calib.cli.commands import app
from calib.cli.shared import with_flags
from calib.settings import FitSettings
from docs.site.commands import leaves
from tests import processes

ROOT = Path(__file__).parents[3]
COMMANDS: Any = typer.main.get_command(app)
OPTIONS = {o for _, command in leaves(COMMANDS, ("calib",)) for parameter in command.params for o in parameter.opts}
# Not options: the power of the lifting, which all calibrations share, and what only functions take.
ONLY_FROM_PYTHON = {
    *("alpha_dbm", "data", "truth_m", "range_m", "target", "weights", "protocol", "name", "before", "section"),
    *("shares", "start_m", "information", "loosest", "boards", "robots"),
    # Named by the command itself, as its own option.
    *("seconds", "speed_m_s", "apart_m", "still_s", "noise_m", "size_m", "rate_hz", "tape_sigma_m", "anchor_sigma_m"),
    "anchor_places",
}


def test_every_parameter_that_an_error_names_has_its_option():
    named = set()
    for path in (ROOT / "calib").rglob("*.py"):
        named |= set(re.findall(r'(?:parameter=|check_choice\()"([a-z_0-9]+)"', path.read_text()))
    assert {"fixed_ns", "groups", "loss", "tag", "to"} <= named
    assert {with_flags(f"`{name}`") for name in named - ONLY_FROM_PYTHON} <= OPTIONS


def test_other_text_stays_as_it_is():
    assert (
        with_flags("a `Path` and -0.5, `minimum_norm` and `fixed_ns`") == "a `Path` and -0.5, --minimum-norm and --fix"
    )


def test_settings_know_what_the_curves_know():
    assert {one.name: set(one.metadata.get("names", ())) for one in fields(FitSettings)}["lift"] == set(LIFTS)
    assert FitSettings().alpha_dbm == ALPHA_DBM


def test_settings_and_keywords_make_the_same_fit():
    flight = calib.sample_flight()
    by_name = calib.fit(flight, loss="huber", fixed_ns={1: -0.3}).calibration
    assert calib.fit(flight, FitSettings(loss="huber"), fixed_ns={1: -0.3}).calibration == by_name
    assert by_name.provenance["settings"] == {"loss": "huber", "fixed_ns": {"1": -0.3}}
    assert "settings" not in calib.fit(flight).calibration.provenance
    with pytest.raises(TypeError, match="los"):
        calib.fit(flight, los="huber")


def test_a_fit_repeats_its_settings(tmp_path):
    flight, made = tmp_path / "f.uwb", tmp_path / "c.json"
    for line in (
        ["sample", "-o", flight, "-n", 300],
        ["fit", flight, "-o", made, "--loss", "huber", "--fix", "1=-0.3"],
    ):
        processes.succeed("calib", *line)
    assert "settings: loss = huber, fixed_ns = {'1': -0.3}" in processes.run("calib", "show", made).stdout
