"""Code blocks of the documentation pages, and how each kind is run.

A block is run unless a comment before it gives a reason: `<!-- not run: REASON -->`, or `<!-- run by: FILE -->` if its
own test runs it. The output of commands and Python is compared with the block of text after them, without numbers,
because versions of libraries change last digits of simulations. A line `...` stands for any lines.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

from tests import processes
from uwblink.pages import figures

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = ROOT / "docs"
FENCE: Final = re.compile(
    r"(?:<!-- (?P<mark>not run|run by): (?P<reason>[^>]+?) -->\n)?"
    r"^(?P<ticks>```+)(?P<info>[^\n]*)\n(?P<code>.*?)^(?P=ticks)$",
    flags=re.M | re.S,
)
NUMBER: Final = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")
COMMANDS: Final = ("uwbsim", "uwblink", "calib")
DRAWING: Final = "drawing"
"""Label of a block without a language."""

CALLED: Final = re.compile(r"^(uwbsim|uwblink|calib|python) +[a-z-]", flags=re.M)
LEFT: Final = "..."


@dataclass(frozen=True, slots=True)
class Block:
    """A block of code: language, label, text, its first line, and the reason if it is not run."""

    language: str
    label: str
    code: str
    line: int
    mark: str
    reason: str


def pages() -> list[Path]:
    """Return the pages that are not generated."""
    generated = {"_build", "generated"}
    return sorted(path for path in DOCS.rglob("*.md") if not generated & set(path.relative_to(DOCS).parts))


def blocks(path: Path) -> list[Block]:
    """Return the blocks of code of a page, without directives of the site."""
    text = path.read_text(encoding="utf-8")
    return [
        Block(
            (found["info"].split() or [DRAWING])[0],
            found["info"].partition(" ")[2].strip(),
            found["code"],
            text.count("\n", 0, found.start("ticks")) + 1,
            found["mark"] or "",
            found["reason"] or "",
        )
        for found in FENCE.finditer(text)
        if not found["info"].startswith("{")
    ]


@dataclass
class Runner:
    """Runs the blocks of one page in order, in the working folder; Python blocks share their names."""

    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__page__"})
    printed: str = ""

    def run(self, block: Block) -> None:
        """Run a block, or compare output with it; raises `AssertionError` with the difference."""
        if block.language == "sh":
            self.printed = "".join(command(line) for line in lines(block.code))
        elif block.language == "python":
            self.printed = self._python(block)
        elif block.language == "toml":
            tomllib.loads(block.code)
        elif block.language == "text":
            compare(self.printed, block.code)
        elif block.language == DRAWING:
            assert not CALLED.search(block.code), "commands in a block without a language; write sh"
        else:
            raise AssertionError(f"no way to run {block.language}; say why not")

    def _python(self, block: Block) -> str:
        """Run Python; return its output, as on a terminal of 100 columns."""
        with patch.dict(os.environ, COLUMNS="100"), contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(block.code, f"line {block.line}", "exec"), self.names)  # noqa: S102 - the pages are our own
        return printed.getvalue()


def lines(code: str) -> Iterator[str]:
    """Yield the commands of a block, without comments; flights have at most 12 s, comparisons 2000 ranges."""
    for most, number in ((12, r"(run\.duration_s=|plan flight .*--duration )(\d+)"), (2000, r"(compare .* -n )(\d+)")):
        code = re.sub(number, lambda found: f"{found[1]}{min(most, int(found[2]))}", code)  # noqa: B023 - called at once
    for line in code.replace("\\\n", " ").splitlines():
        bare = line.split(" #")[0].strip()
        if bare and not bare.startswith("#"):
            yield bare


def command(line: str) -> str:
    """Run a command of the project in this process; return its output, which `> FILE` writes to a file instead."""
    bare, _, output = line.partition(" > ")
    words = shlex.split(bare)
    assert words[0] in COMMANDS, f"{line}: only {', '.join(COMMANDS)} are run"
    with patch.dict(os.environ, COLUMNS="100"):
        printed = processes.succeed(*words).stdout
    if output:
        Path(output).write_text(printed, encoding="utf-8")
    return "" if output else printed


def compare(printed: str, shown: str) -> None:
    """Raise `AssertionError` if the page shows words that were not printed in that order."""
    left = masked(printed)
    for part in filter(str.strip, shown.split(f"{LEFT}\n")):
        wanted = masked(part)
        assert wanted in left, f"the page shows\n{part}\nbut printed was\n{printed}"
        left = left.partition(wanted)[2]


def masked(text: str) -> str:
    """Return words with # in place of numbers, without rules of tables and padding."""
    return " ".join(re.sub(r"[─━]+", "", NUMBER.sub("#", text)).split())


def outline(draw: figures.Draw, width_in: float, kinds: Iterable[str], salt: str = "") -> dict[str, bytes]:
    """Draw a figure without layout and rendering, in place of `uwblink.pages.figures.drawn`."""
    with figures.style():
        draw(width_in)
    return dict.fromkeys(kinds, b"<svg/>")
