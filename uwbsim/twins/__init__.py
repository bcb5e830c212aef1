"""Scenarios fitted to recordings, and how well they are."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.twins.fitting import LEVEL, Compared, Twin, check_name

__all__ = ["LEVEL", "Compared", "Twin", "check_name"]

_HOMES: Final = {
    "LEVEL": "uwbsim.twins.fitting",
    "Compared": "uwbsim.twins.fitting",
    "Twin": "uwbsim.twins.fitting",
    "check_name": "uwbsim.twins.fitting",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
