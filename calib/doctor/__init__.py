"""Names the fault in a recording, and says how much of a long one was looked at."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.doctor.long_recordings import examined_part

__all__ = ["examined_part"]

_HOMES: Final = {"examined_part": "calib.doctor.long_recordings"}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
