"""Turns a document into files: an HTML page, a PDF, and its figures at paper size."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from calib.errors import BadInputError
from calib.report.blocks import PAPER_DPI, Document, rendered
from calib.report.html import to_html
from uwblink.output import check_output, write_bytes, write_text

PAPER_KINDS: Final = ("pdf", "svg")


def html_of(document: Document) -> str:
    """Return a document as the text of one HTML page that needs no other file."""
    return to_html(document, {p.name: rendered(p.draw(), "png") for p in document.pictures()})


def check_places(html: Path, pdf: Path | None, figures: Path | None, *, force: bool) -> None:
    """Raise, before anything is computed, what would keep the files from being written."""
    for path in filter(None, (html, pdf)):
        check_output(path, force=force)
    if figures is not None and figures.exists() and not figures.is_dir():
        raise BadInputError(f"{figures} is a file, expected a folder", parameter="figures")
    if figures is not None and not figures.parent.is_dir():
        raise BadInputError(f"{figures.parent} does not exist", parameter="figures")


def write_document(
    document: Document,
    html: Path,
    pdf: Path | None,
    figures: Path | None,
    *,
    force: bool,
    progress: Callable[[str], None],
) -> None:
    """Write a document as HTML, as PDF, and its figures (PDF and SVG) into a folder; draws each figure once."""
    check_places(html, pdf, figures, force=force)
    pictures: dict[str, bytes] = {}
    files: dict[str, bytes] = {}
    for picture in document.pictures():
        progress(f"drawing {picture.name}")
        figure = picture.draw()
        pictures[picture.name] = rendered(figure, "png")
        if figures:
            files |= {f"{picture.name}.{kind}": rendered(figure, kind, PAPER_DPI) for kind in PAPER_KINDS}
    text = to_html(document, pictures)
    if pdf:
        from calib.report.pdf import to_pdf

        progress("setting the PDF")
        write_bytes(pdf, to_pdf(document, pictures), force=force)
    if figures:
        figures.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            write_bytes(figures / name, data, force=True)
    write_text(html, text, force=force)
