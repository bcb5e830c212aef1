"""What a report is made of, whatever it is shown on: headings, paragraphs, tables, figures."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field

from matplotlib.figure import Figure

PAPER_DPI = 200
SCREEN_DPI = 130


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading of a section."""

    text: str


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph; `kind` is "plain", "lead" (the summary at the top), "warning" or "note" (below a table)."""

    text: str
    kind: str = "plain"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts; the first column is left-aligned. `above` are headings with the columns they span.

    The last row is set apart if `total`.
    """

    header: list[str]
    rows: list[list[str]]
    above: list[tuple[str, int]] = field(default_factory=list)
    total: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure with its file name (no suffix) and caption; drawn only when it is needed."""

    name: str
    draw: Callable[[], Figure]
    caption: str


@dataclass(frozen=True, slots=True)
class Listing:
    """Text to be shown as it is."""

    text: str


Block = Heading | Text | Table | Picture | Listing


@dataclass(frozen=True, slots=True)
class Document:
    """A title and its blocks, in order."""

    title: str
    blocks: list[Block]

    def pictures(self) -> list[Picture]:
        """Return the figures, in order."""
        return [block for block in self.blocks if isinstance(block, Picture)]


def rendered(figure: Figure, kind: str, dpi: int = SCREEN_DPI) -> bytes:
    """Return a figure as a file of a kind that matplotlib writes (png, pdf, svg)."""
    data = io.BytesIO()
    # No date in the file: the same data give the same bytes.
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    figure.savefig(data, format=kind, dpi=dpi, metadata=metadata)
    return data.getvalue()
