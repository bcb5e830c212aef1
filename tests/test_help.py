"""Help on a terminal of 80 columns: complete texts, panels, examples that parse, completion, speed."""

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from typing import Any

import pytest
import typer
from rich.text import Text
from typer import rich_utils

import calib
import uwblink
import uwbsim
from calib.cli.judging import spread_tests
from calib.cli.shared import with_flags
from calib.fitting import known_losses
from tests import processes
from uwblink.cli import shared
from uwblink.exporters import EXPORTERS
from uwbsim.cli.commands import UWBSIM_FLAGS

COMMANDS: dict[str, Any] = {
    name: typer.main.get_command(importlib.import_module(f"{name}.cli.commands").app)
    for name in ("uwblink", "uwbsim", "calib")
}


def below(group: Any, path: list[str]):
    """Yield every command below a group, with the words that call it."""
    context = group.make_context(path[-1], [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        yield [*path, name], command
        if hasattr(command, "list_commands"):
            yield from below(command, [*path, name])


EVERY = [one for name, command in COMMANDS.items() for one in below(command, [name])]


def words_of(text):
    return re.findall(r"[\w.\[\]=-]+", Text.from_markup(text).plain)


@pytest.mark.parametrize(("words", "command"), EVERY, ids=[" ".join(words) for words, _ in EVERY])
def test_help_fits_80_columns_loses_no_word_and_has_examples_that_parse(words, command, capsys, monkeypatch):
    monkeypatch.setattr(rich_utils, "MAX_WIDTH", 80)
    context = command.make_context(" ".join(words), [], resilient_parsing=True)
    text = command.get_help(context) + capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    seen = re.sub(r"[│╭╮╰╯─]", " ", text)
    for told in [command.help, *(getattr(p, "help", None) for p in command.params)]:
        assert Text.from_markup(told or "").plain == (told or "").replace("\\[", "["), "brackets that are markup"
        assert [word for word in words_of(told or "") if word not in seen] == [], told
    # Brackets are not markup, and flags take no value.
    assert [wrong for wrong in ("\\[", "<bool>") if wrong in text] == []
    if len(words) == 2:
        assert isinstance(command.rich_help_panel, str), "commands stand in panels"
    examples = [line.strip() for line in Text.from_markup(command.epilog).plain.splitlines()[1:] if line.strip()]
    assert examples
    for line in examples:
        said = spread_tests(shlex.split(line.partition(" > ")[0]))
        assert said[: len(words)] == words
        deeper, rest = command, said[len(words) :]
        while hasattr(deeper, "get_command"):
            inner = deeper.make_context(rest[0], [], resilient_parsing=True)
            deeper, rest = deeper.get_command(inner, rest[0]), rest[1:]
        deeper.make_context(line, rest)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("calib fit", "calib fit: missing argument 'recordings'; see 'calib fit --help'"),
        ("calib fit f.uwb", "calib fit: missing option '-o' / '--output'; see 'calib fit --help'"),
        ("calib fit f.uwb -o", "option '-o' requires an argument"),
        ("calib doctor f.uwb --of", "calib doctor: no such option: --of"),
        ("uwblink show a b", "uwblink show: got unexpected extra argument(s) (b)"),
        ("uwblink import foo", "uwblink import: no such command 'foo'; see 'uwblink import --help'"),
        ("uwblink replay f.uwb --speed 0", "uwblink replay: invalid value for '--speed'"),
        ("uwbsim nonsense", "uwbsim: no such command 'nonsense'; see 'uwbsim --help'"),
        ("calib nonsense", "calib: no such command 'nonsense'"),
        ("uwblink nonsense", "uwblink: no such command 'nonsense'. Did you mean 'poses'?; see 'uwblink --help'"),
        *((f"{name} --nonsense", f"{name}: no such option: --nonsense") for name in COMMANDS),
    ],
)
def test_usage_errors_are_one_line(words, said):
    assert processes.refuse(*words.split()).startswith(f"error: {said}")


@pytest.mark.parametrize("words", ["calib", "uwblink import", "calib plan"])
def test_a_group_alone_prints_its_help(words):
    ended = processes.run(*words.split())
    assert (ended.returncode, ended.stderr) == (2, "")
    assert "Examples:" in ended.stdout or "Usage: calib" in ended.stdout


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
    assert processes.refuse(*words.split(), "-o", tmp_path / "x.uwb").startswith(f"error: {new}")
    assert not list(tmp_path.iterdir())


