"""What to measure with what one has, before anything is measured, and how well each delay will be known then."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.planning.commands import flight_commands, survey_commands

__all__ = ["flight_commands", "survey_commands"]

_HOMES: Final = {"flight_commands": "calib.planning.commands", "survey_commands": "calib.planning.commands"}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
