"""The protocol workbench: Monte Carlo, prediction, comparison."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.protocols.conditions import chosen

__all__ = [
    "chosen",
]

_HOMES: Final = {
    "chosen": "uwbsim.protocols.conditions",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
