"""A document as PDF on A4: Matplotlib sets text and tables, pypdf inserts the figures, links and the outline.

Lengths are points (1/72 inch) from the upper left corner of a page.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from itertools import groupby
from typing import Any, Final

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.textpath import text_to_path
from pypdf import PdfReader, PdfWriter
from pypdf.annotations import Link
from pypdf.generic import NameObject, TextStringObject

from uwblink.pages.blocks import Document, Heading, Listing, Picture, Table, Text
from uwblink.pages.figures import WIDTHS, style

PAPER: Final = (595.28, 841.89)
"""Width and height of A4."""

MARGIN: Final = (PAPER[0] - 72 * WIDTHS["page"]) / 2
"""Figures of a page's width are printed as large as they are drawn."""

SIZE: Final = 9.5
SMALL: Final = 8.0
"""Text, and the smallest text: that of tables, notes, captions and figures."""

ROW: Final = 1.55 * SMALL
"""Height of a line of a table."""

FILLS: Final = {
    "lead": "#f3f5f7",
    "warning": "#fff4e0",
    "good": "#e5f4ec",
    "doubt": "#fff4e0",
    "bad": "#fdeaea",
}
"""Grounds of paragraphs, as in page.css."""


def to_pdf(document: Document, figures: Mapping[str, bytes]) -> bytes:
    """Return the document as PDF; `figures` are the PDFs of its figures by name, as wide as the page's text."""
    drawings = {name: PdfReader(io.BytesIO(data)).pages[0] for name, data in figures.items()}
    with style():
        pages = _Pages(document, {name: float(page.mediabox.height) for name, page in drawings.items()})
        data = io.BytesIO()
        # No date in the file: the same data give the same bytes; the subtitle says when it was made.
        with PdfPages(data, metadata={"Title": document.title, "CreationDate": None}) as file:
            for figure in pages.pages:
                file.savefig(figure)
    writer = PdfWriter(clone_from=data)
    for name, on, y in pages.placed:
        writer.pages[on].merge_translated_page(drawings[name], MARGIN, PAPER[1] - y)
    for text, begins in pages.sections:
        writer.add_outline_item(title=text, page_number=begins)
    for (_, begins), (on, y) in zip(pages.sections, pages.contents, strict=bool(pages.contents)):
        box = (MARGIN, PAPER[1] - y - 1.45 * SIZE, PAPER[0] - MARGIN, PAPER[1] - y)
        writer.add_annotation(on, Link(rect=box, target_page_index=begins, border=[0, 0, 0]))
    writer.root_object[NameObject("/Lang")] = TextStringObject("en")
    for page in writer.pages:
        page.compress_content_streams()
    writer.compress_identical_objects()  # each figure brings the same fonts
    data = io.BytesIO()
    writer.write(data)
    return data.getvalue()


