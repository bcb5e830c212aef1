"""What a report is made of, whatever it is shown on: headings, paragraphs, tables, figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading of a section."""

    text: str


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph.

    `kind` is "plain", "lead" (the summary at the top), "warning", "note" (below a table), or the verdict: "good",
    "doubt" or "bad", of which the first sentence is set large.
    """

    text: str
    kind: str = "plain"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts; the first column is left-aligned. `above` are headings with the columns they span.

    The last row is set apart if `total`; a table of `words` is left-aligned, and its lines may break.
    """

    header: list[str]
    rows: list[list[str]]
    above: list[tuple[str, int]] = field(default_factory=list)
    total: bool = False
    words: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure with its file name (no suffix) and caption.

    `draw` takes a width in inches (3.5 for a column or a phone, 7.16 for a page) and returns the figure at that width,
    with text of 8 pt; it is called when the figure is needed, in a context that sets fonts and colours
    (`uwblink.pages.figures`).
    """

    name: str
    draw: Callable[[float], Figure]
    caption: str


@dataclass(frozen=True, slots=True)
class Listing:
    """Text to be shown as it is."""

    text: str


Block = Heading | Text | Table | Picture | Listing
VERDICTS = ("good", "doubt", "bad")


@dataclass(frozen=True, slots=True)
class Document:
    """A title and its blocks, in order; `subtitle` says when and how it was made.

    Figures of the same name are numbered, so that none takes another's file.
    """

    title: str
    blocks: list[Block]
    subtitle: str = ""

    def __post_init__(self) -> None:
        """Number figures of the same name from the second on."""
        seen: Counter[str] = Counter()
        for k, block in enumerate(self.blocks):
            if isinstance(block, Picture):
                seen[block.name] += 1
                if seen[block.name] > 1:
                    self.blocks[k] = replace(block, name=f"{block.name}-{seen[block.name]}")

    def pictures(self) -> list[Picture]:
        """Return the figures, in order."""
        return [block for block in self.blocks if isinstance(block, Picture)]

    def captions(self) -> dict[str, str]:
        """Return the captions of the figures by name, numbered."""
        return {p.name: f"Figure {number}. {p.caption}" for number, p in enumerate(self.pictures(), 1)}

    def contents(self) -> list[str]:
        """Return the headings."""
        return [block.text for block in self.blocks if isinstance(block, Heading)]


def sentence_apart(text: str) -> tuple[str, str]:
    """Return the first sentence of a text, and the rest."""
    first, dot, rest = text.partition(". ")
    return (f"{first}.", rest) if dot else (text, "")
