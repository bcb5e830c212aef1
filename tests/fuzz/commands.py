"""Damaged files of every kind, and hostile options, through every command: `python -m tests.fuzz.commands`.

A case is a number: it says which kind of file is damaged how, and which command takes it, the same on every machine.
What must not happen: an exception that nobody caught, a warning of NumPy, more than 20 s of the processor, more than
2 GB, a status that is not 0, 1 or 2, an error of several lines, and an output beside an error.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import multiprocessing
import os
import pkgutil
import random
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NamedTuple

import calib
import calib.cli
import uwblink
import uwblink.cli
import uwbsim
import uwbsim.cli
from tests.fuzz.mutations import WORDS, damage_recording
from tests.fuzz.options import another_option
from tests.fuzz.seeds import ALONE, KINDS, SELDOM, Kind, write_seeds

MAINS: Final = {"uwblink": uwblink.cli.main, "uwbsim": uwbsim.cli.main, "calib": calib.cli.main}
CONTEXT: Final = multiprocessing.get_context("forkserver")
LONGEST_S: Final = 20
LONGEST_WAIT_S: Final = 300.0
TOLD_EVERY: Final = 1000
MOST_BYTES: Final = 2_000_000_000
USAGE: Final = ("Usage:", "─ Error ─")
"""What a mistake in options is answered with: how it would be right, in a few lines."""

OPTIONS_SHARE: Final = 0.1
"""Share of cases in which an option is damaged and not the file."""


ANOTHER_SHARE: Final = 0.5
"""Share of these in which it is an option more."""


class Outcome(NamedTuple):
    """How a command ended: its status, what it printed, and the exception that nobody caught, or None."""

    status: int | None
    error_text: str
    uncaught: str | None


def kind_of(rng: random.Random) -> Kind:
    """Return one of the kinds of files, by their shares."""
    return rng.choices(KINDS, [kind.share for kind in KINDS])[0]


def words_of(kind: Kind, damaged: Path, seeds: Path, out: Path, rng: random.Random) -> list[str]:
    """Return the words of one of a kind's commands."""
    seldom = kind.seldom and rng.randrange(SELDOM) == 0
    place = {"{}": str(damaged), "{folder}": str(damaged.parent), "{out}": str(out)}
    return [_filled(word, place, seeds) for word in shlex.split(rng.choice(kind.seldom if seldom else kind.commands))]


def _filled(word: str, place: dict[str, str], seeds: Path) -> str:
    for name in place:
        word = word.replace(name, place[name])
    head, brace, rest = word.partition("{")
    return head + str(seeds / rest.rstrip("}")) if brace else word


def damage_options(words: list[str], seeds: Path, rng: random.Random) -> list[str]:
    """Change, drop or double one of a command's words after the first two, or add an option that it has."""
    changed = list(words)
    if rng.random() < ANOTHER_SHARE:
        added = [_filled(word, {}, seeds) for word in another_option(words, rng)]
        return [*changed, *(word.replace("\x00", "").encode("utf-8", "replace").decode() for word in added)]
    place = rng.randint(2, len(changed))
    hostile = rng.choice(WORDS).replace("\x00", "").encode("utf-8", "replace").decode()
    there = changed[place : place + 1]
    changed[place : place + 1] = rng.choice(([], [hostile], there * 2, [*there, hostile]))
    return changed


def prepare(number: int, seeds: Path, place: Path) -> list[str]:
    """Damage what case `number` damages, in `place`; returns the words of its command."""
    rng = random.Random(number)
    kind = kind_of(rng)
    damaged = place / kind.file
    shutil.copyfile(seeds / "scenario.toml", place / "scenario.toml")  # which a plan names
    if damaged.parent != place:
        shutil.copytree((seeds / kind.file).parent, damaged.parent)
    if kind.commands is ALONE or rng.random() < OPTIONS_SHARE:
        shutil.copyfile(seeds / kind.file, damaged)
        return damage_options(words_of(kind, damaged, seeds, place / "out", rng), seeds, rng)
    if kind.mutations:
        data = rng.choice(kind.mutations)((seeds / kind.file).read_bytes(), rng)
        damaged.write_bytes(b"" if data is None else data)
    else:
        damage_recording(seeds / kind.file, damaged, rng)
    return words_of(kind, damaged, seeds, place / "out", rng)


