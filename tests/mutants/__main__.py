"""Puts faults into the code and prints which of them no test notices: `python -m tests.mutants`."""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple, TextIO

import pytest

from tests.mutants.operators import Mutant, mutants_of
from tests.mutants.session import (
    BROKEN,
    KILLED,
    QUIET,
    Collected,
    Faulty,
    Reach,
    SameExamples,
    changed_functions,
    in_fork,
    measure,
    put_in,
    read_reach,
    run_items,
)

ROOT: Final = Path(__file__).parents[2]


class Room(NamedTuple):
    """Files in which faults are put, and the tests that should notice them."""

    files: Sequence[str]
    tests: Sequence[str]


ROOMS: Final = {
    "wire": Room(("uwblink/wire/codec.py", "uwblink/wire/fields.py", "uwblink/wire/bulk.py"), ("tests/uwblink/wire",)),
    "twr": Room(
        ("uwblink/ticks.py", "uwblink/twr.py", "uwblink/protocols/rows.py"),
        (
            "tests/uwblink/test_twr.py",
            "tests/uwblink/test_from_arrays.py",
            "tests/uwblink/test_register_protocol.py",
            "tests/uwblink/wire",
        ),
    ),
    "dialogue": Room(
        ("uwblink/boards/connection.py",),
        tuple(f"tests/uwblink/boards/test_{name}.py" for name in ("connection", "connection_limits", "board")),
    ),
    "clocks": Room(
        ("uwbsim/world/clocks.py",),
        (
            "tests/uwbsim/world/test_clocks.py",
            "tests/uwbsim/world/test_allan.py",
            "tests/uwbsim/simulation/test_protocols.py",
        ),
    ),
    "air": Room(
        ("uwbsim/simulation/air.py", "uwbsim/simulation/timestamps.py"),
        ("tests/uwbsim/simulation",),
    ),
    "fit": Room(
        (
            "calib/estimator/optimize.py",
            "calib/estimator/covariance.py",
            "calib/estimator/score_tests.py",
            "calib/estimator/identifiability.py",
        ),
        (
            "tests/calib/estimator",
            "tests/calib/estimation/test_sessions.py",
            "tests/calib/estimation/test_identifiability.py",
        ),
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Try faults room by room; status 1 where fewer than 90 % are noticed."""
    parser = argparse.ArgumentParser(description="Put faults into the code and see whether tests notice.")
    parser.add_argument("rooms", nargs="*", default=[*ROOMS], choices=[*ROOMS, []], help="rooms to try")
    parser.add_argument("--each", type=int, default=60, help="faults in a file, at most")
    parser.add_argument("--seed", type=int, default=1, help="which faults are taken where there are more")
    parser.add_argument("--matching", default="", help="only faults whose line holds this text")
    options = parser.parse_args(arguments)
    total = caught = 0
    begun = time.monotonic()
    for name in options.rooms or ROOMS:
        tried, survivors = try_room(ROOMS[name], options.each, options.seed, options.matching)
        total, caught = total + tried, caught + tried - len(survivors)
        print(f"{name}: {tried} faults, {len(survivors)} unnoticed", flush=True)
    print(f"{total} faults, {caught} noticed ({100 * caught / max(total, 1):.1f} %), {time.monotonic() - begun:.0f} s")
    return int(caught < 0.9 * total)


def try_room(room: Room, each: int, seed: int, matching: str) -> tuple[int, list[Mutant]]:
    """Return how many faults were tried in a room, and those that no test noticed."""
    chosen = [m for file in room.files for m in _sample(ROOT / file, each, seed, matching)]
    survivors: list[Mutant] = []
    with tempfile.TemporaryDirectory() as scratch, os.fdopen(os.dup(1), "w") as terminal:  # pytest captures the other
        place = Path(scratch)
        outside = [m for m in chosen if changed_functions(m) is None]
        inside = [m for m in chosen if m not in outside]
        reached = place / "reach.json"

        def warm() -> int:
            tests = [str(ROOT / test) for test in room.tests]
            paths = [ROOT / file for file in room.files]

            def use(items: dict[str, pytest.Item]) -> None:
                in_fork(lambda: measure(items, paths, reached), 3000)
                reach = read_reach(reached)
                lived = [k for k, mutant in enumerate(inside) if _told(mutant, lives(mutant, items, reach), terminal)]
                (place / "lived").write_text("".join(f"{k}\n" for k in lived))

            pytest.main([*QUIET, f"--basetemp={place / 'warm'}", *tests], [Collected(use)])
            return 0 if (place / "lived").exists() else BROKEN

        in_fork(lambda: _silent(warm), 36_000)
        survivors += [inside[int(k)] for k in (place / "lived").read_text().split()]
        reach = read_reach(reached)
        survivors += [m for m in outside if _told(m, not _notices_anew(m, reach, place), terminal)]
    return len(chosen), survivors


def _told(mutant: Mutant, lived: bool, terminal: TextIO) -> bool:
    """Print a fault that nobody noticed as soon as that is known, for a run takes long; return whether it lived."""
    if lived:
        print(f"  unnoticed  {mutant}", file=terminal, flush=True)
    return lived


def _sample(path: Path, each: int, seed: int, matching: str) -> list[Mutant]:
    source = path.read_text().splitlines()
    found = [m for m in mutants_of(path) if matching in source[m.line - 1]]
    chosen = sorted(random.Random(seed).sample(range(len(found)), min(each, len(found))))
    return [found[k] for k in chosen]


def lives(mutant: Mutant, items: dict[str, pytest.Item], reach: Reach) -> bool:
    """Return whether all tests that reach a fault pass with it."""
    tests = reach.tests(mutant, anywhere=False)
    changed = changed_functions(mutant)
    if not tests or not changed:
        return True

    def work() -> int:
        put_in(changed)
        return run_items([items[test] for test in tests])

    return in_fork(work, 10 + 10 * sum(reach.seconds[test] for test in tests)) != KILLED


def _notices_anew(mutant: Mutant, reach: Reach, place: Path) -> bool:
    """Return whether a test fails when the packages are imported with the fault in them."""
    tests = reach.tests(mutant, anywhere=True)
    name = ".".join(mutant.path.relative_to(ROOT).with_suffix("").parts)

    def work() -> int:
        sys.meta_path.insert(0, Faulty(name, mutant))
        return int(pytest.main([*QUIET, f"--basetemp={place / 'anew'}", *tests], [SameExamples()]))

    return in_fork(lambda: _silent(work), 60 + 10 * sum(reach.seconds[test] for test in tests)) == KILLED


def _silent(work: Callable[[], int]) -> int:
    """Do work that prints, and print nothing."""
    with open(os.devnull, "w") as nowhere:
        sys.stdout = sys.stderr = nowhere
        return int(work())


if __name__ == "__main__":
    raise SystemExit(main())
