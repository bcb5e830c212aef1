"""The commands call nothing but what everybody may call: names of the front doors and of the doors of rooms."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("uwblink", "uwbsim", "calib")

ROOMS = {
    f"{package}.{room.name}"
    for package in PACKAGES
    for room in pkgutil.iter_modules(importlib.import_module(package).__path__)
    if room.ispkg
}

# What commands use beside doors, each with its reason.
BESIDE = {
    "uwblink.exporters.export_recording": "the front door offers no export yet",
    "uwblink.importers.guess.guess_map": "what import suggests where no map is given; read_source takes the map",
    "uwblink.__version__": "what --version prints",
    "uwblink.cli.start": "Ctrl-C while a command is being imported, and what must come before",
    "uwblink.settings": "fields of settings that Python and the command line share",
    "calib.settings": "the settings of a fit, of which its options are made",
    "uwblink.exporters.EXPORTERS": "names of the forms that a recording can leave in, for a shell to complete",
    "uwblink.cli.shared": "options, examples, completion, errors, interrupts and progress, alike in the three commands",
}


def offered(module):
    """What a front door or the door of a room (a module of the first level with `__all__`) offers."""
    return set(getattr(importlib.import_module(module), "__all__", ()))


def used(source):
    """Yield module and name of everything that a module takes from the three packages; "" for a module itself."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names if alias.name.split(".")[0] in PACKAGES)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Attribute):
            # `package.name`, and `package.room.name`, whose room is imported on first use.
            module, name = ast.unparse(node.value), node.attr
            if module in PACKAGES or module in ROOMS:
                yield module, name


def allowed(package, module, name):
    whole = f"{module}.{name}"
    if module in BESIDE or whole in BESIDE:
        return True
    if whole.startswith(f"{package}.cli.") or module == f"{package}.errors":
        return True
    if module.count(".") > 1:
        return False
    return module in PACKAGES if not name else name in offered(module) or whole in ROOMS


def strangers(package, source):
    found = {f"{module}.{name}".rstrip(".") for module, name in used(source) if not allowed(package, module, name)}
    return sorted(found)


@pytest.mark.parametrize("package", PACKAGES)
def test_commands_go_through_doors(package):
    files = sorted((ROOT / package / "cli").rglob("*.py"))
    assert files
    found = {file.name: strangers(package, file.read_text(encoding="utf-8")) for file in files}
    assert {name: names for name, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("package", "source", "found"),
    [
        ("calib", "def f():\n    from calib.fitting.fitting import fit", ["calib.fitting.fitting.fit"]),
        ("calib", "from calib.report import layout", ["calib.report.layout"]),
        ("calib", "import calib.fitting.fitting", ["calib.fitting.fitting"]),
        ("calib", "import calib\ncalib.estimator.x", ["calib.estimator.x"]),
        ("uwbsim", "from uwblink.errors import UwblinkError", ["uwblink.errors.UwblinkError"]),
        ("calib", "import calib\nfrom uwblink.cli import shared\nfrom calib.errors import CalibError\ncalib.fit", []),
    ],
)
def test_the_walk_sees_a_back_door(package, source, found):
    assert strangers(package, source) == found


@pytest.mark.parametrize("package", PACKAGES)
def test_what_the_door_of_a_room_offers_is_there(package):
    rooms = {path.relative_to(ROOT / package).parts[0].removesuffix(".py") for path in (ROOT / package).rglob("*.py")}
    for room in sorted(rooms - {"__init__", "__main__", "cli"}):
        module = importlib.import_module(f"{package}.{room}")
        names = list(getattr(module, "__all__", ()))
        assert len(names) == len(set(names))
        for name in names:
            assert getattr(module, name) is not None


def rooms(package):
    """A package and its rooms, by the names that import them."""
    path = importlib.import_module(package).__path__
    return [package, *(f"{package}.{room.name}" for room in pkgutil.iter_modules(path) if room.ispkg)]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_name_at_a_door_is_that_of_a_module_behind_it(package):
    """Importing such a module, from anywhere, would put it in the place of what the door offers."""
    for room in rooms(package):
        modules = {found.name for found in pkgutil.iter_modules(importlib.import_module(room).__path__)}
        assert sorted(modules & offered(room)) == [], room
