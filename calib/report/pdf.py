"""A report as PDF, on A4: text and tables set here, figures as the drawings they are, page numbers, contents."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from calib.report.blocks import VERDICTS, Block, Document, Heading, Listing, Picture, Table, Text, sentence_apart
from calib.report.pdf_figures import MM_OF_INCH, Place, page_of, size_mm, with_figures
from uwblink.pages.figures import PAGE_IN

if TYPE_CHECKING:
    from fpdf import FPDF

PAPER_MM: Final = (210.0, 297.0)
MARGIN_MM: Final = (PAPER_MM[0] - PAGE_IN * MM_OF_INCH) / 2
"""So that figures of a page's width are printed as large as they are drawn."""

FOOT_MM: Final = 16.0
SIZE: Final = 9.5
SMALL: Final = 8.0
"""The smallest text."""

HEADING_MM: Final = 20.0
LINE_MM: Final = 5.0
NUMBER_MM: Final = 12.0
"""Heights of a heading and of a line of the contents, and width of its page number."""

NARROW_MM: Final = 20.0
"""Up to this width a column is not made narrower."""

PADDING_MM: Final = 2.4
"""Beside the text of a cell."""

ROW_MM: Final = SMALL * 0.55
"""Height of a line of a table."""

GAP_MM: Final = 0.4
"""Above and below the lines of a row."""

FILLS: Final = {
    "lead": (243, 245, 247),
    "warning": (255, 244, 224),
    "good": (229, 244, 236),
    "doubt": (255, 244, 224),
    "bad": (253, 234, 234),
}
FAMILY: Final = "DejaVu"
EPOCH: Final = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
"""Written as the date of creation, so that the same data give the same bytes; the title says when it was made."""


@dataclass(slots=True)
class _Placed:
    """Where figures are to stand, and on which page each section begins.

    `contents` are page and height in mm of the lines that list the sections.
    """

    figures: list[Place] = field(default_factory=list)
    sections: list[int] = field(default_factory=list)
    contents: list[tuple[int, float]] = field(default_factory=list)


def to_pdf(document: Document, figures: Mapping[str, bytes]) -> bytes:
    """Return the document as PDF; `figures` are the PDFs of its figures by name, as wide as the page's text."""
    pictures = {name: page_of(pdf) for name, pdf in figures.items()}
    text, placed = _set(document, {name: size_mm(page) for name, page in pictures.items()})
    return with_figures(bytes(text.output()), pictures, placed.figures)


def _set(document: Document, sizes: Mapping[str, tuple[float, float]]) -> tuple[FPDF, _Placed]:
    """Set text and tables, and leave room for figures of these sizes in mm."""
    page, placed = _new(document), _Placed()
    _write(page, document.title, 18, style="B")
    if document.subtitle:
        _write(page, document.subtitle, SMALL)
    captions, listed = document.captions(), False
    for block, following in zip(document.blocks, [*document.blocks[1:], None], strict=True):
        if isinstance(block, Heading) and not listed:
            _contents(page, document, placed)
            listed = True
        if isinstance(block, Heading):
            _heading(page, block, _beginning_mm(page, following, sizes))
            placed.sections.append(page.page_no())
        elif isinstance(block, Picture):
            _picture(page, block, captions[block.name], sizes[block.name], placed)
        else:
            _block(page, block)
    _number_contents(page, placed)
    return page, placed


def _beginning_mm(page: FPDF, block: Block | None, sizes: Mapping[str, tuple[float, float]]) -> float:
    """Return the room that a heading needs for itself and what it must not be parted from."""
    if isinstance(block, Picture):
        return HEADING_MM + sizes[block.name][1]
    whole = _whole_mm(page, block) if isinstance(block, Table) else 0.0
    return HEADING_MM + (whole or 25.0)


def _whole_mm(page: FPDF, table: Table) -> float:
    """Return the height of a table that is not to be parted: up to half a page, no line broken; 0 of others."""
    height = (ROW_MM + 2 * GAP_MM) * (len(table.rows) + (2 if table.above else 1))
    return height if not table.words and height < page.eph / 2 else 0.0


def _new(document: Document) -> FPDF:
    from fpdf import FPDF
    from matplotlib import get_data_path

    class Numbered(FPDF):
        """Pages with their numbers at the foot."""

        def footer(self) -> None:
            self.set_y(-FOOT_MM + 4)
            self.set_font(FAMILY, "", SMALL)
            self.cell(0, 5, f"{self.page_no()} / {{nb}}", align="C")

    fonts = Path(get_data_path()) / "fonts" / "ttf"
    page = Numbered(format="A4")
    page.set_creation_date(EPOCH)
    page.set_title(document.title)
    page.set_lang("en")
    page.set_margin(MARGIN_MM)
    page.set_auto_page_break(True, FOOT_MM)
    # matplotlib carries these fonts; the built-in ones of PDF know no Greek and no minus sign.
    page.add_font(FAMILY, "", fonts / "DejaVuSans.ttf")
    page.add_font(FAMILY, "B", fonts / "DejaVuSans-Bold.ttf")
    page.add_page()
    return page


def _contents(page: FPDF, document: Document, placed: _Placed) -> None:
    """List the sections; their pages are added when all is set."""
    page.ln(2)
    page.set_font(FAMILY, "", SIZE)
    for text in document.contents():
        if page.will_page_break(LINE_MM):
            page.add_page()
        placed.contents.append((page.page, page.get_y()))
        page.cell(page.epw - NUMBER_MM, LINE_MM, text, new_x="LMARGIN", new_y="NEXT")


