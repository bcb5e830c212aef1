"""The blocks of a page (headings, paragraphs, tables, figures), its HTML, and its files.

An HTML page needs no other file. Its figures use the fonts of the page, and its light or dark colours.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape, unescape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Final

from uwblink.output import write_bytes, write_files, write_text
from uwblink.pages.colours import DARK

if TYPE_CHECKING:
    from uwblink.pages.figures import Draw


VARIABLES: Final = {colour: f"--f{number}" for number, colour in enumerate(DARK)}
"""The CSS variable of each colour in figures; its value is that of the light or of the dark page."""


def _figure_colours(*, dark: bool) -> str:
    return " ".join(f"{name}: {DARK[colour] if dark else colour};" for colour, name in VARIABLES.items())


def _part(name: str) -> str:
    return (files("uwblink.pages") / name).read_text(encoding="utf-8")


CSS: Final = (
    _part("page.css")
    .replace("/* light colours of figures */", _figure_colours(dark=False))
    .replace("/* dark colours of figures */", _figure_colours(dark=True))
)
"""Styles for screens, phones, light and dark pages, and print."""


def inline(svg: bytes, caption: str) -> str:
    """Return an SVG for an HTML page: without prologue and fixed size, with the colours and fonts of the page.

    The attribute `data-panels` describes its panels (see `uwblink.pages.figures.drawn`).
    """
    text = svg.decode()
    text = text[text.index("<svg") :]
    described = re.search(r"<dc:description>(.*?)</dc:description>", text, re.DOTALL)
    panels = escape(unescape(described[1]), quote=True) if described else ""
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="series-([^"]*)"', r'<g class="series" data-name="\1"', text)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"font-family: [^;\"]*", "font-family: system-ui, sans-serif", text)
    text = re.sub(r"font: ([\d.]+)px[^;\"]*", r"font: \1px system-ui, sans-serif", text)
    text = re.sub("|".join(VARIABLES), lambda found: f"var({VARIABLES[found[0].lower()]})", text, flags=re.IGNORECASE)
    attributes = f"role='img' aria-label='{escape(caption, quote=True)}' data-panels='{panels}'"
    head = re.compile(r"<svg [^>]*?viewBox=\"([^\"]*)\"[^>]*>", re.DOTALL)
    return head.sub(lambda found: f'<svg viewBox="{found[1]}" {attributes}>', text, count=1)


def prose(text: str) -> str:
    """Return a text as HTML, with its line breaks, and with names in backticks as code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text)).replace("\n", "<br/>")


def table_html(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    above: Sequence[tuple[str, int]] = (),
    *,
    total: bool = False,
    words: bool = False,
) -> str:
    """Return a table of texts as HTML.

    `above` are headings with the number of columns that each spans. With `total`, the last row is emphasised. Tables of
    `words` are left-aligned, and their lines may break. Tables with more than eight columns have smaller text.
    """
    spans = "".join(f"<th colspan='{span}'>{escape(name)}</th>" for name, span in above)
    over = f"<tr class='above'>{spans}</tr>" if spans else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    # On a phone, the cells of a row of words are below each other, with their headings; with two columns, without.
    heads = ["", *header[1:]] if words and len(header) > 2 else [""] * len(header)
    body = ""
    for k, row in enumerate(rows):
        last = " class='all'" if total and k == len(rows) - 1 else ""
        body += f"<tr{last}>"
        for text, name in zip(row, heads, strict=True):
            named = f" data-head='{escape(name, quote=True)}'" if name and text else ""
            body += f"<td{named}>{prose(text)}</td>"
        body += "</tr>"
    classes = " ".join(name for name, wanted in (("many", len(header) > 8), ("words", words)) if wanted)
    opening = f"<table class='{classes}'>" if classes else "<table>"
    inside = f"<thead>{over}<tr>{head}</tr></thead><tbody>{body}</tbody>"
    return f"<div class='wide' tabindex='0'>{opening}{inside}</table></div>"


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading of a section."""

    text: str


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph.

    `kind` is "plain", "lead" (a summary at the top), "warning", "note" (below a table), or that of a verdict, "good",
    "doubt" or "bad", whose first sentence is larger.
    """

    text: str
    kind: str = "plain"

    def parts(self) -> tuple[str, str]:
        """Return the larger and the normal part of the text."""
        if self.kind not in ("good", "doubt", "bad"):
            return "", self.text
        first, dot, rest = self.text.partition(". ")
        return (f"{first}.", rest) if dot else (first, "")


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts; the first column is left-aligned, the others right-aligned.

    `above` are headings with the number of columns that each spans. With `total`, the last row is emphasised. A table
    of `words` is left-aligned, and its lines may break.
    """

    header: list[str]
    rows: list[list[str]]
    above: list[tuple[str, int]] = field(default_factory=list)
    total: bool = False
    words: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure with its file name (without suffix) and caption.

    `draw` is a function that takes a width in inches (3.5 for a column or a phone, 7.16 for a page) and returns the
    figure at that width. It is called in a context that sets fonts of 8 pt and colours (`uwblink.pages.figures`).
    """

    name: str
    draw: Draw
    caption: str


