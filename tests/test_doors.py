"""Offers and imports of the packages: complete and cheap front doors, rooms in layers, and every name once."""

import ast
import doctest
import importlib
import pkgutil
import subprocess
import sys
from collections import defaultdict
from graphlib import CycleError
from pathlib import Path

import pytest

from tests.rooms import PACKAGES, ROOT, floors, imports, parsed, rooms

HEAVY = ("numpy", "scipy", "duckdb", "matplotlib", "pydantic", "simpy", "typer", "rich", "serial")

# Modules that commands use in addition to front doors, each with its reason.
BESIDE = {
    "uwblink.exporters.export_recording": "the front door offers no export yet",
    "uwblink.importers.guess.guess_map": "what import suggests where no map is given; read_source takes the map",
    "uwblink.__version__": "what --version prints",
    "uwblink.cli.start": "Ctrl-C while a command is being imported, and what must come before",
    "uwblink.settings": "fields of settings that Python and the command line share",
    "calib.settings": "the settings of a fit, of which its options are made",
    "uwbsim.settings": "the settings of a prediction, of which its options are made",
    "uwblink.exporters.EXPORTERS": "names of the forms that a recording can leave in, for a shell to complete",
    "uwblink.cli.shared": "options, examples, completion, errors, interrupts and progress, alike in the three commands",
}


def modules(package):
    """Return the modules directly in a package or a room, by name, and whether each is a folder."""
    return {found.name: found.ispkg for found in pkgutil.iter_modules(importlib.import_module(package).__path__)}


DOORS = {package: {f"{package}.{name}" for name, folder in modules(package).items() if folder} for package in PACKAGES}
ROOMS = set().union(*DOORS.values())


def offered(module):
    """Return the names that a front door or the door of a room (a module of the first level with `__all__`) offers."""
    return set(getattr(importlib.import_module(module), "__all__", ()))


def used(source):
    """Yield module and name of all imports of a module from the three packages; "" for a module itself."""
    for node in ast.walk(parsed(source)):
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
def test_the_check_finds_a_back_door(package, source, found):
    assert strangers(package, source) == found


@pytest.mark.parametrize("package", PACKAGES)
def test_offered_names_are_unique_and_no_modules(package):
    """Importing a module of such a name, from anywhere, would replace the offered object."""
    for door in [package, *(f"{package}.{name}" for name in modules(package) if name != "__main__")]:
        module = importlib.import_module(door)
        names = list(getattr(module, "__all__", ()))
        assert len(names) == len(set(names)), door
        assert [name for name in names if getattr(module, name) is None] == [], door
        if hasattr(module, "__path__"):
            assert sorted(modules(door).keys() & set(names)) == [], door


@pytest.mark.parametrize("package", PACKAGES)
def test_dir_shows_the_offered_names(package):
    module = importlib.import_module(package)
    assert sorted(dir(module)) == sorted(offered(package))
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        _ = module.nothing


# Values have no docstring, and that of a scenario is the description in the JSON Schema: `load` shows one.
WITHOUT = {("uwblink", "PROTOCOLS"), ("uwblink", "SPEED_OF_LIGHT"), ("uwbsim", "Scenario")}
SHOWN = {(package, name) for package in PACKAGES for name in offered(package) if not name.endswith("Error")} - WITHOUT


@pytest.mark.parametrize(("package", "name"), sorted(SHOWN))
def test_everything_but_errors_has_an_example_that_runs(package, name, tmp_path, monkeypatch):
    """Examples of calib take seconds, and tests/calib runs them; of uwbsim, those of classes run, not of methods."""
    monkeypatch.chdir(tmp_path)
    thing = getattr(importlib.import_module(package), name)
    module = sys.modules.get(getattr(thing, "__module__", None) or package)
    examples = [example for example in doctest.DocTestFinder().find(thing, name, module=module) if example.examples]
    assert examples
    runner = doctest.DocTestRunner(verbose=False)
    for example in examples:
        if package == "uwblink" or (package == "uwbsim" and example.name == name):
            runner.run(example)
    assert runner.failures == 0


@pytest.mark.parametrize("package", PACKAGES)
def test_the_example_at_the_head_of_a_package_runs_and_importing_it_loads_nothing_large(package, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert doctest.testmod(importlib.import_module(package)).failed == 0
    code = f"import sys, {package}; print(*(m for m in {HEAVY} if m in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split() == []


# One word means one thing: names of public classes and constants, in all packages together.


def defined(source):
    """Yield the names of public classes and constants that a module defines, including those in tuples."""
    for node in parsed(source).body:
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


def test_names_of_classes_and_constants_are_unique():
    assert twice({path: path.read_text() for package in PACKAGES for path in (ROOT / package).rglob("*.py")}) == {}


def test_the_check_finds_repeated_names():
    sources = {
        "uwblink/a.py": "class Track: ...\nclass _Own: ...\nLEAST, MOST = 1, 2",
        "calib/b.py": "class Track: ...\nclass _Own: ...\nMOST: Final = 5\nTABLE[LEAST] = 1",
    }
    assert twice(sources) == {"Track": [*sources], "MOST": [*sources]}


# Objects with one definition: constants and the robust spread.


FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]

