"""Commands for boards: for one of them, `record` into a file, and `stream` to other programs."""

from __future__ import annotations

import json
import math
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

import uwblink
from uwblink.cli.shared import (
    INTERRUPTED,
    AntennaDelays,
    AsJson,
    BoardIds,
    DialectName,
    Duration,
    Force,
    OptionalCalibration,
    PlanFile,
    PlaybackSpeed,
    Plot,
    Rate,
    add,
    choice,
    count,
    interrupts,
    output,
    print_result,
    starting,
)
from uwblink.display import printable
from uwblink.errors import PlanError, RangingFailedError, RecordingError, RefusedError, UwblinkError
from uwblink.output import check_output

if TYPE_CHECKING:
    from uwblink.boards import Correction, Dialect, Progress
    from uwblink.wire import RangeReport


def _plugged(incomplete: str) -> list[str]:
    return starting(incomplete, (port.device for port in uwblink.boards.boards_ports()))


Port = Annotated[str, typer.Argument(help="Serial port, link to one, or pyserial URL.", autocompletion=_plugged)]
Target = Annotated[int, typer.Argument(min=0, max=254, help="Id of the other board.")]
ProtocolName = Annotated[str, typer.Option(help="Single-sided or double-sided ranging.", **choice("ss", "ds"))]


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    one, several = "Boards", "Recording and streaming"
    for panel, command, name, *examples in (
        (one, ports, "ports", "uwblink ports --probe"),
        (one, info, "info", "uwblink info ports/tag10"),
        (one, twr, "twr", "uwblink twr ports/tag10 20 -n 5", "uwblink twr ports/tag10 20 --protocol ss --json"),
        (one, test, "test", "uwblink test ports/tag10"),
        (one, set_delay, "set-delay", "uwblink set-delay ports/tag20 3000"),
        (one, passive, "passive", "uwblink passive ports/tag20 on"),
        (one, send, "send", 'uwblink send ports/tag10 "hello"'),
        (one, cir, "cir", "uwblink cir ports/tag10 20 --plot cir.png"),
        (
            several,
            record,
            "record",
            "uwblink record ports/tag10 ports/tag20 -o bench.uwb --pairs all",
            "uwblink record ports/* -o flight.uwb --plan plan.toml --live",
        ),
        (
            several,
            stream,
            "stream",
            "uwblink stream ports/tag10 ports/tag20 -c calibration.json",
            "uwblink stream flight.uwb -c calibration.json --udp 127.0.0.1:9870",
        ),
    ):
        add(app, command, *examples, panel=panel, name=name)


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
    plugged = {port.device: port for port in uwblink.boards.boards_ports()}
    rows: list[dict[str, Any]] = [
        {
            "device": name,
            "description": getattr(plugged.get(name), "description", ""),
            "serial_number": getattr(plugged.get(name), "serial_number", None),
        }
        for name in names or plugged
    ]
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
    with uwblink.Board.open(port) as board:
        longest = board.request(uwblink.wire.GetMaxFrame())
        facts = {
            "port": port,
            "board": board.id,
            "longest_frame_bytes": longest.length if isinstance(longest, uwblink.wire.MaxFrameReport) else None,
            "usb_serial_number": uwblink.boards.serial_number(port),
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
                if not ranges and len(failures) >= min(3, exchanges):
                    raise
                continue
            ranges.append(report.range_m)
            row = {"initiator": initiator, "target": target, **_fields(report)}
            typer.echo(json.dumps(row) if as_json else _line(initiator, report))
        interrupted = stop()
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
        uwblink.boards.plot_cir(response, Path(plot), force=force)
    index = response.first_path_milli / 1000
    if as_json:
        typer.echo(json.dumps({"first_path_index": index, "magnitudes": list(response.magnitudes), **_fields(report)}))
        return
    peak = max(range(response.TAPS), key=response.magnitudes.__getitem__)
    typer.echo(_line(initiator, report))
    typer.echo(f"first path at index {index:.3f}, peak {response.magnitudes[peak]} at {peak}")
    if plot:
        typer.echo(f"{plot}")


def record(
    ports: Annotated[list[str], typer.Argument(metavar="PORT...", help="Serial ports or pyserial URLs.")],
    output: Annotated[Path, output("Recording to write (.uwb).")],
    plan: PlanFile = None,
    pairs: Annotated[
        str | None,
        typer.Option(help="all: every two boards range; none: the boards only listen.", **choice("all", "none")),
    ] = None,
    rate: Rate = None,
    duration: Duration = None,
    arrangement: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Name of the arrangement of boards that stand still, for calib survey."),
    ] = None,
    known: Annotated[
        str,
        typer.Option(
            help="Known shape of the arrangement: all boards on a line or on a plane.", **choice("line", "plane")
        ),
    ] = "",
    order: Annotated[
        str, typer.Option(metavar="TAG,TAG...", help="Order of the boards along the line, from either end.")
    ] = "",
    antenna_delays: AntennaDelays = None,
    passive: Annotated[bool, typer.Option("--passive", help="Also record the frames that boards overhear.")] = False,
    cir: Annotated[bool, typer.Option("--cir", help="Also record channel impulse responses.")] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Serve a live page of the recording for browsers on this computer.")
    ] = False,
    live_port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the live page; 0: any free port.")] = 0,
    calibration: OptionalCalibration = None,
    dialect: DialectName = None,
    ids: BoardIds = "",
    force: Force = False,
) -> None:
    """Execute a ranging plan on boards and record everything they send.

    Stops after --duration, or on Ctrl-C. With --calibration, the page of --live also shows corrected ranges. Antenna
    delays are those of --antenna-delays or of the plan; by default 16436 ticks in each board.
    """

    _check_dialect(
        dialect,
        ids,
        plan=plan,
        pairs=pairs,
        rate=rate,
        arrangement=arrangement,
        known=known,
        order=order,
        antenna_delays=antenna_delays,
        passive=passive,
        cir=cir,
    )
    if (plan is None) == (pairs is None) and dialect is None:
        raise PlanError("give either --plan plan.toml or --pairs all")
    if pairs not in (None, "all", "none"):
        raise PlanError(f"--pairs: found {pairs!r}, expected all or none; a plan file can name pairs")
    if calibration and not live:
        raise PlanError("--calibration: corrected ranges are only shown on the live page; add --live")
    check_output(output, force=force, recording=True)
    chosen = _plan(dialect, plan, antenna_delays, "all" if pairs == "all" else (), rate_hz=rate, get_cir=cir)
    options = {"passive": passive, "arrangement": arrangement, "known": known, "order": _ids(order, "order")}
    with ExitStack() as stack:
        stop, watchers = stack.enter_context(interrupts()), [stack.enter_context(_watcher())]
        pages = []
        if live:
            correct = _correction(calibration, chosen)
            pages.append(stack.enter_context(uwblink.boards.LivePage(output, correct=correct, port=live_port)))
            typer.echo(f"live page: {pages[0].url}", err=True)
            watchers.append(pages[0].watch)
        how: dict[str, Any] = {"duration_s": duration or math.inf, "force": force, "stop": stop, "listeners": pages}
        how["watch"] = lambda progress: [watch(progress) for watch in watchers]
        progress = _record(ports, output, chosen, ids, how, options)
    typer.echo(f"{output}: {progress}")


