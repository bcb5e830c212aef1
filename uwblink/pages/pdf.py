"""A document as PDF on A4: Matplotlib sets text and tables, pypdf inserts the figures and the outline.

A document becomes strips, such as a line of text, a row of a table or a figure, which fill one page after the other.
Lengths are points (1/72 inch) from the upper left corner of a page.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Final, NamedTuple

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.textpath import text_to_path
from pypdf import PdfReader, PdfWriter

from uwblink.pages.blocks import Block, Document, Heading, Listing, Picture, Table, Text
from uwblink.pages.figures import WIDTHS, style

PAPER: Final = (595.28, 841.89)
"""Width and height of A4."""

ROOM: Final = 72 * WIDTHS["page"]
"""Width of text; figures of a page's width are printed as large as they are drawn."""

MARGIN: Final = (PAPER[0] - ROOM) / 2

SMALL: Final = 8.0
"""The smallest text: that of tables, notes, captions and figures."""

FILLS: Final = {
    "lead": "#f3f5f7",
    "warning": "#fff4e0",
    "good": "#e5f4ec",
    "doubt": "#fff4e0",
    "bad": "#fdeaea",
}
"""Grounds of paragraphs, as in page.css."""


class Words(NamedTuple):
    """One line of text: its place (`y` below the upper edge of its strip, of the base line), alignment and font."""

    text: str
    x: float
    y: float
    align: str
    font: FontProperties


@dataclass(frozen=True, slots=True)
class Strip:
    """A piece of a page as wide as the text, which is not parted.

    It begins a new page where less height than `room` is left; `heads` are then repeated above it. `figure` is the name
    of a figure that stands on it, `section` the entry of the outline that leads to it.
    """

    height: float
    words: tuple[Words, ...] = ()
    room: float = 0.0
    heads: tuple[Strip, ...] = ()
    figure: str = ""
    section: str = ""
    fill: str = ""
    ruled: bool = False


def to_pdf(document: Document, figures: Mapping[str, bytes]) -> bytes:
    """Return the document as PDF; `figures` are the PDFs of its figures by name, as wide as the page's text."""
    drawings = {name: PdfReader(io.BytesIO(data)).pages[0] for name, data in figures.items()}
    pages: list[Figure] = []
    placed: list[tuple[Strip, int, float]] = []
    y = PAPER[1]
    with style():
        for strip in _strips(document, {name: float(page.mediabox.height) for name, page in drawings.items()}):
            heads: tuple[Strip, ...] = ()
            if y + max(strip.height, strip.room) > PAPER[1] - 45:
                pages.append(Figure(figsize=(PAPER[0] / 72, PAPER[1] / 72)))
                y, heads = MARGIN, strip.heads
            for one in (*heads, strip):
                _draw(pages[-1], one, y)
                y += one.height
            placed.append((strip, len(pages) - 1, y))
        for number, page in enumerate(pages, 1):
            text = Words(f"{number} / {len(pages)}", PAPER[0] / 2, PAPER[1] - 20, "center", _font(SMALL))
            _draw(page, Strip(0.0, (text,)), 0.0)
        data = io.BytesIO()
        # No date in the file: the same data give the same bytes; the subtitle says when it was made.
        with PdfPages(data, metadata={"Title": document.title, "CreationDate": None}) as file:
            for page in pages:
                file.savefig(page)
    writer = PdfWriter(clone_from=data)
    for strip, on, y in placed:
        if strip.figure:
            writer.pages[on].merge_translated_page(drawings[strip.figure], MARGIN, PAPER[1] - y)
        if strip.section:
            writer.add_outline_item(title=strip.section, page_number=on)
    for done in writer.pages:
        done.compress_content_streams()
    writer.compress_identical_objects()  # each figure brings the same fonts
    data = io.BytesIO()
    writer.write(data)
    return data.getvalue()


def _draw(page: Figure, strip: Strip, y: float) -> None:
    """Draw a strip without its figure below a height."""
    left, right, lower = MARGIN / PAPER[0], 1 - MARGIN / PAPER[0], 1 - (y + strip.height) / PAPER[1]
    if strip.fill:
        # A little higher than the strip, so that no gap shows between two.
        height = (strip.height + 1) / PAPER[1]
        page.add_artist(Rectangle((left, lower), right - left, height, fc=strip.fill, lw=0, zorder=0))
    for words in strip.words:
        place = (words.x / PAPER[0], 1 - (y + words.y) / PAPER[1])
        page.text(*place, words.text, font=words.font, ha=words.align, va="baseline", parse_math=False)
    if strip.ruled:
        page.add_artist(Line2D([left, right], [lower, lower], color="#000000", lw=0.3))


def _strips(document: Document, heights: Mapping[str, float]) -> list[Strip]:
    """Return the strips of a document with figures of given heights."""
    parts = [_of_block(block, document.captions(), heights) for block in document.blocks]
    for k, block in enumerate(document.blocks[:-1]):
        if isinstance(block, Heading):
            # A heading stays with the figure or the short table that follows, or with some lines.
            room = sum(strip.height for strip in parts[k]) + max(70.0, parts[k + 1][0].room)
            parts[k][0] = replace(parts[k][0], room=room)
    title = [*_paragraph(document.title, 18, weight="bold"), *_paragraph(document.subtitle, SMALL)]
    return [*title, *(strip for part in parts for strip in part)]


