"""What a page is made of, whatever it is shown on: headings, paragraphs, tables, figures; and its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from uwblink.output import write_bytes, write_files, write_text
from uwblink.pages.html import figure_html, page_html, table_html

if TYPE_CHECKING:
    from uwblink.pages.figures import Draw


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

    def parts(self) -> tuple[str, str]:
        """Return what is set large and what is not."""
        if self.kind not in ("good", "doubt", "bad"):
            return "", self.text
        first, dot, rest = self.text.partition(". ")
        return (f"{first}.", rest) if dot else (first, "")


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
    with text of 8 pt. It is called in a context that sets fonts and colours (`uwblink.pages.figures`).
    """

    name: str
    draw: Draw
    caption: str


@dataclass(frozen=True, slots=True)
class Listing:
    """Text that is shown as it is; lines of one that is a `table` do not break on a screen."""

    text: str
    table: bool = False


Block = Heading | Text | Table | Picture | Listing


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
        """Return the headings; they are listed above the first section where there are more than two."""
        return [block.text for block in self.blocks if isinstance(block, Heading)]


Drawings = Mapping[str, Mapping[str, Mapping[str, bytes]]]
"""Files of figures by name, width ("page" or "column") and kind ("svg" or "pdf")."""


def draw_figures(
    document: Document, kinds: Mapping[str, list[str]], progress: Callable[[str], None] = lambda _: None
) -> Drawings:
    """Draw each figure of a document once at each width that has `kinds` of files."""
    from uwblink.pages.figures import WIDTHS, drawn

    found = {}
    for one in document.pictures():
        progress(f"drawing {one.name}")
        found[one.name] = {
            width: drawn(one.draw, WIDTHS[width], wanted, salt=f"{one.name} {width}")
            for width, wanted in kinds.items()
            if wanted
        }
    return found


def to_html(document: Document, drawings: Drawings | None = None) -> str:
    """Return a document as one page of HTML that needs no other file; all text is escaped."""
    drawings = draw_figures(document, {"page": ["svg"], "column": ["svg"]}) if drawings is None else drawings
    captions, number = document.captions(), 0
    parts = [f"<p class='note'>{escape(document.subtitle)}</p>"] if document.subtitle else []
    for block in document.blocks:
        match block:
            case Heading(text):
                number += 1
                if number == 1 and len(document.contents()) > 2:
                    entries = (
                        f"<li><a href='#s{k}'>{escape(t)}</a></li>" for k, t in enumerate(document.contents(), 1)
                    )
                    parts.append(f"<nav aria-label='Contents'><ol>{''.join(entries)}</ol></nav>")
                parts.append(f"<h2 id='s{number}'>{escape(text)}</h2>")
            case Text(_, kind):
                large, rest = map(escape, block.parts())
                parts.append(f"<p class='verdict {kind}'><b>{large}</b> {rest}</p>" if large else
                             f"<p class='{escape(kind, quote=True)}'>{rest}</p>")  # fmt: skip
            case Listing(text, table):
                opening = "<pre class='table'>" if table else "<pre>"
                parts.append(f"{opening}{escape(text)}</pre>")
            case Picture(name):
                svg = {width: files["svg"] for width, files in drawings[name].items()}
                parts.append(figure_html(svg, captions[name]))
            case Table(header, rows, above, total, words):
                parts.append(table_html(header, rows, above, total=total, words=words))
    return page_html(document.title, parts)


def write_document(
    document: Document,
    output: Path | None,
    pdf: Path | None = None,
    figures: Path | None = None,
    *,
    force: bool = False,
    progress: Callable[[str], None] = lambda _: None,
) -> None:
    """Write a document as HTML (as PDF where `output` ends in .pdf), as PDF, and its figures into a folder.

    Each figure is drawn once at each width; the folder has PDF and SVG of both. `progress` is told what is being done.
    Raises what `uwblink.output.check_output` raises.
    """
    page = output if output is not None and output.suffix.lower() != ".pdf" else None
    papers = [path for path in (output if page is None else None, pdf) if path is not None]
    screen, paper = ["svg"] if page or figures else [], ["pdf"] if figures else []
    kinds = {"page": screen + (paper or ["pdf"] * bool(papers)), "column": screen + paper}
    made = draw_figures(document, kinds, progress)
    if papers:
        from uwblink.pages.pdf import to_pdf

        progress("setting the PDF")
        data = to_pdf(document, {name: widths["page"]["pdf"] for name, widths in made.items()})
        for path in papers:
            write_bytes(path, data, force=force)
    if figures:
        files: dict[str, bytes] = {}
        for name, widths in made.items():
            for width, drawings in widths.items():
                files |= {f"{name}-{width}.{kind}": data for kind, data in drawings.items()}
        write_files(figures, files, force=force)
    if page:
        progress("writing the page")
        write_text(page, to_html(document, made), force=force)
