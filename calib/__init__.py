"""Fits, applies and evaluates calibrations of ultra-wideband ranges."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.estimation.losses import register_loss

__all__ = ["register_loss"]

_HOMES: Final = {
    "register_loss": "calib.estimation.losses",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
