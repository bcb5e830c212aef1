"""One word means one thing: the names of public classes and of constants, in all packages together."""

import ast
from collections import defaultdict

from tests.rooms import PACKAGES, ROOT


def defined(source):
    """Yield the names of public classes and constants that a module defines, those in tuples included."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef):
            yield node.name
        for part in ast.walk(node) if isinstance(node, ast.Assign | ast.AnnAssign) else ():
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store) and part.id.isupper():
                yield part.id


def twice(sources):
    """Return the names that several modules define, with the modules."""
    found = defaultdict(list)
    for path, source in sources.items():
        for name in defined(source):
            found[name].append(path)
    return {name: paths for name, paths in found.items() if len(paths) > 1 and not name.startswith("_")}


def test_no_two_modules_give_one_name_to_a_class_or_a_constant():
    assert twice({path: path.read_text() for package in PACKAGES for path in (ROOT / package).rglob("*.py")}) == {}


def test_a_name_of_two_things_is_seen():
    sources = {
        "uwblink/a.py": "class Track: ...\nclass _Own: ...\nLEAST, MOST = 1, 2",
        "calib/b.py": "class Track: ...\nclass _Own: ...\nMOST: Final = 5\nTABLE[LEAST] = 1",
    }
    assert twice(sources) == {"Track": [*sources], "MOST": [*sources]}


# What stands in one place only: constants and the robust spread.


FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]

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
