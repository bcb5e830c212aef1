"""Pages of HTML that need no other file: the frame, tables, and figures in two widths."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Final

from uwblink.pages.drawings import inline
from uwblink.pages.stylesheet import CSS, JS, PARTS

if TYPE_CHECKING:
    from uwblink.pages.figures import Draw

MANY: Final = 8
"""Columns from which a table is set smaller."""


def page_html(title: str, parts: Iterable[str]) -> str:
    """Return a whole page; `parts` are HTML already, `title` is text and becomes the heading."""
    return "\n".join(
        [
            "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width, initial-scale=1'>",
            f"<title>{escape(title)}</title><style>{CSS}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            f"{PARTS}<script>{JS}</script></body></html>\n",
        ]
    )


def figure_html(drawings: Mapping[str, bytes], caption: str) -> str:
    """Return a figure: drawings (SVG) by width, "page" and "column", of which a page shows the one that fits."""
    wide, narrow = (inline(drawings[name], caption) for name in ("page", "column"))
    return (
        f"<figure><div class='wide'>{wide}</div><div class='narrow'>{narrow}</div>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def both_widths(draw: Draw, caption: str, salt: str) -> str:
    """Draw a figure at both widths, and return it as HTML; `salt` is a word that no other figure of the page has."""
    from uwblink.pages.figures import WIDTHS, drawn

    drawings = {name: drawn(draw, width, ["svg"], salt=f"{salt} {name}")["svg"] for name, width in WIDTHS.items()}
    return figure_html(drawings, caption)


def table_html(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    above: Sequence[tuple[str, int]] = (),
    *,
    total: bool = False,
    words: bool = False,
) -> str:
    """Return a table of texts; `above` are headings with the columns they span, the last row is set apart if `total`.

    Tables of `words` are left-aligned and break their lines.
    """
    spans = "".join(f"<th colspan='{span}'>{escape(name)}</th>" for name, span in above)
    over = f"<tr class='above'>{spans}</tr>" if spans else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    # On a phone cells of words stand below each other, without the row of headings; one alone needs no name.
    heads = ["", *header[1:]] if words and len(header) > 2 else [""] * len(header)
    body = []
    for k, row in enumerate(rows):
        last = " class='all'" if total and k == len(rows) - 1 else ""
        body.append(f"<tr{last}>" + "".join(_cell(cell, heads[j]) for j, cell in enumerate(row)) + "</tr>")
    kind = " ".join(name for name, so in (("many", len(header) > MANY), ("words", words)) if so)
    of_kind = f" class='{kind}'" if kind else ""
    parts = f"<thead>{over}<tr>{head}</tr></thead><tbody>{''.join(body)}</tbody>"
    return f"<div class='wide' tabindex='0'><table{of_kind}>{parts}</table></div>"


def _cell(text: str, head: str) -> str:
    named = f" data-head='{escape(head, quote=True)}'" if head and text else ""
    return f"<td{named}>{escape(text)}</td>"
