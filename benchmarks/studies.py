"""What studies over seeds share: their options, stored outcomes, and the sections of pages that they write."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any


def options(description: str | None, seeds: int) -> argparse.ArgumentParser:
    """Return the options of a study that writes a table into a page."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seeds", type=int, default=seeds, help="at most so many a world")
    parser.add_argument("--workers", type=int, default=2, help="number of processes")
    parser.add_argument("--write", action="store_true", help="write the table into the page")
    return parser


def write_section(page: Path, name: str, text: str) -> None:
    """Replace what stands between the comments "name" and "end of name" of a page.

    Raises `ValueError` if the page has not exactly one of each.
    """
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    page.write_text(f"{before}{begin}{text.rstrip()}\n{end}{after}", encoding="utf-8")


def outcomes_of(
    name: str, seeds: range, one: Callable[[str, int], Any], kind: type[Any], results: Path | None, pool: Executor
) -> dict[int, Any]:
    """Return the outcomes of a world by seed, dataclasses of a `kind`, each by `one(name, seed)`.

    Outcomes in a file of results, a line each, are taken from there, and new ones are added; their arrays become lists.
    """
    lines = results.read_text(encoding="utf-8").splitlines() if results is not None and results.exists() else []
    found: dict[int, Any] = {}
    for line in map(json.loads, lines):
        if line.pop("world") == name and (seed := line.pop("seed")) in seeds:
            found[seed] = kind(**line)
    missing = [seed for seed in seeds if seed not in found]
    for seed, outcome in zip(missing, pool.map(partial(one, name), missing), strict=True):
        found[seed] = outcome
        if results is not None:
            line = {"world": name, "seed": seed, **asdict(outcome)}
            with results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line, default=list) + "\n")
    return dict(sorted(found.items()))
