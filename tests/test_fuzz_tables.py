"""The tables of the fuzzer hold today's commands and options."""

import shlex

import pytest

from tests.fuzz.options import command_of, commands
from tests.fuzz.seeds import KINDS

LINES = sorted({line for kind in KINDS for line in (*kind.commands, *kind.seldom)})
OF_BOARDS = {f"uwblink {name}" for name in ("ports", "info", "twr", "test", "passive", "send", "cir", "set-delay")}
OF_BOARDS |= {"uwblink record"}
"""Commands that do nothing without boards, which `test_bad_input.py` and the decoder's fuzzer try."""

OF_FOLDERS = {"uwblink import miluv"}
"""Of whose files `tests/uwblink/importers/test_miluv.py` damages each."""


@pytest.mark.parametrize("line", LINES)
def test_every_line_is_one_that_its_command_takes(line):
    words = shlex.split(line.replace("{}", "file").replace("{", "").replace("}", ""))
    name = command_of(words)
    assert commands()[name].make_context(name, words[len(name.split()) :])


def test_every_command_has_a_line():
    assert {command_of(line.split()) for line in LINES} == set(commands()) - OF_BOARDS - OF_FOLDERS
