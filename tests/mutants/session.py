"""Runs tests on faulty code without starting Python anew: a process that has collected the tests forks for each fault.

In the fork the functions that differ get the faulty code, and the tests that reach the line run, the quickest first,
until one fails. A fault outside functions takes a fork that imports the packages anew.
"""

from __future__ import annotations

import gc
import importlib.abc
import importlib.util
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Final, NamedTuple

import coverage
import pytest
from _pytest.runner import runtestprotocol

from tests.mutants.operators import Mutant

KILLED, SURVIVED, BROKEN = 1, 0, 99
MOST_BYTES: Final = 4_000_000_000
LONGEST_TESTS_S: Final = 40.0
"""How long the tests of one fault took on sound code, at most; the slower of many that reach a line are left out."""

QUIET: Final = ("-q", "-x", "-p", "no:xdist", "-p", "no:cacheprovider", "-p", "no:randomly", "--no-header")


class Reach(NamedTuple):
    """What tests took on sound code, by name, and which of them reach a line of a file."""

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]]

    def tests(self, mutant: Mutant, *, anywhere: bool) -> list[str]:
        """Return the tests that reach a fault, or its file, the quickest first."""
        lines = self.lines.get(str(mutant.path), {})
        names = {name for some in lines.values() for name in some} if anywhere else set(lines.get(mutant.line, ()))
        found: list[str] = []
        total = 0.0
        for name in sorted(names, key=lambda n: self.seconds[n]):
            total += self.seconds[name]
            if found and total > LONGEST_TESTS_S:
                break
            found.append(name)
        return found


def in_fork(work: Callable[[], int], longest_s: float) -> int:
    """Do work in a fork; returns `KILLED` or `SURVIVED`, the former where it does not end in time.

    Raises `SystemExit` where the work itself cannot be done.
    """
    sys.stdout.flush()
    child = os.fork()
    if not child:
        status = KILLED
        try:
            os.setpgid(0, 0)  # to be ended with all that it starts
            resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))
            status = work()
        except BaseException:
            status = BROKEN
            traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(status)
    until = time.monotonic() + longest_s
    while time.monotonic() < until:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            if os.waitstatus_to_exitcode(status) == BROKEN:
                raise SystemExit("the tests could not be run")
            return KILLED if os.waitstatus_to_exitcode(status) else SURVIVED
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return KILLED


class SameExamples:
    """A plug-in of pytest that has hypothesis try the same examples every time, and remember none."""

    def pytest_configure(self, config: pytest.Config) -> None:
        """Choose how hypothesis works; imported by now, with its assertions rewritten."""
        from hypothesis import Phase, settings

        # That a test fails is enough: no example needs to be made smaller.
        phases = [Phase.explicit, Phase.generate]
        settings.register_profile("mutants", derandomize=True, database=None, deadline=None, phases=phases)
        settings.load_profile("mutants")


class Collected(SameExamples):
    """A plug-in of pytest that, in place of running what was collected, hands it to `use`."""

    def __init__(self, use: Callable[[dict[str, pytest.Item]], None]) -> None:
        """Have `use` called with the collected tests by name."""
        self._use = use

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Take the place of the loop over tests."""
        self._use({item.nodeid: item for item in session.items})
        return True


def run_items(items: Sequence[pytest.Item], after: Callable[[pytest.Item, float], None] | None = None) -> int:
    """Run tests until one fails; returns `KILLED` then. `after` is told of each, and how long it took."""
    for item, following in zip(items, [*items[1:], None], strict=True):
        begun = time.process_time()  # the same on a busy machine
        reports = runtestprotocol(item, nextitem=following, log=False)
        if after:
            after(item, time.process_time() - begun)
        if any(report.failed for report in reports):
            return KILLED
    return SURVIVED


def measure(items: dict[str, pytest.Item], paths: Sequence[Path], into: Path) -> int:
    """Run all tests on sound code, and write down what each takes and reaches."""
    seconds: dict[str, float] = {}
    watch = coverage.Coverage(data_file=None, include=[str(p) for p in paths], config_file=False)
    watch.start()
    watch.switch_context("collected")

    def note(item: pytest.Item, took: float) -> None:
        seconds[item.nodeid] = took

    for item in items.values():
        watch.switch_context(item.nodeid)
        if run_items([item], note) == KILLED:
            into.write_text(json.dumps({"failed": item.nodeid}))
            return KILLED
    watch.stop()
    data = watch.get_data()
    lines = {
        str(path): {
            line: [c for c in contexts if c in seconds] for line, contexts in data.contexts_by_lineno(str(path)).items()
        }
        for path in paths
    }
    into.write_text(json.dumps({"seconds": seconds, "lines": lines}))
    return SURVIVED


def read_reach(path: Path) -> Reach:
    """Read what `measure` wrote; raises `SystemExit` where a test fails on sound code."""
    found = json.loads(path.read_text())
    if "failed" in found:
        raise SystemExit(f"{found['failed']} fails on sound code")
    lines = {file: {int(line): tests for line, tests in of.items()} for file, of in found["lines"].items()}
    return Reach(found["seconds"], lines)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def changed_functions(mutant: Mutant) -> dict[CodeType, CodeType] | None:
    """Return the code that a fault changes, by the sound code; None where it is outside functions."""
    sound = [*_codes(compile(mutant.path.read_text(), str(mutant.path), "exec", dont_inherit=True))]
    faulty = [*_codes(mutant.code())]
    if len(sound) != len(faulty):
        return None
    changed = {a: b for a, b in zip(sound, faulty, strict=True) if a != b}
    # What holds a changed function differs by that alone; module and classes ran long ago.
    own = [a for a, b in changed.items() if _itself(a) != _itself(b)]
    return None if any(not code.co_flags & 0x2 for code in own) else changed


def _itself(code: CodeType) -> tuple[Any, ...]:
    """Return what a piece of code does, without what it holds."""
    return code.co_code, code.co_names, tuple(c for c in code.co_consts if not isinstance(c, CodeType))


def put_in(changed: dict[CodeType, CodeType]) -> None:
    """Give every function that has one of the sound codes the faulty one."""
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and function.__code__ in changed:
            function.__code__ = changed[function.__code__]


class Faulty(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from faulty code."""

    def __init__(self, name: str, mutant: Mutant) -> None:
        """Take the place of the module `name`."""
        self._name, self._mutant = name, mutant

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        """Return how to import the module, if it is this one."""
        if name != self._name:
            return None
        return importlib.util.spec_from_file_location(name, self._mutant.path, loader=self)

    def create_module(self, spec: Any) -> None:
        """Let Python make the module."""

    def exec_module(self, module: Any) -> None:
        """Run the faulty code."""
        exec(self._mutant.code(), module.__dict__)  # noqa: S102 - the project's own code with one fault
