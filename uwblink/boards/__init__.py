"""Boards on serial ports: driver, plans, recorder, replay."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.boards.corrections import Correction, delays_warning, load_correction
    from uwblink.boards.figures import plot_cir
    from uwblink.boards.live_page import LivePage
    from uwblink.boards.ports import boards_ports, serial_number
    from uwblink.boards.progress import Progress
    from uwblink.boards.ranging_plan import load_plan
    from uwblink.boards.replay import decode_again, play, rewrite, summarize

__all__ = [
    "Correction",
    "LivePage",
    "Progress",
    "boards_ports",
    "decode_again",
    "delays_warning",
    "load_correction",
    "load_plan",
    "play",
    "plot_cir",
    "rewrite",
    "serial_number",
    "summarize",
]

_HOMES: Final = {
    "Correction": "uwblink.boards.corrections",
    "LivePage": "uwblink.boards.live_page",
    "Progress": "uwblink.boards.progress",
    "boards_ports": "uwblink.boards.ports",
    "decode_again": "uwblink.boards.replay",
    "delays_warning": "uwblink.boards.corrections",
    "load_correction": "uwblink.boards.corrections",
    "load_plan": "uwblink.boards.ranging_plan",
    "play": "uwblink.boards.replay",
    "plot_cir": "uwblink.boards.figures",
    "rewrite": "uwblink.boards.replay",
    "serial_number": "uwblink.boards.ports",
    "summarize": "uwblink.boards.replay",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