@dataclass(frozen=True, slots=True)
class Listing:
    """Preformatted text. On a screen, the lines of a `table` do not break."""

    text: str
    table: bool = False


Block = Heading | Text | Table | Picture | Listing


@dataclass(frozen=True, slots=True)
class Document:
    """A title and blocks, in order; `subtitle` states when and how the document was made.

    If figures have the same name, numbers are added, so that their files differ.
    """

    title: str
    blocks: list[Block]
    subtitle: str = ""

    def __post_init__(self) -> None:
        """Add numbers to the names of figures that repeat an earlier name."""
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
        """Return the captions of the figures by name, with their numbers."""
        return {p.name: f"Figure {number}. {p.caption}" for number, p in enumerate(self.pictures(), 1)}

    def contents(self) -> list[str]:
        """Return the headings; a page with more than two lists them above the first section."""
        return [block.text for block in self.blocks if isinstance(block, Heading)]


def draw_figures(
    document: Document, kinds: Mapping[str, Sequence[str]], progress: Callable[[str | float], None] = lambda _: None
) -> dict[str, bytes]:
    """Draw each figure of a document once at each width; return files by name, such as "errors-page.svg".

    `kinds` are the kinds of files by width, "page" or "column". `progress` is called with the present step, and with
    the share of the figures that are drawn.
    """
    from uwblink.pages.figures import WIDTHS, drawn

    files: dict[str, bytes] = {}
    for k, one in enumerate(document.pictures()):
        progress(k / len(document.pictures()))
        progress(f"drawing {one.name}")
        for width, width_in in WIDTHS.items():
            made = drawn(one.draw, width_in, kinds[width], salt=f"{one.name} {width}") if kinds[width] else {}
            files |= {f"{one.name}-{width}.{kind}": data for kind, data in made.items()}
    return files


def to_html(document: Document, drawings: Mapping[str, bytes] | None = None) -> str:
    """Return a document as one HTML page that needs no other file; all text is escaped.

    `drawings` are its figures as returned by `draw_figures`; by default they are drawn.
    """
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
                large, rest = map(prose, block.parts())
                parts.append(f"<p class='verdict {kind}'><b>{large}</b> {rest}</p>" if large else
                             f"<p class='{escape(kind, quote=True)}'>{rest}</p>")  # fmt: skip
            case Listing(text, table):
                opening = "<pre class='table'>" if table else "<pre>"
                parts.append(f"{opening}{escape(text)}</pre>")
            case Picture(name):
                # The style of the page shows the drawing that fits the screen.
                wide, narrow = (inline(drawings[f"{name}-{width}.svg"], captions[name]) for width in ("page", "column"))
                parts.append(
                    f"<figure><div class='wide'>{wide}</div><div class='narrow'>{narrow}</div>"
                    f"<figcaption>{escape(captions[name])}</figcaption></figure>"
                )
            case Table(header, rows, above, total, words):
                parts.append(table_html(header, rows, above, total=total, words=words))
    title = escape(document.title)
    # Without JavaScript, a page lacks only values at the pointer and enlarged figures.
    return "\n".join(
        [
            "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width, initial-scale=1'>",
            f"<title>{title}</title><style>{CSS}</style></head><body>",
            f"<h1>{title}</h1>",
            *parts,
            "<div id='tip'></div><dialog id='zoom' aria-label='Figure, closer'><form method='dialog'>"
            "<button>Close</button> wheel: closer · drag: move · double click: all</form>"
            f"<div style='height:100%'></div></dialog><script>{_part('page.js')}</script></body></html>\n",
        ]
    )


def write_document(
    document: Document,
    output: Path | None,
    pdf: Path | None = None,
    figures: Path | None = None,
    *,
    force: bool = False,
    progress: Callable[[str | float], None] = lambda _: None,
) -> None:
    """Write a document to `output` as HTML, or as PDF if it ends in .pdf; to `pdf` as PDF; and its figures to a folder.

    Each figure is drawn once at each width; the folder has PDF and SVG of both. `progress` is called with the present
    step, and with the share of the figures that are drawn. Raises the errors of `uwblink.output.check_output`.
    """
    page = output if output is not None and output.suffix.lower() != ".pdf" else None
    papers = [path for path in (output if page is None else None, pdf) if path is not None]
    svg = ["svg"] if page or figures else []
    kinds = {"page": [*svg, *(["pdf"] if papers or figures else [])], "column": [*svg, *(["pdf"] if figures else [])]}
    made = draw_figures(document, kinds, progress)
    if papers:
        from uwblink.pages.pdf import to_pdf

        progress("setting the PDF")
        data = to_pdf(document, {one.name: made[f"{one.name}-page.pdf"] for one in document.pictures()})
        for path in papers:
            write_bytes(path, data, force=force)
    if figures:
        write_files(figures, made, force=force)
    if page:
        progress("writing the page")
        write_text(page, to_html(document, made), force=force)
