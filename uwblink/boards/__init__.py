"""Boards on serial ports: driver, plans, recorder, replay, and a picture of an impulse response.

Replay uses the stored bytes of a recording: it decodes them again, or plays them back on pseudo-terminals.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from uwblink.boards.dialects import DIALECTS, Dialect, PrintedRange, dialect_of, printed_ranges, record_printed
from uwblink.boards.listeners import Heard, Progress, delays_warning, load_correction
from uwblink.boards.live_page import LivePage
from uwblink.boards.ports import boards_ports, open_terminals, serial_number, wait_until
from uwblink.boards.ranging_plan import load_plan
from uwblink.boards.record import append_rows
from uwblink.corrections import Correction
from uwblink.errors import RecordingError
from uwblink.output import write_bytes
from uwblink.recording.file import Recording
from uwblink.recording.schema import FrameRow
from uwblink.twr import Exchanges
from uwblink.wire.codec import Decoder, Event, exchanges_of
from uwblink.wire.messages import REPORTS, Cir, Overheard, RangeReport, TextLine

__all__ = [
    "DIALECTS",
    "Correction",
    "Dialect",
    "LivePage",
    "PrintedRange",
    "Progress",
    "boards_ports",
    "decode_again",
    "delays_warning",
    "dialect_of",
    "load_correction",
    "load_plan",
    "play",
    "plot_cir",
    "printed_ranges",
    "record_printed",
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


@dataclass(frozen=True, slots=True)
class Decoded:
    """Decoded bytes: exchanges and all other messages, both in order of time, and counts."""

    exchanges: Exchanges
    others: list[Heard]
    skipped_bytes: int
    messages: int

    def count(self, kind: type[Event]) -> int:
        """Return the number of other messages of a kind."""
        return sum(isinstance(one.message, kind) for one in self.others)


def decode_again(recording: Recording) -> Decoded:
    """Decode all bytes from boards; raises `RecordingError` if there are none."""
    frames, ids = _bytes_from_boards(recording), board_ids(recording)
    decoders = {frame.board: Decoder(REPORTS) for frame in frames}
    boards = {name: ids.get(name, k) for k, name in enumerate(decoders)}
    parts, others = [exchanges_of([])], list[Heard]()

    def heard() -> Iterator[Heard]:
        for frame in frames:
            yield from (Heard(frame.time_ns, boards[frame.board], e) for e in decoders[frame.board].feed(frame.data))
        for name, decoder in decoders.items():
            yield from (Heard(frames[-1].time_ns, boards[name], e) for e in decoder.finish())

    events = heard()
    # In blocks, because messages as objects need ten times the memory of columns.
    while block := list(islice(events, 10_000)):
        parts.append(exchanges_of((one.time_ns, one.board, one.message) for one in block))
        others += [one for one in block if not isinstance(one.message, RangeReport)]
    return Decoded(
        Exchanges.concatenate(parts).in_time_order(),
        others,
        sum(decoder.skipped_bytes for decoder in decoders.values()),
        sum(decoder.messages for decoder in decoders.values()),
    )


def board_ids(recording: Recording) -> dict[str, int]:
    """Return the board at each port at the start of the recording."""
    ports = recording.meta().get("ports", {})
    return {str(name): int(board) for board, name in ports.items()} if isinstance(ports, dict) else {}


def rewrite(source: Recording, decoded: Decoded, output: Path, *, force: bool = False) -> None:
    """Write a copy of a recording with decoded exchanges; raises what `Recording.create` raises."""
    with source.copying(output, without=("exchanges", "overheard", "cirs"), force=force) as written:
        written.append("exchanges", decoded.exchanges)
        append_rows(written, decoded.others)


def play(
    recording: Recording,
    ready: Callable[[dict[str, str]], None],
    *,
    speed: float = 1.0,
    link_dir: Path | None = None,
) -> int:
    """Play the bytes from boards back on one pseudo-terminal each; returns how many frames were played.

    `ready` is called with the new name of each board's port before the first byte. Raises `RecordingError` if the
    recording has no bytes.
    """
    frames = _bytes_from_boards(recording)
    ids = board_ids(recording)
    names = sorted({frame.board for frame in frames})
    terminals = open_terminals(
        {name: link_dir / f"tag{ids.get(name, k)}" if link_dir else None for k, name in enumerate(names)}
    )
    try:
        ready({name: terminal.name for name, terminal in terminals.items()})
        start_s, first_ns = time.monotonic(), frames[0].time_ns
        for frame in frames:
            wait_until(start_s + (frame.time_ns - first_ns) * 1e-9 / speed, lambda: False)
            terminals[frame.board].write(frame.data)
        return len(frames)
    finally:
        for terminal in terminals.values():
            terminal.unplug()


def summarize(recording: Recording, decoded: Decoded) -> dict[str, Any]:
    """Return the numbers of decoded and of stored rows, for JSON."""
    rows = {"exchanges": len(decoded.exchanges), "overheard": decoded.count(Overheard), "cirs": decoded.count(Cir)}
    return {
        "messages": decoded.messages,
        "skipped_bytes": decoded.skipped_bytes,
        "texts": decoded.count(TextLine),
        **{table: {"stored": recording.count(table), "decoded": count} for table, count in rows.items()},
    }


def _bytes_from_boards(recording: Recording) -> list[FrameRow]:
    """Return the bytes from boards; raises `RecordingError` when there are none."""
    frames = [frame for frame in recording.frames() if frame.direction == "in"]
    if not frames:
        raise RecordingError(f"{recording.path}: holds no bytes from boards; only recordings of boards can be replayed")
    return frames
