"""Commands that talk to one board."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from uwblink.cli.guide import add, choice, starting
from uwblink.cli.shared import INTERRUPTED, AsJson, interrupts, print_json

if TYPE_CHECKING:
    from uwblink.wire import RangeReport

PANEL: Final = "Boards"


def _plugged(incomplete: str) -> list[str]:
    from uwblink.boards import boards_ports

    return starting(incomplete, (port.device for port in boards_ports()))


Port = Annotated[str, typer.Argument(help="Serial port, link to one, or pyserial URL.", autocompletion=_plugged)]
Target = Annotated[int, typer.Argument(min=0, max=254, help="Id of the other board.")]
ProtocolName = Annotated[str, typer.Option(help="Single-sided or double-sided ranging.", **choice("ss", "ds"))]


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    for command, *examples in (
        (ports, "uwblink ports --probe"),
        (info, "uwblink info ports/tag10"),
        (twr, "uwblink twr ports/tag10 20 -n 5", "uwblink twr ports/tag10 20 --protocol ss --json"),
        (test, "uwblink test ports/tag10"),
        (passive, "uwblink passive ports/tag20 on"),
        (send, 'uwblink send ports/tag10 "hello"'),
        (cir, "uwblink cir ports/tag10 20 --plot cir.png"),
    ):
        add(app, command, *examples, panel=PANEL)
    add(app, set_delay, "uwblink set-delay ports/tag20 3000", panel=PANEL, name="set-delay")


def ports(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[PORT]...", help="Ports to probe.", autocompletion=_plugged)
    ] = None,
    probe: Annotated[bool, typer.Option("--probe", help="Ask the named ports, or all listed, for their id.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the serial devices with the boards' USB identity (0483:5740); nothing is written to any, unless probed."""
    from uwblink import Board
    from uwblink.boards import boards_ports
    from uwblink.errors import UwblinkError

    found = boards_ports()
    rows = [asdict(port) for port in found]
    if names:
        known = {port.device: asdict(port) for port in found}
        rows = [known.get(n, {"device": n, "description": "", "serial_number": None}) for n in names]
    if probe:
        for row in rows:
            try:
                with Board.open(str(row["device"])) as board:
                    row["board"] = board.id
            except UwblinkError as error:
                row["error"] = str(error)
    if as_json:
        print_json(rows)
        return
    if not rows:
        typer.echo(
            "no serial device with the boards' USB identity (0483:5740) is plugged in; "
            "boards at other devices are named as they are, and `uwbsim serve` makes simulated ones"
        )
    for row in rows:
        said = f"board {row['board']}" if "board" in row else row.get("error", row["description"])
        typer.echo(f"{row['device']}  {said}")


def info(port: Port, as_json: AsJson = False) -> None:
    """Print a board's id and longest frame."""
    from uwblink import Board
    from uwblink.boards import serial_number
    from uwblink.wire import GetMaxFrame, MaxFrameReport

    with Board.open(port) as board:
        longest = board.request(GetMaxFrame())
        facts = {
            "port": port,
            "board": board.id,
            "longest_frame_bytes": longest.length if isinstance(longest, MaxFrameReport) else None,
            "usb_serial_number": serial_number(port),
        }
    if as_json:
        print_json(facts)
        return
    number = facts["usb_serial_number"] or "none"
    typer.echo(
        f"{port}: board {facts['board']}, frames of up to {facts['longest_frame_bytes']} bytes, "
        f"USB serial number {number}"
    )


