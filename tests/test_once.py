"""What stands in one place only: constants and the robust spread."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = [path for package in ("uwblink", "uwbsim", "calib") for path in sorted((ROOT / package).rglob("*.py"))]

# Numbers that every formula takes from one module: in air, in a vacuum, and what makes a median deviation a sigma.
HOMES = {
    299_702_547.0: "uwblink/ticks.py",
    299_792_458.0: "calib/checks/columns.py",
    1.4826: "calib/spread.py",
}


def numbers(source):
    return {
        node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant) and node.value in HOMES
    }


def test_constants_are_written_once():
    found = [(number, path) for path in FILES for number in numbers(path.read_text(encoding="utf-8"))]
    assert sorted((number, path.relative_to(ROOT).as_posix()) for number, path in found) == sorted(HOMES.items())
