"""The command that hands ranges on as they come."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from uwblink.cli.guide import add
from uwblink.cli.recording import PANEL, with_antenna_delays
from uwblink.cli.shared import Force, interrupts

if TYPE_CHECKING:
    from uwblink import RangingPlan, StreamedRange
    from uwblink.boards import Correction

SUFFIX: Final = ".uwb"
BOARDS: Final = "Of boards"
SENT: Final = "Where ranges go"


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(
        app,
        stream,
        "uwblink stream ports/tag10 ports/tag20 -c calibration.json",
        "uwblink stream flight.uwb -c calibration.json --udp 127.0.0.1:9870",
        panel=PANEL,
    )


def stream(
    source: Annotated[list[str], typer.Argument(metavar="SOURCE...", help="Ports of boards, or one recording (.uwb).")],
    calibration: Annotated[Path | None, typer.Option("-c", "--calibration", help="Correct by it (.json).")] = None,
    plan: Annotated[
        Path | None, typer.Option(rich_help_panel=BOARDS, help="Who ranges with whom (.toml); else every two.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.001, rich_help_panel=BOARDS, help="Exchanges a second in total (Hz).")
    ] = None,
    antenna_delays: Annotated[
        Path | None,
        typer.Option(rich_help_panel=BOARDS, help="What was programmed into them (.toml); else 16436 into all."),
    ] = None,
    duration: Annotated[float | None, typer.Option(min=0.001, help="Seconds; without it, until the end.")] = None,
    speed: Annotated[float, typer.Option(min=0.001, help="How much faster a recording plays; inf: at once.")] = 1.0,
    udp: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", rich_help_panel=SENT, help="Send JSON datagrams there (PlotJuggler: 9870)."),
    ] = None,
    foxglove: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT", rich_help_panel=SENT, help="Serve a WebSocket for Foxglove there (its own: 8765)."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", rich_help_panel=BOARDS, help="Recording of them to write as well (.uwb)."),
    ] = None,
    force: Force = False,
    quiet: Annotated[bool, typer.Option("--quiet", rich_help_panel=SENT, help="Print no ranges.")] = False,
) -> None:
    """Print ranges as they come, a line of JSON each, corrected where a calibration is given, and send them on."""
    from uwblink.boards import Progress

    seen = Progress()
    senders: list[Callable[[StreamedRange], object]] = [] if quiet else [_print]
    with ExitStack() as stack:
        stop = stack.enter_context(interrupts())
        senders += _senders(stack, udp, foxglove)
        chosen = _plan(source, plan, rate, output, antenna_delays)
        correct = _correction(calibration, source, chosen)
        if output and chosen:
            count = _record(source, output, chosen, correct, duration, stop, [seen], senders, force=force)
        else:
            ranges = _begin(source, correct, chosen, duration, speed, stop, seen)
            stack.callback(ranges.close)
            count = _hand_on(ranges, senders)
    faults = ", ".join(f"{kind} {number}" for kind, number in sorted(seen.faults.items()))
    typer.echo(f"{count} ranges" + (f"; faults: {faults}" if faults else ""), err=True)


def _correction(calibration: Path | None, source: list[str], plan: RangingPlan | None) -> Correction | None:
    """Return the correction of a calibration, and warn where it is of other antenna delays than the ranges."""
    from uwblink import Recording
    from uwblink.boards import delays_warning, load_correction
    from uwblink.recording import delays_in_meta

    if calibration is None:
        return None
    correct = load_correction(calibration)
    if plan is None:
        with Recording.open(source[0]) as recording:
            warning = delays_warning(correct, delays_in_meta(recording.meta()), [t.tag for t in recording.tags()])
    else:
        warning = delays_warning(correct, plan.delays())
    if warning:
        typer.echo(f"warning: {calibration}: {warning}", err=True)
    return correct


def _plan(
    source: list[str], path: Path | None, rate: float | None, output: Path | None, antenna_delays: Path | None
) -> RangingPlan | None:
    from dataclasses import replace

    from uwblink import RangingPlan
    from uwblink.boards import load_plan
    from uwblink.errors import PlanError

    if _is_recording(source):
        if path or rate or output or antenna_delays:
            raise PlanError(
                f"{source[0]}: it is streamed as it is; --plan, --rate, --antenna-delays and --output are for boards"
            )
        return None
    chosen = with_antenna_delays(load_plan(path) if path else RangingPlan(), antenna_delays)
    return replace(chosen, rate_hz=rate) if rate else chosen


def _is_recording(source: list[str]) -> bool:
    return len(source) == 1 and source[0].endswith(SUFFIX)


def _begin(
    source: list[str],
    calibration: Correction | None,
    plan: RangingPlan | None,
    duration: float | None,
    speed: float,
    stop: Callable[[], bool],
    seen: Any,
) -> Any:
    import uwblink

    return uwblink.stream(
        source[0] if _is_recording(source) else source,
        calibration=calibration,
        plan=plan,
        duration_s=duration or math.inf,
        speed=speed,
        stop=stop,
        listeners=[seen],
    )


def _senders(stack: ExitStack, udp: str | None, foxglove: str | None) -> Iterator[Callable[[StreamedRange], object]]:
    """Yield what sends ranges on, open until the stack ends."""
    from uwblink.streaming import FoxgloveServer, UdpSender

    if udp is not None:
        yield stack.enter_context(UdpSender(udp)).send
    if foxglove is not None:
        server = stack.enter_context(FoxgloveServer(foxglove))
        typer.echo(f"foxglove: {server.url}", err=True)
        yield server.send


def _record(
    ports: list[str],
    output: Path,
    plan: RangingPlan,
    calibration: Correction | None,
    duration: float | None,
    stop: Callable[[], bool],
    listeners: list[Any],
    senders: list[Callable[[StreamedRange], object]],
    *,
    force: bool,
) -> int:
    """Record boards and send their ranges on; returns how many. What was recorded is kept, whoever goes away."""
    import uwblink
    from uwblink.streaming import RangeListener

    count = 0

    def send_on(found: StreamedRange) -> None:
        nonlocal count
        count += 1
        for send in senders:
            send(found)

    told = [*listeners, RangeListener(send_on, calibration)]
    try:
        uwblink.record(ports, output, plan, duration_s=duration or math.inf, stop=stop, listeners=told, force=force)
    except BrokenPipeError:
        _nobody_reads()
    return count


def _nobody_reads() -> None:
    """Have Python not try to write what is left when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _hand_on(ranges: Iterator[StreamedRange], senders: list[Callable[[StreamedRange], object]]) -> int:
    """Send all ranges on; returns how many. Whoever reads the lines may go away: that ends the stream."""
    count = 0
    try:
        for count, found in enumerate(ranges, start=1):  # noqa: B007 - how many there were is what is wanted
            for send in senders:
                send(found)
    except BrokenPipeError:
        _nobody_reads()
    return count


def _print(found: StreamedRange) -> None:
    sys.stdout.write(found.to_json() + "\n")
    sys.stdout.flush()
