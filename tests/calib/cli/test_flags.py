"""The command line speaks of flags where the library speaks of parameters."""

import re
from pathlib import Path
from typing import Any

import pytest
import typer

from calib.cli.commands import app
from calib.cli.flags import with_flags
from calib.estimation.arguments import FitSettings

ROOT = Path(__file__).parents[3]
COMMANDS: Any = typer.main.get_command(app)
OPTIONS = {
    option for command in COMMANDS.commands.values() for parameter in command.params for option in parameter.opts
}
# A reference power of the lifting is not an option: the calibrations of all commands share the published one.
ONLY_FROM_PYTHON = {
    "alpha_dbm",
    "data",
    "truth_m",
    "range_m",
    "target",
    "weights",
    "protocol",
    "name",
    "before",
    "section",
    "shares",
    "start_m",
    "information",
    "loosest",
    "boards",
    "robots",
}


@pytest.mark.parametrize("parameter", sorted(set(FitSettings.__annotations__) - ONLY_FROM_PYTHON))
def test_every_setting_of_a_fit_has_its_flag(parameter):
    assert with_flags(f"`{parameter}`") in OPTIONS


def test_every_parameter_that_an_error_names_has_its_flag():
    named = set()
    for path in (ROOT / "calib").rglob("*.py"):
        named |= set(re.findall(r'(?:parameter=|check_choice\()"([a-z_0-9]+)"', path.read_text()))
    assert {"fixed_ns", "groups", "loss", "tag", "to"} <= named
    assert {with_flags(f"`{name}`") for name in named - ONLY_FROM_PYTHON} <= OPTIONS


def test_every_parameter_that_a_warning_names_has_its_flag():
    said = ["surveys/saying", "estimation/warnings", "estimation/limits", "estimation/confounding"]
    texts = [(ROOT / "calib" / f"{name}.py").read_text() for name in said]
    named = {name for text in texts for name in re.findall(r'^ +f?"[^"\n]*`([a-z_0-9]+)`', text, re.MULTILINE)}
    assert {"known", "delays_only"} <= named
    assert {with_flags(f"`{name}`") for name in named} <= OPTIONS


def test_the_library_does_not_speak_of_flags():
    for path in (ROOT / "calib").rglob("*.py"):
        if "cli" in path.parts:
            continue
        texts = re.findall(r'"[^"\n]*?(?<![-\w])--[a-z][-a-z]+[^"\n]*"', path.read_text())
        # Docstrings and remedies may name a whole command.
        assert [text for text in texts if "uwblink" not in text and "`calib " not in text] == [], path


def test_other_text_stays_as_it_is():
    assert (
        with_flags("a `Path` and -0.5, `minimum_norm` and `fixed_ns`") == "a `Path` and -0.5, --minimum-norm and --fix"
    )
