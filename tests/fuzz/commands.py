"""Damaged files of every kind, and hostile options, with every command: `python -m tests.fuzz.commands`.

A case is a number that determines the kind of file, its damage and the command, equally on every machine. Failures are:
an uncaught exception, a warning of NumPy, more than 20 s of processor time, more than 2 GB, a status other than 0, 1 or
2, an error of several lines, and an output in spite of an error.
"""

from __future__ import annotations

import argparse
import random
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Final

from tests import processes
from tests.fuzz.mutations import WORDS, damage_recording
from tests.fuzz.options import another_option
from tests.fuzz.seeds import ALONE, KINDS, SELDOM, Kind, write_seeds

LIMITS: Final = {resource.RLIMIT_DATA: 2_000_000_000, resource.RLIMIT_CPU: 20}
"""Limits of memory in bytes and of processor time in seconds of a command."""

LONGEST_WAIT_S: Final = 300.0
TOLD_EVERY: Final = 1000
OPTIONS_SHARE: Final = 0.1
"""Share of cases in which an option is damaged instead of the file."""

ANOTHER_SHARE: Final = 0.5
"""Share of these in which an option is added."""


def kind_of(rng: random.Random) -> Kind:
    """Return one of the kinds of files, by their shares."""
    return rng.choices(KINDS, [kind.share for kind in KINDS])[0]


def words_of(kind: Kind, damaged: Path, seeds: Path, out: Path, rng: random.Random) -> list[str]:
    """Return the words of one of the commands of a kind."""
    seldom = kind.seldom and rng.randrange(SELDOM) == 0
    place = {"": str(damaged), "folder": str(damaged.parent), "out": str(out)}
    return [_filled(word, place, seeds) for word in shlex.split(rng.choice(kind.seldom if seldom else kind.commands))]


def _filled(word: str, place: dict[str, str], seeds: Path) -> str:
    return re.sub(r"\{(.*?)\}", lambda found: place.get(found[1], str(seeds / found[1])), word)


def _argument(word: str) -> str:
    """Return a word that is possible as an argument of a command: without NUL and lone surrogates."""
    return word.replace("\x00", "").encode("utf-8", "replace").decode()


def damage_options(words: list[str], seeds: Path, rng: random.Random) -> list[str]:
    """Change, remove or repeat one of the words of a command after the first two, or add one of its options."""
    if rng.random() < ANOTHER_SHARE:
        return [*words, *(_argument(_filled(word, {}, seeds)) for word in another_option(words, rng))]
    place = rng.randint(2, len(words))
    hostile = _argument(rng.choice(WORDS))
    there = words[place : place + 1]
    return [*words[:place], *rng.choice(([], [hostile], there * 2, [*there, hostile])), *words[place + 1 :]]


def prepare(number: int, seeds: Path, place: Path) -> list[str]:
    """Make the damage of case `number` in `place`; return the words of its command."""
    rng = random.Random(number)
    kind = kind_of(rng)
    damaged = place / kind.file
    shutil.copyfile(seeds / "scenario.toml", place / "scenario.toml")  # because a plan names it
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


def judge(ended: subprocess.CompletedProcess[str], written: list[Path]) -> str:
    """Return a text on a failure of a command that has ended; "" if there is none."""
    said = [line for line in ended.stderr.splitlines() if not line.startswith("warning: ")]
    text, refused = " / ".join(said), ended.returncode == 2
    in_one_line = len(said) == 1 and text.startswith("error: ")
    failures = {
        f"died of signal {-ended.returncode}": ended.returncode < 0,
        f"uncaught {text[-120:]!r}": "Traceback (most recent call last)" in ended.stderr,
        f"status {ended.returncode}": ended.returncode not in (0, 1, 2),
        f"an error of {len(said)} lines: {text[:200]!r}": refused and not in_one_line,
        f"an error that steers the terminal: {text[:200]!r}": refused and not text.isprintable(),
        "an output beside an error": refused and bool(written),
    }
    return next((failure for failure, there in failures.items() if there), "")


def run_case(number: int, seeds: Path, folder: Path) -> tuple[str, int | None]:
    """Run a case; return a text on its failure, or "", and the status of the command."""
    place = folder / str(number)
    place.mkdir()
    words = prepare(number, seeds, place)
    try:
        # The working folder is its own folder, because a hostile word may be the name of an output.
        ended = processes.run(*words, cwd=place, timeout=LONGEST_WAIT_S, limits=LIMITS)
    except subprocess.TimeoutExpired:
        return f"waits for ever   [{' '.join(words)[:150]}]", None
    if wrong := judge(ended, [*place.glob("out*")]):
        return f"{wrong}   [{' '.join(words)[:150]}]", ended.returncode
    shutil.rmtree(place)
    return "", ended.returncode


def main() -> int:
    """Run cases and print failures; status 1 if there are any."""
    parser = argparse.ArgumentParser(description="Run commands on damaged files.")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--only", default="", help="kinds of files to damage, by the beginning of their names")
    parser.add_argument("--keep", type=Path, help="folder for the damaged files of cases that went wrong")
    options = parser.parse_args()
    found: Counter[str] = Counter()
    statuses: Counter[int | None] = Counter()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        seeds, folder = Path(scratch) / "seeds", (options.keep or Path(scratch) / "cases").absolute()
        write_seeds(seeds)
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(options.first, options.first + options.cases):
            if kind_of(random.Random(number)).file.startswith(options.only):
                wrong, status = run_case(number, seeds, folder)
                statuses[status] += 1
                if wrong:
                    found[wrong.partition("   [")[0]] += 1
                    print(f"case {number}: {wrong}", flush=True)
            if (number + 1 - options.first) % TOLD_EVERY == 0:
                print(f"up to {number}: {found.total()} wrong, {time.monotonic() - begun:.0f} s", file=sys.stderr)
    told = f"{options.cases} cases, {found.total()} wrong, {time.monotonic() - begun:.0f} s; ended with"
    print(told, dict(statuses))
    for wrong, count in found.most_common():
        print(f"{count:6d}  {wrong}")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
