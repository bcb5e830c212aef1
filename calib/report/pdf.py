"""A report as PDF, on A4."""

from __future__ import annotations

import datetime
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from calib.report.blocks import Block, Document, Heading, Listing, Picture, Table, Text

if TYPE_CHECKING:
    from fpdf import FPDF

MARGIN_MM: Final = 16
SIZE: Final = 9.5
SMALL: Final = 7.5
FILLS: Final = {"lead": (243, 245, 247), "warning": (255, 244, 224)}
FAMILY: Final = "DejaVu"
EPOCH: Final = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
"""Written as the date of creation, so that the same data give the same bytes."""


def to_pdf(document: Document, pictures: Mapping[str, bytes]) -> bytes:
    """Return the document as PDF; `pictures` are its figures as PNG by name."""
    from fpdf import FPDF
    from matplotlib import get_data_path

    fonts = Path(get_data_path()) / "fonts" / "ttf"
    page = FPDF(format="A4")
    page.set_creation_date(EPOCH)
    page.set_title(document.title)
    page.set_margin(MARGIN_MM)
    page.set_auto_page_break(True, MARGIN_MM)
    # matplotlib carries these fonts; the built-in ones of PDF know no Greek and no minus sign.
    page.add_font(FAMILY, "", fonts / "DejaVuSans.ttf")
    page.add_font(FAMILY, "B", fonts / "DejaVuSans-Bold.ttf")
    page.add_page()
    _write(page, document.title, 18, style="B")
    for block, following in zip(document.blocks, [*document.blocks[1:], None], strict=True):
        # A heading stays with what it heads.
        if isinstance(block, Heading) and page.will_page_break(110 if isinstance(following, Picture) else 45):
            page.add_page()
        _block(page, block, pictures)
    return bytes(page.output())


def _block(page: FPDF, block: Block, pictures: Mapping[str, bytes]) -> None:
    match block:
        case Heading(text):
            page.ln(3)
            _write(page, text, 13, style="B")
            page.line(page.l_margin, page.get_y(), page.w - page.r_margin, page.get_y())
            page.ln(2)
        case Text(text, kind):
            fill = FILLS.get(kind)
            _write(page, text, SMALL + 0.5 if kind == "note" else SIZE, fill=fill)
            page.ln(1.5)
        case Listing(text):
            _write(page, text, SMALL, fill=FILLS["lead"])
        case Picture():
            _picture(page, pictures[block.name], block.caption)
        case Table():
            _table(page, block)


def _write(page: FPDF, text: str, size: float, *, style: str = "", fill: tuple[int, int, int] | None = None) -> None:
    page.set_font(FAMILY, "B" if style == "B" else "", size)
    if fill:
        page.set_fill_color(*fill)
    page.multi_cell(0, size * 0.5, text, align="L", fill=fill is not None, new_x="LMARGIN", new_y="NEXT", padding=1)


def _picture(page: FPDF, png: bytes, caption: str) -> None:
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        height = page.epw * image.height / image.width
    height = min(height, page.eph - 20)
    if page.will_page_break(height + 8):
        page.add_page()
    page.image(io.BytesIO(png), w=page.epw, h=height, keep_aspect_ratio=True)
    _write(page, caption, SMALL)
    page.ln(1.5)


def _table(page: FPDF, table: Table) -> None:
    from fpdf.enums import TableBordersLayout
    from fpdf.fonts import FontFace

    columns = len(table.header)
    size = SIZE - 1 if columns <= 8 else 6.0
    page.set_font(FAMILY, "", size)
    # Columns as wide as their widest cell, the whole never wider than the page.
    cells = [table.header, *table.rows]
    page.set_font(FAMILY, "B", size)
    heads = [page.get_string_width(name) for name in table.header]
    page.set_font(FAMILY, "", size)
    widths = [max(heads[k], *(page.get_string_width(row[k]) for row in cells)) + 3 for k in range(columns)]
    scale = min(1.0, page.epw / sum(widths))
    with page.table(
        col_widths=tuple(w * scale for w in widths),
        width=sum(widths) * scale,
        align="LEFT",
        text_align=("LEFT", *["RIGHT"] * (columns - 1)),
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        line_height=size * 0.55,
        headings_style=FontFace(emphasis="BOLD"),
        num_heading_rows=2 if table.above else 1,
        padding=0.4,
    ) as drawn:
        if table.above:
            row = drawn.row()
            for name, span in table.above:
                row.cell(name, colspan=span, align="CENTER")
        for k, texts in enumerate(cells):
            row = drawn.row(style=FontFace(emphasis="BOLD") if table.total and k == len(cells) - 1 else None)
            for text in texts:
                row.cell(text)
    page.ln(2)
