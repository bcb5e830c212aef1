"""Short texts of tables for terminals and notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__: Final = ["as_html", "as_text", "cut", "excerpt", "first_few", "printable"]

SHOWN_ROWS: Final = 6
"""Rows of a table, and items of a list, that fit beside a headline on a small terminal."""

WIDTH: Final = 79
"""Columns of a terminal that are used: one less than the usual 80, as some break lines at the last."""


def printable(value: Any) -> str:
    """Return text without control characters, since texts of files can come from anyone."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(value))


def excerpt(columns: Mapping[str, NDArray[Any]]) -> list[list[str]]:
    """Return the names of columns, and as text their first rows and the last one."""
    count = len(next(iter(columns.values())))
    rows = list(range(count)) if count <= SHOWN_ROWS else [*range(SHOWN_ROWS - 1), count - 1]
    table = [list(columns), *([_cell(column[k]) for column in columns.values()] for k in rows)]
    if count > SHOWN_ROWS:
        table.insert(-1, ["..."] * len(columns))
    return table


def as_text(title: str, table: Sequence[Sequence[str]]) -> str:
    """Return a title and a table of cells, right-aligned; columns that do not fit on a line are left out and named."""
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    fitting = sum(1 for k in range(len(widths)) if sum(widths[: k + 1]) + 2 * (k + 1) <= WIDTH)
    lines = ["".join(f"  {cell:>{width}}" for cell, width in zip(row[:fitting], widths, strict=False)) for row in table]
    left_out = ", ".join(table[0][fitting:])
    more = [cut(f"  and {left_out}")] if left_out else []
    return "\n".join([cut(title), *lines, *more])


def as_html(title: str, table: Sequence[Sequence[str]]) -> str:
    """Return the same as HTML, with all columns, in a box that scrolls sideways."""
    head = "".join(f"<th>{escape(name)}</th>" for name in table[0])
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in table[1:])
    return (
        f"<div style='overflow-x:auto'><p>{escape(title)}</p>"
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def cut(line: str, width: int = WIDTH) -> str:
    """Return a line that is no longer than `width`."""
    return line if len(line) <= width else line[: width - 3] + "..."


def first_few(items: Iterable[str], most: int = SHOWN_ROWS) -> str:
    """Return the first words, separated by commas, and the number of others; `none` for no words."""
    listed = list(items)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return (", ".join(listed[:most]) + more) or "none"


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else cut(printable(value), 20)
