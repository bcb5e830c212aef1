"""The look of pages, on a screen, on a phone, by day and by night, and on paper; and what they do when pointed at."""

from __future__ import annotations

from importlib.resources import files
from typing import Final

from uwblink.pages.drawings import colours_css

_HERE: Final = files("uwblink.pages")
CSS: Final = (
    (_HERE / "page.css")
    .read_text(encoding="utf-8")
    .replace("/* figures by day */", colours_css(False))
    .replace("/* figures by night */", colours_css(True))
)
JS: Final = (_HERE / "page.js").read_text(encoding="utf-8")
"""Without scripts a page has everything but this."""

PARTS: Final = (
    "<div id='tip'></div><dialog id='zoom' aria-label='Figure, closer'><form method='dialog'><button>Close</button> "
    "wheel: closer · drag: move · double click: all</form><div style='height:100%'></div></dialog>"
)
"""What the script shows things in."""
