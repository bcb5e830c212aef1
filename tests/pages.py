"""Code blocks of the documentation's pages, and how each kind is run.

A block is run unless a comment before it says why not: `<!-- not run: REASON -->`, or `<!-- run by: FILE -->` where a
test of its own runs it. What a page's commands and Python print is held against the block of text behind them, numbers
aside: those of simulations move by a last digit with versions of libraries. A line `...` stands for any lines.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

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
"""What a block without a language is."""

CALLED: Final = re.compile(r"^(uwbsim|uwblink|calib|python) +[a-z-]", flags=re.M)
LEFT: Final = "..."


@dataclass(frozen=True, slots=True)
class Block:
    """A block of code: language, label, text, the line it begins at, and why it is not run, if so."""

    language: str
    label: str
    code: str
    line: int
    mark: str
    reason: str


def pages() -> list[Path]:
    """Return the pages that people write."""
    found = (path for path in DOCS.rglob("*.md") if not {"_build", "generated"} & set(path.relative_to(DOCS).parts))
    return sorted(found)


def blocks(path: Path) -> list[Block]:
    """Return the blocks of code of a page; directives of the site are none."""
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
    """Runs the blocks of one page one after the other, in the working folder; Python shares its names."""

    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__page__"})
    printed: str = ""

    def run(self, block: Block) -> None:
        """Run a block, or hold what was printed against it; raises `AssertionError` that says what is wrong."""
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
        with told() as printed:
            exec(compile(block.code, f"line {block.line}", "exec"), self.names)  # noqa: S102 - the pages are our own
        return printed.getvalue()


def lines(code: str) -> Iterator[str]:
    """Yield the commands of a block, without comments; flights are of 12 s at most, comparisons of 2000 ranges."""
    for most, number in ((12, r"(run\.duration_s=|plan flight .*--duration )(\d+)"), (2000, r"(compare .* -n )(\d+)")):
        code = re.sub(number, lambda found: f"{found[1]}{min(most, int(found[2]))}", code)  # noqa: B023 - called at once
    for line in code.replace("\\\n", " ").splitlines():
        bare = line.split(" #")[0].strip()
        if bare and not bare.startswith("#"):
            yield bare


def command(line: str) -> str:
    """Run a command of the project in this process; returns what it printed, which `> FILE` writes instead."""
    bare, _, output = line.partition(" > ")
    words = shlex.split(bare)
    assert words[0] in COMMANDS, f"{line}: only {', '.join(COMMANDS)} are run"
    complaints, status = io.StringIO(), None
    with told() as printed, contextlib.redirect_stderr(complaints), patch.object(sys, "argv", words):
        try:
            import_module(f"{words[0]}.cli").main()
        except SystemExit as end:
            status = end.code
    assert status in (0, None), f"{line}: status {status}\n{printed.getvalue()}{complaints.getvalue()}"
    if output:
        Path(output).write_text(printed.getvalue(), encoding="utf-8")
        return ""
    return printed.getvalue()


@contextlib.contextmanager
def told() -> Iterator[io.StringIO]:
    """Catch what is printed, as it would be on a terminal of 100 columns."""
    with patch.dict(os.environ, COLUMNS="100"), contextlib.redirect_stdout(io.StringIO()) as printed:
        yield printed


def compare(printed: str, shown: str) -> None:
    """Raise `AssertionError` where the page shows words that were not printed in that order."""
    left = masked(printed)
    for part in filter(str.strip, shown.split(f"{LEFT}\n")):
        wanted = masked(part)
        assert wanted in left, f"the page shows\n{part}\nbut printed was\n{printed}"
        left = left.partition(wanted)[2]


def masked(text: str) -> str:
    """Return words with numbers as #: rules of tables and padding aside."""
    bare = NUMBER.sub("#", text)
    return " ".join(word for word in re.sub(r"[─━]+", "", bare).split())


def outline(draw: figures.Draw, width_in: float, kinds: Iterable[str], salt: str = "") -> dict[str, bytes]:
    """Make a figure without setting and rendering it, in place of `uwblink.pages.figures.drawn`."""
    with figures.style():
        draw(width_in)
    return dict.fromkeys(kinds, b"<svg/>")
