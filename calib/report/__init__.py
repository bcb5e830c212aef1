"""Reports as HTML and PDF, and their figures."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.report.writing import check_places

__all__ = [
    "check_places",
]

_HOMES: Final = {
    "check_places": "calib.report.writing",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