class _Pages:
    """The pages of a document with room for figures of given heights, and the places of figures and links.

    `placed` are name, page and lower edge of each figure, `sections` headings with their pages, `contents` page and
    upper edge of the lines that list them.
    """

    def __init__(self, document: Document, heights: Mapping[str, float]) -> None:
        self.pages: list[Figure] = []
        self.placed: list[tuple[str, int, float]] = []
        self.sections: list[tuple[str, int]] = []
        self.contents: list[tuple[int, float]] = []
        self.y = 0.0
        self._new_page()
        self._write(document.title, 18, bold=True)
        self._write(document.subtitle, SMALL)
        captions, contents = document.captions(), document.contents()
        for block, following in zip(document.blocks, [*document.blocks[1:], None], strict=True):
            match block:
                case Heading(text):
                    if not self.sections and len(contents) > 2:
                        self._list(contents)
                    # A heading stays with the figure or the short table that follows, or with some lines.
                    room = heights[following.name] if isinstance(following, Picture) else 70.0
                    room = max(room, self._whole(following)) if isinstance(following, Table) else room
                    self._need(min(room + 55, PAPER[1] - 2 * MARGIN - 30))
                    self.sections.append((text, len(self.pages) - 1))
                    self.y += 9
                    self._write(text, 13, bold=True)
                    self._rule(MARGIN, PAPER[0] - MARGIN)
                    self.y += 6
                case Text(_, kind):
                    large, rest = block.parts()
                    self._write(large, 13, bold=True, fill=FILLS.get(kind), below=0.0)
                    self._write(rest, SMALL if kind == "note" else SIZE + 1 if large else SIZE, fill=FILLS.get(kind))
                    self.y += 4
                case Listing(text):
                    self._write(text, SMALL, fill=FILLS["lead"], family="DejaVu Sans Mono")
                case Picture(name):
                    self._need(heights[name] + 30)
                    self.y += heights[name]
                    self.placed.append((name, len(self.pages) - 1, self.y))
                    self._write(captions[name], SMALL)
                    self.y += 4
                case Table():
                    for columns, widths in _parts(block):
                        self._table(block, columns, widths)
        for (on, y), (_, begins) in zip(self.contents, self.sections, strict=bool(self.contents)):
            self._text(str(begins + 1), PAPER[0] - MARGIN, y, SIZE, align="right", page=on)
        for k in range(len(self.pages)):
            self._text(f"{k + 1} / {len(self.pages)}", PAPER[0] / 2, PAPER[1] - 30, SMALL, align="center", page=k)

    def _new_page(self) -> None:
        self.pages.append(Figure(figsize=(PAPER[0] / 72, PAPER[1] / 72)))
        self.y = MARGIN

    def _need(self, height: float) -> bool:
        """Begin a new page if the height does not fit on this one; returns whether it did."""
        full = self.y + height > PAPER[1] - 45
        if full:
            self._new_page()
        return full

    def _text(
        self, text: str, x: float, y: float, size: float, *, align: str = "left", page: int = -1, **font: Any
    ) -> None:
        place = (x / PAPER[0], 1 - (y + 1.1 * size) / PAPER[1])
        self.pages[page].text(*place, text, fontsize=size, ha=align, va="baseline", parse_math=False, **font)

    def _rule(self, left: float, right: float) -> None:
        height = 1 - self.y / PAPER[1]
        line = Line2D([left / PAPER[0], right / PAPER[0]], [height, height], color="#000000", lw=0.3)
        self.pages[-1].add_artist(line)

    def _write(
        self,
        text: str,
        size: float,
        *,
        bold: bool = False,
        fill: str | None = None,
        family: str = "DejaVu Sans",
        below: float = 4.0,
    ) -> None:
        """Write a paragraph over the width of the page, on a filled ground if `fill` is given."""
        if not text:
            return
        font = FontProperties(family=family, weight="bold" if bold else "normal", size=size)
        step, edge = 1.45 * size, 6.0 if fill else 0.0
        for line in _lines(text, PAPER[0] - 2 * MARGIN - 2 * edge, font):
            self._need(step)
            if fill:
                # A little higher than the line, so that no gap shows between two.
                corner = (MARGIN / PAPER[0], 1 - (self.y + step + 2) / PAPER[1])
                size_of = (1 - 2 * MARGIN / PAPER[0], (step + 3) / PAPER[1])
                self.pages[-1].add_artist(Rectangle(corner, *size_of, fc=fill, lw=0, zorder=0))
            self._text(line, MARGIN + edge, self.y, size, family=family, weight="bold" if bold else "normal")
            self.y += step
        self.y += below

    def _list(self, contents: list[str]) -> None:
        self.y += 6
        for text in contents:
            self._need(1.45 * SIZE)
            self.contents.append((len(self.pages) - 1, self.y))
            self._text(text, MARGIN, self.y, SIZE)
            self.y += 1.45 * SIZE

    def _whole(self, table: Table) -> float:
        """Return the height of a table that is kept on one page: up to half of it, no line broken; 0 of others."""
        height = (ROW + 2.4) * (len(table.rows) + (2 if table.above else 1))
        return height if not table.words and height < (PAPER[1] - 2 * MARGIN) / 2 else 0.0

    def _table(self, table: Table, columns: list[int], widths: list[float]) -> None:
        """Set some columns of a table; its headings are repeated on every page."""
        over = [name for name, span in table.above for _ in range(span)]
        edges = [MARGIN + sum(widths[:k]) for k in range(len(widths) + 1)]
        self._need(self._whole(table))

        def cells_of(texts: list[str], *, bold: bool) -> list[list[str]]:
            return [_lines(texts[c], w - 4, _font(bold=bold)) for c, w in zip(columns, widths, strict=True)]

        head = cells_of(table.header, bold=True)
        for k, row in enumerate(table.rows):
            bold = table.total and k == len(table.rows) - 1
            cells = cells_of(row, bold=bold)
            if self._need(ROW * max(map(len, cells)) + 2.4) or k == 0:
                if over:
                    for name, group in groupby(range(len(columns)), key=lambda place: over[columns[place]]):
                        places = list(group)
                        middle = (edges[places[0]] + edges[places[-1] + 1]) / 2
                        self._text(name, middle, self.y, SMALL, align="center", weight="bold")
                    self.y += ROW + 2.4
                self._row(head, edges, left=table.words, bold=True)
            self._row(cells, edges, left=table.words, bold=bold)
        self.y += 8

    def _row(self, cells: list[list[str]], edges: list[float], *, left: bool, bold: bool) -> None:
        for k, lines in enumerate(cells):
            align = "left" if left or k == 0 else "right"
            x = edges[k] + 2 if align == "left" else edges[k + 1] - 2
            for n, line in enumerate(lines):
                self._text(line, x, self.y + n * ROW + 1.2, SMALL, align=align, weight="bold" if bold else "normal")
        self.y += ROW * max(map(len, cells)) + 2.4
        self._rule(edges[0], edges[-1])


