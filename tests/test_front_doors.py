"""What each package offers: sorted, complete, cheap to import, and every example in it runs."""

import doctest
import importlib
import subprocess
import sys

import pytest

PACKAGES = ("uwblink", "uwbsim", "calib")
HEAVY = ("numpy", "scipy", "duckdb", "matplotlib", "pydantic", "simpy", "typer", "rich", "serial")


def offered(package):
    return sorted(getattr(importlib.import_module(package), "__all__", []))


# The examples of the other two need files and leave rows behind: tests/uwbsim and tests/calib run theirs.
NAMES = [("uwblink", name) for name in offered("uwblink")]


@pytest.mark.parametrize("package", PACKAGES)
def test_what_dir_shows_is_what_is_offered(package):
    module = importlib.import_module(package)
    if offered(package):
        assert sorted(dir(module)) == offered(package)
        assert len(set(module.__all__)) == len(module.__all__)
        with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
            _ = module.nothing


@pytest.mark.parametrize(("package", "name"), NAMES)
def test_every_name_is_there_and_every_example_runs(package, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    thing = getattr(importlib.import_module(package), name)
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner(verbose=False)
    module = sys.modules.get(getattr(thing, "__module__", None) or package)
    for example in finder.find(thing, name, module=module):
        runner.run(example)
    assert runner.failures == 0


@pytest.mark.parametrize("package", PACKAGES)
def test_the_example_at_the_head_of_a_package_runs(package, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert doctest.testmod(importlib.import_module(package)).failed == 0


def shown(thing):
    return [t for t in doctest.DocTestFinder().find(thing, "thing") if t.examples]


# Values have no docstring, and a scenario's is the description in the JSON Schema: `load` shows one.
WITHOUT = {("uwblink", "PROTOCOLS"), ("uwblink", "SPEED_OF_LIGHT"), ("uwbsim", "Scenario")}
SHOWN = {(package, name) for package in PACKAGES for name in offered(package) if not name.endswith("Error")} - WITHOUT


@pytest.mark.parametrize(("package", "name"), sorted(SHOWN))
def test_everything_but_errors_has_an_example(package, name):
    assert shown(getattr(importlib.import_module(package), name))


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_costs_nothing(package):
    """Not a matter of seconds, which depend on the machine: nothing large is loaded."""
    code = f"import sys, {package}; print(*(m for m in {HEAVY} if m in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split() == []
