"""Commands for one board."""

from __future__ import annotations

import json
import os
import statistics
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import uwblink
from uwblink.cli.guide import AsJson, Force, Plot, add, choice, count, starting
from uwblink.cli.shared import INTERRUPTED, interrupts, print_result
from uwblink.errors import RangingFailedError, RecordingError, RefusedError, UwblinkError
from uwblink.output import check_output

if TYPE_CHECKING:
    from uwblink.wire import RangeReport


def _plugged(incomplete: str) -> list[str]:
    from uwblink.boards import boards_ports

    return starting(incomplete, (port.device for port in boards_ports()))


Port = Annotated[str, typer.Argument(help="Serial port, link to one, or pyserial URL.", autocompletion=_plugged)]
Target = Annotated[int, typer.Argument(min=0, max=254, help="Id of the other board.")]
ProtocolName = Annotated[str, typer.Option(help="Single-sided or double-sided ranging.", **choice("ss", "ds"))]


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    for command, name, *examples in (
        (ports, "ports", "uwblink ports --probe"),
        (info, "info", "uwblink info ports/tag10"),
        (twr, "twr", "uwblink twr ports/tag10 20 -n 5", "uwblink twr ports/tag10 20 --protocol ss --json"),
        (test, "test", "uwblink test ports/tag10"),
        (set_delay, "set-delay", "uwblink set-delay ports/tag20 3000"),
        (passive, "passive", "uwblink passive ports/tag20 on"),
        (send, "send", 'uwblink send ports/tag10 "hello"'),
        (cir, "cir", "uwblink cir ports/tag10 20 --plot cir.png"),
    ):
        add(app, command, *examples, panel="Boards", name=name)


