"""From recordings, simulations, arrays and data frames to ranges with true distances."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.data.sources import load_each

__all__ = ["load_each"]

_HOMES: Final = {"load_each": "calib.data.sources"}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
