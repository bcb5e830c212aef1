"""What a recording holds, for people and as JSON."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from uwblink.recording.file import Recording
from uwblink.recording.schema import TABLES, Fault

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from uwblink.boards.progress import Progress

_FAILED = re.compile(r"ranged with (\d+): message|ranging with (\d+) failed")


def summarize(recording: Recording) -> dict[str, Any]:
    """Return tags, pairs, counts, rates, time span, protocols, faults and provenance, JSON-ready."""
    exchanges, poses, meta = recording.exchanges(), recording.poses(), recording.meta()
    span_s = float(np.ptp(exchanges.time_ns)) * 1e-9 if len(exchanges) else 0.0
    ends = np.column_stack([exchanges.initiator, exchanges.target])
    pairs, counts = np.unique(ends, axis=0, return_counts=True)
    failed = failures_by_pair(recording.faults())
    ends = np.vstack([ends, np.array(sorted(failed), dtype=np.int64).reshape(-1, 2)])
    pairs, counts = np.unique(ends, axis=0, return_counts=True)
    counts -= np.array([tuple(pair) in failed for pair in pairs.tolist()], dtype=counts.dtype)
    names, rows = np.unique(exchanges.protocol, return_counts=True)
    kinds, faults = np.unique([f.kind for f in recording.faults()], return_counts=True)
    bodies, seen = np.unique(poses.body, return_counts=True)
    return {
        "file": recording.path.name,
        "span_s": span_s,
        "counts": {table: recording.count(table) for table in TABLES if table != "meta"},
        "tags": [{"tag": t.tag, "body": t.body, "lever_arm_m": list(t.lever_arm_m)} for t in recording.tags()],
        "pairs": [
            {
                "initiator": int(i),
                "target": int(j),
                "exchanges": int(n),
                "failed": failed.get((int(i), int(j)), 0),
                "rate_hz": n / span_s if span_s else None,
            }
            for (i, j), n in zip(pairs, counts, strict=True)
        ],
        "protocols": dict(zip(names.tolist(), rows.tolist(), strict=True)),
        "faults": dict(zip(kinds.tolist(), faults.tolist(), strict=True)),
        "poses": dict(zip(bodies.tolist(), seen.tolist(), strict=True)),
        "provenance": {k: v for k, v in meta.items() if k not in {"scenario", "planted"}},
    }


def failures_by_pair(faults: list[Fault]) -> dict[tuple[int, int], int]:
    """Count failed exchanges by (initiator, target), from the faults that simulator and recorder write."""
    counts: dict[tuple[int, int], int] = {}
    for fault in faults:
        found = _FAILED.search(fault.detail)
        if found and fault.board.isdecimal():
            pair = int(fault.board), int(found[1] or found[2])
            counts[pair] = counts.get(pair, 0) + 1
    return counts


def print_summary(summary: dict[str, Any], console: Console) -> None:
    """Print a summary; text from the file is escaped, since it may come from anyone."""
    from rich.table import Table

    console.print(
        f"{_plain(summary['file'])}: {summary['counts']['exchanges']} exchanges in {summary['span_s']:.1f} s, "
        f"protocols {_counted(summary['protocols'])}"
    )
    tags = Table("tag", "body", "lever arm (m)")
    for tag in summary["tags"]:
        tags.add_row(str(tag["tag"]), _plain(tag["body"]), " ".join(f"{v:+.3f}" for v in tag["lever_arm_m"]))
    pairs = Table("initiator", "target", "exchanges", "rate (Hz)", "success")
    for pair in summary["pairs"]:
        rate = "" if pair["rate_hz"] is None else f"{pair['rate_hz']:.1f}"
        tried = pair["exchanges"] + pair["failed"]
        success = f"{100 * pair['exchanges'] / tried:.1f} %" if tried else ""
        pairs.add_row(str(pair["initiator"]), str(pair["target"]), str(pair["exchanges"]), rate, success)
    for table in (tags, pairs):
        console.print(table)
    console.print(f"poses: {_counted(summary['poses'])}")
    console.print(f"faults: {_counted(summary['faults'])}")
    for key, value in summary["provenance"].items():
        console.print(f"  {_plain(key)}: {_plain(value)}")


def progress_table(progress: Progress) -> Table:
    """Return a recorder's progress as a table: rate and success of each pair, last range and power, faults."""
    from rich.table import Table

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
    table.caption = f"faults: {_counted(progress.faults)}{last}"
    return table


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{_plain(name)} {count}" for name, count in counts.items()) or "none"


def _plain(value: Any) -> str:
    from rich.markup import escape

    return escape("".join(c if c.isprintable() else "�" for c in str(value)))
