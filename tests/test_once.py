"""What stands in one place only: constants, the robust spread, and the flags of commands."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [path for package in ("uwblink", "uwbsim", "calib") for path in sorted((ROOT / package).rglob("*.py"))]

# Numbers that every formula takes from one module: in air, in a vacuum, and what makes a median deviation a sigma.
HOMES = {
    299_702_547.0: "uwblink/ticks.py",
    299_792_458.0: "calib/doctor/timestamps.py",
    1.4826: "calib/spread.py",
}


def numbers(source):
    return {
        node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant) and node.value in HOMES
    }


@pytest.mark.parametrize("number", sorted(HOMES))
def test_a_constant_is_written_once(number):
    places = [path for path in FILES if number in numbers(path.read_text(encoding="utf-8"))]
    assert [path.relative_to(ROOT).as_posix() for path in places] == [HOMES[number]]


def flags_in_texts(source):
    """Return the texts of a module that speak of a flag, other than docstrings and whole commands."""
    tree = ast.parse(source)
    # Docstrings stand alone, as those of variables do.
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
    ]
    # A text that names a command may name its flags, as in 'uwblink poses --offset'; names of style sheets are none.
    flags = re.compile(r"(?<![-\w])--[a-z][-a-z]+")
    allowed = re.compile(r"\b(uwblink|uwbsim|calib) [a-z]|:root \{")
    return [text for text in texts if flags.search(text) and not allowed.search(text)]


def test_libraries_speak_of_parameters_and_only_commands_of_flags():
    found = {
        path.relative_to(ROOT).as_posix(): flags_in_texts(path.read_text(encoding="utf-8"))
        for path in FILES
        if "cli" not in path.parts
    }
    assert {name: texts for name, texts in found.items() if texts} == {}


def test_the_walk_sees_a_flag_and_leaves_commands_alone():
    assert flags_in_texts("raise E(f'{x}: exists; give --force')") == [": exists; give --force"]
    assert flags_in_texts("'''Doc: --force.'''\nx = \"shift the poses with 'uwblink poses --offset'\"") == []


def test_no_package_starts_a_command():
    """A sweep that ran calib as a process went past the import rule; functions are handed in instead."""
    starts = re.compile(
        r"^\s*(import|from) (subprocess|multiprocessing\.subprocess)|os\.system\(|os\.spawn", re.MULTILINE
    )
    assert [path.name for path in FILES if starts.search(path.read_text(encoding="utf-8"))] == []
