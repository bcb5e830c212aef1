"""What the commands print as tables; text that comes from a file or a board is escaped, since it may be anyone's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from uwblink.display import printable
from uwblink.recording import Summary, counted

if TYPE_CHECKING:
    from rich.console import Console

    from uwblink.boards import Progress


def print_summary(summary: Summary, console: Console) -> None:
    """Print what a recording holds."""
    console.print(escape(summary.headline()))
    tags = Table("tag", "body", "lever arm (m)")
    for tag in summary.tags:
        tags.add_row(str(tag.tag), _plain(tag.body), " ".join(f"{v:+.3f}" for v in tag.lever_arm_m))
    pairs = Table("initiator", "target", "exchanges", "rate (Hz)", "success")
    for pair in summary.pairs:
        rate = "" if pair.rate_hz is None else f"{pair.rate_hz:.1f}"
        tried = pair.exchanges + pair.failed
        success = f"{100 * pair.exchanges / tried:.1f} %" if tried else ""
        pairs.add_row(str(pair.initiator), str(pair.target), str(pair.exchanges), rate, success)
    for table in (tags, pairs, *_skews(summary)):
        console.print(table)
    if summary.reported_twice:
        console.print(f"{summary.reported_twice} reported by both ends, {summary.contradictory} of them differently")
    console.print(f"poses: {escape(counted(summary.poses))}")
    console.print(f"faults: {escape(counted(summary.faults))}")
    for key, value in summary.provenance.items():
        console.print(f"  {_plain(key)}: {_plain(value)}")


def _skews(summary: Summary) -> Iterator[Table]:
    """Yield a table of clock skews by the stamps and by the carriers, in ppm, where pairs range double-sided."""
    if not summary.skews:
        return
    table = Table("pair", "by stamps (ppm)", "by carriers", "slope", "residual", "sign")
    signs = {True: "same", False: "OTHER", None: ""}
    for one in summary.skews:
        carrier, residual, slope = (
            "" if value is None else f"{value:{form}}"
            for value, form in ((one.carrier_ppm, "+.2f"), (one.residual_ppm, ".2f"), (one.slope, ".3f"))
        )
        table.add_row(one.pair, f"{one.stamps_ppm:+.2f}", carrier, slope, residual, signs[one.same_sign])
    yield table


def progress_table(progress: Progress) -> Table:
    """Return a recorder's progress as a table: rate and success of each pair, last range and power, faults."""
    table = Table(title=f"{progress.time_s:.1f} s, {progress.exchanges} of {progress.tried} exchanges")
    for name in ("pair", "rate (Hz)", "success", "range (m)", "FPP (dBm)"):
        table.add_column(name, justify="right")
    for (initiator, target), pair in progress.pairs.items():
        table.add_row(
            f"{initiator} -> {target}",
            f"{pair.rate_hz(progress.time_s):.1f}",
            f"{100 * pair.good / pair.tried:.0f} %" if pair.tried else "",
            f"{pair.range_m:.3f}" if pair.good else "",
            f"{pair.fpp_dbm:.1f}" if pair.good else "",
        )
    last = f"\n{_plain(progress.last_fault)}" if progress.last_fault else ""
    table.caption = f"faults: {escape(counted(progress.faults))}{last}"
    return table


def _plain(value: Any) -> str:
    return escape(printable(value))