def ports(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[PORT]...", help="Ports to probe.", autocompletion=_plugged)
    ] = None,
    probe: Annotated[bool, typer.Option("--probe", help="Ask each board for its id.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the serial devices with the USB identity of the boards (0483:5740).

    Nothing is written to a port without --probe.
    """
    from uwblink.boards import boards_ports

    known: dict[str, dict[str, Any]] = {port.device: asdict(port) for port in boards_ports()}
    unknown = {"description": "", "serial_number": None}
    rows = [known.get(name, {"device": name, **unknown}) for name in names or known]
    for row in rows if probe else ():
        try:
            with uwblink.Board.open(str(row["device"])) as board:
                row["board"] = board.id
        except UwblinkError as error:
            row["error"] = str(error)
    none = (
        "no serial device with the boards' USB identity (0483:5740) is plugged in; "
        "name other ports on the command line, or make simulated ones with `uwbsim serve`"
    )
    lines = [
        f"{row['device']}  " + (f"board {row['board']}" if "board" in row else row.get("error", row["description"]))
        for row in rows
    ]
    print_result(rows, "\n".join(lines) or none, as_json=as_json)


def info(port: Port, as_json: AsJson = False) -> None:
    """Print a board's id and longest frame."""
    from uwblink.boards import serial_number
    from uwblink.wire import GetMaxFrame, MaxFrameReport

    with uwblink.Board.open(port) as board:
        longest = board.request(GetMaxFrame())
        facts = {
            "port": port,
            "board": board.id,
            "longest_frame_bytes": longest.length if isinstance(longest, MaxFrameReport) else None,
            "usb_serial_number": serial_number(port),
        }
    text = (
        f"{port}: board {facts['board']}, frames of up to {facts['longest_frame_bytes']} bytes, "
        f"USB serial number {facts['usb_serial_number'] or 'none'}"
    )
    print_result(facts, text, as_json=as_json)


def twr(
    port: Port,
    target: Target,
    protocol: ProtocolName = "ds",
    exchanges: Annotated[int, count("Number of exchanges.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Range with another board; prints a line for each range, and a summary at the end, also after Ctrl-C."""

    ranges: list[float] = []
    failures: list[RangingFailedError] = []
    with interrupts() as stop, uwblink.Board.open(port) as board:
        initiator = board.id
        while len(ranges) + len(failures) < exchanges and not stop():
            try:
                report = board.range(target, protocol=protocol)
            except RangingFailedError as error:
                failures.append(error)
                if not ranges and len(failures) >= 3:
                    raise
                continue
            ranges.append(report.range_m)
            row = {"initiator": initiator, "target": target, **_fields(report)}
            typer.echo(json.dumps(row) if as_json else _line(initiator, report))
        interrupted = stop()
    if failures and not ranges and not interrupted:
        raise failures[-1]
    if as_json or exchanges > 1:
        typer.echo(_summary_of(ranges, len(failures), exchanges, as_json=as_json))
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _summary_of(ranges: list[float], failed: int, asked: int, *, as_json: bool) -> str:
    mean = statistics.fmean(ranges) if ranges else None
    spread = statistics.stdev(ranges) if len(ranges) > 1 else None
    if as_json:
        figures = {"exchanges": len(ranges), "failed": failed, "asked": asked, "mean_m": mean, "std_m": spread}
        return json.dumps({"summary": figures})
    deviation = "" if spread is None else f" ± {spread:.4f}"
    return f"{len(ranges)} of {asked} exchanges" + ("" if mean is None else f", mean {mean:.4f}{deviation} m")


def _line(initiator: int, report: RangeReport) -> str:
    return (
        f"{initiator} -> {report.neighbour}  {report.range_m:8.4f} m  "
        f"FPP {report.fpp1_dbm:.1f} / {report.fpp2_dbm:.1f} dBm  skew {report.skew1_ppm:+.2f} ppm"
    )


def _fields(report: RangeReport) -> dict[str, float]:
    return {name: getattr(report, name) for name in type(report).FIELDS if name != "neighbour"}


def test(port: Port) -> None:
    """Test that a board echoes one field of each kind."""

    with uwblink.Board.open(port) as board:
        board.test()
        typer.echo(f"{port}: board {board.id} echoes every kind of field")


def set_delay(
    port: Port,
    delay_uus: Annotated[int, typer.Argument(metavar="N", help="280 to 6500, in units of 512/499.2 us.")],
) -> None:
    """Set the response delay of double-sided exchanges for which this board is the target (C08)."""

    with uwblink.Board.open(port) as board:
        board.set_response_delay(delay_uus)
    typer.echo(f"{port}: response delay {delay_uus} ({delay_uus * 512 / 499.2 + 0.25641:.1f} µs), until power is lost")


def passive(
    port: Port, state: Annotated[str, typer.Argument(help="Whether to listen.", **choice("on", "off"))]
) -> None:
    """Make a board listen to the exchanges of others, or stop listening."""

    if state not in ("on", "off"):
        raise RefusedError(f"passive: found {state!r}, expected on or off")
    with uwblink.Board.open(port) as board:
        board.set_passive(state == "on")
    typer.echo(f"{port}: passive listening {state}" + (", until power is lost" if state == "on" else ""))


def send(port: Port, text: Annotated[str, typer.Argument(help="Up to 57 bytes in UTF-8.")]) -> None:
    """Broadcast a text to every board in range."""

    data = os.fsencode(text)  # exactly the bytes of the command line
    with uwblink.Board.open(port) as board:
        board.send(data)
    typer.echo(f"{port}: {len(data)} bytes sent; delivery is not confirmed")


def cir(
    port: Port,
    target: Target,
    protocol: ProtocolName = "ds",
    plot: Plot = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Range with another board and print the channel impulse response."""

    if plot:
        check_output(plot, force=force)
        if plot.suffix.lower() not in (".png", ".svg", ".pdf"):
            raise RecordingError(f"{plot}: found {plot.suffix or 'no suffix'}, expected .png, .svg or .pdf")
    with uwblink.Board.open(port) as board:
        report, response = board.cir(target, protocol=protocol)
        initiator = board.id
    if plot:
        from uwblink.boards import plot_cir

        plot_cir(response, Path(plot), force=force)
    index = response.first_path_milli / 1000
    if as_json:
        typer.echo(json.dumps({"first_path_index": index, "magnitudes": list(response.magnitudes), **_fields(report)}))
        return
    peak = max(range(response.TAPS), key=response.magnitudes.__getitem__)
    typer.echo(_line(initiator, report))
    typer.echo(f"first path at index {index:.3f}, peak {response.magnitudes[peak]} at {peak}")
    if plot:
        typer.echo(f"{plot}")
