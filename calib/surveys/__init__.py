"""Calibration without true distances: boards that stand still, in several arrangements."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.surveys.knowledge import load_knowledge

__all__ = [
    "load_knowledge",
]

_HOMES: Final = {
    "load_knowledge": "calib.surveys.knowledge",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
