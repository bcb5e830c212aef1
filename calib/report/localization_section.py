"""The section of a report on localization."""

from __future__ import annotations

from functools import partial
from typing import Final

from calib.evaluation.consistency import Summary, summarize
from calib.evaluation.localization import PAPER_RMSE_M
from calib.evaluation.tracking import Localization, Settings
from calib.report.blocks import Block, Heading, Picture, Table, Text

MOST_TRACKS: Final = 12
"""Bodies whose paths are drawn; the table holds all."""

HEADS: Final = {
    "raw": "raw",
    "calibrated": "calibrated",
    "variance": "with variance",
    "robust": "reckoning with reflections",
}


def localization(found: list[Localization]) -> list[Block]:
    """Return the table of the paper beside the paper's own, and figures."""
    from calib.report import figures_tracks

    if not found:
        return []
    total = summarize(found)
    names = list(total.rmse_m)
    rows = [[f"{one.source} {one.body}", *(f"{one.rmse_m[name].mean():.3f}" for name in names)] for one in found]
    rows.append(["mean", *(f"{total.rmse_m[name]:.3f}" for name in names)])
    rows.append(["its spread over seeds", *(f"{total.spread_m[name]:.3f}" for name in names)])
    rows.append(["against raw", "", *(f"{-100 * less:+.0f} %" for less in total.reduction.values())])
    paper = [f"{PAPER_RMSE_M[name]:.3f}" if name in PAPER_RMSE_M else "" for name in names]
    rows.append(["ICRA 2023, its own flights", *paper])
    blocks: list[Block] = [
        Heading("Localization"),
        Table(["body", *(HEADS[name] for name in names)], rows, [("", 1), ("RMSE (m)", len(names))]),
        Text(told(found), "note"),
        Text(
            "With the calibrated variance the mean NIS is "
            f"{total.nis:.2f} (1 expected, 95 % bounds {total.nis_bounds[0]:.2f} to {total.nis_bounds[1]:.2f}, "
            f"{100 * total.nis_inside:.0f} % of the values within their own), the mean NEES {total.nees:.2f} (3 "
            f"expected, {total.nees_bounds[0]:.2f} to {total.nees_bounds[1]:.2f}, {100 * total.nees_inside:.0f} %); "
            f"{100 * total.accepted:.1f} % of the ranges pass the gate. {_verdict(total)}",
            "note",
        ),
        Picture(
            "rmse", partial(figures_tracks.rmse_bars, found=found), "RMSE of the position of each body, and the mean."
        ),
    ]
    for one in found[:MOST_TRACKS]:
        blocks.append(
            Picture(
                f"track-{file_name(one.source, one.body)}",
                partial(figures_tracks.track, one=one),
                f"{one.source}, {one.body}: path from above, height, and position error over time, with three "
                "sigmas of the filter with variance.",
            )
        )
    if len(found) > MOST_TRACKS:
        blocks.append(Text(f"The first {MOST_TRACKS} of {len(found)} tracks are drawn; the table has all.", "note"))
    return blocks


def file_name(source: str, body: str) -> str:
    """Return what figures of a body in a recording are called."""
    return "".join(c if c.isalnum() else "-" for c in f"{source.removesuffix('.uwb')}-{body}")


def _verdict(total: Summary) -> str:
    """Say what it means where NIS or NEES lie."""
    above = total.nis > total.nis_bounds[1] or total.nees > total.nees_bounds[1]
    below = total.nis < total.nis_bounds[0] or total.nees < total.nees_bounds[0]
    if above:
        return "Above their bounds: the filter is surer than it should be, as with reflections, which sigma leaves out."
    if below:
        return "Below their bounds: the filter is less sure than it could be, as where a gate refuses the tail."
    return "Both lie within: the filter knows how good it is."


def told(found: list[Localization], settings: Settings | None = None) -> str:
    """Say how the filters were set up, and how far the paper's own figures may be compared."""
    chosen, fixed = settings or Settings(), found[0].fixed
    own = "these flights are simulated" if all(one.simulated for one in found) else "these are other flights"
    paper = ", ".join(f"{value:.3f}" for value in PAPER_RMSE_M.values())
    return (
        "One body at a time is tracked by an EKF from its ranges to the others, whose positions are known; velocity "
        f"and attitude are inputs from the poses, velocity with white noise of {chosen.velocity_std_mps:g} m/s an axis "
        f"at {chosen.velocity_rate_hz:g} Hz, as a small drone's optical flow has it. How much a calibration gains "
        "depends on that choice: the better velocity is known, the less ranges decide. Fixed standard deviations, "
        f"{fixed.source}: raw {100 * fixed.std_m['raw']:.0f} cm, calibrated {100 * fixed.std_m['calibrated']:.0f} cm. "
        f"ICRA 2023 has {paper} m (raw, calibrated, with variance) for real flights of its own and another filter's "
        f"noise; {own}, so metres do not compare, and percentages only as far as the filters' noise is alike."
    )
