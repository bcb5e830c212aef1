"""Turns a document into files: an HTML page, a PDF, and its figures at paper size."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from calib.errors import BadInputError
from calib.report.blocks import Document
from calib.report.html import to_html
from uwblink.output import check_output, write_bytes, write_files, write_text
from uwblink.pages.figures import WIDTHS, drawn

PAPER_KINDS: Final = ("pdf", "svg")


def html_of(document: Document) -> str:
    """Return a document as the text of one HTML page that needs no other file."""
    drawings = {
        p.name: {name: drawn(p.draw, width, ["svg"], salt=f"{p.name} {name}")["svg"] for name, width in WIDTHS.items()}
        for p in document.pictures()
    }
    return to_html(document, drawings)


def check_places(output: Path | None, pdf: Path | None, figures: Path | None, *, force: bool) -> None:
    """Raise, before anything is computed, what would keep the files from being written."""
    for path in filter(None, (output, pdf)):
        check_output(path, force=force)
    if pdf is not None and output is not None and output.resolve() == pdf.resolve():
        raise BadInputError(f"{output} is the page already; give the PDF another name", parameter="pdf")
    if figures is not None and figures.exists() and not figures.is_dir():
        raise BadInputError(f"{figures} is a file, expected a folder", parameter="figures")
    if figures is not None and not force and any(f for k in PAPER_KINDS for f in figures.glob(f"*.{k}")):
        raise BadInputError(f"{figures} holds figures already; give another folder, or `force` to replace them",
                            parameter="figures")  # fmt: skip
    if figures is not None and not figures.parent.is_dir():
        raise BadInputError(f"{figures.parent} does not exist", parameter="figures")


def is_pdf(path: Path) -> bool:
    """Return whether a file of that name is to be a PDF."""
    return path.suffix.lower() == ".pdf"


def write_document(
    document: Document,
    output: Path | None,
    pdf: Path | None,
    figures: Path | None,
    *,
    force: bool,
    progress: Callable[[str], None] = lambda _: None,
) -> None:
    """Write a document as HTML (as PDF where `output` ends so), as PDF, and its figures into a folder.

    Each figure is drawn once at each width, a column's and a page's; the folder has PDF and SVG of both.
    """
    check_places(output, pdf, figures, force=force)
    papers = [path for path in (output, pdf) if path is not None and (path is pdf or is_pdf(path))]
    page = None if output is None or is_pdf(output) else output
    kinds = {
        "page": [kind for kind, wanted in (("svg", page or figures), ("pdf", papers or figures)) if wanted],
        "column": [kind for kind, wanted in (("svg", page or figures), ("pdf", figures)) if wanted],
    }
    made: dict[str, dict[str, dict[str, bytes]]] = {}
    for picture in document.pictures():
        progress(f"drawing {picture.name}")
        made[picture.name] = {
            width: drawn(picture.draw, WIDTHS[width], wanted, salt=f"{picture.name} {width}")
            for width, wanted in kinds.items()
            if wanted
        }
    if papers:
        from calib.report.pdf import to_pdf

        progress("setting the PDF")
        data = to_pdf(document, {name: widths["page"]["pdf"] for name, widths in made.items()})
        for path in papers:
            write_bytes(path, data, force=force)
    if figures:
        named = {
            f"{name}-{width}.{kind}": data
            for name, widths in made.items()
            for width, files in widths.items()
            for kind, data in files.items()
        }
        write_files(figures, named, force=force)
    if page:
        progress("writing the page")
        drawings = {name: {width: files["svg"] for width, files in widths.items()} for name, widths in made.items()}
        write_text(page, to_html(document, drawings), force=force)
