"""From ranges to calibrations: the fit and what it doubts."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.estimation.losses import known_losses

__all__ = [
    "known_losses",
]

_HOMES: Final = {
    "known_losses": "calib.estimation.losses",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
