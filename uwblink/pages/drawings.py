"""Drawings (SVG) made part of a page: colours that follow its light, its fonts, and names for lines."""

from __future__ import annotations

import re
from html import escape, unescape
from typing import Final

from uwblink.pages.colours import DARK

VARIABLES: Final = {colour: f"--f{number}" for number, colour in enumerate(DARK)}
"""The CSS variables of a figure's colours."""

_COLOUR: Final = re.compile("|".join(VARIABLES), re.IGNORECASE)
_DESCRIPTION: Final = re.compile(r"<dc:description>(.*?)</dc:description>", re.DOTALL)
_METADATA: Final = re.compile(r"\s*<metadata>.*?</metadata>", re.DOTALL)
_SERIES: Final = re.compile(r'<g id="series-([^"]*)"')
_NAME: Final = re.compile(r'<g id="[^"]*"')
_FONT: Final = re.compile(r"font-family: [^;\"]*")
_SHORT_FONT: Final = re.compile(r"font: ([\d.]+)px[^;\"]*")
_HEAD: Final = re.compile(r"<svg [^>]*?viewBox=\"([^\"]*)\"[^>]*>", re.DOTALL)


def inline(svg: bytes, caption: str) -> str:
    """Return a drawing as part of a page of HTML: no prologue, no fixed size, the page's colours and fonts.

    It has the readings of its panels (see `drawn`) in `data-panels`.
    """
    text = svg.decode()
    text = text[text.index("<svg") :]
    told = _DESCRIPTION.search(text)
    panels = escape(unescape(told[1]), quote=True) if told else ""
    text = _METADATA.sub("", text)
    text = _SERIES.sub(lambda found: f'<g class="series" data-name="{found[1]}"', text)
    text = _NAME.sub("<g", text)
    text = _FONT.sub("font-family: system-ui, sans-serif", text)
    text = _SHORT_FONT.sub(r"font: \1px system-ui, sans-serif", text)
    text = _COLOUR.sub(lambda found: f"var({VARIABLES[found[0].lower()]})", text)
    head = f"<svg viewBox=\"\\1\" role='img' aria-label='{escape(caption, quote=True)}' data-panels='{panels}'>"
    return _HEAD.sub(lambda found: head.replace("\\1", found[1]), text, count=1)


def colours_css(dark: bool) -> str:
    """Return the declarations of a figure's colours on a page of light or dark ground."""
    return " ".join(f"{name}: {DARK[colour] if dark else colour};" for colour, name in VARIABLES.items())
