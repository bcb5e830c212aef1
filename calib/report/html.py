"""A report as one HTML file with everything in it, readable on a screen, a phone and on paper."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from calib.report.blocks import VERDICTS, Block, Document, Heading, Listing, Picture, Table, Text, sentence_apart
from uwblink.pages.html import figure_html, page_html, table_html

Drawings = Mapping[str, Mapping[str, bytes]]
"""Figures by name: drawings (SVG) by width, "page" and "column"."""


def to_html(document: Document, drawings: Drawings) -> str:
    """Return the document as HTML. All text is escaped."""
    captions, headings = document.captions(), iter(range(len(document.blocks)))
    parts, listed = [], False
    if document.subtitle:
        parts.append(f"<p class='note'>{escape(document.subtitle)}</p>")
    for block in document.blocks:
        if isinstance(block, Heading):
            if not listed:
                parts.append(_contents(document))
                listed = True
            parts.append(f"<h2 id='s{next(headings) + 1}'>{escape(block.text)}</h2>")
        else:
            parts.append(_block(block, drawings, captions))
    return page_html(document.title, parts)


def _contents(document: Document) -> str:
    """List the sections, below what stands before the first of them: the verdict."""
    entries = [f"<li><a href='#s{k}'>{escape(text)}</a></li>" for k, text in enumerate(document.contents(), 1)]
    return f"<nav aria-label='Contents'><ol>{''.join(entries)}</ol></nav>"


def _block(block: Block, drawings: Drawings, captions: Mapping[str, str]) -> str:
    match block:
        case Text(text, kind) if kind in VERDICTS:
            first, rest = sentence_apart(text)
            return f"<p class='verdict {kind}'><b>{escape(first)}</b> {escape(rest)}</p>"
        case Text(text, kind):
            return f"<p class='{escape(kind, quote=True)}'>{escape(text)}</p>"
        case Listing(text):
            return f"<pre>{escape(text)}</pre>"
        case Picture():
            return figure_html(drawings[block.name], captions[block.name])
        case Table():
            return table_html(block.header, block.rows, block.above, total=block.total, words=block.words)
        case Heading():
            raise AssertionError("headings are set by the caller")
