"""The section of a report on localization."""

from __future__ import annotations

from functools import partial
from typing import Final

from calib.evaluation.localization import FILTERS, PAPER_RMSE_M, Localization, Summary, summarize
from calib.report.blocks import Block, Heading, Picture, Table, Text

MOST_TRACKS: Final = 3
"""Bodies whose paths are drawn; the table holds all."""

ABOVE: Final = [("", 1), ("RMSE (m)", 3), ("change", 2)]


def localization(found: list[Localization]) -> list[Block]:
    """Return the table of the paper beside the paper's own, and figures."""
    from calib.report import figures_tracks

    if not found:
        return []
    total = summarize(found)
    rows = [
        [f"{one.source} {one.body}", *(f"{one.tracks[s].rmse_m:.3f}" for s in FILTERS), *_reductions(one)]
        for one in found
    ]
    less = [f"{-100 * total.reduction[s]:+.0f} %" for s in FILTERS[1:]]
    rows.append(["mean", *(f"{total.rmse_m[s]:.3f}" for s in FILTERS), *less])
    rows.append(["ICRA 2023, Table II, its flights", *(f"{PAPER_RMSE_M[s]:.3f}" for s in FILTERS), "-38 %", "-46 %"])
    blocks: list[Block] = [
        Heading("Localization"),
        Table(["body", "raw", "calibrated", "with variance", "calibrated", "with variance"], rows, ABOVE),
        Text(
            "One body at a time is tracked by an EKF from its ranges to the others, whose positions are known; "
            "velocity and attitude are inputs. With the calibrated variance the mean NIS is "
            f"{total.nis:.2f} (1 expected, 95 % bounds {total.nis_bounds[0]:.2f} to {total.nis_bounds[1]:.2f}, "
            f"{100 * total.nis_inside:.0f} % of the values within their own), the mean NEES {total.nees:.2f} (3 "
            f"expected, {total.nees_bounds[0]:.2f} to {total.nees_bounds[1]:.2f}, {100 * total.nees_inside:.0f} %); "
            f"{100 * total.accepted:.1f} % of the ranges pass the gate. {_verdict(total)}",
            "note",
        ),
        Picture("rmse", partial(figures_tracks.rmse_bars, found), "RMSE of the position in every scenario."),
    ]
    for one in found[:MOST_TRACKS]:
        name = "".join(c if c.isalnum() else "-" for c in f"{one.source.removesuffix('.uwb')}-{one.body}")
        blocks += [
            Picture(
                f"track-error-{name}",
                partial(figures_tracks.error_over_time, one),
                f"{one.source}, {one.body}: position error over time.",
            ),
            Picture(
                f"track-{name}",
                partial(figures_tracks.trajectories, one),
                f"{one.source}, {one.body}: paths from above, and height over time.",
            ),
        ]
    return blocks


def _verdict(total: Summary) -> str:
    """Say what it means where NIS or NEES lie."""
    above = total.nis > total.nis_bounds[1] or total.nees > total.nees_bounds[1]
    below = total.nis < total.nis_bounds[0] or total.nees < total.nees_bounds[0]
    if above:
        return "Above their bounds: the filter is surer than it should be, as with reflections, which sigma leaves out."
    if below:
        return "Below their bounds: the filter is less sure than it could be, as where a gate refuses the tail."
    return "Both lie within: the filter knows how good it is."


def _reductions(one: Localization) -> list[str]:
    raw = one.tracks["raw"].rmse_m
    return [f"{100 * (one.tracks[stage].rmse_m / raw - 1):+.0f} %" for stage in FILTERS[1:]]
