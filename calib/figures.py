"""Figures of a calibration: errors and their distribution, curves over power, delays, and residuals.

Functions that take Matplotlib axes draw into them, or into new ones, and return them. Functions that take a width in
inches return a figure of that width (`uwblink.pages.figures`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes as Axes
from matplotlib.figure import Figure

from calib.calibration.comparison import Comparison
from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.estimator.grouped_errors import fit_grouped_errors
from calib.evaluation.statistics import CORRECTION_STAGES, compare_with_planted, pair_rows, planted_curve
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats, Ints
from uwblink.pages.colours import BLUE, GREEN, INK, MUTED, PALE, VERMILION, WINE, look
from uwblink.pages.figures import NARROW_IN, WIDTHS, label, legend, mark, outlines, sheet
from uwblink.ticks import SPEED_OF_LIGHT

STAGE_LINES: Final[dict[str, dict[str, Any]]] = {
    "raw": {"color": VERMILION, "ls": (0, (1.5, 1.2)), "label": "raw"},
    "delays": {"color": WINE, "ls": (0, (5, 1.5)), "label": "delays corrected"},
    "full": {"color": BLUE, "ls": "-", "label": "fully corrected"},
}
"""Line style of each stage of correction."""

PLANTED: Final[dict[str, Any]] = {"color": GREEN, "ls": (0, (5, 1.5))}
"""Line style of a planted curve."""

MIN_RANGES_PER_BIN: Final = 60
"""With so many ranges, a tenth of them reflected, the error model is known to 15 %; with fewer the median is drawn."""

MOST_RANGES_PER_BIN: Final = 2000
"""With so many ranges the standard error of the centre is a fortieth of the noise, less than a drawn point."""

MOST_PAIRS: Final = 24
"""Pairs whose errors are drawn over time, those with the largest spread."""


@dataclass(frozen=True, slots=True)
class Binned:
    """Errors by lifted power: median power, centre, standard deviation and median of each bin (bins,), metres.

    Centre and deviation are those of direct ranges if the curve was fitted to these, else those of all ranges.
    """

    lifted: Floats
    centre_m: Floats
    std_m: Floats
    median_m: Floats


def over_power(
    ranges: Ranges, applied: CorrectedRanges, calibration: Calibration, which: Literal["bias", "sigma"]
) -> dict[str, Binned]:
    """Return errors by lifted power, of each pair by name in 6 bins, and of "all" in 20.

    They are the delay-corrected errors for the "bias" curve, and the fully corrected ones for "sigma".
    """
    lifted = applied.lifted
    error_m = (applied.delay_corrected_m if which == "bias" else applied.corrected_m) - ranges.truth_m
    sets = {name: (lifted[rows], error_m[rows], 6) for name, rows in pair_rows(ranges).items()}
    return binned({**sets, "all": (lifted, error_m, 20)}, calibration.loss)


def binned(sets: Mapping[str, tuple[Floats, Floats, int]], loss: str) -> dict[str, Binned]:
    """Return sets of (lifted powers (n,), errors (n,), number of bins) in bins of equal counts, as a fit weighs them.

    The curve of a fit follows the errors of direct ranges; reflections only lengthen, so medians and means lie above
    it. Least squares ("l2") follow the mean.
    """
    groups = {
        name: np.array_split(np.argsort(x), max(1, min(bins, len(x) // MIN_RANGES_PER_BIN)))
        for name, (x, _, bins) in sets.items()
    }
    errors = [sets[name][1][rows] for name, some in groups.items() for rows in some]
    centres = np.array([(np.mean(e) if loss == "l2" else np.median(e), np.std(e)) for e in errors])
    told = [k for k, e in enumerate(errors) if len(e) >= MIN_RANGES_PER_BIN and float(np.ptp(e)) >= 1e-9]
    if loss != "l2" and told:
        core = fit_grouped_errors([errors[k] for k in told], MOST_RANGES_PER_BIN)
        centres[told] = np.column_stack([core.centre_m, core.sigma_m])
    found, first = {}, 0
    for name, some in groups.items():
        x, error_m, _ = sets[name]
        own = centres[first : first + len(some)]
        first += len(some)
        medians = [(np.median(x[rows]), np.median(error_m[rows])) for rows in some]
        powers, middles = np.array(medians).T
        found[name] = Binned(powers, own[:, 0], own[:, 1], middles)
    return found


def histogram(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Draw range errors in the three stages, in cm; the outermost bins hold everything beyond them."""
    axes = axes or new_axes()
    errors = _errors_cm(ranges, applied)
    # Limits: 98 % of the corrected errors, and of the raw ones if they are close.
    low, high = np.quantile(errors["full"], (0.01, 0.99))
    raw = np.quantile(errors["raw"], (0.02, 0.98))
    if raw[1] - raw[0] + abs(float(np.mean(raw)) - float(low + high) / 2) < 5 * (high - low):
        low, high = min(low, raw[0]), max(high, raw[1])
    margin = 0.05 * float(high - low) + 0.1
    low, high = float(low) - margin, float(high) + margin
    lines = {stage: {"lw": 1.3, **line} for stage, line in STAGE_LINES.items()}
    outlines(axes, errors, np.linspace(low, high, 41), lines)
    label(axes, "range error (cm)", "ranges (%)")
    return _explained(axes)