def _record(
    ports: list[str],
    output: Path,
    chosen: uwblink.RangingPlan | Dialect,
    ids: str,
    how: Mapping[str, Any],
    of_plan: Mapping[str, Any],
) -> Progress:
    """Record from boards that execute a plan, or that print ranges in a dialect."""
    if isinstance(chosen, uwblink.RangingPlan):
        return uwblink.record(ports, output, chosen, **how, **of_plan)
    return uwblink.boards.record_printed(ports, output, chosen, ids=_ids(ids, "ids"), **how)


def stream(
    source: Annotated[list[str], typer.Argument(metavar="SOURCE...", help="Ports of boards, or one recording (.uwb).")],
    calibration: OptionalCalibration = None,
    use: Annotated[
        str,
        typer.Option(
            help="Lines to print. exchanges: ranges; receptions: also corrected differences of arrival at boards "
            "that overheard an exchange.",
            **choice("exchanges", "receptions"),
        ),
    ] = "exchanges",
    plan: PlanFile = None,
    rate: Rate = None,
    antenna_delays: AntennaDelays = None,
    duration: Duration = None,
    speed: PlaybackSpeed = 1.0,
    udp: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Address for JSON datagrams (PlotJuggler: 9870).")
    ] = None,
    foxglove: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Address of a WebSocket for Foxglove (its default: 8765)."),
    ] = None,
    output: Annotated[Path | None, output("Also write a recording of the boards (.uwb).")] = None,
    dialect: DialectName = None,
    ids: BoardIds = "",
    force: Force = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print no ranges.")] = False,
) -> None:
    """Print ranges as they arrive, one line of JSON each, or send them to other programs.

    A line has the times and ids of an exchange, and its range_m. With --use receptions there are also lines with
    difference_m: the distance from the listener to the target minus that to the initiator. corrected_m has the standard
    deviation sigma_m. Differences of one exchange have the covariance shared_m squared; they are not correlated with
    its range. --udp and --foxglove send only ranges.

    Without --plan, every two boards range. Stops after --duration, at the end of the recording, or on Ctrl-C. Antenna
    delays are those of --antenna-delays or of the plan; by default 16436 ticks in each board.
    """
    of_boards = not (len(source) == 1 and source[0].endswith(".uwb"))
    if not of_boards and (plan or rate or output or antenna_delays or dialect):
        raise PlanError(
            f"{source[0]}: --plan, --rate, --antenna-delays, --dialect and --output can only be used with boards, "
            f"not with a recording"
        )
    _check_dialect(dialect, ids, plan=plan, rate=rate, antenna_delays=antenna_delays, use=use == "receptions")
    seen = uwblink.boards.Progress()
    with ExitStack() as stack:
        stop, sink = stack.enter_context(interrupts()), _Sink(stack, udp=udp, foxglove=foxglove, quiet=quiet)
        chosen = _plan(dialect, plan, antenna_delays, rate_hz=rate) if of_boards else None
        correct = _correction(calibration, chosen, None if of_boards else source[0])
        how: dict[str, Any] = {"duration_s": duration or math.inf, "stop": stop}
        try:
            if output and chosen:
                how["listeners"] = [seen, uwblink.streaming.RangeListener(sink.send, correct, use)]
                _record(source, output, chosen, ids, how | {"force": force}, {"passive": use == "receptions"})
            else:
                how["calibration"] = correct
                if chosen is None:
                    ranges = uwblink.stream(source[0], use=use, speed=speed, **how)
                elif isinstance(chosen, uwblink.RangingPlan):
                    ranges = uwblink.stream(source, use=use, plan=chosen, listeners=[seen], **how)
                else:
                    ranges = uwblink.streaming.stream_printed(source, chosen, ids=_ids(ids, "ids"), **how)
                stack.callback(ranges.close)
                for found in ranges:
                    sink.send(found)
        except BrokenPipeError:
            # The reader of the lines closed, which ends the stream; Python must not write the rest at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    typer.echo(f"{sink.count} ranges" + (f"; faults: {seen.fault_counts()}" if seen.faults else ""), err=True)


