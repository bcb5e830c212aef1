"""What packages and rooms offer: complete, cheap to import, and all that commands call."""

import ast
import doctest
import importlib
import pkgutil
import subprocess
import sys

import pytest

from tests.rooms import PACKAGES, ROOT

HEAVY = ("numpy", "scipy", "duckdb", "matplotlib", "pydantic", "simpy", "typer", "rich", "serial")

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


def modules(package):
    """Return the modules right below a package or a room, by name, and whether each is a folder."""
    return {found.name: found.ispkg for found in pkgutil.iter_modules(importlib.import_module(package).__path__)}


DOORS = {package: {f"{package}.{name}" for name, folder in modules(package).items() if folder} for package in PACKAGES}
ROOMS = set().union(*DOORS.values())


def offered(module):
    """Return what a front door or the door of a room (a module of the first level with `__all__`) offers."""
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
def test_what_doors_offer_is_there_once_and_by_no_name_of_a_module(package):
    """Importing a module of such a name, from anywhere, would put it in the place of what the door offers."""
    for door in [package, *(f"{package}.{name}" for name in modules(package) if name != "__main__")]:
        module = importlib.import_module(door)
        names = list(getattr(module, "__all__", ()))
        assert len(names) == len(set(names)), door
        assert [name for name in names if getattr(module, name) is None] == [], door
        if hasattr(module, "__path__"):
            assert sorted(modules(door).keys() & set(names)) == [], door


@pytest.mark.parametrize("package", PACKAGES)
def test_what_dir_shows_is_what_is_offered(package):
    module = importlib.import_module(package)
    assert sorted(dir(module)) == sorted(offered(package))
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        _ = module.nothing


# Values have no docstring, and a scenario's is the description in the JSON Schema: `load` shows one.
WITHOUT = {("uwblink", "PROTOCOLS"), ("uwblink", "SPEED_OF_LIGHT"), ("uwbsim", "Scenario")}
SHOWN = {(package, name) for package in PACKAGES for name in offered(package) if not name.endswith("Error")} - WITHOUT


@pytest.mark.parametrize(("package", "name"), sorted(SHOWN))
def test_everything_but_errors_has_an_example_that_runs(package, name, tmp_path, monkeypatch):
    """Those of calib take seconds, and tests/calib runs them; of uwbsim those of classes run, not of their methods."""
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
