"""What the three commands share: errors as one line, statuses, warnings of plug-ins, flags for parameters."""

import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import typer

from uwblink.cli import shared
from uwblink.cli.commands import app
from uwblink.errors import PluginWarning, RecordingError

ROOT = Path(__file__).parents[3]


class MineError(Exception):
    """An error of another package."""


class WorseError(MineError):
    """One with a status of its own."""


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (None, 0, ""),
        (RecordingError("f.uwb: exists; or `force` and `map_file`"), 2, "error: f.uwb: exists; or --force and --map\n"),
        (MineError("mine"), 2, "error: mine\n"),
        (WorseError("worse"), 1, "error: worse\n"),
        (MineError("a\nb\x1b[31m \ud800"), 2, "error: a\\nb\\x1b[31m \\ud800\n"),
        (OSError(36, "File name too long", "aaa"), 2, "error: aaa: File name too long\n"),
        (MemoryError(), 2, "error: not enough memory for that; nothing was written\n"),
    ],
)
def test_an_error_is_one_line_and_a_status(error, code, line, capsys):
    app = shared.new_app("Try.")

    @app.command()
    def fail() -> None:
        if error:
            raise error

    with pytest.raises(SystemExit) as end:
        shared.run(app, MineError, statuses={WorseError: 1}, arguments=["fail"])
    assert end.value.code == code
    assert capsys.readouterr().err == line


def test_numbers_beyond_numbers_are_an_error_and_not_a_result(capsys):
    app = shared.new_app("Try.")

    @app.command()
    def fail() -> None:
        print((np.array([1e300]) * 1e300)[0])

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        with pytest.raises(SystemExit) as end:
            shared.run(app, arguments=["fail"])
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: numbers beyond what can be computed with (overflow")


def test_an_error_of_nobody_is_not_swallowed():
    app = shared.new_app("Try.")

    @app.command()
    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        shared.run(app, arguments=["fail"])


def test_only_warnings_of_plug_ins_become_lines(capsys):
    app = shared.new_app("Try.")

    @app.command()
    def warn() -> None:
        warnings.simplefilter("always")
        warnings.warn("left out", PluginWarning, stacklevel=1)
        warnings.warn("other", UserWarning, stacklevel=1)

    with pytest.warns(UserWarning, match="other") as caught, pytest.raises(SystemExit):
        shared.run(app, arguments=["warn"])
    assert [str(w.message) for w in caught] == ["other"]
    assert capsys.readouterr().err == "warning: left out\n"


@pytest.mark.parametrize("package", ["uwblink", "uwbsim", "calib"])
def test_python_m_is_the_command(package):
    found = subprocess.run([sys.executable, "-m", package, "--version"], capture_output=True, text=True, check=True)
    first, beside = found.stdout.splitlines()
    assert re.fullmatch(package + r" [0-9]+\.[0-9]+\.[0-9]+", first)
    assert re.fullmatch(r"Python 3\.[0-9.]+, numpy [0-9.]+, .*duckdb [0-9.]+, .*", beside)


def test_the_library_speaks_of_parameters_and_each_has_its_flag():
    group = typer.main.get_command(app)
    options = {o for command in group.commands.values() for p in command.params for o in p.opts}  # type: ignore[attr-defined]
    options |= {"--map"}  # of `import csv`
    named = set()
    for path in (ROOT / "uwblink").rglob("*.py"):
        if "cli" in path.parts:
            continue
        text = re.sub(r'""".*?"""', "", path.read_text(), flags=re.DOTALL)
        assert re.findall(r'"[^"\n]*?(?<![-\w])--[a-z][-a-z]+[^"\n]*"', text) == [], path
        named |= set(re.findall(r'"[^"\n]*`([a-z_]+)`', text))
    assert {"force", "offset", "map_file", "tags_from"} <= named
    named -= {
        "message",
        "time_s",
        "line",
    }  # columns of tables and keys of maps, of which the descriptions of map keys speak
    assert {shared.with_flags(f"`{name}`") for name in named} <= options
