"""The comparison of protocols as one HTML page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from uwblink.output import check_folder, made_folder, write_text
from uwblink.pages.html import both_widths, page_html, table_html
from uwbsim.pages import protocol_figures as figures
from uwbsim.protocols.comparison import Comparison, ProtocolErrors, over_reply, over_skew, over_state
from uwbsim.protocols.conditions import conditions_of
from uwbsim.tables import write_csv, write_parquet

COLUMNS: Final[dict[str, Callable[[ProtocolErrors], str]]] = {
    "protocol": lambda o: o.protocol,
    "bias (cm)": lambda o: f"{100 * o.bias_m:+.2f}",
    "predicted": lambda o: f"{100 * o.predicted_bias_m:+.2f}",
    "std (cm)": lambda o: f"{100 * o.std_m:.2f}",
    "predicted ": lambda o: f"{100 * o.predicted_std_m:.2f}",
    "RMSE (cm)": lambda o: f"{100 * o.rmse_m:.2f}",
    "95 % of errors (cm)": lambda o: f"{100 * o.low_m:+.1f} … {100 * o.high_m:+.1f}",
    "messages": lambda o: str(o.messages),
    "air (µs)": lambda o: f"{1e6 * o.air_s:.0f}",
    "duration (µs)": lambda o: f"{1e6 * o.duration_s:.0f}",
    "radio on (µs)": lambda o: f"{1e6 * o.radio_on_s:.0f}",
    "rate (1/s)": lambda o: f"{o.rate_hz:.0f}",
}
"""What tables on the page and on the terminal show of an outcome."""


FILES: Final = ("compare.html", "compare.csv", "compare.parquet")
"""What `write_comparison` writes into its folder."""


def write_comparison(found: Comparison, folder: Path, *, force: bool = False) -> None:
    """Write a comparison as page and tables (`FILES`) into a folder, which is made where it is missing.

    Raises what `check_folder` raises.
    """
    check_folder(folder, FILES, force=force)
    text, rows = page(found), [one.to_dict() for one in found.outcomes]
    html, table, packed = (folder / name for name in FILES)
    with made_folder(folder):
        write_parquet(packed, rows, force=force)  # first, because it asks most of the folder's name
        write_text(html, text, force=force)
        write_csv(table, rows, force=force)


def page(found: Comparison) -> str:
    """Return the page; text from the scenario is escaped."""
    scenario, outcomes, samples = found.scenario, found.outcomes, found.samples
    protocols = {row.name: row for row in found.protocols}
    states = conditions_of(scenario)
    skew = {name: over_skew(scenario, row) for name, row in protocols.items()}
    reply = {name: over_reply(scenario, row) for name, row in protocols.items()}
    distance = {n: over_state(row, states, states.distance_m, samples[n]) for n, row in protocols.items()}
    power = {n: over_state(row, states, states.power_dbm, samples[n]) for n, row in protocols.items()}
    over = [
        (skew, "relative skew of the clocks (ppm)", "Error over the relative skew of the clocks.", False),
        (
            reply,
            "delay of the scheduled message (µs)",
            "Error over the delay of the scheduled message: the response of single-sided ranging, the final of "
            "double-sided.",
            True,
        ),
        (distance, "distance (m)", "Error over distance: bins of as many ranges each.", False),
        (power, "first-path power (dBm)", "Error over first-path power, likewise.", False),
    ]
    wide, narrow = _halves(list(COLUMNS))
    parts = [
        f"<p>{outcomes[0].ranges:,} raw ranges with each protocol in the same world, with the same noise. Errors are "
        "those of raw ranges: antenna delays, power bias and reflections are in them.</p>",
        table_html(wide, [[COLUMNS[name](o) for name in wide] for o in outcomes]),
        table_html(narrow, [[COLUMNS[name](o) for name in narrow] for o in outcomes]),
        "<p class='note'>Predicted: by the protocol's formulas, without simulating. Air: sum of the frames' lengths; "
        "duration: from the first to the last; radio on: sending and listening, of both radios together, a proxy of "
        "energy; rate: exchanges one after the other.</p>",
        both_widths(
            partial(figures.histograms, samples=samples),
            "Errors. The outermost bins hold everything beyond them.",
            "errors",
        ),
        "<h2>Which wins where</h2>",
        "<p>By prediction, once delays and power bias are calibrated, without reflections. One range: the least error "
        "of a single range. Per second: the least error of the mean of what fits into a second.</p>",
        _winners(list(protocols), found.winners),
        "<h2>Over what</h2><p>Points are simulated, lines predicted; the first two without delays, power bias and "
        "reflections. Axes that cover decades are logarithmic, and say so; biases have a sign, so theirs is to scale "
        f"up to ± {figures.LINEAR_CM:g} cm and logarithmic beyond.</p>",
        *(
            both_widths(partial(figures.error_over, curves=c, x=x, logarithmic=log), caption, f"over {x}")
            for c, x, caption, log in over
        ),
    ]
    return page_html(f"Protocols in {scenario.run.name}", parts)


def _halves(names: list[str]) -> tuple[list[str], list[str]]:
    """Return what protocols know and what they cost: the columns of two tables, each whole on a screen."""
    cut = names.index("messages")
    return names[:cut], ["protocol", *names[cut:]]


def _winners(names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    header = ["scheduled delay (µs)", "one range", "per second", *(f"{name} (cm)" for name in names)]
    cells = [
        [
            str(row["scheduled_us"]),
            row["rmse"],
            row["per_second"],
            *(f"{100 * row[f'rmse_m {name}']:.2f}" for name in names),
        ]
        for row in rows
    ]
    return table_html(header, cells)
