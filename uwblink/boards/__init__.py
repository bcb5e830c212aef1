"""Boards on serial ports: driver, plans, recorder, replay, and a picture of an impulse response."""

from pathlib import Path
from typing import Any

from uwblink.boards.listeners import Correction, Progress, delays_warning, load_correction
from uwblink.boards.live_page import LivePage
from uwblink.boards.ports import boards_ports, serial_number
from uwblink.boards.ranging_plan import load_plan
from uwblink.boards.replay import decode_again, play, rewrite, summarize
from uwblink.output import write_bytes
from uwblink.wire.messages import Cir

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


def plot_cir(cir: Cir, path: Path, *, force: bool = False) -> None:
    """Draw a channel impulse response around its first path, and write it in the format of the file's suffix.

    Raises what `uwblink.output.whole` raises.
    """
    from uwblink.pages.colours import BLUE, VERMILION
    from uwblink.pages.figures import label, picture, sheet

    first = cir.first_path_milli / 1000
    low, high = max(int(first) - 20, 0), min(int(first) + 80, cir.TAPS)
    tap_ns = 1e3 / (2 * 499.2)  # half a chip of 499.2 MHz (firmware wire format, 4)

    def draw(width_in: float) -> Any:
        figure, (axes,) = sheet(width_in, height_in=3.2)
        axes.plot([(k - first) * tap_ns for k in range(low, high)], cir.magnitudes[low:high], color=BLUE)
        axes.axvline(0, color=VERMILION, label=f"first path, index {first:.3f}")
        axes.set_title(f"{cir.initiator} ranging with {cir.target}", loc="left")
        label(axes, "time after the first path (ns)", "magnitude")
        axes.legend()
        return figure

    write_bytes(path, picture(draw, path.suffix.removeprefix(".").lower()), force=force)