def cumulative(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Draw the share of ranges whose error is smaller than a size, in the three stages."""
    axes = axes or new_axes()
    errors = {stage: np.sort(np.abs(error)) for stage, error in _errors_cm(ranges, applied).items()}
    shares = np.concatenate([np.linspace(0, 0.98, 150), np.linspace(0.981, 1, 20)])
    for stage, error in errors.items():
        (line,) = axes.plot(np.quantile(error, shares), 100 * shares, **STAGE_LINES[stage])
        mark(line, STAGE_LINES[stage]["label"])
    for share in (50, 95):
        axes.axhline(share, color=PALE, lw=0.6, zorder=0)
    full, raw = (float(np.quantile(errors[stage], 0.99)) for stage in ("full", "raw"))
    axes.set_xlim(0, max(full, min(raw, 4 * full), 1e-9))
    axes.set_ylim(0, 100)
    axes.set_yticks([0, 25, 50, 75, 95])
    label(axes, "size of the range error (cm)", "ranges with less (%)")
    return _explained(axes)


def curve_over_power(
    ranges: Ranges,
    applied: CorrectedRanges,
    calibration: Calibration,
    which: Literal["bias", "sigma"],
    axes: Axes | None = None,
    found: Mapping[str, Binned] | None = None,
) -> Axes:
    """Draw the "bias" or "sigma" curve over lifted power with its band, the planted curve, and errors of pairs and of
    all ranges.

    Errors are those of `over_power`, or `found` if given; for the bias their medians are drawn as well.
    """
    axes, found = axes or new_axes(), found or over_power(ranges, applied, calibration, which)
    bias, squares = which == "bias", calibration.loss == "l2"
    values = {name: 100 * (own.centre_m if bias else own.std_m) for name, own in found.items()}
    for k, (name, own) in enumerate(found.items()):
        if name != "all":
            line = axes.plot(own.lifted, values[name], color=PALE, lw=0.8, label="" if k else "each pair")[0]
            mark(line, f"pair {name}")
    everything = found["all"]
    text = "mean of all pairs" if squares else "core of all pairs"
    axes.plot(everything.lifted, values["all"], "o", color=INK, ms=3, label=text, zorder=4)
    keep_strays_out(axes, np.concatenate(list(values.values())))
    if bias and not squares:
        medians = 100 * everything.median_m
        axes.plot(everything.lifted, medians, "_", color=MUTED, ms=6, label="medians, reflections included")
    curve = calibration.bias_curve if bias else calibration.sigma_curve
    grid = np.linspace(*curve.range, 300)
    _curve(axes, calibration, which, grid, 100 * curve(grid), color=BLUE, lw=1.6, label="fitted", zorder=3)
    planted = planted_curve(ranges, f"{which}_curve", grid)
    if planted is not None:
        beside = compare_with_planted(ranges, applied, calibration) if bias else None
        planted += 0.0 if beside is None else beside.shift_ns * 1e-9 * SPEED_OF_LIGHT
        axes.plot(grid, 100 * planted, label="planted, same gauge" if bias else "planted", **PLANTED)
    if not bias:
        axes.set_ylim(bottom=0)
    _power_axes(axes, calibration, "bias (cm)" if bias else "standard deviation (cm)")
    return _explained(axes)


def _curve(
    axes: Axes, calibration: Calibration, which: Literal["bias", "sigma"], grid: Floats, values: Floats, **line: Any
) -> None:
    """Draw values of a curve (n,) in cm over lifted powers (n,), with the band of 95 % where there is one."""
    std_m = calibration.band(grid, which)
    if std_m is not None:
        half = 100 * TWO_SIDED_95 * std_m
        axes.fill_between(grid, values - half, values + half, color=line["color"], alpha=0.25, lw=0, label="95 % band")
    mark(axes.plot(grid, values, **line)[0], line["label"])


def _power_axes(axes: Axes, calibration: Calibration, y: str) -> None:
    """Label the axes, with first-path powers in dBm on top."""
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
    """Draw delays in ns with 95 % intervals, and planted delays moved by the common shift.

    A delay far from all others is drawn at the edge, with its value; one without an interval is a circle.
    """
    axes = axes or new_axes()
    tags = sorted(calibration.delays_ns)
    place = np.arange(len(tags), dtype=np.float64)
    values = np.array([calibration.delays_ns[tag] for tag in tags])
    std = np.array([calibration.delays_std_ns.get(tag, np.nan) for tag in tags])
    bars = np.where(np.isfinite(std), TWO_SIDED_95 * std, 0.0)
    inside = within_fence(values)
    beside = 0.12 if planted_ns else 0.0
    bounded, unbounded = inside & (bars > 0), inside & (bars == 0)
    dots: dict[str, Any] = {"fmt": "o", "ms": 3.5, "capsize": 2.5, "color": BLUE, "label": "fitted, 95 % interval"}
    if bounded.any():
        axes.errorbar((place - beside)[bounded], values[bounded], bars[bounded], **dots)
    if unbounded.any():
        name = "without an interval: pinned or undetermined"
        axes.plot((place - beside)[unbounded], values[unbounded], "o", ms=4, mfc="none", mec=BLUE, label=name)
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
        where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "top"}
        axes.annotate(f"{values[k]:+.1f} ns", (place[k], 0.97), color=BLUE, **where)
    axes.axhline(0, color=PALE, lw=0.7, zorder=0)
    every = max(1, len(tags) // 24 + 1)
    axes.set_xticks(place[::every], [str(tag) for tag in tags[::every]])
    axes.margins(x=0.06)
    label(axes, "tag", "antenna delay (ns)")
    return _explained(axes)


def within_fence(values: Floats) -> Any:
    """Return which values (n,) determine the limits of an axis: those within 12 median deviations of the median."""
    away = np.abs(values - np.median(values))
    usual = float(np.median(away))
    return away <= (12.0 * usual if usual > 0 else np.inf)


def keep_strays_out(axes: Axes, values: Floats) -> None:
    """Set the limits of the vertical axis by values (n,) without outliers."""
    inside = values[within_fence(values)]
    low, high = float(inside.min()), float(inside.max())
    margin = 0.12 * (high - low) + 1e-9
    axes.set_ylim(low - margin, high + margin)


def new_axes() -> Axes:
    """Return the axes of a new pyplot figure."""
    from matplotlib import pyplot

    return pyplot.subplots(figsize=(WIDTHS["page"], 3.2), layout="constrained")[1]


def alone(draw: Callable[[Axes], Axes], width_in: float) -> Figure:
    """Return a figure of a width in inches, drawn into its only axes."""
    figure, (axes,) = sheet(width_in, height_in=3.1)
    draw(axes)
    return figure


def _errors_cm(ranges: Ranges, applied: CorrectedRanges) -> dict[str, Floats]:
    return {stage: 100 * (getattr(applied, name) - ranges.truth_m) for stage, name in CORRECTION_STAGES.items()}


def _explained(axes: Axes) -> Axes:
    """Add the legend: above axes that have their own figure, else inside."""
    figure = axes.figure
    if isinstance(figure, Figure) and len(figure.axes) == 1 and figure.get_layout_engine() is not None:
        legend(figure, axes)
    else:
        axes.legend(frameon=False)
    return axes


def distribution(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Draw errors in the three stages: shares by size and sign, and how many are smaller than a size."""
    figure, (left, right) = sheet(width_in, 2)
    for draw, axes in ((histogram, left), (cumulative, right)):
        inside = draw(ranges, applied, axes).get_legend()
        if inside:
            inside.remove()
    legend(figure)
    return figure


def z_scores(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Draw errors over their sigma: a histogram beside the normal density, and quantiles against normal quantiles."""
    z = (applied.corrected_m - ranges.truth_m) / applied.sigma_m
    figure, (left, right) = sheet(width_in, 2)
    edges = np.linspace(-6, 6, 61)
    inside = np.clip(z, edges[0], edges[-1] - 1e-9)
    density = np.histogram(inside, edges)[0] / len(z) / (edges[1] - edges[0])
    left.stairs(density, edges, fill=True, color=BLUE, alpha=0.55, label="ranges")
    grid = np.linspace(-6, 6, 200)
    left.plot(grid, np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), color=INK, lw=1.2, label="standard normal")
    label(left, "error over its σ; all beyond ±6 in the last bins", "density")
    shares = (np.arange(300) + 0.5) / 300
    normal = [NormalDist().inv_cdf(share) for share in shares.tolist()]
    right.plot(normal, np.clip(np.quantile(z, shares), -6, 12), ".", ms=3, color=BLUE)
    right.plot([-3, 3], [-3, 3], color=INK, lw=1.2)
    right.set_ylim(-6, 12)
    label(right, "quantile of the standard normal", "quantile of error over σ")
    legend(figure, left)
    return figure


def residuals(width_in: float, ranges: Ranges, applied: CorrectedRanges, alpha_dbm: float) -> Figure:
    """Draw calibrated errors over distance and over first-path power, with medians and the middle 68 %."""
    figure, panels = sheet(width_in, 2, sharey=True)
    error = 100 * (applied.corrected_m - ranges.truth_m)
    power = 10 * np.log10(np.maximum(applied.lifted, 1e-9)) + alpha_dbm
    over = ((ranges.truth_m, "true distance (m)"), (power, "lifted power, in dBm"))
    for panel, (x, name) in zip(panels, over, strict=True):
        every = slice(None, None, max(len(x) // 3000, 1))  # more points show nothing more
        panel.plot(x[every], error[every], ".", ms=1.2, color=PALE, rasterized=True, zorder=0)
        groups = np.array_split(np.argsort(x), max(1, min(16, len(x) // 40)))
        middle = [float(np.median(x[rows])) for rows in groups]
        low, median, high = np.array([np.quantile(error[rows], (0.16, 0.5, 0.84)) for rows in groups]).T
        panel.fill_between(middle, low, high, color=BLUE, alpha=0.25, lw=0, label="middle 68 %")
        panel.plot(middle, median, "o-", ms=2.8, color=BLUE, label="median")
        panel.axhline(0, color=MUTED, lw=0.7)
        low_x, high_x = np.quantile(x, (0.001, 0.999))
        margin = 0.03 * (high_x - low_x) + 1e-6
        panel.set_xlim(low_x - margin, high_x + margin)
        # Labels like -97.5 are wide: there is room for fewer than by default.
        panel.locator_params(axis="x", nbins=7, steps=[1, 2, 5, 10])
        label(panel, name, "calibrated error (cm)" if panel is panels[0] or width_in < NARROW_IN else "")
    panels[0].set_ylim(*_reach_cm(error))
    legend(figure, panels[0])
    return figure


def over_time(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Draw the calibrated error of each pair over time, with the band in which 95 % should lie."""
    error = 100 * (applied.corrected_m - ranges.truth_m)
    pairs = most_spread(ranges, error)
    time = (ranges.time_ns - ranges.time_ns.min()) * 1e-9
    across = 2 if width_in < NARROW_IN else 4
    figure, panels = sheet(width_in, len(pairs), height_in=1.05, across=across, sharex=True, sharey=True)
    figure.set_figheight(figure.get_figheight() + 0.6)
    for panel, (name, own) in zip(panels, pairs.items(), strict=True):
        order = own[np.argsort(time[own])]
        shown, some = order[:: max(1, len(order) // 800)], order[:: max(1, len(order) // 120)]
        panel.plot(time[shown], error[shown], ".", ms=1.3, color=BLUE, alpha=0.6, rasterized=True)
        for side in (-196, 196):
            panel.plot(time[some], side * applied.sigma_m[some], color=INK, lw=0.6)
        panel.set_title(f"tags {name}", loc="left", pad=2)
        label(panel, "", "")
    panels[0].set_ylim(*_reach_cm(error))
    figure.supxlabel("time (s)", fontsize="medium")
    figure.supylabel("calibrated error (cm)", fontsize="medium")
    return figure


def most_spread(ranges: Ranges, error: Floats) -> dict[str, Ints]:
    """Return the rows of the pairs that are drawn over time: all, or of many those whose errors spread most."""
    pairs = {name: np.flatnonzero(rows) for name, rows in pair_rows(ranges).items()}
    spread = {name: float(np.ptp(np.quantile(error[rows], (0.05, 0.95)))) for name, rows in pairs.items()}
    kept = sorted(pairs, key=lambda name: -spread[name])[:MOST_PAIRS]
    return {name: rows for name, rows in pairs.items() if name in kept}


def _reach_cm(error: Floats) -> tuple[float, float]:
    """Return the limits of errors in cm: all but the outermost hundredth."""
    low, high = np.quantile(error, (0.003, 0.985))
    margin = 0.1 * float(high - low) + 0.1
    return float(low) - margin, float(high) + margin


def scale_sensitivity(width_in: float, scales_ns: list[float], fits: list[Calibration], chosen_ns: float) -> Figure:
    """Draw the change of each delay, less their mean, with the scale of the loss."""
    figure, (axes,) = sheet(width_in, height_in=2.8)
    tags = sorted(fits[0].delays_ns)
    table = np.array([[fit.delays_ns[tag] for tag in tags] for fit in fits])
    table -= table.mean(axis=1, keepdims=True)
    reference = table[int(np.argmin(np.abs(np.log(np.array(scales_ns) / chosen_ns))))]
    moved = 1e3 * (table - reference)
    for k, tag in enumerate(tags):
        (line,) = axes.plot(scales_ns, moved[:, k], label=f"tag {tag}", **look(k).line())
        mark(line, f"tag {tag}")
    keep_strays_out(axes, moved.ravel())
    axes.axvline(chosen_ns, color=MUTED, ls="--", lw=0.8)
    axes.text(chosen_ns, 0.98, " chosen", transform=axes.get_xaxis_transform(), va="top", color=MUTED)
    axes.set_xscale("log")
    kept = scales_ns[::2] if width_in < NARROW_IN else scales_ns
    axes.set_xticks(kept, [f"{scale:.3g}" for scale in kept])
    axes.set_xticks([], minor=True)
    label(axes, "scale of the loss (ns of flight)", "change of the delay (ps)")
    legend(figure)
    return figure


def differences(width_in: float, found: Comparison) -> Figure:
    """Draw the difference of each delay, second less first, with 95 % intervals and without the common shift."""
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
    """Draw bias curves of two calibrations about their own means, and sigma curves, over lifted power."""
    figure, panels = sheet(width_in, 2)
    kinds: tuple[Literal["bias", "sigma"], ...] = ("bias", "sigma")
    lines: tuple[dict[str, Any], ...] = ({"color": VERMILION, "ls": (0, (5, 1.5))}, {"color": BLUE})
    for which, axes in zip(kinds, panels, strict=True):
        for one, name, line in zip(known, names, lines, strict=True):
            curve = one.bias_curve if which == "bias" else one.sigma_curve
            grid = np.linspace(*curve.range, 200)
            values = 100 * curve(grid)
            values -= values.mean() if which == "bias" else 0.0
            _curve(axes, one, which, grid, values, label=name, **line)
    label(panels[0], "lifted power", "bias, mean taken out (cm)")
    label(panels[1], "lifted power", "standard deviation (cm)")
    panels[1].set_ylim(bottom=0)
    legend(figure, panels[0], texts=names)
    return figure
