"""The tables of the fuzzer have the present commands and options; and damaged calibrations."""

import functools
import re
import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

import calib
from tests.fuzz.options import command_of, commands
from tests.fuzz.seeds import KINDS

LINES = sorted({line for kind in KINDS for line in (*kind.commands, *kind.seldom)})
OF_BOARDS = {f"uwblink {name}" for name in ("ports", "info", "twr", "test", "passive", "send", "cir", "set-delay")}
OF_BOARDS |= {"uwblink record"}
"""Commands that do nothing without boards, which `test_bad_input.py` and `test_codec.py` test."""

OF_FOLDERS = {"uwblink import miluv"}
"""`tests/uwblink/importers/test_miluv.py` damages each of its files."""


@pytest.mark.parametrize("line", LINES)
def test_every_line_is_one_that_its_command_takes(line):
    words = shlex.split(line.replace("{}", "file").replace("{", "").replace("}", ""))
    name = command_of(words)
    assert commands()[name].make_context(name, words[len(name.split()) :])


def test_every_command_has_a_line():
    assert {command_of(line.split()) for line in LINES} == set(commands()) - OF_BOARDS - OF_FOLDERS


@functools.cache
def document():
    return calib.fit(calib.sample_flight(300)).calibration.to_json()


@given(st.integers(0, 2000), st.sampled_from(["null", "-1", "1e400", "NaN", '"x"', "[]", "{}", "true", "0", "1e300"]))
def test_a_damaged_calibration_is_read_again_the_same_or_refused_in_one_line(place, word):
    values = [*re.finditer(r"(?<=: )[^{}\[\],]+|-?[0-9][0-9.e-]*", document())]
    start, end = values[place % len(values)].span()
    try:
        found = calib.Calibration.from_json(document()[:start] + word + document()[end:])
        said, same = "", calib.Calibration.from_json(found.to_json()) == found
    except calib.CalibError as error:
        said, same = str(error), True
    assert ("\n" not in said, same) == (True, True)