def twr(
    port: Port,
    target: Target,
    protocol: ProtocolName = "ds",
    count: Annotated[int, typer.Option("-n", min=1, help="How many exchanges.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Range with another board; a line each as it comes, and a summary at the end, also of what Ctrl-C cut short."""
    from uwblink import Board
    from uwblink.errors import RangingFailedError

    ranges: list[float] = []
    failures: list[RangingFailedError] = []
    with interrupts() as stop, Board.open(port) as board:
        initiator = board.id
        while len(ranges) + len(failures) < count and not stop():
            try:
                report = board.range(target, protocol=protocol)
            except RangingFailedError as error:
                failures.append(error)
                if not ranges and len(failures) >= 3:
                    raise
                continue
            ranges.append(report.range_m)
            row = {"initiator": initiator, "target": target, **_fields(report)}
            _print_now(json.dumps(row) if as_json else _line(initiator, report))
        interrupted = stop()
    if failures and not ranges and not interrupted:
        raise failures[-1]
    if as_json or count > 1:
        _print_now(_summary_of(ranges, len(failures), count, as_json=as_json))
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _print_now(line: str) -> None:
    """Print a line so that whoever reads it through a pipe has it at once."""
    typer.echo(line)
    sys.stdout.flush()


def _summary_of(ranges: list[float], failed: int, count: int, *, as_json: bool) -> str:
    import statistics

    mean = statistics.fmean(ranges) if ranges else None
    spread = statistics.stdev(ranges) if len(ranges) > 1 else None
    if as_json:
        figures = {"exchanges": len(ranges), "failed": failed, "asked": count, "mean_m": mean, "std_m": spread}
        return json.dumps({"summary": figures})
    text = f"{len(ranges)} of {count} exchanges"
    if mean is not None:
        text += f", mean {mean:.4f}" + (f" ± {spread:.4f}" if spread is not None else "") + " m"
    return text


def _line(initiator: int, report: RangeReport) -> str:
    return (
        f"{initiator} -> {report.neighbour}  {report.range_m:8.4f} m  "
        f"FPP {report.fpp1_dbm:.1f} / {report.fpp2_dbm:.1f} dBm  skew {report.skew1_ppm:+.2f} ppm"
    )


def _fields(report: RangeReport) -> dict[str, float]:
    return {name: getattr(report, name) for name in type(report).FIELDS if name != "neighbour"}


def test(port: Port) -> None:
    """Have a board echo one field of each kind."""
    from uwblink import Board

    with Board.open(port) as board:
        board.test()
        typer.echo(f"{port}: board {board.id} echoes every kind of field")


def set_delay(
    port: Port,
    delay_uus: Annotated[int, typer.Argument(metavar="N", help="280 to 6500, in units of 512/499.2 us.")],
) -> None:
    """Set the response delay of double-sided exchanges for which this board is the target (C08)."""
    from uwblink import Board

    with Board.open(port) as board:
        board.set_response_delay(delay_uus)
    typer.echo(f"{port}: response delay {delay_uus} ({delay_uus * 512 / 499.2 + 0.25641:.1f} µs), until power is lost")


def passive(
    port: Port, state: Annotated[str, typer.Argument(help="Whether to listen.", **choice("on", "off"))]
) -> None:
    """Have a board listen to the exchanges of others, or stop to."""
    from uwblink import Board
    from uwblink.errors import RefusedError

    if state not in ("on", "off"):
        raise RefusedError(f"passive: found {state!r}, expected on or off")
    with Board.open(port) as board:
        board.set_passive(state == "on")
    typer.echo(f"{port}: passive listening {state}" + (", until power is lost" if state == "on" else ""))


def send(port: Port, text: Annotated[str, typer.Argument(help="Up to 57 bytes in UTF-8.")]) -> None:
    """Broadcast a text to every board in range."""
    from uwblink import Board

    data = os.fsencode(text)  # the bytes that were typed, whatever they are
    with Board.open(port) as board:
        board.send(data)
    typer.echo(f"{port}: {len(data)} bytes sent; delivery is not confirmed")


def cir(
    port: Port,
    target: Target,
    protocol: ProtocolName = "ds",
    plot: Annotated[Path | None, typer.Option(help="Picture to write (.png, .svg or .pdf).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the picture if it exists.")] = False,
    as_json: AsJson = False,
) -> None:
    """Range with another board and print the channel impulse response."""
    from uwblink import Board
    from uwblink.errors import RecordingError
    from uwblink.output import check_output

    if plot:
        check_output(plot, force=force)
        if plot.suffix.lower() not in (".png", ".svg", ".pdf"):
            raise RecordingError(f"{plot}: found {plot.suffix or 'no suffix'}, expected .png, .svg or .pdf")
    with Board.open(port) as board:
        report, response = board.cir(target, protocol=protocol)
        initiator = board.id
    if plot:
        from uwblink.boards import plot_cir

        plot_cir(response, plot, force=force)
    index = response.first_path_milli / 1000
    if as_json:
        typer.echo(json.dumps({"first_path_index": index, "magnitudes": list(response.magnitudes), **_fields(report)}))
        return
    peak = max(range(response.TAPS), key=response.magnitudes.__getitem__)
    typer.echo(_line(initiator, report))
    typer.echo(f"first path at index {index:.3f}, peak {response.magnitudes[peak]} at {peak}")
    if plot:
        typer.echo(f"{plot}")
