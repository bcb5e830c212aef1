"""Virtual boards on virtual or pseudo-terminal ports."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.boards.server import extended

__all__ = [
    "extended",
]

_HOMES: Final = {
    "extended": "uwbsim.boards.server",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
