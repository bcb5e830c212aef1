"""A twin beside its recording as one HTML page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

from uwblink.output import check_output, write_text
from uwblink.pages.html import both_widths, page_html, table_html
from uwbsim.pages import twin_figures as figures
from uwbsim.twins import LEVEL, Compared, Twin

BY_PAIR: Final = ("residual of calibrated ranges", "first-path power at initiator")

TWIN_COLUMNS: Final[dict[str, Callable[[Compared], str]]] = {
    "quantity": lambda c: f"{c.name} ({c.unit})",
    "verdict": lambda c: "alike" if c.alike else "differ",
    "median": lambda c: _both(c.median_measured, c.median_simulated),
    "10 %": lambda c: _both(c.low_measured, c.low_simulated),
    "90 %": lambda c: _both(c.high_measured, c.high_simulated),
    "to a pair's next": lambda c: _both(c.lag1_measured, c.lag1_simulated, ".2f"),
    "worth": lambda c: f"{c.worth_measured:.0f} of {c.count}",
    "D": lambda c: f"{c.distance:.3f}",
    "p": lambda c: f"{c.probability:.2g}",
}
"""What tables on the page and on the terminal show of a quantity: measured, then simulated."""


def write_twin(found: Twin, compared: Sequence[Compared], path: Path, *, force: bool = False) -> None:
    """Write the page; raises what `check_output` raises."""
    check_output(path, force=force)
    write_text(path, page(found, compared), force=force)


def page(found: Twin, compared: Sequence[Compared]) -> str:
    """Return the page; names of files are escaped."""
    alike = sum(one.alike for one in compared)
    pairs = [one for one in compared if one.name in BY_PAIR]
    parts = [
        f"<p>A scenario fitted to {len(found.measured):,} exchanges of {len(found.measured.pairs)} pairs, with the "
        f"delays and the bias curve of {escape(Path(found.calibration).name)} as truth, and what it makes beside what "
        f"was measured. {alike} of {len(compared)} quantities are alike.</p>",
        "<h2>Measured and simulated</h2>",
        "<p>Each cell has the measured value, then the simulated one. <i>To a pair's next</i> is the autocorrelation "
        "to the pair's next exchange, <i>worth</i> how many independent values the measured ones are worth, "
        "<i>D</i> the "
        "largest difference of the cumulative distributions, and <i>p</i> how likely chance makes it so large "
        f"(Kolmogorov and Smirnov, with sizes as the values are worth); below {LEVEL:g} they differ. The scenario was "
        "fitted to these same exchanges, so the test is of its form, not of what it predicts.</p>",
        table_html(list(TWIN_COLUMNS), [[show(one) for show in TWIN_COLUMNS.values()] for one in compared]),
        both_widths(
            partial(figures.marginals, found=compared),
            "Distributions. The outermost bins hold what lies beyond them.",
            "marginals",
        ),
        "<h2>Pair by pair</h2>",
        both_widths(
            partial(figures.by_pair, found=pairs),
            "A dot a pair of five exchanges or more; on the line both agree.",
            "pairs",
        )
        if pairs
        else "",
        "<h2>What was found</h2>",
        table_html(
            ["what", "value"], [[name, _shown(value)] for name, value in found.found.items() if _is_number(value)]
        ),
        *(_nested(found, name) for name in ("tags", "pairs")),
        "<h2>What the recording cannot tell</h2><p>This keeps its default, or was decided without the recording.</p>",
        "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in found.unknown) + "</ul>",
    ]
    return page_html(f"The twin of {Path(found.recording).name}", parts)


def _nested(found: Twin, name: str) -> str:
    rows = found.found[name]
    columns = list(next(iter(rows.values())))
    cells = [[key, *(_shown(row[column]) for column in columns)] for key, row in rows.items()]
    return table_html([name[:-1], *columns], cells)


def _is_number(value: object) -> bool:
    return value is None or isinstance(value, int | float)


def _shown(value: object) -> str:
    if value is None:
        return "not told"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _both(measured: float, simulated: float, form: str = ".3g") -> str:
    return " / ".join("–" if math.isnan(value) else format(value, form) for value in (measured, simulated))