class _Sink:
    """Prints what a stream yields, and sends its ranges to other programs; `count` is the number of ranges."""

    def __init__(self, stack: ExitStack, *, udp: str | None, foxglove: str | None, quiet: bool) -> None:
        self.count, self._quiet = 0, quiet
        self._senders: list[Callable[[uwblink.StreamedRange], object]] = []
        if udp is not None:
            self._senders.append(stack.enter_context(uwblink.streaming.UdpSender(udp)).send)
        if foxglove is not None:
            server = stack.enter_context(uwblink.streaming.FoxgloveServer(foxglove))
            typer.echo(f"foxglove: {server.url}", err=True)
            self._senders.append(server.send)

    def send(self, found: uwblink.StreamedRange | uwblink.streaming.StreamedDifference) -> None:
        if not self._quiet:
            typer.echo(found.to_json())
        if isinstance(found, uwblink.StreamedRange):
            self.count += 1
            for send in self._senders:
                send(found)


def _check_dialect(dialect: str | None, ids: str, **others: Any) -> None:
    """Raise `PlanError` for options that plan exchanges, as boards of a dialect range by themselves, or ids without."""
    if ids and dialect is None:
        raise PlanError(
            "can only be used with --dialect; boards of this project's firmware report their ids", parameter="ids"
        )
    for name, value in others.items() if dialect is not None else ():
        if value:
            raise PlanError("cannot be used with --dialect, because these boards range by themselves", parameter=name)


