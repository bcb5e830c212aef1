"""Help as people see it in a terminal of 80 columns: whole texts, panels, examples that parse, completion."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.text import Text

import calib
import uwbsim
from calib.cli.commands import app as calib_app
from calib.cli.judging import spread_tests
from tests import processes
from uwblink.cli.commands import app as uwblink_app
from uwbsim.cli.commands import app as uwbsim_app

APPS = {"uwblink": uwblink_app, "uwbsim": uwbsim_app, "calib": calib_app}
COMMANDS: dict[str, Any] = {name: typer.main.get_command(app) for name, app in APPS.items()}
BIN = Path(sys.executable).parent


def leaves(group: Any, path: list[str]):
    """Yield every command below a group, with the words that call it."""
    context = group.make_context(path[-1], [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        words = [*path, name]
        yield words, command
        if hasattr(command, "list_commands"):
            yield from leaves(command, words)


EVERY = [one for name, command in COMMANDS.items() for one in leaves(command, [name])]
NAMES = [" ".join(words) for words, _ in EVERY]


@pytest.fixture(scope="module", autouse=True)
def _terminal_of_80_columns():
    from typer import rich_utils

    before = rich_utils.MAX_WIDTH
    rich_utils.MAX_WIDTH = 80
    yield
    rich_utils.MAX_WIDTH = before


def shown(command, words, capsys):
    context = command.make_context(" ".join(words), [], resilient_parsing=True)
    text = command.get_help(context)
    return text + capsys.readouterr().out


def words_of(text):
    return re.findall(r"[\w.\[\]=-]+", Text.from_markup(text).plain)


@pytest.mark.parametrize(("words", "command"), EVERY, ids=NAMES)
def test_help_fits_80_columns_and_loses_no_word(words, command, capsys):
    text = shown(command, words, capsys)
    assert max(map(len, text.splitlines())) <= 80
    seen = re.sub(r"[│╭╮╰╯─]", " ", text)
    for told in [command.help, *(getattr(p, "help", None) for p in command.params)]:
        assert Text.from_markup(told or "").plain == (told or "").replace("\\[", "["), (
            "brackets that rich takes for markup"
        )
        missing = [word for word in words_of(told or "") if word not in seen]
        assert missing == [], told
    assert not re.search(r"\\\[", text)
    assert "<bool>" not in text, "a flag takes no value"


@pytest.mark.parametrize(
    ("words", "new"),
    [
        ("calib sample --anchors", "--anchors is now --with-anchors"),
        ("calib survey f.uwb --anchors=a.toml", "--anchors is now --save-anchors"),
        ("calib survey f.uwb --arrangement B", "--arrangement is now a part of --save-anchors NAME=FILE"),
        ("calib export c.json --to registers --base f.uwb", "--base is now --antenna-delays"),
        ("calib plan survey 4 --anchors 1,2", "--anchors is now --anchor-tags"),
        ("calib plan flight 4 --seconds 60", "--seconds is now --duration"),
        ("calib plan 4 --on line", "calib plan is now calib plan survey"),
        ("calib plan --on flight 4", "calib plan is now calib plan survey"),
    ],
)
def test_old_names_are_answered_with_the_new_ones(words, new, tmp_path):
    done = processes.run(*words.split(), "-o", tmp_path / "x.uwb")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {new}")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("words", "command"), EVERY, ids=NAMES)
def test_every_command_has_an_example_that_parses(words, command):
    lines = [line.strip() for line in Text.from_markup(command.epilog).plain.splitlines()[1:]]
    examples = [line for line in lines if line]
    assert examples
    for line in examples:
        said = spread_tests(shlex.split(line.partition(" > ")[0]))
        assert said[: len(words)] == words
        deeper = command
        rest = said[len(words) :]
        while hasattr(deeper, "get_command"):
            context = deeper.make_context(rest[0], [], resilient_parsing=True)
            deeper, rest = deeper.get_command(context, rest[0]), rest[1:]
        deeper.make_context(line, rest)


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_stand_in_panels(name, capsys):
    top = COMMANDS[name]
    context = top.make_context(name, [], resilient_parsing=True)
    for command in top.list_commands(context):
        assert isinstance(top.get_command(context, command).rich_help_panel, str), command


def completed(words, cwd=None):
    """What a shell is told where it asks for what may follow `words`."""
    name = words[0]
    line = " ".join(words)
    environment = os.environ | {
        f"_{name.upper()}_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
    }
    done = subprocess.run([BIN / name], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_shell_completes_commands_and_names(tmp_path):
    assert "localize" in completed(["calib", "lo"])
    assert {"cauchy"} == set(completed(["calib", "fit", "x.uwb", "--loss", "ca"]))
    assert {"ds", "ds-alt", "ds-sym"} == set(completed(["uwbsim", "predict", "--protocol", "ds"]))
    assert {"ss,ds", "ss,ds-alt", "ss,ds-sym"} == set(
        completed(["uwbsim", "optimum", "x.toml", "--protocols", "ss,ds"])
    )


def test_a_shell_completes_the_tags_of_a_recording(tmp_path):
    world = {"run": {"duration_s": 0.2}, "ranging": {"rate_hz": 50}}
    world["bodies"] = [
        {"name": str(tag), "motion": {"model": "static", "position_m": [float(tag), 0.0, 1.0]}} for tag in (1, 7, 71)
    ]
    world["tags"] = [{"id": tag, "body": str(tag)} for tag in (1, 7, 71)]
    uwbsim.simulate(uwbsim.load(world)).save(tmp_path / "f.uwb")
    told = completed(["calib", "add-tag", "f.uwb", "-c", "c.json", "--tag", "7"], tmp_path)
    assert told == ["7", "71"]
    assert completed(["calib", "fit", "f.uwb", "--fix", "1"], tmp_path) == ["1="]
    assert completed(["calib", "fit", "absent.uwb", "--fix", "1"], tmp_path) == []


def test_what_the_help_lists_is_what_the_packages_know():
    from calib.fitting import known_losses
    from uwblink import PROTOCOLS
    from uwblink.exporters import EXPORTERS

    parameters = {
        (" ".join(words), p.name): p.metavar.replace(" ", "").split("|")
        for words, c in EVERY
        for p in c.params
        if p.metavar and "|" in p.metavar
    }
    assert set(known_losses()) == set(parameters["calib fit", "loss"])
    assert set(parameters["uwbsim predict", "protocol"]) == set(PROTOCOLS)
    assert set(parameters["uwblink export", "to"]) == set(EXPORTERS)
    known = calib.fit(calib.sample_flight()).calibration
    for form in parameters["calib export", "to"]:
        assert calib.export(known, form)


def test_completion_installs_itself(tmp_path):
    environment = os.environ | {
        "HOME": str(tmp_path),
        "SHELL": "/bin/bash",
        "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1",
    }
    install = [str(BIN / "calib"), "--install-completion", "bash"]
    done = subprocess.run(install, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "calib" in (tmp_path / ".bashrc").read_text()