# Numbers that every formula takes from one module: the speed of light in air and in vacuum, and the factor of median
# deviations.
HOMES = {
    299_702_547.0: "uwblink/ticks.py",
    299_792_458.0: "calib/checks/columns.py",
    1.4826: "calib/spread.py",
}


def test_constants_are_written_once():
    nodes = [(node, path) for path in FILES for node in ast.walk(parsed(path.read_text(encoding="utf-8")))]
    found = [(node.value, path) for node, path in nodes if isinstance(node, ast.Constant) and node.value in HOMES]
    assert sorted((number, path.relative_to(ROOT).as_posix()) for number, path in found) == sorted(HOMES.items())


# The import rule of docs/architecture.md, tested with every import statement.


FORBIDDEN = {
    "uwblink": {"uwbsim", "calib"},
    "uwbsim": {"calib"},
    "calib": {"uwbsim"},
}
# Libraries that only certain files may import.
CONFINED = {
    "serial": lambda path: path == "uwblink/boards/ports.py",
    "simpy": lambda path: path.startswith("uwbsim/"),
    "matplotlib": lambda path: "figures" in Path(path).name or path == "uwblink/pages/pdf.py",
    "pypdf": lambda path: path == "uwblink/pages/pdf.py",
    "typer": lambda path: "/cli/" in path,
    "rich": lambda path: "/cli/" in path,
    "duckdb": lambda path: path.startswith("uwblink/") or path == "uwbsim/sweep/runner.py",
    "pydantic": lambda path: path.startswith(("uwbsim/", "calib/calibration/")),
    "threadpoolctl": lambda path: (
        path
        in {
            "calib/checks/examine.py",
            "calib/fitting/fitting.py",
            "calib/planning/flights.py",
            "calib/surveys/survey.py",
            "calib/trajectories/fitting.py",
            "uwbsim/sweep/executors.py",
            "uwbsim/twins/fitting.py",
        }
    ),
    "yaml": lambda path: path in {"uwblink/importers/miluv.py", "calib/calibration/formats.py"},
    "mcap": lambda path: path in {"uwblink/importers/bags.py", "uwblink/exporters/mcap.py"},
    "rosbags": lambda path: path in {"uwblink/importers/bags.py", "uwblink/exporters/mcap.py"},
    "foxglove": lambda path: path == "uwblink/streaming/senders.py",
    "gtsam": lambda path: path == "calib/factors.py",
    "pandas": lambda path: path == "uwblink/arrays.py",
    "distributed": lambda path: path == "uwbsim/sweep/executors.py",
}
NEVER = {"pickle", "pyarrow"}


def violations(path: str, source: str) -> list[str]:
    names = {name.split(".")[0] for name in imports(source)}
    # A twin reads a calibration through the front door of calib.
    forbidden = FORBIDDEN[path.split("/")[0]] - ({"calib"} if path == "uwbsim/twins/range_errors.py" else set())
    wrong = names & (forbidden | NEVER)
    wrong |= {lib for lib, allowed in CONFINED.items() if lib in names and not allowed(path)}
    return [f"{path} imports {name}" for name in sorted(wrong)]


def test_packages_keep_the_import_rule():
    paths = [path.relative_to(ROOT).as_posix() for path in FILES]
    assert {path.split("/")[0] for path in paths} == {*PACKAGES}
    assert [line for path in paths for line in violations(path, (ROOT / path).read_text())] == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("uwblink/x.py", "import calib.fitting.fitting"),
        ("calib/x.py", "def f():\n    from uwbsim import clock"),
        ("calib/x.py", "import simpy"),
        ("uwbsim/x.py", "from matplotlib.figure import Figure"),
        ("uwblink/x.py", "import pickle"),
    ],
)
def test_the_check_finds_a_violation_of_the_import_rule(path, source):
    assert violations(path, source)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_rooms_import_each_other_in_a_circle(package):
    assert floors(rooms(package))


def test_the_check_finds_a_circle(tmp_path):
    sources = {
        "__init__": "from calib.fits.x import a",
        "errors": "",
        "fits/x": "import calib.errors\nfrom calib.report import y",
        "report/y": "def f():\n    from calib.fits.x import g",
    }
    for name, source in sources.items():
        path = tmp_path / "calib" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    graph = rooms("calib", tmp_path)
    assert graph == {"errors": set(), "fits": {"errors", "report"}, "report": {"fits"}}
    with pytest.raises(CycleError, match="fits"):
        floors(graph)
