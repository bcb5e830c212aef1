"""The commands that execute a ranging plan: `record` into a file, `stream` to other programs."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import uwblink
from uwblink.cli.guide import (
    AntennaDelays,
    Duration,
    Force,
    OptionalCalibration,
    PlanFile,
    PlaybackSpeed,
    Rate,
    add,
    choice,
    output,
)
from uwblink.cli.shared import interrupts
from uwblink.display import printable
from uwblink.errors import PlanError
from uwblink.output import check_output

if TYPE_CHECKING:
    from rich.table import Table

    from uwblink.boards import Correction, LivePage, Progress


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    for command, *examples in (
        (
            record,
            "uwblink record ports/tag10 ports/tag20 -o bench.uwb --pairs all",
            "uwblink record ports/* -o flight.uwb --plan plan.toml --live",
        ),
        (
            stream,
            "uwblink stream ports/tag10 ports/tag20 -c calibration.json",
            "uwblink stream flight.uwb -c calibration.json --udp 127.0.0.1:9870",
        ),
    ):
        add(app, command, *examples, panel="Recording and streaming")


def record(
    ports: Annotated[list[str], typer.Argument(metavar="PORT...", help="Serial ports or pyserial URLs.")],
    output: Annotated[Path, output("Recording to write (.uwb).")],
    plan: PlanFile = None,
    pairs: Annotated[
        str | None, typer.Option(help="Range every two boards, or none: only listen.", **choice("all", "none"))
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
    passive: Annotated[bool, typer.Option("--passive", help="Record what boards overhear, too.")] = False,
    cir: Annotated[bool, typer.Option("--cir", help="Record channel impulse responses, too.")] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Serve a page that shows the recording to this computer's browser.")
    ] = False,
    live_port: Annotated[int, typer.Option(min=0, max=65535, help="Port of that page; 0: a free one.")] = 0,
    calibration: OptionalCalibration = None,
    force: Force = False,
) -> None:
    """Execute a ranging plan on boards and record everything they send.

    Ends after --duration, else with Ctrl-C. The page of --live shows ranges that --calibration corrects, too. Without
    --antenna-delays, and without those of a plan, 16436 ticks in each board are assumed.
    """

    check_output(output, force=force, recording=True)
    if (plan is None) == (pairs is None):
        raise PlanError("give either --plan plan.toml or --pairs all")
    if pairs not in (None, "all", "none"):
        raise PlanError(f"--pairs: found {pairs!r}, expected all or none; a plan file can name pairs")
    if calibration and not live:
        raise PlanError("--calibration: corrected ranges are shown on the page of --live; add --live")
    chosen = _plan(plan, rate, antenna_delays, pairs="all" if pairs == "all" else ())
    if cir:
        chosen = replace(chosen, get_cir=True)
    with ExitStack() as stack:
        stop, watch = stack.enter_context(interrupts()), stack.enter_context(_watcher())
        page = stack.enter_context(_page(output, calibration, live_port, chosen)) if live else None

        def watch_all(progress: Progress) -> None:
            watch(progress)
            if page:
                page.watch(progress)

        progress = uwblink.record(
            ports,
            output,
            chosen,
            duration_s=duration or math.inf,
            passive=passive,
            arrangement=arrangement,
            known=known,
            order=_ids(order),
            force=force,
            stop=stop,
            watch=watch_all,
            listeners=[page] if page else [],
        )
    typer.echo(f"{output}: {progress}")


def stream(
    source: Annotated[list[str], typer.Argument(metavar="SOURCE...", help="Ports of boards, or one recording (.uwb).")],
    calibration: OptionalCalibration = None,
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
    output: Annotated[Path | None, output("Recording of the boards to write as well (.uwb).")] = None,
    force: Force = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print no ranges.")] = False,
) -> None:
    """Print ranges as they arrive, one line of JSON each, and send them on.

    Without --plan, every two boards range. Ends after --duration, else with the recording or Ctrl-C. Without
    --antenna-delays, and without those of a plan, 16436 ticks in each board are assumed.
    """
    from uwblink.boards import Progress
    from uwblink.streaming import FoxgloveServer, RangeListener, UdpSender

    of_boards = not (len(source) == 1 and source[0].endswith(".uwb"))
    if not of_boards and (plan or rate or output or antenna_delays):
        raise PlanError(
            f"{source[0]}: a recording takes no --plan, --rate, --antenna-delays and --output; they are for boards"
        )
    seen, count = Progress(), 0
    senders: list[Callable[[uwblink.StreamedRange], object]] = (
        [] if quiet else [lambda found: typer.echo(found.to_json())]
    )

    def send_on(found: uwblink.StreamedRange) -> None:
        nonlocal count
        count += 1
        for send in senders:
            send(found)

    with ExitStack() as stack:
        stop = stack.enter_context(interrupts())
        if udp is not None:
            senders.append(stack.enter_context(UdpSender(udp)).send)
        if foxglove is not None:
            server = stack.enter_context(FoxgloveServer(foxglove))
            typer.echo(f"foxglove: {server.url}", err=True)
            senders.append(server.send)
        chosen = _plan(plan, rate, antenna_delays) if of_boards else None
        correct = _correction(calibration, chosen, None if of_boards else source[0])
        duration_s = duration or math.inf
        try:
            if output and chosen:
                told = [seen, RangeListener(send_on, correct)]
                uwblink.record(source, output, chosen, duration_s=duration_s, stop=stop, listeners=told, force=force)
            else:
                ranges = uwblink.stream(
                    source if of_boards else source[0],
                    calibration=correct,
                    plan=chosen,
                    duration_s=duration_s,
                    speed=speed,
                    stop=stop,
                    listeners=[seen],
                )
                stack.callback(ranges.close)
                for found in ranges:
                    send_on(found)
        except BrokenPipeError:
            # The reader of the lines closed, which ends the stream; Python must not write the rest at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    typer.echo(f"{count} ranges" + (f"; faults: {seen.fault_counts()}" if seen.faults else ""), err=True)


def _plan(
    path: Path | None, rate: float | None, antenna_delays: Path | None, pairs: str | tuple[()] = "all"
) -> uwblink.RangingPlan:
    """Return the plan of a file, or one for `pairs`; raises `PlanError` if antenna delays are given twice."""
    from uwblink.boards import load_plan
    from uwblink.recording import load_antenna_delays

    chosen = load_plan(path) if path else uwblink.RangingPlan("all" if pairs == "all" else ())
    if antenna_delays and chosen.antenna_delays:
        raise PlanError(
            f"{antenna_delays}: the plan has [antenna_delays], too; leave one of them out", parameter="antenna_delays"
        )
    if antenna_delays:
        chosen = replace(chosen, antenna_delays=load_antenna_delays(antenna_delays))
    return replace(chosen, rate_hz=rate) if rate else chosen


def _correction(path: Path | None, plan: uwblink.RangingPlan | None, recording: str | None = None) -> Correction | None:
    """Return the correction of a calibration, and warn if its antenna delays differ from those of the ranges."""
    from uwblink.boards import delays_warning, load_correction
    from uwblink.recording import delays_in_meta

    if path is None:
        return None
    correct = load_correction(path)
    if plan is not None:
        warning = delays_warning(correct, plan.delays())
    else:
        with uwblink.Recording.open(recording or "") as opened:
            warning = delays_warning(correct, delays_in_meta(opened.meta()), [t.tag for t in opened.tags()])
    if warning:
        typer.echo(f"warning: {path}: {warning}", err=True)
    return correct


def _ids(text: str) -> tuple[int, ...]:

    words = [word.strip() for word in text.split(",")] if text else []
    if not all(word.isascii() and word.isdigit() and len(word) < 6 for word in words):
        raise PlanError(f"--order: found {text!r:.40}, expected ids with commas, as in 3,1,2")
    return tuple(map(int, words))


def _page(path: Path, calibration: Path | None, port: int, plan: uwblink.RangingPlan) -> LivePage:
    """Return the served live page."""
    from uwblink.boards import LivePage

    page = LivePage(path, correct=_correction(calibration, plan), port=port)
    typer.echo(f"live page: {page.url}", err=True)
    return page


@contextmanager
def _watcher() -> Iterator[Callable[[Progress], None]]:
    """Show a live table on a terminal, and a line every two seconds elsewhere."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

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
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=str(progress))
    for name in ("pair", "rate (Hz)", "success", "range (m)", "FPP (dBm)"):
        table.add_column(name, justify="right")
    for (initiator, target), cells in progress.rows():
        table.add_row(f"{initiator} -> {target}", *cells)
    table.caption = escape(printable(progress.last_fault))
    return table
