"""Figures of the protocol workbench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwblink.arrays import Floats
from uwblink.pages.colours import BLUE, VERMILION, Look, look
from uwblink.pages.figures import label, legend, mark, sheet
from uwbsim.protocols.comparison import ErrorCurve, Optimum

LINEAR_CM: Final = 1.0
"""Biases below are drawn to scale, larger ones by their logarithm."""


def looks(names: Sequence[str]) -> dict[str, Look]:
    """Return how each protocol is drawn: by colour, marker and dashes."""
    return {name: look(k) for k, name in enumerate(names)}


def histograms(width_in: float, samples: Mapping[str, Floats]) -> Figure:
    """Errors of raw ranges, one outline a protocol; the outermost bins hold everything beyond them."""
    figure, (axes,) = sheet(width_in, height_in=2.9)
    best = min((np.quantile(e, (0.005, 0.995)) for e in samples.values()), key=np.ptp)
    margin = 0.25 * np.ptp(best) + 1e-4
    edges = 100 * np.linspace(best[0] - margin, best[1] + margin, 81)
    for name, own in looks(list(samples)).items():
        inside = np.clip(100 * samples[name], edges[0] + 1e-9, edges[-1] - 1e-9)
        share = 100 * np.histogram(inside, edges)[0] / len(inside)
        mark(axes.stairs(share, edges, lw=1.2, color=own.colour, ls=own.dashes, label=name), name)
    ticks = [t for t in axes.get_xticks() if edges[8] < t < edges[-9]]
    names = [f"≤ {edges[0]:.0f}", *(f"{t:.0f}" for t in ticks), f"≥ {edges[-1]:.0f}"]
    axes.set_xticks([edges[0], *ticks, edges[-1]], [text.replace("-", "−") for text in names])
    axes.set_xlim(edges[0], edges[-1])
    label(axes, "range error (cm)", "ranges (%)")
    legend(figure)
    return figure


def error_over(width_in: float, curves: Mapping[str, ErrorCurve], x: str, *, logarithmic: bool = False) -> Figure:
    """Bias and standard deviation over something: simulated as points, predicted as lines."""
    figure, (left, right) = sheet(width_in, 2)
    for name, own in looks(list(curves)).items():
        c = curves[name]
        line: dict[str, Any] = {"color": own.colour, "ls": own.dashes, "lw": 1.1}
        dots: dict[str, Any] = {"color": own.colour, "ls": "", "marker": own.marker, "ms": 3}
        left.plot(c.x, 100 * c.predicted_bias_m, **line)
        left.plot(c.x, 100 * c.bias_m, **dots)
        right.plot(c.x, 100 * c.predicted_std_m, **line)
        mark(right.plot(c.x, 100 * c.std_m, **dots)[0], name)
        left.plot([], [], **(line | dots | {"ls": own.dashes}), label=name)
    biases = np.concatenate([100 * np.concatenate([c.bias_m, c.predicted_bias_m]) for c in curves.values()])
    wide = float(np.abs(biases).max()) > 20 * LINEAR_CM
    label(left, x, "bias (cm), log axis" if wide else "bias (cm)")
    label(right, x, "standard deviation (cm)")
    if wide:
        _signed_decades(left, float(np.abs(biases).max()))
    spreads = [float(v) for c in curves.values() for v in c.std_m]
    if max(spreads) > 10 * min(spreads):
        right.set_yscale("log")
        _plain_decades(right, min(spreads) * 100, max(spreads) * 100)
        right.set_ylabel("standard deviation (cm), log axis")
    else:
        right.set_ylim(bottom=0)
    for axes in (left, right):
        if logarithmic:
            _microseconds(axes)
        else:
            axes.locator_params(axis="x", nbins=6)  # nine of powers cover each other
    legend(figure, left)
    return figure


def _signed_decades(axes: Axes, most: float) -> None:
    """Draw biases of either sign over decades, with plain numbers."""
    axes.set_yscale("symlog", linthresh=LINEAR_CM)
    ticks = [10.0**k for k in range(int(np.ceil(np.log10(most))) + 1)]
    low, high = axes.get_ylim()
    kept = [t for t in [*(-t for t in ticks), 0.0, *ticks] if low <= t <= high]
    if len(kept) < 4:
        finer = [m * t for t in ticks for m in (1, 2, 5)]
        kept = [t for t in [*(-t for t in finer), 0.0, *finer] if low <= t <= high]
    axes.set_yticks(kept, [f"{t:g}".replace("-", "−") for t in kept])
    axes.set_yticks([], minor=True)


def _plain_decades(axes: Axes, least: float, most: float) -> None:
    ticks = [m * 10.0**k for k in range(-2, 6) for m in (1, 2, 5) if 0.8 * least <= m * 10.0**k <= 1.25 * most]
    kept = ticks if len(ticks) < 8 else ticks[::3]
    axes.set_yticks(kept, [f"{t:g}" for t in kept])
    axes.set_yticks([], minor=True)


def optimum_curve(width_in: float, found: Optimum) -> Figure:
    """Root mean squared error of one range, and of the mean of a second full of them, over the delay."""
    figure, (left, right) = sheet(width_in, 2)
    delays = 1e6 * found.delays_s
    left.plot(delays, 100 * np.sqrt(found.range_m2), color=BLUE)
    right.plot(delays, 1000 * np.sqrt(found.second_m2), color=BLUE)
    for axes, y in ((left, 100 * found.rms_m), (right, 1000 * found.second_rms_m)):
        axes.plot([1e6 * found.delay_s], [y], "o", color=VERMILION)
        axes.annotate(f"{1e6 * found.delay_s:.0f} µs", (1e6 * found.delay_s, y), (6, 8), textcoords="offset points")
        _microseconds(axes)
    label(left, "delay of the scheduled message (µs)", "error of one range (cm)")
    label(right, "delay of the scheduled message (µs)", "error of the mean of one second (mm)")
    return figure


def _microseconds(axes: Axes) -> None:
    """Make the horizontal axis logarithmic, from 300 us to 6 ms, with plain numbers."""
    axes.set_xscale("log")
    ticks = [300, 600, 1000, 2000, 4000]
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.set_xticks([], minor=True)
