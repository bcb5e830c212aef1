"""How pages and figures look: colours, paper sizes, drawings that follow a page's light, HTML without a network.

Figures are drawn at the widths at which they are printed, a column and a page, with text of 8 pt; a page shows the
narrow ones on a phone.
"""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.pages.figures import drawn, picture
    from uwblink.pages.html import figure_html, page_html, table_html

__all__ = [
    "drawn",
    "figure_html",
    "page_html",
    "picture",
    "table_html",
]

_HOMES: Final = {
    "drawn": "uwblink.pages.figures",
    "figure_html": "uwblink.pages.html",
    "page_html": "uwblink.pages.html",
    "picture": "uwblink.pages.figures",
    "table_html": "uwblink.pages.html",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
