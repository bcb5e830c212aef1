"""The colours of figures and pages, on light and on dark pages.

Any two of the six colours of `SERIES` differ by at least 15 (CIEDE2000), for normal vision and for each kind of colour
blindness (simulated as in Machado, Oliveira and Fernandes 2009), on light and on dark pages. Series also differ by
marker and dashes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

BLUE: Final = "#0072b2"
VERMILION: Final = "#c8500a"
GREEN: Final = "#004422"
WINE: Final = "#661155"
GREY: Final = "#666666"
SAGE: Final = "#889988"
INK: Final = "#1a1a1a"
MUTED: Final = "#595959"
GRID: Final = "#d8d8d8"
PALE: Final = "#b4b4b4"

SERIES: Final = (BLUE, VERMILION, GREEN, WINE, GREY, SAGE)
"""Colours of series of one kind, such as tags, bodies or protocols."""

DARK: Final = {
    BLUE: "#4aa8e8",
    VERMILION: "#f08a4b",
    GREEN: "#88ffbb",
    WINE: "#999999",
    GREY: "#776655",
    SAGE: "#4466bb",
    INK: "#e8e8e8",
    MUTED: "#a8adb3",
    GRID: "#3a3f45",
    PALE: "#6a7078",
}
"""The colour that replaces each one on a dark page."""


@dataclass(frozen=True, slots=True)
class Look:
    """Colour, marker and dashes of a series."""

    colour: str
    marker: str
    dashes: Any

    def line(self, *, marker: bool = True) -> dict[str, Any]:
        """Return the look as arguments of matplotlib's `plot`."""
        shape = {"marker": self.marker, "ms": 3.2} if marker else {}
        return {"color": self.colour, "ls": self.dashes, "lw": 1.1, **shape}


def look(number: int) -> Look:
    """Return the look of a series by its number. 84 looks are different, and 28 of them also without colours."""
    markers = ("o", "s", "^", "D", "v", "P", "X")
    dashes: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
    return Look(SERIES[number % len(SERIES)], markers[number % len(markers)], dashes[number % len(dashes)])
