"""Documents as PDF on A4: ReportLab sets text and tables, pypdf inserts figures and the outline.

Lengths are in points (1/72 inch).
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from html import escape
from itertools import chain, groupby
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import matplotlib
from pypdf import PdfReader, PdfWriter
from reportlab.lib.enums import TA_CENTER, TA_LEFT, TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.pdfbase.pdfmetrics import registerFont, registerFontFamily, stringWidth
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.platypus import BaseDocTemplate, CondPageBreak, Flowable, Frame, PageTemplate, Paragraph, XPreformatted
from reportlab.platypus import Table as Grid

from uwblink.pages.blocks import Block, Document, Heading, Listing, Picture, Table, Text, prose
from uwblink.pages.figures import WIDTHS

TEXT_WIDTH: Final = 72 * WIDTHS["page"]
"""Width of text, equal to that of figures, so that these are not scaled."""

SMALL: Final = 8.0
"""Font size of tables, notes, captions and figures."""

FILLS: Final = {
    "lead": "#f3f5f7",
    "warning": "#fff4e0",
    "good": "#e5f4ec",
    "doubt": "#fff4e0",
    "bad": "#fdeaea",
}
"""Background colours of paragraphs, as in page.css."""

FONTS: Final = {"sans": "DejaVuSans", "bold": "DejaVuSans-Bold", "mono": "DejaVuSansMono"}
"""Font files of Matplotlib, so that text and figures have the same font."""


Place = tuple[Block, int, float, float]
"""A block, the number of its page from 0, and x and y of its lower left corner."""


class _Space(Flowable):  # type: ignore[misc] # ReportLab has no types
    """Empty space for a block, which appends the place of the block to `places` when it is drawn."""

    def __init__(self, block: Block, height: float, places: list[Place]) -> None:
        super().__init__()
        self.width, self.height, self._block, self._places = TEXT_WIDTH, height, block, places

    def draw(self) -> None:
        """Append the place."""
        self._places.append((self._block, self.canv.getPageNumber() - 1, *self.canv.absolutePosition(0, 0)))


def to_pdf(document: Document, figures: Mapping[str, bytes]) -> bytes:
    """Return the document as PDF; `figures` are PDFs of its figures at the width of a page, by name."""
    for name, file in FONTS.items():
        registerFont(TTFont(name, Path(matplotlib.get_data_path(), "fonts", "ttf", f"{file}.ttf")))
    registerFontFamily("sans", normal="sans", bold="bold", italic="sans", boldItalic="bold")
    drawings = {name: PdfReader(io.BytesIO(data)).pages[0] for name, data in figures.items()}
    heights = {name: float(page.mediabox.height) for name, page in drawings.items()}
    # The first pass determines the number of pages.
    count, *_ = _set(document, heights, 0)
    _, data, places = _set(document, heights, count)
    writer = PdfWriter(clone_from=data)
    for block, page, x, y in places:
        if isinstance(block, Picture):
            writer.pages[page].merge_translated_page(drawings[block.name], x, y)
        elif isinstance(block, Heading):
            writer.add_outline_item(title=block.text, page_number=page)
    for done in writer.pages:
        done.compress_content_streams()
    writer.compress_identical_objects()  # all figures contain the same fonts
    data = io.BytesIO()
    writer.write(data)
    return data.getvalue()


def _set(document: Document, heights: Mapping[str, float], count: int) -> tuple[int, io.BytesIO, list[Place]]:
    """Return the number of pages, the PDF without figures, and the places of headings and figures.

    The footer of each page has its number and `count`, the number of pages.
    """
    data, places, margin = io.BytesIO(), list[Place](), (A4[0] - TEXT_WIDTH) / 2
    # `invariant`: no dates, so that the same data give the same bytes. The subtitle states the date.
    file = BaseDocTemplate(data, pagesize=A4, title=document.title, invariant=1, initialFontName="sans")
    frame = Frame(margin, 45, TEXT_WIDTH, A4[1] - margin - 45, *[0] * 4)

    def number(page: Any, _: Any) -> None:
        page.setFont("sans", SMALL)
        page.drawCentredString(A4[0] / 2, 20, f"{page.getPageNumber()} / {count}")

    file.addPageTemplates(PageTemplate(frames=[frame], onPage=number))
    file.build(list(_story(document, heights, places)))
    return file.page, data, places


def _story(document: Document, heights: Mapping[str, float], places: list[Place]) -> Iterator[Any]:
    """Yield the content of the pages, from top to bottom."""
    yield from (_text(escape(document.title), 18, fontName="bold"), _text(escape(document.subtitle), SMALL))
    captions, together = document.captions(), list[Any]()
    for block in document.blocks:
        match block:
            case Heading(text):
                # Keep a heading on the page of the next block.
                together += [_Space(block, 0.0, places), _text(escape(text), 13, fontName="bold", spaceBefore=9)]
                continue
            case Text(_, kind):
                large, rest = map(prose, block.parts())
                large = f'<font size="13"><b>{large}</b></font><br/>' if large else ""
                together.append(_text(large + rest, SMALL if kind == "note" else 9.5, FILLS.get(kind)))
            case Listing(text):
                # Characters of DejaVu Sans Mono are 0.602 font sizes wide.
                columns = int((TEXT_WIDTH - 10) / (0.602 * SMALL))
                broken = (wrap(line, columns, drop_whitespace=False) or [""] for line in text.split("\n"))
                lines = "\n".join(chain.from_iterable(broken))
                together.append(_text(escape(lines), SMALL, FILLS["lead"], XPreformatted, fontName="mono"))
            case Picture(name):
                together += [_Space(block, heights[name], places), _text(prose(captions[name]), SMALL)]
            case Table():
                together += _tables(block)
        height = sum(one.wrap(TEXT_WIDTH, A4[1])[1] + one.getSpaceBefore() + one.getSpaceAfter() for one in together)
        # Blocks are kept on one page; those above two thirds of a page need only space for a heading and some lines.
        yield CondPageBreak(height if height < A4[1] * 2 / 3 else 100.0)
        yield from together
        together = []
    yield from together


def _text(html: str, size: float, fill: str | None = None, kind: Any = Paragraph, **style: Any) -> Any:
    """Return a paragraph of HTML with a background colour, if any."""
    padding = 5 if fill else 0
    own = {"fontName": "sans", "spaceAfter": 8 + padding, "splitLongWords": 1, "backColor": fill}
    own |= {"borderPadding": padding, "leftIndent": padding, "rightIndent": padding}
    html = html.replace("<code>", '<font name="mono">').replace("</code>", "</font>")
    return kind(html, ParagraphStyle("", fontSize=size, leading=1.45 * size, **(own | style)))


def _tables(table: Table) -> Iterator[Flowable]:
    """Yield a table; if it is wider than the page, several tables that repeat the first column.

    In a table of words, or with two columns, columns above 57 points (20 mm) are made narrower instead, and their lines
    break.
    """
    rows = [table.header, *table.rows]
    widths = [max(stringWidth(row[k], "bold", SMALL) for row in rows) + 7 for k in range(len(table.header))]
    if sum(widths) > TEXT_WIDTH and (table.words or len(widths) < 3):
        wide = sum(w for w in widths if w > 57)
        left = max(TEXT_WIDTH - (sum(widths) - wide), 57.0)
        widths = [max(w * left / wide, 20.0) if w > 57 else w for w in widths]
    parts = [[0]]
    for k in range(1, len(widths)):
        if len(parts[-1]) > 1 and sum(widths[c] for c in parts[-1]) + widths[k] > TEXT_WIDTH + 0.1:
            parts.append([0])
        parts[-1].append(k)
    over = [name for name, span in table.above for _ in range(span)]
    total = len(rows) - 1 if table.total else 0
    for columns in parts:
        style: list[Any] = [
            ("FONTNAME", (0, 0), (-1, -1), "sans"),
            ("LINEBELOW", (0, 0), (-1, -1), 0.3, "#000000"),
            ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ("LEFTPADDING", (0, 0), (-1, -1), 2),
            ("RIGHTPADDING", (0, 0), (-1, -1), 2),
            ("TOPPADDING", (0, 0), (-1, -1), 1),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 2),
        ]
        cells = [
            [_cell(row[c], TA_LEFT if table.words or c == 0 else TA_RIGHT, bold=k in (0, total)) for c in columns]
            for k, row in enumerate(rows)
        ]
        if over:
            spans = [list(places) for _, places in groupby(range(len(columns)), key=lambda k: over[columns[k]])]
            cells = [[_cell(over[c], TA_CENTER, bold=True) for c in columns], *cells]
            style += [("SPAN", (places[0], 0), (places[-1], 0)) for places in spans]
        above = len(cells) - len(table.rows)
        shape: dict[str, Any] = {"colWidths": [widths[c] for c in columns], "repeatRows": above, "splitInRow": 1}
        yield Grid(cells, **shape, style=style, hAlign="LEFT", spaceAfter=8)


def _cell(text: str, alignment: int, *, bold: bool) -> Paragraph:
    return _text(prose(text), SMALL, spaceAfter=0, fontName="bold" if bold else "sans", alignment=alignment)
