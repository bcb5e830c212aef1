"""Figures of the protocol workbench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwblink.arrays import Floats
from uwbsim.protocols.comparison import ErrorCurve
from uwbsim.protocols.reply_delay import Optimum

# Okabe and Ito's palette, which colour-blind readers can tell apart.
PALETTE: Final = ("#D55E00", "#E69F00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9")
WIDE: Final = (9.0, 3.6)


def colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour for each protocol."""
    return {name: PALETTE[k % len(PALETTE)] for k, name in enumerate(names)}


def histograms(samples: Mapping[str, Floats]) -> Figure:
    """Errors of raw ranges, one outline a protocol; the outermost bins hold everything beyond them."""
    figure = Figure(figsize=WIDE, layout="constrained")
    axes = figure.subplots()
    best = min((np.quantile(e, (0.005, 0.995)) for e in samples.values()), key=np.ptp)
    margin = 0.25 * np.ptp(best) + 1e-4
    edges = 100 * np.linspace(best[0] - margin, best[1] + margin, 81)
    for name, colour in colours(list(samples)).items():
        inside = np.clip(100 * samples[name], edges[0] + 1e-9, edges[-1] - 1e-9)
        weights = np.full(len(inside), 100 / len(inside))
        axes.hist(inside, edges.tolist(), weights=weights, histtype="step", lw=1.6, color=colour, label=name)
    _label(axes, "range error (cm)", "% of ranges")
    axes.legend(frameon=False)
    return figure


def error_over(curves: Mapping[str, ErrorCurve], x: str, *, logarithmic: bool = False) -> Figure:
    """Bias and standard deviation over something: simulated as points, predicted as lines."""
    figure = Figure(figsize=WIDE, layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, colour in colours(list(curves)).items():
        c = curves[name]
        left.plot(c.x, 100 * c.predicted_bias_m, color=colour, lw=1.3)
        left.plot(c.x, 100 * c.bias_m, "o", ms=3.5, color=colour, label=name)
        right.plot(c.x, 100 * c.predicted_std_m, color=colour, lw=1.3)
        right.plot(c.x, 100 * c.std_m, "o", ms=3.5, color=colour, label=name)
    _label(left, x, "bias (cm)")
    _label(right, x, "standard deviation (cm)")
    left.set_yscale("symlog", linthresh=1.0)
    if max(float(c.std_m.max()) for c in curves.values()) > 10 * min(float(c.std_m.min()) for c in curves.values()):
        right.set_yscale("log")
    else:
        right.set_ylim(bottom=0)
    if logarithmic:
        for axes in (left, right):
            _microseconds(axes)
    left.legend(frameon=False, fontsize="small")
    return figure


def optimum_curve(found: Optimum) -> Figure:
    """Root mean squared error of one range, and of the mean of a second full of them, over the delay."""
    figure = Figure(figsize=WIDE, layout="constrained")
    left, right = figure.subplots(1, 2)
    delays = 1e6 * found.delays_s
    left.plot(delays, 100 * np.sqrt(found.range_m2), color=PALETTE[2])
    right.plot(delays, 1000 * np.sqrt(found.second_m2), color=PALETTE[2])
    for axes, y in ((left, 100 * found.rms_m), (right, 1000 * found.second_rms_m)):
        axes.plot([1e6 * found.delay_s], [y], "o", color=PALETTE[0])
        axes.annotate(f"{1e6 * found.delay_s:.0f} us", (1e6 * found.delay_s, y), (6, 8), textcoords="offset points")
        _microseconds(axes)
    _label(left, "delay of the scheduled message (us)", "error of one range (cm)")
    _label(right, "delay of the scheduled message (us)", "error of the mean of one second (mm)")
    return figure


def _microseconds(axes: Axes) -> None:
    """Make the horizontal axis logarithmic, from 300 us to 6 ms, with plain numbers."""
    axes.set_xscale("log")
    ticks = [300, 600, 1000, 2000, 4000]
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.set_xticks([], minor=True)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
