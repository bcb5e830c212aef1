"""Pages of scenes, comparisons, sweeps and twins: one HTML file each, without other files."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.database import write_tables
from uwblink.output import check_folder, check_output, made_folder, write_bytes, write_files, write_text
from uwblink.pages.blocks import Block, Document, Heading, Listing, Picture, Table, Text, to_html, write_document
from uwblink.pages.figures import picture
from uwblink.protocols.table import PROTOCOLS
from uwbsim.errors import ScenarioError
from uwbsim.pages import figures
from uwbsim.protocols.comparison import BestDelay, ProtocolComparison, ProtocolErrors, over_reply, over_skew, over_state
from uwbsim.protocols.conditions import conditions_of
from uwbsim.protocols.prediction import FleetFigures
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.run import preview
from uwbsim.sweep.design import SweepDesign
from uwbsim.sweep.runner import STORE, ResultStore
from uwbsim.twins import TWIN_LEVEL, Compared, Twin


def show(scenario: Scenario | Source, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a page (.html: room, preview and timing of every protocol) or a picture of the room (.png, .svg, .pdf).

    `scenario` is whatever `load` takes, or a `Scenario`. Raises `ScenarioError` for a suffix other than .html, .png,
    .svg and .pdf, and what `check_output` raises.

    >>> from pathlib import Path
    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> uwbsim.show(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     },
    ...     "scene.png",
    ... )
    >>> Path("scene.png").read_bytes()[1:4]
    b'PNG'
    """
    path, pictures = Path(path), (".png", ".svg", ".pdf")
    check_output(path, force=force)
    scenario = as_scenario(scenario)
    suffix = path.suffix.lower()
    if suffix in pictures:
        write_bytes(path, picture(partial(figures.room, scenario=scenario), suffix[1:]), force=force)
    elif suffix == ".html":
        write_text(path, to_html(scene(scenario)), force=force)
    else:
        raise ScenarioError(f"{path}: found {suffix or 'no suffix'}, expected .html, {', '.join(pictures)}")


def scene(scenario: Scenario) -> Document:
    """Return the page of a scene: its room, the preview, and an exchange of each protocol."""
    # Protocols of equal messages differ in their formulas only, which no picture shows: the first of them is drawn.
    distinct: dict[Any, str] = {}
    for name, row in PROTOCOLS.items():
        distinct.setdefault(row.messages, name)
    blocks: list[Block] = [
        Picture(
            "room",
            partial(figures.room, scenario=scenario),
            "Paths of bodies (two minutes at most), tags at the start, obstacles and walls of the room, to scale.",
        ),
        Heading("Preview"),
        Listing(str(preview(scenario)), table=True),
        Heading("One exchange"),
        Text(
            "All stamps, with their names in the paper; pale: preamble and start of frame, full: header and data. dt41 "
            "is the initiator's round trip, dt32 the target's reply, dt53 and dt64 the third interval by the clocks of "
            "its sender and of its receiver."
        ),
    ]
    blocks += [
        Picture(f"timing-{name}", partial(figures.timing, scenario=scenario, name=name), f"{PROTOCOLS[name].title}.")
        for name in distinct.values()
    ]
    return Document(scenario.run.name, blocks)


