"""The figures of a calibration, drawn into axes: errors and their distribution, curves over power, delays.

Each takes matplotlib axes, or makes new ones where there are none, and returns them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes as Axes
from matplotlib.figure import Figure

from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.evaluation.statistics import CORRECTION_STAGES, beside_planted, planted_curve
from calib.over_power import Binned, OverPower, biases, sigmas
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats
from uwblink.pages.colours import BLUE, GREEN, INK, MUTED, PALE, VERMILION, WINE
from uwblink.pages.figures import label, legend, mark, sheet
from uwblink.ticks import SPEED_OF_LIGHT

COLOURS: Final = {"raw": VERMILION, "delays": WINE, "full": BLUE, "planted": GREEN}
DASHES: Final = {"raw": (0, (1.5, 1.2)), "delays": (0, (5, 1.5)), "full": "-"}
LABELS: Final = {"raw": "raw", "delays": "delays corrected", "full": "fully corrected"}
HISTOGRAM_BINS: Final = 40
WIDE: Final = (7.16, 3.2)
STRAY: Final = 12.0
"""Values further from the median than so many median deviations do not decide how far an axis runs."""


def histogram(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Range errors in the three stages, in cm; the outermost bins hold everything beyond them."""
    axes = axes or new_axes()
    errors = _errors_cm(ranges, applied)
    low, high = _reach(errors)
    edges = np.linspace(low, high, HISTOGRAM_BINS + 1)
    for stage, error in errors.items():
        inside = np.clip(error, low, np.nextafter(high, low))
        share = np.histogram(inside, edges)[0] * (100 / len(error))
        mark(axes.stairs(share, edges, lw=1.3, color=COLOURS[stage], ls=DASHES[stage], label=LABELS[stage]), stage)
    _outermost(axes, low, high)
    label(axes, "range error (cm)", "ranges (%)")
    return _explained(axes)


