"""Boards on serial ports: driver, plans, recorder, replay."""

from uwblink.boards.figures import plot_cir
from uwblink.boards.listeners import Correction, Progress, delays_warning, load_correction
from uwblink.boards.live_page import LivePage
from uwblink.boards.ports import boards_ports, serial_number
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
