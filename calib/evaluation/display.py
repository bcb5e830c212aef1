"""An evaluation on one screen: errors by stage, for all ranges and by pair, as text and as HTML."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Final

from calib.evaluation.error_statistics import ErrorStatistics

HEADER: Final = ("pair", "n", "raw", "std", "delays", "std", "full", "std", "total z", "95 % holds")
TITLE: Final = "Range errors in cm: mean and robust standard deviation, raw, with delays and fully corrected"
MOST_PAIRS: Final = 40


def as_text(pairs: Mapping[str, ErrorStatistics], overall: ErrorStatistics) -> str:
    """Return a table as lines of text, a row a pair and one for all."""
    lines = ["".join(f"{cell:>8s}" for cell in row[:-1]) + f"  {row[-1]}" for row in _rows(pairs, overall)]
    return "\n".join([TITLE, *lines])


def as_html(pairs: Mapping[str, ErrorStatistics], overall: ErrorStatistics) -> str:
    """Return the same table as HTML, for notebooks."""
    rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in _rows(pairs, overall))
    return f"<p>{escape(TITLE)}</p><table>{rows}</table>"


def _rows(pairs: Mapping[str, ErrorStatistics], overall: ErrorStatistics) -> list[tuple[str, ...]]:
    more = [("...", *[""] * (len(HEADER) - 2), f"{len(pairs) - MOST_PAIRS} more")] if len(pairs) > MOST_PAIRS else []
    shown = [(name, *_cells(group)) for name, group in list(pairs.items())[:MOST_PAIRS]]
    return [HEADER, *shown, *more, ("all", *_cells(overall))]


def _cells(group: ErrorStatistics) -> tuple[str, ...]:
    cells = [str(group.raw.n)]
    for stats in (group.raw, group.delays, group.full):
        cells += [f"{100 * stats.mean_m:+.1f}", f"{100 * stats.robust_std_m:.1f}"]
    if group.total_std != group.total_std:
        return (*cells, "-", f"{100 * group.coverage['95']:.0f} %")
    return (*cells, f"{group.total_std:.2f}", f"{100 * group.inside_95:.0f} %")
