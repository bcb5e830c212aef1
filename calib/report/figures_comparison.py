"""Figures of two calibrations side by side, and of bodies localized by what is on board."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from matplotlib.figure import Figure

from calib.calibration.comparison import Comparison
from calib.calibration.model import Calibration
from calib.evaluation.onboard_track import OnboardTrack
from calib.figures import keep_strays_out
from calib.spread import TWO_SIDED_95
from uwblink.pages.colours import BLUE, INK, MUTED, VERMILION
from uwblink.pages.figures import label, legend, mark, sheet

OF_TWO: Final = ((VERMILION, "s", (0, (5, 1.5))), (BLUE, "o", "-"))
SAMPLES: Final = 700


def differences(width_in: float, found: Comparison) -> Figure:
    """How far each delay differs, second less first, with 95 % intervals, the common shift taken out."""
    figure, (axes,) = sheet(width_in, height_in=2.6)
    tags = sorted(found.difference_ns)
    place, values = np.arange(len(tags)), 1e3 * np.array([found.difference_ns[tag] for tag in tags])
    half = 1e3 * TWO_SIDED_95 * np.nan_to_num([found.std_ns[tag] for tag in tags])
    axes.errorbar(place, values, half, fmt="o", ms=3.5, capsize=2.5, color=BLUE, label="difference, 95 % interval")
    axes.axhline(0, color=MUTED, lw=0.7)
    keep_strays_out(axes, np.concatenate([values - half, values + half, [0.0]]))
    axes.set_xticks(place, [str(tag) for tag in tags])
    label(axes, "tag", "difference of the delay (ps)")
    legend(figure)
    return figure


def both_curves(width_in: float, known: Sequence[Calibration], names: Sequence[str]) -> Figure:
    """Bias curves of two calibrations about their own means, and sigma curves, over lifted power."""
    figure, panels = sheet(width_in, 2)
    kinds: tuple[Literal["bias", "sigma"], ...] = ("bias", "sigma")
    for which, axes in zip(kinds, panels, strict=True):
        for one, name, (colour, _, dashes) in zip(known, names, OF_TWO, strict=True):
            curve = one.bias_curve if which == "bias" else one.sigma_curve
            grid = np.linspace(*curve.range, 200)
            values, std_m = 100 * curve(grid), one.band(grid, which)
            values -= values.mean() if which == "bias" else 0.0
            if std_m is not None:
                half = 100 * TWO_SIDED_95 * std_m
                axes.fill_between(grid, values - half, values + half, color=colour, alpha=0.2, lw=0)
            mark(axes.plot(grid, values, color=colour, ls=dashes, label=name)[0], name)
    label(panels[0], "lifted power", "bias, mean taken out (cm)")
    label(panels[1], "lifted power", "standard deviation (cm)")
    panels[1].set_ylim(bottom=0)
    legend(figure, panels[0])
    return figure


def onboard(width_in: float, one: OnboardTrack) -> Figure:
    """The path from above and the height over time, beside the truth where poses say it."""
    figure, (path, height) = sheet(width_in, 2, height_in=2.8)
    every = slice(None, None, max(1, len(one.time_ns) // SAMPLES))
    time = (one.time_ns - one.time_ns[0])[every] * 1e-9
    for place, colour, dashes, name in (
        (one.truth_m, INK, "-", "true"),
        (one.estimate_m, BLUE, OF_TWO[0][2], one.used),
    ):
        if np.isfinite(place).any():
            mark(path.plot(place[every, 0], place[every, 1], color=colour, ls=dashes, lw=1, label=name)[0], name)
            height.plot(time, place[every, 2], color=colour, ls=dashes, lw=1)
    path.set_aspect("equal", adjustable="datalim")
    label(path, "east (m)", "north (m)")
    label(height, "time (s)", "up (m)")
    legend(figure, path)
    return figure
