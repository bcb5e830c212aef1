"""The results of a sweep as one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.output import write_text
from uwblink.pages.html import both_widths, page_html
from uwbsim.pages.sweep_figures import Swept, figure_over_keys
from uwbsim.sweep.design import SweepDesign
from uwbsim.sweep.results import Store
from uwbsim.sweep.runner import STORE

SWEEP_PAGE: Final = "results.html"
MOST_ROWS: Final = 200_000
"""Rows of which a page is made; of more the tables are there for whoever looks."""

MOST_FIGURES: Final = 8
FIRST: Final = (
    "rmse_m",
    "std_m",
    "bias_m",
    "full_std_m",
    "full_robust_std_m",
    "delays_rms_ns",
    "curve_rms_m",
    "correction_rms_m",
)
"""What is drawn before anything else."""

SAID: Final = {
    "rmse_m": "root mean square of the errors of raw ranges",
    "std_m": "standard deviation of the errors of raw ranges",
    "bias_m": "mean error of raw ranges",
    "median_m": "median error of raw ranges",
    "low_m": "what 2.5 % of the errors of raw ranges lie below",
    "high_m": "what 2.5 % of the errors of raw ranges lie above",
    "predicted_bias_m": "mean error as it is predicted without simulating",
    "predicted_std_m": "standard deviation as it is predicted without simulating",
}
"""What figures are, in words."""

NOT_RESULTS: Final = ("scenario", "number", "seed", "uwbcal", "numpy", "python", "status", "error", "protocol")


def write_sweep_page(plan: SweepDesign, folder: Path) -> Path:
    """Write the page of a sweep into the folder of its results, in the place of one that is there; return its path.

    Raises `TableError` where the folder has no results.
    """
    with Store.open(folder / STORE) as store:
        rows = list(islice(store.rows(), MOST_ROWS + 1))
    path = folder / SWEEP_PAGE
    write_text(path, _page(plan, rows), force=True)
    return path


def _page(plan: SweepDesign, rows: Sequence[Mapping[str, Any]]) -> str:
    good = [row for row in rows if row.get("status") == "ok"]
    keys = list(plan.axes) if plan.rows is None else list(dict.fromkeys(key for row in plan.rows for key in row))
    varied = [key for key in keys if len({str(row.get(key)) for row in good}) > 1]
    parts = [
        f"<p>{plan.total:,} runs over {_listed(keys)}, {len(plan.seeds)} seed{'s' * (len(plan.seeds) > 1)} each, of "
        f"which {len({row['number'] for row in rows}) - len({row['number'] for row in good}):,} failed. Lines are "
        "medians, bands reach from the least to the largest over seeds and over all other keys; maps are medians over "
        "seeds. The tables beside this page have every run.</p>"
    ]
    if len(rows) > MOST_ROWS:
        parts.append(f"<p class='warning'>Of more than {MOST_ROWS:,} rows the first are drawn.</p>")
    drawn = _figures(good, keys)
    if not drawn or not varied:
        parts.append("<p class='warning'>Nothing to draw: no run gave a number that changes with a key.</p>")
    for name in drawn[:MOST_FIGURES] if varied else []:
        swept = Swept(
            {key: [row.get(key) for row in good] for key in varied},
            [str(row.get("protocol", "")) for row in good],
            _column(good, name),
        )
        shown, swept = _unit(name, swept)
        caption = f"{shown}: {SAID[name]}." if name in SAID else f"{shown}."
        parts.append(both_widths(partial(figure_over_keys, swept=swept, name=shown), caption, name))
    if len(drawn) > MOST_FIGURES:
        parts.append(f"<p class='note'>Not drawn: {_listed(drawn[MOST_FIGURES:])}.</p>")
    return page_html(f"Sweep: {plan.name}", parts)


def _figures(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[str]:
    """Return the columns of results that are numbers and change, the telling ones first."""
    names = list(dict.fromkeys(name for row in rows for name in row if name not in NOT_RESULTS and name not in keys))
    found = []
    for name in names:
        values = _column(rows, name)
        known = values[np.isfinite(values)]
        if len(known) and np.ptp(known) > 0:
            found.append(name)
    return sorted(found, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), names.index(name)))


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> Any:
    values = (row.get(name) for row in rows)
    return np.array([v if isinstance(v, int | float) and not isinstance(v, bool) else np.nan for v in values], float)


def _unit(name: str, swept: Swept) -> tuple[str, Swept]:
    """Return a figure's name as an axis has it, errors in cm instead of metres."""
    if name.endswith("_m"):
        return f"{name[:-2].replace('_', ' ')} (cm)", Swept(swept.values, swept.protocol, 100 * swept.figure)
    stem, _, unit = name.rpartition("_")
    known = {"ns", "s", "hz", "ps", "ppm", "dbm"}
    return (f"{stem.replace('_', ' ')} ({unit})" if unit in known else name.replace("_", " ")), swept


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"<code>{escape(name)}</code>" for name in names) or "nothing"