def _font(*, bold: bool) -> FontProperties:
    return FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal", size=SMALL)


def _width(text: str, font: FontProperties) -> float:
    return float(text_to_path.get_text_width_height_descent(text, font, False)[0]) if text else 0.0


def _lines(text: str, width: float, font: FontProperties) -> list[str]:
    """Break a text into lines of a width: between words, and a word that is longer than a line inside."""
    if "\n" not in text and _width(text, font) <= width:
        return [text]
    found = []
    for paragraph in text.split("\n"):
        line = ""
        for word in re.findall(r"\S+\s*|\s+", paragraph):
            if line.strip() and _width(line + word.rstrip(), font) > width:
                found.append(line.rstrip())
                line = ""
            while _width(line + word.rstrip(), font) > width and len(word) > 1:
                fits = next((k for k in range(len(word), 1, -1) if _width(line + word[:k], font) <= width), 1)
                found.append(line + word[:fits])
                line, word = "", word[fits:]
            line += word
        found.append(line.rstrip())
    return found


def _parts(table: Table) -> list[tuple[list[int], list[float]]]:
    """Return the columns of each part of a table, and their widths; parts have the first column in common.

    Where a table of words is wider than the page, its columns above 57 points (20 mm) give way and their lines break.
    Other tables are cut between columns: text stays as large as it is.
    """
    # Columns are as wide as their widest cells.
    bold = [table.header, *(table.rows[-1:] if table.total else [])]
    cells = [(row, _font(bold=strong)) for rows, strong in ((bold, True), (table.rows, False)) for row in rows]
    widths = [max(_width(row[k], font) for row, font in cells) + 7 for k in range(len(table.header))]
    room = PAPER[0] - 2 * MARGIN
    if sum(widths) <= room:
        return [(list(range(len(widths))), widths)]
    if table.words or len(widths) < 3:
        wide = sum(w for w in widths if w > 57)
        left = max(room - (sum(widths) - wide), 57.0)
        return [(list(range(len(widths))), [w * left / wide if w > 57 else w for w in widths])]
    groups: list[list[int]] = []
    used = room
    for k in range(1, len(widths)):
        used += widths[k]
        if used > room:
            groups.append([0])
            used = widths[0] + widths[k]
        groups[-1].append(k)
    return [(columns, [widths[k] for k in columns]) for columns in groups]