def _plan(
    dialect: str | None,
    path: Path | None,
    antenna_delays: Path | None,
    pairs: Literal["all"] | tuple[()] = "all",
    **options: Any,
) -> uwblink.RangingPlan | Dialect:
    """Return what boards do: print ranges in a dialect, or execute the plan of a file, or one for `pairs`.

    A plan gets the `options` that are given. Raises `PlanError` if antenna delays are given twice.
    """
    if dialect is not None:
        return uwblink.boards.dialect_of(dialect)
    chosen = uwblink.boards.load_plan(path) if path else uwblink.RangingPlan(pairs)
    if antenna_delays and chosen.antenna_delays:
        raise PlanError(
            f"{antenna_delays}: the plan also has [antenna_delays]; remove one of them", parameter="antenna_delays"
        )
    if antenna_delays:
        options["antenna_delays"] = uwblink.recording.load_antenna_delays(antenna_delays)
    return replace(chosen, **{name: value for name, value in options.items() if value})


def _correction(
    path: Path | None, chosen: uwblink.RangingPlan | Dialect | None, recording: str | None = None
) -> Correction | None:
    """Return the correction of a calibration, and warn if its antenna delays differ from those of the ranges."""
    if path is None:
        return None
    correct = uwblink.boards.load_correction(path)
    warning = ""
    if isinstance(chosen, uwblink.RangingPlan):
        warning = uwblink.boards.delays_warning(correct, chosen.delays())
    if recording is not None:
        with uwblink.Recording.open(recording) as opened:
            delays, tags = uwblink.recording.delays_in_meta(opened.meta()), [one.tag for one in opened.tags()]
        warning = uwblink.boards.delays_warning(correct, delays, tags)
    if warning:
        typer.echo(f"warning: {path}: {warning}", err=True)
    return correct


def _ids(text: str, parameter: str) -> tuple[int, ...]:
    words = [word.strip() for word in text.split(",")] if text else []
    if not all(word.isascii() and word.isdigit() and len(word) < 6 for word in words):
        raise PlanError(f"found {text!r:.40}, expected ids with commas, as in 3,1,2", parameter=parameter)
    return tuple(map(int, words))


@contextmanager
def _watcher() -> Iterator[Callable[[Progress], None]]:
    """Show a live table on a terminal, and a line every two seconds elsewhere."""
    if sys.stderr.isatty():
        with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
            yield lambda progress: live.update(_progress_table(progress), refresh=True)
        return
    next_s, fault = 2.0, ""

    def watch(progress: Progress) -> None:
        nonlocal next_s, fault
        if progress.last_fault != fault:
            fault = progress.last_fault
            typer.echo(f"{progress.time_s:7.1f} s  {printable(fault)}", err=True)
        if progress.time_s >= next_s:
            next_s = progress.time_s + 2.0
            typer.echo(f"{progress.time_s:7.1f} s  {progress}", err=True)

    yield watch


def _progress_table(progress: Progress) -> Table:
    """Return a recorder's progress as a table: rate and success of each pair, last range and power, faults."""
    table = Table(title=str(progress))
    for name in ("pair", "rate (Hz)", "success, 10 s", "range (m)", "FPP (dBm)"):
        table.add_column(name, justify="right")
    for (initiator, target), cells in progress.rows():
        table.add_row(f"{initiator} -> {target}", *cells)
    absent = [f"board {board} is unplugged" for board in sorted(progress.absent.copy())]
    table.caption = escape(printable("; ".join(filter(None, [progress.last_fault, *absent]))))
    return table