def _of_block(block: Block, captions: Mapping[str, str], heights: Mapping[str, float]) -> list[Strip]:
    match block:
        case Heading(text):
            *lines, gap = _paragraph(text, 13, weight="bold")
            lines[-1] = replace(lines[-1], ruled=True, section=text)
            return [Strip(9.0), *lines, gap]
        case Text(_, kind):
            large, rest = block.parts()
            fill = FILLS.get(kind, "")
            size = SMALL if kind == "note" else 9.5
            return [*_paragraph(large, 13, fill, weight="bold")[:-1], *_paragraph(rest, size, fill)]
        case Listing(text):
            return _paragraph(text, SMALL, FILLS["lead"], family="DejaVu Sans Mono")
        case Picture(name):
            return [Strip(heights[name], figure=name, room=heights[name] + 30), *_paragraph(captions[name], SMALL)]
        case Table():
            return [strip for columns, widths in _parts(block) for strip in _table(block, columns, widths)]


def _paragraph(text: str, size: float, fill: str = "", **font: Any) -> list[Strip]:
    """Return the lines of a text and the gap below; no lines of an empty text."""
    set_in, edge = _font(size, **font), 6.0 if fill else 0.0
    lines = _lines(text, ROOM - 2 * edge, set_in) if text else []
    strips = [
        Strip(1.45 * size, (Words(line, MARGIN + edge, 1.1 * size, "left", set_in),), fill=fill) for line in lines
    ]
    return [*strips, Strip(8.0)]


def _table(table: Table, columns: list[int], widths: list[float]) -> list[Strip]:
    """Return some columns of a table as strips; a table of up to half a page is not parted."""
    edges = [MARGIN + sum(widths[:k]) for k in range(len(widths) + 1)]
    line_height = 1.55 * SMALL

    def row(texts: list[str], weight: str = "normal") -> Strip:
        font, words, most = _font(SMALL, weight=weight), [], 1
        for k, column in enumerate(columns):
            left = table.words or k == 0
            x, align = (edges[k] + 2, "left") if left else (edges[k + 1] - 2, "right")
            lines = _lines(texts[column], widths[k] - 4, font)
            words += [Words(line, x, n * line_height + 1.1 * SMALL + 1.2, align, font) for n, line in enumerate(lines)]
            most = max(most, len(lines))
        return Strip(line_height * most + 2.4, tuple(words), ruled=True)

    over = [name for name, span in table.above for _ in range(span)]
    above = []
    for name, group in groupby(range(len(columns)) if over else (), key=lambda place: over[columns[place]]):
        places = list(group)
        middle = (edges[places[0]] + edges[places[-1] + 1]) / 2
        above.append(Words(name, middle, 1.1 * SMALL, "center", _font(SMALL, weight="bold")))
    heads = (Strip(line_height + 2.4 if above else 0.0, tuple(above)), row(table.header, "bold"))
    last = len(table.rows) - 1 if table.total else None
    rows = [replace(row(texts, "bold" if k == last else "normal"), heads=heads) for k, texts in enumerate(table.rows)]
    whole = sum(strip.height for strip in (*heads, *rows))
    room = whole if whole < PAPER[1] / 2 else sum(strip.height for strip in (*heads, *rows[:1]))
    return [replace(heads[0], room=room), heads[1], *rows, Strip(8.0)]


def _font(size: float, weight: str = "normal", family: str = "DejaVu Sans") -> FontProperties:
    return FontProperties(family=family, weight=weight, size=size)


def _width(text: str, font: FontProperties) -> float:
    return float(text_to_path.get_text_width_height_descent(text, font, False)[0]) if text else 0.0


def _lines(text: str, width: float, font: FontProperties) -> list[str]:
    """Break a text into lines of a width: between words, and a word that is longer than a line anywhere."""
    found = []
    for paragraph in text.split("\n"):
        line = ""
        for word in re.findall(r"\S+\s*|\s+", paragraph):
            for piece in [word] if _width(word.rstrip(), font) <= width else word:
                if line.strip() and _width(line + piece.rstrip(), font) > width:
                    found.append(line.rstrip())
                    line = ""
                line += piece
        found.append(line.rstrip())
    return found


def _parts(table: Table) -> list[tuple[list[int], list[float]]]:
    """Return the columns of each part of a table, and their widths; parts have the first column in common.

    Where a table of words is wider than the page, its columns above 57 points (20 mm) give way and their lines break.
    Other tables are cut between columns: text stays as large as it is.
    """
    rows = [table.header, *table.rows]
    widths = [max(_width(row[k], _font(SMALL, "bold")) for row in rows) + 7 for k in range(len(table.header))]
    if sum(widths) > ROOM and (table.words or len(widths) < 3):
        wide = sum(w for w in widths if w > 57)
        left = max(ROOM - (sum(widths) - wide), 57.0)
        widths = [w * left / wide if w > 57 else w for w in widths]
    parts = [[0]]
    for k in range(1, len(widths)):
        if len(parts[-1]) > 1 and sum(widths[c] for c in parts[-1]) + widths[k] > ROOM + 0.1:
            parts.append([0])
        parts[-1].append(k)
    return [(columns, [widths[k] for k in columns]) for columns in parts]