def completed(words, cwd):
    """Return the completions that a shell gets after `words`."""
    asked = {f"_{words[0].upper()}_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words)}
    asked["COMP_CWORD"] = str(len(words) - 1)
    return processes.succeed(words[0], cwd=cwd, env=os.environ | asked).stdout.split()


def test_a_shell_completes_commands_names_and_the_tags_of_a_recording(tmp_path):
    exchanges = uwblink.Exchanges.from_arrays([1, 7], [7, 71], range_m=[6.0, 64.0])
    tags = [uwblink.Tag(number, str(number), (0.0, 0.0, 0.0)) for number in (1, 7, 71)]
    uwblink.Contents(exchanges=exchanges, tags=tags).save(tmp_path / "f.uwb")
    for line, words in (
        ("calib lo", ["localize"]),
        ("calib fit x.uwb --loss ca", ["cauchy"]),
        ("uwbsim predict --protocol ds", ["ds", "ds-alt", "ds-sym"]),
        ("uwbsim optimum x.toml --protocols ss,ds", ["ss,ds", "ss,ds-alt", "ss,ds-sym"]),
        ("calib add-tag f.uwb -c c.json --tag 7", ["7", "71"]),
        ("calib fit f.uwb --fix 1", ["1="]),
        ("calib fit absent.uwb --fix 1", []),
    ):
        assert completed(line.split(), tmp_path) == words


def test_completion_installs_itself(tmp_path):
    home = {"HOME": str(tmp_path), "SHELL": "/bin/bash", "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    processes.succeed("calib", "--install-completion", "bash", env=os.environ | home)
    assert "calib" in (tmp_path / ".bashrc").read_text()


def test_help_lists_the_registered_names():
    parameters = {
        (" ".join(words), p.name): p.metavar.replace(" ", "").split("|")
        for words, c in EVERY
        for p in c.params
        if p.metavar and "|" in p.metavar
    }
    for command, option, known in (
        ("calib fit", "loss", known_losses()),
        ("uwbsim predict", "protocol", uwblink.PROTOCOLS),
        ("uwblink export", "to", EXPORTERS),
    ):
        assert set(parameters[command, option]) == set(known)
    fitted = calib.fit(calib.sample_flight()).calibration
    for form in parameters["calib export", "to"]:
        assert calib.export(fitted, form)


# Errors name parameters, and the command line the options for them: not those that only functions have, nor those of
# calib that its commands name themselves (those of plans), or that belong to ranges from arrays and their errors.
ONLY_FROM_PYTHON = {
    "calib": {
        *("alpha_dbm", "data", "truth_m", "range_m", "target", "weights", "protocol", "name", "before", "section"),
        *("shares", "start_m", "information", "loosest", "boards", "robots", "anchor_places", "reference"),
        *("seconds", "speed_m_s", "apart_m", "still_s", "noise_m", "size_m", "rate_hz", "tape_sigma_m"),
        *("anchor_sigma_m", "side", "odds", "features", "temperature_c"),
    },
    "uwbsim": {"effect", "source", "name", "evaluate", "lost_share"},
}


@pytest.mark.parametrize(
    ("package", "pattern", "known", "more", "flag", "spelled"),
    [
        (
            "calib",
            r'(?:parameter=|check_choice\()"([a-z_0-9]+)"',
            {"fixed_ns", "groups", "loss", "tag", "to"},
            set(),
            with_flags,
            list,
        ),
        (
            "uwbsim",
            r'parameter="([a-z_0-9]+)"',
            {"count", "overrides", "overhead_s", "workers"},
            set(uwbsim.State.__dataclass_fields__),
            lambda text: shared.with_flags(text, UWBSIM_FLAGS),
            lambda opts: ["/".join(opts)],
        ),
    ],
    ids=["calib", "uwbsim"],
)
def test_every_parameter_that_an_error_names_has_its_option(package, pattern, known, more, flag, spelled):
    named = set[str]()
    for path in (processes.ROOT / package).rglob("*.py"):
        named |= set(re.findall(pattern, path.read_text()))
    options = {o for words, command in EVERY if words[0] == package for p in command.params for o in spelled(p.opts)}
    assert known <= named
    assert {flag(f"`{name}`") for name in (named - ONLY_FROM_PYTHON[package]) | more} <= options


HEAVY = ["numpy", "scipy", "duckdb", "matplotlib", "simpy", "serial", "pandas", "pypdf", "rosbags"]
SCRIPT = """
import contextlib, importlib, io, json, sys

main, seen = importlib.import_module(sys.argv[1] + ".cli").main, []
for words, heavy in [(words, json.loads(sys.argv[3])) for words in json.loads(sys.argv[2])]:
    sys.argv = [*words, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        main()
    seen.append([len(text.getvalue()), [name for name in heavy if name in sys.modules]])
print(json.dumps(seen))
"""


@pytest.mark.slow
@pytest.mark.parametrize("package", COMMANDS)
def test_help_is_printed_before_anything_heavy_is_imported(package):
    """`uwblink import` lists the table of importers, plug-ins included, so its commands may import three of them."""
    called = [[package], *(words for words, _ in EVERY if words[0] == package)]
    assert len(called) > 5
    # Imports of one command remain for the next ones, so the importers come last.
    called.sort(key=lambda words: words[1:2] == ["import"])
    script = [sys.executable, "-c", SCRIPT, package, json.dumps(called), json.dumps(HEAVY)]
    seen = json.loads(subprocess.run(script, capture_output=True, text=True, check=True).stdout)
    for words, (length, loaded) in zip(called, seen, strict=True):
        assert length > 100, words
        assert set(loaded) <= ({"numpy", "scipy", "duckdb"} if words[1:2] == ["import"] else set()), words


# The three commands: versions, usage errors, Ctrl-C during their start; and forks behave as new processes do.


@pytest.mark.parametrize("package", ["uwbsim", "uwblink", "calib"])
@pytest.mark.parametrize("module", ["typer", "uwblink.cli.shared"])
def test_interrupted_while_it_is_imported(package, module):
    code = (
        "import os, signal, sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        f"from {package}.cli import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


@pytest.mark.parametrize(
    "words",
    [
        ("uwbsim", "validate", "scenarios/noiseless.toml"),
        ("calib", "fit", "nowhere.uwb", "-o", "c.json"),
        ("uwblink", "nonsense"),
        ("calib", "--help"),
    ],
)
def test_status_and_output_of_a_fork_are_those_of_a_new_process(words, monkeypatch):
    monkeypatch.chdir(processes.ROOT)
    plain = subprocess.run([processes.BIN / words[0], *words[1:]], capture_output=True, text=True)
    forked = processes.fork(*words)
    assert (forked.returncode, forked.stdout, forked.stderr) == (plain.returncode, plain.stdout, plain.stderr)