COMPARISON_COLUMNS: Final[dict[str, Callable[[ProtocolErrors], str]]] = {
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
"""Columns of tables of protocols, on the page and on the terminal."""

FLEET_COLUMNS: Final[dict[str, Callable[[FleetFigures], str]]] = {
    "of a fleet": lambda o: o.method,
    "std (cm)": lambda o: f"{100 * o.std_m:.2f}",
    "RMSE (cm)": lambda o: f"{100 * o.rmse_m:.2f}",
    "air (µs)": lambda o: f"{1e6 * o.air_s:.0f}",
    "radio on (µs)": lambda o: f"{1e6 * o.radio_on_s:.0f}",
    "updates (1/s)": lambda o: figures.three_digits(o.update_hz),
}
"""Columns of tables of ways of ranging in a fleet; air and radio are per range, or difference of arrival."""

FILES: Final = ("compare.html", "compare.csv", "compare.parquet")
"""Names of the files of `write_comparison`."""


def write_comparison(
    found: ProtocolComparison, folder: Path, *, figures: Path | None = None, force: bool = False
) -> None:
    """Write a comparison as page and tables (`FILES`) into a folder, which is made where it is missing.

    `figures` is a folder for its figures at paper size (PDF and SVG). Raises what `check_folder` raises.
    """
    check_folder(folder, FILES, force=force)
    html, table, packed = (folder / name for name in FILES)
    with made_folder(folder):
        # First, because Parquet asks most of the folder's name.
        write_tables(table, packed, [one.to_dict() for one in found.outcomes], force=force)
        write_document(comparison(found), html, figures=figures, force=force)


def comparison(found: ProtocolComparison) -> Document:
    """Return the page of a comparison: errors, costs, the best protocol by delay, and curves of errors."""
    outcomes, names = found.outcomes, [row.name for row in found.protocols]
    # Two tables, errors and costs, each narrow enough for a screen.
    cut = list(COMPARISON_COLUMNS).index("messages")
    halves = [list(COMPARISON_COLUMNS)[:cut], ["protocol", *list(COMPARISON_COLUMNS)[cut:]]]
    winners = [
        [
            str(row["scheduled_us"]),
            row["rmse"],
            row["per_second"],
            *(f"{100 * row[f'rmse_m {name}']:.2f}" for name in names),
        ]
        for row in found.winners
    ]
    blocks: list[Block] = [
        Text(
            f"{outcomes[0].ranges:,} raw ranges per protocol, in the same world and with the same noise. Errors are "
            "those of raw ranges, with antenna delays, power bias and reflections."
        ),
        *(Table(half, [[COMPARISON_COLUMNS[name](one) for name in half] for one in outcomes]) for half in halves),
        Text(
            "Predicted: analytically, without simulation. Air: total duration of the frames; duration: from the start "
            "of the first frame to the end of the last; radio on: time for which the two radios send or listen, a "
            "proxy of energy; rate: exchanges per second, one after the other.",
            "note",
        ),
        Picture(
            "errors",
            partial(figures.histograms, samples=found.samples),
            "Distribution of errors. The outermost bins include all values beyond them.",
        ),
        Heading("Best protocol by delay"),
        Text(
            "Predicted, after calibration of delays and power bias, without reflections. One range: the protocol "
            "with the smallest error of a single range. Per second: the protocol with the smallest error of the mean "
            "of all ranges in a second."
        ),
        Table(["scheduled delay (µs)", "one range", "per second", *(f"{name} (cm)" for name in names)], winners),
        Heading(f"A fleet of {found.fleet[0].tags} tags"),
        Text(
            "Predicted, after calibration and without reflections. Protocols: the pairs range in turn. broadcast: "
            "each tag sends a frame in turn, which all others receive. tdoa: the tags are anchors that broadcast, "
            "and any number of listeners measure differences of arrival. Air and radio on: per range, or per "
            "difference at a listener. Updates: highest rate at which all pairs range, or a listener gets all "
            "differences."
        ),
        Table([*FLEET_COLUMNS], [[show(one) for show in FLEET_COLUMNS.values()] for one in found.fleet]),
        Heading("Errors over skew, delay, distance and power"),
        Text(
            "Points are simulated, lines predicted; the first two figures are without antenna delays, power bias and "
            "reflections. Axes that cover decades are logarithmic and labelled so; the axis of biases is linear up "
            "to ± 1 cm and logarithmic beyond."
        ),
    ]
    return Document(f"Protocols in {found.scenario.run.name}", [*blocks, *_error_curves(found)])


def _error_curves(found: ProtocolComparison) -> list[Picture]:
    """Return figures of the errors over skew, delay, distance and power, without quantities that do not vary."""
    scenario, samples = found.scenario, found.samples
    protocols = {row.name: row for row in found.protocols}
    states = conditions_of(scenario)
    over = [
        (
            {name: over_skew(scenario, row) for name, row in protocols.items()},
            "relative skew of the clocks (ppm)",
            "Error over the relative skew of the clocks.",
        ),
        (
            {name: over_reply(scenario, row) for name, row in protocols.items()},
            "delay of the scheduled message (µs)",
            "Error over the delay of the scheduled message: the response of single-sided ranging, the final of "
            "double-sided.",
        ),
        (
            {name: over_state(row, states, states.distance_m, samples[name]) for name, row in protocols.items()},
            "distance (m)",
            "Error over distance, in bins of equal numbers of ranges.",
        ),
        (
            {name: over_state(row, states, states.power_dbm, samples[name]) for name, row in protocols.items()},
            "first-path power (dBm)",
            "Error over first-path power, in bins of equal numbers of ranges.",
        ),
    ]
    return [
        Picture(
            f"over {x.partition(' (')[0]}".replace(" ", "-"),
            partial(figures.error_over, curves=curves, x=x, logarithmic=x.startswith("delay")),
            caption,
        )
        for curves, x, caption in over
        if any(np.ptp(c.x) > 0 for c in curves.values())  # of boards that stand still there is one distance
    ]


def optimum_file(protocol: str) -> str:
    """Return the name of the picture of a protocol that `write_optima` writes."""
    return f"optimum-{protocol}.png"


def write_optima(found: Iterable[BestDelay], folder: Path, *, force: bool = False) -> None:
    """Write the curve of each optimum as a picture (.png) into a folder, which is made where it is missing.

    Raises what `check_folder` raises.
    """
    drawn = {optimum_file(one.protocol): picture(partial(figures.optimum_curve, found=one), "png") for one in found}
    check_folder(folder, drawn, force=force)
    write_files(folder, drawn, force=force)


RESULTS: Final = {
    "rmse_m": "root mean square of the errors of raw ranges",
    "std_m": "standard deviation of the errors of raw ranges",
    "bias_m": "mean error of raw ranges",
    "full_std_m": "",
    "full_robust_std_m": "",
    "delays_rms_ns": "",
    "curve_rms_m": "",
    "correction_rms_m": "",
    "median_m": "median error of raw ranges",
    "low_m": "2.5 % quantile of the errors of raw ranges",
    "high_m": "97.5 % quantile of the errors of raw ranges",
    "predicted_bias_m": "predicted mean error",
    "predicted_std_m": "predicted standard deviation",
}
"""Descriptions of the results of a sweep; the first eight are drawn, or others where a sweep has none of them."""

UNITS: Final = {unit: unit for unit in ("m", "ns", "s", "ps", "ppm", "us", "uus", "deg")} | {
    "hz": "Hz",
    "db": "dB",
    "dbm": "dBm",
    "mps": "m/s",
}
"""Units at the end of names, and how they are written."""


def _spelled(name: str, units: Mapping[str, str] = UNITS) -> str:
    """Return the last part of a dotted name in words, with its unit in brackets."""
    stem, _, unit = name.rpartition(".")[2].replace("_", " ").rpartition(" ")
    return f"{stem} ({units[unit]})" if stem and unit in units else f"{stem} {unit}".strip()


def write_sweep_page(plan: SweepDesign, folder: Path, *, figures: Path | None = None) -> Path:
    """Write the page of a sweep into the folder of its results, replacing an earlier one; return its path.

    `figures` is a folder for its figures at paper size. Raises `TableError` where the folder has no results.
    """
    most = 200_000  # rows of which a page is made; the tables have all
    with ResultStore.open(folder / STORE) as store:
        rows = list(islice(store, most + 1))
    path, document = folder / "results.html", _swept(plan, rows)
    if len(rows) > most:
        document.blocks.append(Text(f"Only the first {most:,} rows are drawn; the tables contain all.", "warning"))
    write_document(document, path, figures=figures, force=True)
    return path


def _swept(plan: SweepDesign, rows: Sequence[Mapping[str, Any]]) -> Document:
    good = [row for row in rows if row.get("status") == "ok"]
    varied = [key for key in plan.keys if len({str(row.get(key)) for row in good}) > 1]
    failed = len({row["number"] for row in rows}) - len({row["number"] for row in good})
    blocks: list[Block] = [
        Text(
            f"{plan.total:,} runs over {', '.join(plan.keys) or 'nothing'}, {len(plan.seeds)} "
            f"seed{'s' * (len(plan.seeds) > 1)} each, of which {failed:,} failed. Lines are medians, bands the full "
            "range over seeds and over all other keys; maps are medians over seeds. The tables in this folder "
            "contain every run."
        ),
    ]
    found = _results(good, plan.keys) if varied else {}
    if not found:
        blocks.append(Text("Nothing to draw: no numerical result varies between runs.", "warning"))
    protocols = [str(row.get("protocol", "")) for row in good]
    spelled = {key: _spelled(key) for key in varied}
    columns = {
        spelled[key] if list(spelled.values()).count(spelled[key]) == 1 else key: [row.get(key) for row in good]
        for key in varied
    }
    most = list(RESULTS)[:8]
    drawn = [name for name in found if name in most] or list(found)[: len(most)]
    for name in drawn:
        shown, scale = _spelled(name, UNITS | {"m": "cm"}), 100.0 if name.endswith("_m") else 1.0
        described = f": {RESULTS[name]}" if RESULTS.get(name) else ""
        draw = partial(
            figures.result_over_keys, keys=columns, protocol=protocols, result=scale * found[name], name=shown
        )
        blocks.append(Picture(name, draw, f"{shown}{described}."))
    if len(found) > len(drawn):
        blocks.append(Text(f"Not drawn: {', '.join(name for name in found if name not in drawn)}.", "note"))
    return Document(f"Sweep: {plan.name}", blocks)


def _results(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> dict[str, Any]:
    """Return the results that are numbers and change, as columns (rows,); those of `RESULTS` first."""
    beside = {"scenario", "number", "seed", "uwbcal", "numpy", "python", "status", "error", "protocol", *keys}
    found = {}
    for name in dict.fromkeys(name for row in rows for name in row if name not in beside):
        cells = [row.get(name) for row in rows]
        values = np.array([cell if type(cell) in (int, float) else np.nan for cell in cells], dtype=np.float64)
        known = values[np.isfinite(values)]
        if len(known) and np.ptp(known) > 0:
            found[name] = values
    order = list(RESULTS)
    return dict(sorted(found.items(), key=lambda item: order.index(item[0]) if item[0] in order else len(order)))


TWIN_COLUMNS: Final[dict[str, Callable[[Compared], str]]] = {
    "quantity": lambda c: f"{c.name} ({c.unit})",
    "verdict": lambda c: c.verdict,
    "median": lambda c: _both(c.measured.median, c.simulated.median),
    "10 %": lambda c: _both(c.measured.low, c.simulated.low),
    "90 %": lambda c: _both(c.measured.high, c.simulated.high),
    "lag-1 corr., detect.": lambda c: f"{_both(c.measured.lag1, c.simulated.lag1, '.2f')}, {c.lag1_detectable:.2f}",
    "effective n": lambda c: f"{c.measured.worth:.0f} of {c.measured.count}",
    "D, detect.": lambda c: f"{c.distance:.2f}, {c.detectable:.2f}",
    "p": lambda c: f"{np.nanmin([c.probability, c.lag1_probability]):.2g}",
}
"""Columns of tables of compared quantities, on the page and on the terminal: measured, then simulated."""


def _both(measured: float, simulated: float, form: str = ".3g") -> str:
    return " / ".join("–" if math.isnan(value) else format(round(value, 4), form) for value in (measured, simulated))


def write_twin(found: Twin, compared: Sequence[Compared], path: Path, *, force: bool = False) -> None:
    """Write the page of a twin; raises what `check_output` raises."""
    check_output(path, force=force)
    alike = sum(one.verdict == "alike" for one in compared)
    pairs = [one for one in compared if one.name in ("residual of calibrated ranges", "first-path power at initiator")]
    numbers = {name: value for name, value in found.found.items() if value is None or isinstance(value, int | float)}
    blocks: list[Block] = [
        Text(
            f"A scenario fitted to {len(found.measured):,} exchanges of {len(found.measured.pairs)} pairs, with the "
            f"delays and the bias curve of {Path(found.known.where).name} as truth, and a comparison of its "
            f"simulation with the measurements. {alike} of {len(compared)} quantities are alike."
        ),
        Heading("Measured and simulated"),
        Text(
            "Each cell has the measured value, then the simulated one. The lag-1 correlation is that of consecutive "
            "exchanges of a pair. The effective n is the number of independent values with the same information "
            "as the measured ones. D is the largest difference of the cumulative distributions. Correlations and D are "
            "followed by the difference that is detected in nine of ten such recordings. p is the smaller p-value of "
            "two tests: of D (Kolmogorov and Smirnov, with effective n) and of the difference of the lag-1 "
            f"correlations. Below {TWIN_LEVEL / 2:g} the quantities differ; there are too few values where a D of 0.2 "
            "or a difference of correlations of 0.4 would not be detected. "
            "The scenario was fitted to the same exchanges, so this tests its form, not its predictions."
        ),
        Table(list(TWIN_COLUMNS), [[show(one) for show in TWIN_COLUMNS.values()] for one in compared]),
        Picture(
            "marginals",
            partial(figures.marginals, found=compared),
            "Distributions. The outermost bins include all values beyond them.",
        ),
        Heading("By pair"),
    ]
    if pairs:
        caption = "One dot per pair of five exchanges or more; on the line both are equal."
        blocks.append(Picture("pairs", partial(figures.by_pair, found=pairs), caption))
    blocks += [
        Heading("Fitted values"),
        Table(["quantity", "value"], [[name, _shown(value)] for name, value in numbers.items()]),
    ]
    for name in ("tags", "pairs"):
        rows = found.found[name]
        columns = list(next(iter(rows.values())))
        cells = [[key, *(_shown(row[column]) for column in columns)] for key, row in rows.items()]
        blocks.append(Table([name[:-1], *columns], cells))
    blocks += [
        Heading("Properties that the recording does not determine"),
        Table(
            ["they keep their defaults, or are chosen without the recording"],
            [[text] for text in found.unknown],
            words=True,
        ),
    ]
    write_text(path, to_html(Document(f"The twin of {Path(found.measured.where).name}", blocks)), force=force)


def _shown(value: object) -> str:
    return "not determined" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
