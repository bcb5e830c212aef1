"""The command that records."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from uwblink.cli.guide import add, choice
from uwblink.cli.shared import Force, interrupts

if TYPE_CHECKING:
    from uwblink import RangingPlan
    from uwblink.boards import LivePage, Progress

AntennaDelays = Annotated[
    Path | None,
    typer.Option(help="What was programmed into the boards, as calib export wrote it (.toml); else 16436 into all."),
]
PANEL: Final = "Recording and streaming"
LIVE: Final = "Live page"
LINE_EVERY_S = 2.0


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(
        app,
        record,
        "uwblink record ports/tag10 ports/tag20 -o bench.uwb --pairs all",
        "uwblink record ports/* -o flight.uwb --plan plan.toml --live",
        panel=PANEL,
    )


def record(
    ports: Annotated[list[str], typer.Argument(metavar="PORT...", help="Serial ports or pyserial URLs.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Recording to write (.uwb).")],
    plan: Annotated[Path | None, typer.Option(help="Who ranges with whom (.toml).")] = None,
    pairs: Annotated[
        str | None, typer.Option(help="Every two boards, or none: only listen.", **choice("all", "none"))
    ] = None,
    rate: Annotated[float | None, typer.Option(min=0.001, help="Exchanges a second in total (Hz).")] = None,
    duration: Annotated[float | None, typer.Option(min=0.001, help="Seconds; without it, until Ctrl-C.")] = None,
    arrangement: Annotated[
        str | None, typer.Option(metavar="NAME", help="Boards stand still: name how, for calib survey.")
    ] = None,
    known: Annotated[
        str, typer.Option(help="How boards of an arrangement are known to stand.", **choice("line", "plane"))
    ] = "",
    order: Annotated[
        str, typer.Option(metavar="TAG,TAG...", help="In which order they lie along a line, from either end.")
    ] = "",
    antenna_delays: AntennaDelays = None,
    passive: Annotated[bool, typer.Option("--passive", help="Record what boards overhear, too.")] = False,
    cir: Annotated[bool, typer.Option("--cir", help="Record channel impulse responses, too.")] = False,
    live: Annotated[
        bool, typer.Option("--live", rich_help_panel=LIVE, help="Serve a page about it to this computer's browser.")
    ] = False,
    live_port: Annotated[
        int, typer.Option(min=0, max=65535, rich_help_panel=LIVE, help="Port of the page; 0: a free one.")
    ] = 0,
    calibration: Annotated[
        Path | None, typer.Option(rich_help_panel=LIVE, help="Show ranges corrected, too (.json).")
    ] = None,
    force: Force = False,
) -> None:
    """Play a ranging plan on boards and record everything they say."""
    from dataclasses import replace

    from uwblink import RangingPlan
    from uwblink import record as run
    from uwblink.boards import load_plan
    from uwblink.errors import PlanError
    from uwblink.output import check_output

    check_output(output, force=force, recording=True)
    if (plan is None) == (pairs is None):
        raise PlanError("give either --plan plan.toml or --pairs all")
    if pairs not in (None, "all", "none"):
        raise PlanError(f"--pairs: found {pairs!r}, expected all or none; a plan file can name pairs")
    chosen = load_plan(plan) if plan else RangingPlan("all" if pairs == "all" else ())
    chosen = with_antenna_delays(chosen, antenna_delays)
    if rate:
        chosen = replace(chosen, rate_hz=rate)
    if cir:
        chosen = replace(chosen, get_cir=True)
    if known and not arrangement:
        raise PlanError("--known: is said of an arrangement; give --arrangement NAME, too")
    if order and known != "line":
        raise PlanError("--order: is that of boards on a line; give --known line, too")
    if calibration and not live:
        raise PlanError("--calibration: corrected ranges are shown on the page of --live; give that, too")
    with interrupts() as stop, _watcher() as watch, _page(output, calibration, live_port, live, chosen) as page:

        def watch_all(progress: Progress) -> None:
            watch(progress)
            if page:
                page.watch(progress)

        progress = run(
            ports,
            output,
            chosen,
            duration_s=duration or float("inf"),
            passive=passive,
            arrangement=arrangement,
            known=known,
            order=_ids(order),
            force=force,
            stop=stop,
            watch=watch_all,
            listeners=[page] if page else [],
        )
    typer.echo(f"{output}: {_summary(progress)}")


def with_antenna_delays(plan: RangingPlan, path: Path | None) -> RangingPlan:
    """Return a plan with the antenna delays of a file; raises `PlanError` where it has some of its own."""
    from dataclasses import replace

    from uwblink.errors import PlanError
    from uwblink.recording import load_antenna_delays

    if path is None:
        return plan
    if plan.antenna_delays:
        raise PlanError(
            f"{path}: the plan has [antenna_delays], too; leave one of them out", parameter="antenna_delays"
        )
    return replace(plan, antenna_delays=load_antenna_delays(path))


def _ids(text: str) -> tuple[int, ...]:
    from uwblink.errors import PlanError

    words = [word.strip() for word in text.split(",")] if text else []
    if not all(word.isascii() and word.isdigit() and len(word) < 6 for word in words):
        raise PlanError(f"--order: found {text!r:.40}, expected ids with commas, as in 3,1,2")
    return tuple(map(int, words))


@contextmanager
def _page(
    output: Path, calibration: Path | None, port: int, live: bool, plan: RangingPlan
) -> Iterator[LivePage | None]:
    """Serve the live page, if it was asked for."""
    if not live:
        yield None
        return
    from uwblink.boards import LivePage, delays_warning, load_correction

    correct = load_correction(calibration) if calibration else None
    if warning := delays_warning(correct, plan.delays()):
        typer.echo(f"warning: {calibration}: {warning}", err=True)
    with LivePage(output, correct=correct, port=port) as page:
        typer.echo(f"live page: {page.url}", err=True)
        yield page


@contextmanager
def _watcher() -> Iterator[Callable[[Progress], None]]:
    """Show a live table on a terminal, and a line every two seconds elsewhere."""
    if not sys.stderr.isatty():
        yield _Lines().watch
        return
    from rich.console import Console
    from rich.live import Live

    from uwblink.cli.tables import progress_table

    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
        yield lambda progress: live.update(progress_table(progress), refresh=True)


class _Lines:
    """Plain lines of progress."""

    def __init__(self) -> None:
        self._next_s = LINE_EVERY_S
        self._fault = ""

    def watch(self, progress: Progress) -> None:
        if progress.last_fault != self._fault:
            self._fault = progress.last_fault
            typer.echo(f"{progress.time_s:7.1f} s  {_printable(self._fault)}", err=True)
        if progress.time_s >= self._next_s:
            self._next_s = progress.time_s + LINE_EVERY_S
            typer.echo(f"{progress.time_s:7.1f} s  {_summary(progress)}", err=True)


def _summary(progress: Progress) -> str:
    text = f"{progress.exchanges} of {progress.tried} exchanges in {progress.time_s:.1f} s"
    if progress.overheard:
        text += f", {progress.overheard} overheard"
    if progress.cirs:
        text += f", {progress.cirs} impulse responses"
    faults = ", ".join(f"{kind} {count}" for kind, count in sorted(progress.faults.items()))
    return text + f"; faults: {faults or 'none'}"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)
