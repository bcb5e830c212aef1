"""The evaluation as a table on the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from calib.evaluation import CORRECTION_STAGES, ErrorStatistics, Evaluation

WIDE = 110
"""Columns that the table never needs more than: where nobody looks, no figure must lose its last digits."""

ROOMY = 92
"""Columns from which there is room for two blanks between figures; a terminal of 80 has room for one."""

SHORT = {"raw": "raw", "delays": "delay", "full": "full"}


def print_table(evaluation: Evaluation, console: Console) -> None:
    """Print errors in centimetres, a row a pair and one for all.

    Last, the share in % that chi-square rejects, the spread of errors over the total sigma, and how many of them lie
    between the quantiles for 95 %.
    """
    gap = 1 if console.width >= ROOMY else 0
    table = Table(
        title="Range error in cm", title_justify="left", box=SIMPLE_HEAD, padding=(0, gap, 0, 0), pad_edge=False
    )
    table.add_column("pair", no_wrap=True)
    table.add_column("n", justify="right", no_wrap=True)
    for stage in CORRECTION_STAGES:
        for what in ("mean", "std", "rob."):
            table.add_column(f"{SHORT[stage]}\n{what}", justify="right", no_wrap=True)
    table.add_column("chi2\nout%", justify="right", no_wrap=True)
    for what in ("total\nz std", "in\n95%"):
        table.add_column(what, justify="right", no_wrap=True)
    for name, group in evaluation.pairs.items():
        table.add_row(name, *_cells(group))
    table.add_section()
    table.add_row("all", *_cells(evaluation.overall), style="bold")
    console.print(table)
    for line in remarks(evaluation):
        console.print(line, highlight=False, soft_wrap=True)


def remarks(evaluation: Evaluation) -> Iterator[str]:
    """Yield what the table has no room for: quantiles, the test before and after, coverage, what was planted."""
    group = evaluation.overall
    yield (
        f"95 % of the calibrated errors lie between {100 * group.full.low_m:+.1f} and {100 * group.full.high_m:+.1f} cm"
        f"; {100 * group.rejected:.1f} % lie beyond what sigma explains at 95 % (5 % without reflections)"
    )
    covered = ", ".join(f"{100 * share:.1f} % for {name} %" for name, share in group.coverage.items())
    yield f"sigma covers {covered}"
    if group.total_std == group.total_std:
        yield (
            f"with reflections, of which {100 * group.tail_share:.1f} % are expected: errors over the total sigma have "
            f"a standard deviation of {group.total_std:.2f}, and {100 * group.inside_95:.1f} % lie between their "
            "quantiles for 95 %"
        )
    planted = evaluation.planted
    if planted:
        rms = (sum(d**2 for d in planted.delay_error_ns.values()) / len(planted.delay_error_ns)) ** 0.5
        yield (
            f"from what was planted: delays {rms:.4f} ns rms, bias curve {100 * planted.curve_rms_m:.2f} cm, "
            f"whole correction {100 * planted.correction_rms_m:.2f} cm rms"
        )


def _cells(group: ErrorStatistics) -> list[str]:
    cells = [str(group.raw.n)]
    for stage in CORRECTION_STAGES:
        stats = getattr(group, stage)
        figures = (stats.mean_m, stats.std_m, stats.robust_std_m)
        cells += [f"{100 * figure:.1f}" for figure in figures]
    return [*cells, f"{100 * group.rejected:.1f}", _known(group.total_std, "{:.2f}"), _known(100 * group.inside_95)]


def _known(value: float, form: str = "{:.1f}") -> str:
    return form.format(value) if value == value else "-"