def cumulative(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Share of ranges whose error is smaller than so much, in the three stages."""
    axes = axes or new_axes()
    errors = {stage: np.sort(np.abs(error)) for stage, error in _errors_cm(ranges, applied).items()}
    shares = np.concatenate([np.linspace(0, 0.98, 150), np.linspace(0.981, 1, 20)])
    for stage, error in errors.items():
        (line,) = axes.plot(
            np.quantile(error, shares), 100 * shares, color=COLOURS[stage], ls=DASHES[stage], label=LABELS[stage]
        )
        mark(line, LABELS[stage])
    for share in (50, 95):
        axes.axhline(share, color=PALE, lw=0.6, zorder=0)
    full, raw = (float(np.quantile(errors[stage], 0.99)) for stage in ("full", "raw"))
    axes.set_xlim(0, max(full, min(raw, 4 * full), 1e-9))
    axes.set_ylim(0, 100)
    axes.set_yticks([0, 25, 50, 75, 95])
    label(axes, "size of the range error (cm)", "ranges with less (%)")
    return _explained(axes)


def bias_over_power(
    ranges: Ranges,
    applied: CorrectedRanges,
    calibration: Calibration,
    axes: Axes | None = None,
    *,
    found: OverPower | None = None,
) -> Axes:
    """Centre of the delay-corrected errors' core over lifted power: every pair, all, fitted, planted; and medians.

    What is `found` by `biases` already need not be found again.
    """
    axes = axes or new_axes()
    everything = _over_power(axes, found or biases(ranges, applied, calibration), calibration.loss, "centre_m")
    if calibration.loss != "l2":
        axes.plot(
            everything.lifted, 100 * everything.median_m, "_", color=MUTED, ms=6, label="medians, reflections included"
        )
    _curve(axes, calibration, "bias")
    grid = np.linspace(*calibration.bias_curve.range, 300)
    planted = planted_curve(ranges, "bias_curve", grid)
    if planted is not None:
        beside = beside_planted(ranges, applied, calibration)
        shift = beside.shift_ns * 1e-9 * SPEED_OF_LIGHT if beside else 0.0
        axes.plot(grid, 100 * (planted + shift), ls=DASHES["delays"], color=GREEN, label="planted, same gauge")
    _power_axes(axes, calibration, "bias (cm)")
    return _explained(axes)


def sigma_over_power(
    ranges: Ranges,
    applied: CorrectedRanges,
    calibration: Calibration,
    axes: Axes | None = None,
    *,
    found: OverPower | None = None,
) -> Axes:
    """Standard deviation of the calibrated errors' core over lifted power, likewise; `found` by `sigmas`."""
    axes = axes or new_axes()
    _over_power(axes, found or sigmas(ranges, applied, calibration), calibration.loss, "std_m")
    _curve(axes, calibration, "sigma")
    grid = np.linspace(*calibration.sigma_curve.range, 300)
    planted = planted_curve(ranges, "sigma_curve", grid)
    if planted is not None:
        axes.plot(grid, 100 * planted, ls=DASHES["delays"], color=GREEN, label="planted")
    axes.set_ylim(bottom=0)
    _power_axes(axes, calibration, "standard deviation (cm)")
    return _explained(axes)


def _over_power(axes: Axes, found: OverPower, loss: str, what: str) -> Binned:
    shown: list[Floats] = []
    for name, own in found.pairs.items():
        shown.append(100 * getattr(own, what))
        (line,) = axes.plot(own.lifted, shown[-1], color=PALE, lw=0.8, label="" if len(shown) > 1 else "each pair")
        mark(line, f"pair {name}")
    everything = found.everything
    name = "mean of all pairs" if loss == "l2" else "core of all pairs"
    axes.plot(everything.lifted, 100 * getattr(everything, what), "o", color=INK, ms=3, label=name, zorder=4)
    keep_strays_out(axes, np.concatenate([*shown, 100 * getattr(everything, what)]))
    return everything


def _curve(axes: Axes, calibration: Calibration, which: Literal["bias", "sigma"]) -> None:
    curve = calibration.bias_curve if which == "bias" else calibration.sigma_curve
    grid = np.linspace(*curve.range, 300)
    middle, std_m = 100 * curve(grid), calibration.band(grid, which)
    if std_m is not None:
        half = 100 * TWO_SIDED_95 * std_m
        axes.fill_between(grid, middle - half, middle + half, color=BLUE, alpha=0.3, lw=0, label="95 % band")
    axes.plot(grid, middle, color=BLUE, lw=1.6, label="fitted", zorder=3)


def _power_axes(axes: Axes, calibration: Calibration, y: str) -> None:
    """Name the axes, and put first-path powers in dBm above: the same axis in the radio's unit."""
    alpha = calibration.alpha_dbm
    label(axes, f"lifted power ψ = 10^((p − α) / 10 dB), α = {alpha:g} dBm".replace("-", "−"), y)
    low, high = axes.get_xlim()
    top = axes.secondary_xaxis("top")
    kept: list[float] = []
    # A label takes 0.4 inch.
    apart = (high - low) * 0.4 / max(1.0, axes.figure.get_figure(root=True).get_figwidth() - 0.6)
    for power in np.arange(np.floor(alpha + 40), alpha - 40, -1.0):
        place = 10 ** ((power - alpha) / 10)
        if max(low, 1e-4) <= place <= high and (not kept or abs(kept[-1] - place) > apart):
            kept.append(float(place))
    top.set_xticks(kept, [f"{10 * np.log10(place) + alpha:.0f}".replace("-", "−") for place in kept])
    top.set_xlabel("first-path power p (dBm)")
    top.spines["top"].set_color(MUTED)


def delays(
    calibration: Calibration,
    planted_ns: Mapping[int, float] | None = None,
    shift_ns: float = 0.0,
    axes: Axes | None = None,
) -> Axes:
    """Delays in ns with 95 % intervals; planted ones, if known, beside them, moved by the common shift.

    What lies far from all the others is at the edge, with its value.
    """
    axes = axes or new_axes()
    tags = sorted(calibration.delays_ns)
    place = np.arange(len(tags), dtype=np.float64)
    values = np.array([calibration.delays_ns[tag] for tag in tags])
    std = np.array([calibration.delays_std_ns.get(tag, np.nan) for tag in tags])
    bars = np.where(np.isfinite(std), TWO_SIDED_95 * std, 0.0)
    inside = within_fence(values)
    beside = 0.12 if planted_ns else 0.0
    axes.errorbar(
        (place - beside)[inside],
        values[inside],
        bars[inside],
        fmt="o",
        ms=3.5,
        capsize=2.5,
        color=BLUE,
        label="fitted, 95 % interval",
    )
    low, high = float(values[inside].min()), float(values[inside].max())
    if planted_ns:
        known = np.array([planted_ns.get(tag, np.nan) + shift_ns for tag in tags])
        axes.plot(place + beside, known, "x", ms=5, mew=1.4, color=GREEN, label="planted, same gauge")
        near = known[inside & np.isfinite(known)]
        low, high = min([low, *near]), max([high, *near])
    bar = min(float(bars[inside].max()), 4 * float(np.median(bars[inside])))
    margin = 0.08 * (high - low) + bar + 1e-6
    axes.set_ylim(low - margin, high + 2.2 * margin if not inside.all() else high + margin)
    for k in np.flatnonzero(~inside):
        axes.annotate(
            f"{values[k]:+.1f} ns",
            (place[k], 0.97),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="top",
            color=BLUE,
        )
    axes.axhline(0, color=PALE, lw=0.7, zorder=0)
    every = max(1, len(tags) // 24 + 1)
    axes.set_xticks(place[::every], [str(tag) for tag in tags[::every]])
    axes.margins(x=0.06)
    label(axes, "tag", "antenna delay (ns)")
    return _explained(axes)


def within_fence(values: Floats) -> Any:
    """Return which values (n,) may decide how far an axis runs: all but those far from the others."""
    away = np.abs(values - np.median(values))
    usual = float(np.median(away))
    return away <= (STRAY * usual if usual > 0 else np.inf)


def keep_strays_out(axes: Axes, values: Floats) -> None:
    """Let the vertical axis run over values (n,) but strays."""
    inside = values[within_fence(values)]
    low, high = float(inside.min()), float(inside.max())
    margin = 0.12 * (high - low) + 1e-9
    axes.set_ylim(low - margin, high + margin)


def _errors_cm(ranges: Ranges, applied: CorrectedRanges) -> dict[str, Floats]:
    return {stage: 100 * (getattr(applied, name) - ranges.truth_m) for stage, name in CORRECTION_STAGES.items()}


def _reach(errors: Mapping[str, Floats]) -> tuple[float, float]:
    """Return from where to where a histogram runs: over 98 % of the corrected, and the raw where they are near."""
    low, high = np.quantile(errors["full"], (0.01, 0.99))
    raw = np.quantile(errors["raw"], (0.02, 0.98))
    if raw[1] - raw[0] + abs(float(np.mean(raw)) - float(low + high) / 2) < 5 * (high - low):
        low, high = min(low, raw[0]), max(high, raw[1])
    margin = 0.05 * float(high - low) + 0.1
    return float(low) - margin, float(high) + margin


def _outermost(axes: Axes, low: float, high: float) -> None:
    """Say at its ends that the axis holds everything beyond."""
    inner = [t for t in axes.get_xticks() if low + 0.12 * (high - low) < t < high - 0.12 * (high - low)]
    names = [f"≤ {low:.0f}", *(f"{t:.0f}" for t in inner), f"≥ {high:.0f}"]
    axes.set_xticks([low, *inner, high], [name.replace("-", "−") for name in names])
    axes.set_xlim(low, high)


def _explained(axes: Axes) -> Axes:
    """Explain the lines: above the axes where they have a figure of their own, else inside."""
    figure = axes.figure
    if isinstance(figure, Figure) and len(figure.axes) == 1 and figure.get_layout_engine() is not None:
        legend(figure, axes)
    else:
        axes.legend(frameon=False)
    return axes


def new_axes() -> Axes:
    """Return the axes of a new figure, which pyplot shows and closes."""
    from matplotlib import pyplot

    return pyplot.subplots(figsize=WIDE, layout="constrained")[1]


def alone(draw: Callable[[Axes], Axes], width_in: float) -> Figure:
    """Return a figure of its own, of a width in inches, with what is drawn into its axes."""
    figure, (axes,) = sheet(width_in, height_in=3.1)
    draw(axes)
    return figure
