"""From ranges to calibrations: the fit and what it doubts."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.estimation.arguments import FitSettings

__all__ = [
    "FitSettings",
]

_HOMES: Final = {
    "FitSettings": "calib.estimation.arguments",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