def execute(words: list[str]) -> Outcome:
    """Run a command in this process."""
    printed, errors = io.StringIO(), io.StringIO()
    sys.argv = words
    uncaught: str | None = None
    status: int | None = 0
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        try:
            MAINS[words[0]]()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0 if end.code is None else 99
        except BaseException as error:
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "/tests/" not in f.filename]
            where = next((f for f in reversed(frames) if any(f"/{m}/" in f.filename for m in MAINS)), frames[-1])
            uncaught = f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {str(error)[:120]!r}"
    return Outcome(status, errors.getvalue(), uncaught)


def judge(outcome: Outcome, written: list[Path]) -> str:
    """Return what is wrong with how a command ended; nothing where it ended well."""
    if outcome.uncaught:
        return f"uncaught {outcome.uncaught}"
    if outcome.status not in (0, 1, 2):
        return f"status {outcome.status}"
    lines = outcome.error_text.splitlines()
    said = [line for line in lines if not line.startswith("warning: ")]
    if outcome.status == 2 and not any(lines_of_usage in outcome.error_text for lines_of_usage in USAGE):
        if len(said) != 1 or not said[0].startswith("error: "):
            return f"an error of {len(said)} lines: {' / '.join(said)[:200]!r}"
        if not said[0].isprintable():
            return f"an error that steers the terminal: {said[0][:200]!r}"
        if written:
            return "an output beside an error"
    return ""


def _try(number: int, seeds: Path, place: Path, pipe: Connection) -> None:
    """Try a case in this process; sends what is wrong with it, the status, and the words of the command."""
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S))
    place.mkdir()
    os.chdir(place)  # a hostile word may be the name of an output
    words = prepare(number, seeds, place)
    outcome = execute(words)
    pipe.send((judge(outcome, [*place.glob("out*")]), outcome.status, words))


def run_case(number: int, seeds: Path, folder: Path) -> tuple[str, int | None]:
    """Try a case in a process of its own; returns what is wrong, or nothing, and the command's status."""
    place = folder / str(number)
    mine, theirs = CONTEXT.Pipe()
    process = CONTEXT.Process(target=_try, args=(number, seeds, place, theirs), daemon=True)
    process.start()
    process.join(LONGEST_WAIT_S)
    if process.exitcode is None:
        process.kill()
        return "waits for ever", None
    if not mine.poll():
        return f"died with {process.exitcode} (-{signal.SIGXCPU}: after {LONGEST_S} s of work)", None
    wrong, status, words = mine.recv()
    if not wrong:
        shutil.rmtree(place)
    return f"{wrong}   [{' '.join(words)[:150]}]" if wrong else "", status


def everything() -> list[str]:
    """Return the modules of the packages that can be imported here; those of extras that are absent cannot."""
    found = []
    for package in (uwblink, uwbsim, calib):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with contextlib.suppress(ImportError):
                if not module.name.endswith("__main__") and importlib.import_module(module.name):
                    found.append(module.name)
    return found


def main() -> int:
    """Try cases and print what is wrong; status 1 where anything is."""
    parser = argparse.ArgumentParser(description="Run commands on damaged files.")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--only", help="kinds of files to damage, by the beginning of their names")
    parser.add_argument("--keep", type=Path, help="folder for the damaged files of cases that went wrong")
    options = parser.parse_args()
    found: Counter[str] = Counter()
    statuses: Counter[int | None] = Counter()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        seeds, folder = Path(scratch) / "seeds", (options.keep or Path(scratch) / "cases").absolute()
        write_seeds(seeds)
        folder.mkdir(parents=True, exist_ok=True)
        CONTEXT.set_forkserver_preload(["__main__", *everything()])
        for number in range(options.first, options.first + options.cases):
            if options.only and not kind_of(random.Random(number)).file.startswith(options.only):
                continue
            wrong, status = run_case(number, seeds, folder)
            statuses[status] += 1
            if wrong:
                found[wrong.partition("   [")[0]] += 1
                print(f"case {number}: {wrong}", flush=True)
            if (number + 1 - options.first) % TOLD_EVERY == 0:
                said = f"up to {number}: {sum(found.values())} wrong, {time.monotonic() - begun:.0f} s"
                print(said, file=sys.stderr, flush=True)
    print(
        f"{options.cases} cases, {sum(found.values())} wrong, {time.monotonic() - begun:.0f} s; ended with",
        dict(statuses),
    )
    for wrong, count in found.most_common():
        print(f"{count:6d}  {wrong}")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