def _number_contents(page: FPDF, placed: _Placed) -> None:
    last, at = page.page, page.get_y()
    for (on, y), begins in zip(placed.contents, placed.sections, strict=True):
        page.page = on
        page.set_font(FAMILY, "B", SIZE)  # a page that is gone back to knows nothing of the font now chosen
        page.set_font(FAMILY, "", SIZE)
        page.set_xy(page.l_margin, y)
        link = page.add_link(page=begins)
        page.cell(page.epw - NUMBER_MM, LINE_MM, "", link=link)
        page.cell(NUMBER_MM, LINE_MM, str(begins), align="R", link=link)
    page.page = last
    page.set_y(at)


def _heading(page: FPDF, block: Heading, room_mm: float) -> None:
    """A heading stays with what it heads."""
    if page.will_page_break(min(room_mm, page.eph - 10)):
        page.add_page()
    page.ln(3)
    page.start_section(block.text)
    _write(page, block.text, 13, style="B")
    page.line(page.l_margin, page.get_y(), page.w - page.r_margin, page.get_y())
    page.ln(2)


def _block(page: FPDF, block: Block) -> None:
    match block:
        case Text(text, kind) if kind in VERDICTS:
            first, rest = sentence_apart(text)
            _write(page, first, 13, style="B", fill=FILLS[kind])
            if rest:
                _write(page, rest, SIZE + 1, fill=FILLS[kind])
            page.ln(1.5)
        case Text(text, kind):
            _write(page, text, SMALL if kind == "note" else SIZE, fill=FILLS.get(kind))
            page.ln(1.5)
        case Listing(text):
            _write(page, text, SMALL, fill=FILLS["lead"])
        case Table():
            for part in _parts(page, block):
                _table(page, part)


def _write(page: FPDF, text: str, size: float, *, style: str = "", fill: tuple[int, int, int] | None = None) -> None:
    page.set_font(FAMILY, "B" if style == "B" else "", size)
    if fill:
        page.set_fill_color(*fill)
    page.multi_cell(0, size * 0.5, text, align="L", fill=fill is not None, new_x="LMARGIN", new_y="NEXT", padding=1)


def _picture(page: FPDF, block: Picture, caption: str, size: tuple[float, float], placed: _Placed) -> None:
    """Leave room for a figure, and write its caption below."""
    height = size[1]
    if page.will_page_break(height + 10):
        page.add_page()
    placed.figures.append(Place(block.name, page.page_no() - 1, page.l_margin, page.h - page.get_y() - height))
    page.ln(height)
    _write(page, caption, SMALL)
    page.ln(1.5)


def _widths(page: FPDF, table: Table) -> list[float]:
    """Return how wide the columns of a table are, as their widest cells."""
    bold = [table.header, *table.rows[-1:]] if table.total else [table.header]
    page.set_font(FAMILY, "B", SMALL)
    wide = [max(page.get_string_width(row[k]) for row in bold) for k in range(len(table.header))]
    page.set_font(FAMILY, "", SMALL)
    return [max([w, *(page.get_string_width(row[k]) for row in table.rows)]) + PADDING_MM for k, w in enumerate(wide)]


def _parts(page: FPDF, table: Table) -> list[Table]:
    """Cut a table that is wider than the page into tables with the same first column; text stays as large as it is."""
    widths = _widths(page, table)
    if table.words or sum(widths) <= page.epw or len(widths) < 3:
        return [table]
    parts, columns, used = [], [0], widths[0]
    for k in range(1, len(widths)):
        if used + widths[k] > page.epw and len(columns) > 1:
            parts.append(_columns(table, columns))
            columns, used = [0], widths[0]
        columns.append(k)
        used += widths[k]
    return [*parts, _columns(table, columns)]


def _narrowed(widths: list[float], room_mm: float) -> list[float]:
    """Return widths that fit: where they do not, wide columns give way, whose lines break, and narrow ones stay."""
    narrow = [w <= NARROW_MM for w in widths]
    wide = sum(w for w, stays in zip(widths, narrow, strict=True) if not stays)
    left = room_mm - (sum(widths) - wide)
    if sum(widths) <= room_mm or left <= 0:
        return widths
    return [w if stays else w * left / wide for w, stays in zip(widths, narrow, strict=True)]


def _columns(table: Table, kept: list[int]) -> Table:
    """Return some columns of a table."""
    over = [name for name, span in table.above for _ in range(span)]
    above: list[tuple[str, int]] = []
    for k in kept if over else []:
        same = bool(above) and above[-1][0] == over[k]
        above = [*above[:-1], (over[k], above[-1][1] + 1)] if same else [*above, (over[k], 1)]
    return Table([table.header[k] for k in kept], [[row[k] for k in kept] for row in table.rows], above, table.total)


def _table(page: FPDF, table: Table) -> None:
    from fpdf.enums import TableBordersLayout
    from fpdf.fonts import FontFace

    widths = _narrowed(_widths(page, table), page.epw)
    width = min(page.epw, sum(widths))
    page.set_fill_color(255, 255, 255)
    page.set_font(FAMILY, "", SMALL)
    if page.will_page_break(_whole_mm(page, table)):
        page.add_page()
    with page.table(
        col_widths=tuple(widths),
        width=width,
        align="LEFT",
        text_align="LEFT" if table.words else ("LEFT", *["RIGHT"] * (len(widths) - 1)),
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        line_height=ROW_MM,
        headings_style=FontFace(emphasis="BOLD"),
        num_heading_rows=2 if table.above else 1,
        padding=GAP_MM,
    ) as drawn:
        if table.above:
            row = drawn.row()
            for name, span in table.above:
                row.cell(name, colspan=span, align="CENTER")
        for k, texts in enumerate([table.header, *table.rows]):
            row = drawn.row(style=FontFace(emphasis="BOLD") if table.total and k == len(table.rows) else None)
            for text in texts:
                row.cell(text)
    page.ln(2)
