"""Pages of HTML that need no other file: the frame, tables, and drawings that follow the page's light and fonts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape, unescape
from importlib.resources import files
from typing import Final

from uwblink.pages.colours import DARK

VARIABLES: Final = {colour: f"--f{number}" for number, colour in enumerate(DARK)}
"""The CSS variable of each colour of a figure; its value depends on the ground of the page."""


def _figure_colours(*, dark: bool) -> str:
    return " ".join(f"{name}: {DARK[colour] if dark else colour};" for colour, name in VARIABLES.items())


def _part(name: str) -> str:
    return (files("uwblink.pages") / name).read_text(encoding="utf-8")


CSS: Final = (
    _part("page.css")
    .replace("/* figures by day */", _figure_colours(dark=False))
    .replace("/* figures by night */", _figure_colours(dark=True))
)
"""Styles for a screen, a phone, light and dark ground, and paper."""


def page_html(title: str, parts: Iterable[str]) -> str:
    """Return a whole page; `parts` are HTML already, `title` is text and becomes the heading.

    Without its script a page loses only the values under the pointer and the enlarged figures.
    """
    return "\n".join(
        [
            "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width, initial-scale=1'>",
            f"<title>{escape(title)}</title><style>{CSS}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            "<div id='tip'></div><dialog id='zoom' aria-label='Figure, closer'><form method='dialog'>"
            "<button>Close</button> wheel: closer · drag: move · double click: all</form>"
            f"<div style='height:100%'></div></dialog><script>{_part('page.js')}</script></body></html>\n",
        ]
    )


def figure_html(drawings: Mapping[str, bytes], caption: str) -> str:
    """Return a figure: drawings (SVG) by width, "page" and "column", of which a page shows the one that fits."""
    wide, narrow = (inline(drawings[name], caption) for name in ("page", "column"))
    return (
        f"<figure><div class='wide'>{wide}</div><div class='narrow'>{narrow}</div>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def inline(svg: bytes, caption: str) -> str:
    """Return a drawing as part of a page: no prologue, no fixed size, the colours and fonts of the page.

    What its panels show (see `uwblink.pages.figures.drawn`) is in the attribute `data-panels`.
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


def table_html(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    above: Sequence[tuple[str, int]] = (),
    *,
    total: bool = False,
    words: bool = False,
) -> str:
    """Return a table of texts; `above` are headings with the columns they span, the last row is set apart if `total`.

    Tables of `words` are left-aligned and break their lines. Tables of more than eight columns are set smaller.
    """
    spans = "".join(f"<th colspan='{span}'>{escape(name)}</th>" for name, span in above)
    over = f"<tr class='above'>{spans}</tr>" if spans else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    # On a phone cells of words stand below each other, each with its heading; of two columns the second needs none.
    heads = ["", *header[1:]] if words and len(header) > 2 else [""] * len(header)
    body = ""
    for k, row in enumerate(rows):
        last = " class='all'" if total and k == len(rows) - 1 else ""
        body += f"<tr{last}>"
        for text, name in zip(row, heads, strict=True):
            named = f" data-head='{escape(name, quote=True)}'" if name and text else ""
            body += f"<td{named}>{escape(text)}</td>"
        body += "</tr>"
    classes = " ".join(name for name, wanted in (("many", len(header) > 8), ("words", words)) if wanted)
    opening = f"<table class='{classes}'>" if classes else "<table>"
    inside = f"<thead>{over}<tr>{head}</tr></thead><tbody>{body}</tbody>"
    return f"<div class='wide' tabindex='0'>{opening}{inside}</table></div>"
