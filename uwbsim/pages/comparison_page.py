"""The comparison of protocols as one HTML page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from uwblink.output import write_text
from uwbsim.output import check_folder
from uwbsim.pages import protocol_figures as figures
from uwbsim.pages.scenario_figures import png
from uwbsim.pages.scenario_page import STYLE, figure_html
from uwbsim.protocols.comparison import Comparison, ProtocolErrors, over_reply, over_skew, over_state
from uwbsim.protocols.conditions import conditions_of
from uwbsim.tables import write_csv, write_parquet

TABLE_STYLE = """
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .85rem; }
th, td { padding: .2rem .45rem; text-align: right; border-bottom: 1px solid #8884; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } figcaption { font-size: .9rem; }
@page { size: A4; margin: 16mm; } @media print { figure, tr { break-inside: avoid; } body { max-width: none; } }
"""

COLUMNS: Final[dict[str, Callable[[ProtocolErrors], str]]] = {
    "protocol": lambda o: o.protocol,
    "bias (cm)": lambda o: f"{100 * o.bias_m:+.2f}",
    "predicted": lambda o: f"{100 * o.predicted_bias_m:+.2f}",
    "std (cm)": lambda o: f"{100 * o.std_m:.2f}",
    "predicted ": lambda o: f"{100 * o.predicted_std_m:.2f}",
    "RMSE (cm)": lambda o: f"{100 * o.rmse_m:.2f}",
    "95 % of errors (cm)": lambda o: f"{100 * o.low_m:+.1f} … {100 * o.high_m:+.1f}",
    "messages": lambda o: str(o.messages),
    "air (us)": lambda o: f"{1e6 * o.air_s:.0f}",
    "duration (us)": lambda o: f"{1e6 * o.duration_s:.0f}",
    "radio on (us)": lambda o: f"{1e6 * o.radio_on_s:.0f}",
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
    folder.mkdir(exist_ok=True)
    html, table, packed = (folder / name for name in FILES)
    write_text(html, text, force=force)
    write_csv(table, rows, force=force)
    write_parquet(packed, rows, force=force)


def page(found: Comparison) -> str:
    """Return the page; text from the scenario is escaped."""
    scenario, outcomes, samples = found.scenario, found.outcomes, found.samples
    protocols = {row.name: row for row in found.protocols}
    states = conditions_of(scenario)
    skew = {name: over_skew(scenario, row) for name, row in protocols.items()}
    reply = {name: over_reply(scenario, row) for name, row in protocols.items()}
    distance = {n: over_state(row, states, states.distance_m, samples[n]) for n, row in protocols.items()}
    power = {n: over_state(row, states, states.power_dbm, samples[n]) for n, row in protocols.items()}
    title = escape(f"Protocols in {scenario.run.name}")
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{title}</title><style>{STYLE}{TABLE_STYLE}</style></head><body><h1>{title}</h1>",
        f"<p>{outcomes[0].ranges:,} raw ranges with each protocol in the same world, with the same noise. Errors are "
        "those of raw ranges: antenna delays, power bias and reflections are in them. Radio on: sending and listening, "
        "of both radios together, a proxy of energy.</p>",
        _table(list(COLUMNS), [[show(o) for show in COLUMNS.values()] for o in outcomes]),
        _picture(figures.histograms(samples), "Errors. The outermost bins hold everything beyond them."),
        "<h2>Which wins where</h2>",
        "<p>By prediction, once delays and power bias are calibrated, without reflections. One range: the least error "
        "of a single range. Per second: the least error of the mean of what fits into a second.</p>",
        _winners(list(protocols), found.winners),
        "<h2>Over what</h2><p>Points are simulated, lines predicted; the first two without delays, power bias and "
        "reflections.</p>",
        _picture(figures.error_over(skew, "relative skew (ppm)"), "Error over the relative skew of the clocks."),
        _picture(
            figures.error_over(reply, "delay of the scheduled message (us)", logarithmic=True),
            "Error over the delay of the scheduled message: the response of single-sided ranging, the final of "
            "double-sided.",
        ),
        _picture(figures.error_over(distance, "distance (m)"), "Error over distance."),
        _picture(figures.error_over(power, "first-path power (dBm)"), "Error over first-path power."),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _winners(names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    header = ["scheduled delay (us)", "one range", "per second", *(f"{name} (cm)" for name in names)]
    cells = [
        [
            str(row["scheduled_us"]),
            row["rmse"],
            row["per_second"],
            *(f"{100 * row[f'rmse_m {name}']:.2f}" for name in names),
        ]
        for row in rows
    ]
    return _table(header, cells)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class='wide'><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _picture(figure: Any, caption: str) -> str:
    return figure_html(png(figure), caption)
