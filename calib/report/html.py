"""A report as one HTML file with everything in it, readable on a screen, a phone and on paper."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from typing import Final

from calib.report.blocks import Block, Document, Heading, Listing, Picture, Table, Text

STYLE: Final = """
:root { color-scheme: light dark; --ink: #1a1a1a; --page: #fff; --line: #ccc; --soft: #f3f5f7; --warn: #fff4e0;
  --edge: #d08700; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --page: #16181b; --line: #444; --soft: #22262b;
  --warn: #33280f; --edge: #e0a030; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--page); max-width: 1040px;
  margin: 0 auto; padding: 1rem; }
h1 { line-height: 1.2; } h2 { margin-top: 2.2rem; border-bottom: 1px solid var(--line); }
.lead { font-size: 1.15rem; background: var(--soft); padding: .8rem 1rem; border-radius: .4rem; }
.warning { background: var(--warn); border-left: .3rem solid var(--edge); padding: .5rem 1rem; border-radius: .2rem; }
.note { font-size: .9rem; } .wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } tr.all { font-weight: bold; }
table.many { font-size: .85rem; } .many th, .many td { padding: .2rem .4rem; }
tr.above th { text-align: center; border-left: 1px solid var(--line); }
figure { margin: 1rem 0; } figure img { width: 100%; height: auto; background: #fff; border-radius: .4rem; }
figcaption { font-size: .9rem; }
pre { background: var(--soft); padding: .6rem; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .8rem; }
@page { size: A4; margin: 16mm; }
@media print { :root { --ink: #000; --page: #fff; --line: #bbb; --soft: #f3f5f7; --warn: #fff4e0; }
  body { max-width: none; padding: 0; font-size: 10.5pt; } h2 { break-after: avoid; }
  figure, tr { break-inside: avoid; } .wide { overflow: visible; }
  table { font-size: 8.5pt; } th, td { padding: .1rem .35rem; } }
"""


MANY: Final = 10
"""Columns from which a table is set smaller."""


def to_html(document: Document, pictures: Mapping[str, bytes]) -> str:
    """Return the document as HTML; `pictures` are its figures as PNG by name. All text is escaped."""
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{escape(document.title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(document.title)}</h1>",
        *[_block(block, pictures) for block in document.blocks],
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _block(block: Block, pictures: Mapping[str, bytes]) -> str:
    match block:
        case Heading(text):
            return f"<h2>{escape(text)}</h2>"
        case Text(text, kind):
            return f"<p class='{kind}'>{escape(text)}</p>"
        case Listing(text):
            return f"<pre>{escape(text)}</pre>"
        case Picture():
            return _figure(pictures[block.name], block.caption)
        case Table():
            return _table(block)


def _figure(png: bytes, caption: str) -> str:
    data = base64.b64encode(png).decode()
    return (
        f"<figure><img alt='{escape(caption, quote=True)}' src='data:image/png;base64,{data}'>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _table(table: Table) -> str:
    spans = "".join(f"<th colspan='{span}'>{escape(name)}</th>" for name, span in table.above)
    above = f"<tr class='above'>{spans}</tr>" if spans else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in table.header)
    rows = []
    for k, row in enumerate(table.rows):
        last = " class='all'" if table.total and k == len(table.rows) - 1 else ""
        rows.append(f"<tr{last}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    many = " class='many'" if len(table.header) > MANY else ""
    body = f"<thead>{above}<tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f"<div class='wide'><table{many}>{body}</table></div>"
