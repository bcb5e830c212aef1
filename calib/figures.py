"""Figures of a calibration: errors and their distribution, curves over power, delays, and residuals.

Functions with a parameter `axes` draw into these Matplotlib axes, or into new ones, and return them. Functions with a
parameter `width_in` return a new figure of that width in inches (`uwblink.pages.figures`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes as Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike
from scipy.stats import norm

from calib.calibration.applying import CorrectedRanges
from calib.calibration.comparison import CalibrationComparison
from calib.calibration.model import Calibration
from calib.data.ranges import Ranges
from calib.errors import UnanswerableError
from calib.estimator.grouped_errors import fit_grouped_errors
from calib.evaluation.statistics import CORRECTION_STAGES, Evaluation, compare_with_planted, pair_rows, planted_curve
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats, Ints
from uwblink.display import first_few
from uwblink.pages.colours import BLUE, GREEN, GRID, INK, MUTED, PALE, VERMILION, WINE, look
from uwblink.pages.figures import NARROW_IN, WIDTHS, bulk, dots, label, legend, mark, outlines, series, sheet
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
"""Number of ranges from which the error model is fitted in a bin; smaller bins show the median. With 60 ranges, a tenth
of them reflected, the standard errors of its parameters are 15 %."""

MOST_RANGES_PER_BIN: Final = 2000
"""Largest number of ranges of a bin that are fitted: the standard error of the centre is then a fortieth of the noise,
less than the size of a drawn point."""

MOST_PAIRS: Final = 24
"""Largest number of pairs in a figure of pairs."""


@dataclass(frozen=True, slots=True)
class Binned:
    """Errors by lifted power: median power, centre, standard deviation and median of each bin (bins,), metres.

    In bins with enough ranges, centre and standard deviation are those of direct ranges. In smaller bins, the centre is
    the median of all ranges and the standard deviation that of all ranges. With least squares, both are those of all
    ranges in every bin, and the centre is the mean.
    """

    lifted: Floats
    centre_m: Floats
    std_m: Floats
    median_m: Floats


def over_power(
    ranges: Ranges, applied: CorrectedRanges, calibration: Calibration, which: Literal["bias", "sigma"]
) -> dict[str, Binned]:
    """Return errors by lifted power: of each pair, by its name, in 6 bins, and of "all" ranges in 20 bins.

    For the "bias" curve these are errors of delay-corrected ranges; for "sigma", errors of fully corrected ranges.
    """
    error_m = (applied.delay_corrected_m if which == "bias" else applied.corrected_m) - ranges.truth_m
    sets = {name: (np.flatnonzero(rows), 6) for name, rows in pair_rows(ranges).items()}
    return binned(applied.lifted, error_m, sets | {"all": (np.arange(len(error_m)), 20)}, calibration.loss)


def binned(lifted: Floats, error_m: Floats, sets: Mapping[str, tuple[Ints, int]], loss: str) -> dict[str, Binned]:
    """Return errors (n,) by lifted power (n,), for each of the `sets`: rows and a number of bins with equal counts.

    A fitted curve follows the errors of direct ranges. Reflections lengthen ranges, so the median and the mean of all
    errors lie above the curve. With least squares (`loss` "l2") the curve follows the mean.
    """
    groups = {
        name: np.array_split(rows[np.argsort(lifted[rows])], max(1, min(bins, len(rows) // MIN_RANGES_PER_BIN)))
        for name, (rows, bins) in sets.items()
    }
    errors = [error_m[rows] for some in groups.values() for rows in some]
    powers = [np.median(lifted[rows]) for some in groups.values() for rows in some]
    medians = [np.median(e) for e in errors]
    centre_m = np.array([np.mean(e) for e in errors] if loss == "l2" else medians)
    std_m = np.array([np.std(e) for e in errors])
    fitted = [k for k, e in enumerate(errors) if len(e) >= MIN_RANGES_PER_BIN and float(np.ptp(e)) >= 1e-9]
    if loss != "l2" and fitted:
        core = fit_grouped_errors([errors[k] for k in fitted], MOST_RANGES_PER_BIN)
        centre_m[fitted], std_m[fitted] = core.centre_m, core.sigma_m
    ends = np.cumsum([len(some) for some in groups.values()])[:-1]
    parts = zip(*(np.split(column, ends) for column in (powers, centre_m, std_m, medians)), strict=True)
    return {name: Binned(*own) for name, own in zip(groups, parts, strict=True)}


def histogram(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Draw histograms of range errors in the three stages, in cm; the outermost bins include all larger errors."""
    axes = axes or new_axes()
    errors = _errors_cm(ranges, applied)
    low, high = np.quantile(errors["full"], (0.01, 0.99))
    margin = 0.05 * float(high - low) + 0.1
    # Include the raw errors, but at most twice the span of the corrected ones on either side.
    reach, raw = 2 * (high - low), np.quantile(errors["raw"], (0.02, 0.98))
    low, high = max(min(low, raw[0]), low - reach) - margin, min(max(high, raw[1]), high + reach) + margin
    lines = {stage: {"lw": 1.3, **line} for stage, line in STAGE_LINES.items()}
    outlines(axes, errors, np.linspace(low, high, 41), lines)
    label(axes, "range error (cm)", "ranges (%)")
    return _with_legend(axes)


def cumulative(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Draw the distribution functions of absolute range errors in the three stages."""
    axes = axes or new_axes()
    errors = {stage: np.abs(error) for stage, error in _errors_cm(ranges, applied).items()}
    shares = np.concatenate([np.linspace(0, 0.98, 150), np.linspace(0.981, 1, 20)])
    for stage, error in errors.items():
        series(axes, np.quantile(error, shares), 100 * shares, **STAGE_LINES[stage])
    full, raw = (float(np.quantile(errors[stage], 0.99)) for stage in ("full", "raw"))
    axes.set(xlim=(0, max(full, min(raw, 4 * full), 1e-9)), ylim=(0, 100), yticks=[0, 25, 50, 75, 95])
    label(axes, "absolute range error (cm)", "ranges with smaller error (%)")
    return _with_legend(axes)


def curve_over_power(
    ranges: Ranges,
    applied: CorrectedRanges,
    calibration: Calibration,
    which: Literal["bias", "sigma"],
    axes: Axes | None = None,
    found: Mapping[str, Binned] | None = None,
) -> Axes:
    """Draw the "bias" or "sigma" curve over lifted power with its 95 % band, the planted curve, and measured errors.

    The errors of each pair and of all ranges are `found`, or by default those of `over_power`. With the bias, the
    medians of all ranges are drawn, too.
    """
    axes, found = axes or new_axes(), found or over_power(ranges, applied, calibration, which)
    bias, squares = which == "bias", calibration.loss == "l2"
    values = {name: 100 * (own.centre_m if bias else own.std_m) for name, own in found.items()}
    everything = found["all"]
    for name in list(found)[:-1]:
        mark(axes.plot(found[name].lifted, values[name], color=PALE, lw=0.8)[0], f"pair {name}")
    axes.plot([], [], color=PALE, lw=0.8, label="each pair")
    text = "mean of all pairs" if squares else "core of all pairs"
    axes.plot(everything.lifted, values["all"], "o", color=INK, ms=3, label=text, zorder=4)
    curve = calibration.bias_curve if bias else calibration.sigma_curve
    grid = np.linspace(*curve.range, 300)
    # Most of a curve over lifted power can be flat, and most ranges in its steep part.
    limit_without_outliers(axes, np.concatenate([*values.values(), 100 * curve(grid)]), 100 * curve(everything.lifted))
    if bias and not squares:
        medians = 100 * everything.median_m
        axes.plot(everything.lifted, medians, "_", color=MUTED, ms=6, label="medians, reflections included")
    _curve(axes, calibration, which, grid, 100 * curve(grid), color=BLUE, lw=1.6, label="fitted", zorder=3)
    planted = planted_curve(ranges, f"{which}_curve", grid)
    if planted is not None:
        compared = compare_with_planted(ranges, applied, calibration) if bias else None
        planted += 0.0 if compared is None else compared.shift_ns * 1e-9 * SPEED_OF_LIGHT
        axes.plot(grid, 100 * planted, label="planted, same gauge" if bias else "planted", **PLANTED)
    if not bias:
        axes.set_ylim(bottom=0)
    alpha = calibration.alpha_dbm
    name = f"lifted power ψ = 10^((p − α) / 10 dB), α = {alpha:g} dBm".replace("-", "−")
    label(axes, name, "bias (cm)" if bias else "standard deviation (cm)")
    _powers_above(axes, alpha)
    return _with_legend(axes)


def _curve(
    axes: Axes, calibration: Calibration, which: Literal["bias", "sigma"], grid: Floats, values: Floats, **line: Any
) -> None:
    """Draw values of a curve (n,) in cm over lifted powers (n,), with its 95 % band if that is known."""
    std_m = calibration.band(grid, which)
    half = None if std_m is None else 100 * TWO_SIDED_95 * std_m
    between = None if half is None else (values - half, values + half)
    series(axes, grid, values, between, band="95 % band", **line)


def _powers_above(axes: Axes, alpha_dbm: float) -> None:
    """Mark some first-path powers in whole dBm on top of an axis of lifted powers."""
    low, high = axes.get_xlim()
    power = np.unique(np.rint(alpha_dbm + 10 * np.log10(np.linspace(high / 6, high, 6))))
    place = 10 ** ((power - alpha_dbm) / 10)
    shown = (place >= low) & (place <= high)
    top = axes.secondary_xaxis("top")
    top.set_xticks(place[shown], [f"{level:.0f}".replace("-", "−") for level in power[shown]])
    top.set_xlabel("first-path power p (dBm)")
    top.spines["top"].set_color(MUTED)


def delays(
    calibration: Calibration,
    planted_ns: Mapping[int, float] | None = None,
    shift_ns: float = 0.0,
    axes: Axes | None = None,
) -> Axes:
    """Draw delays in ns with 95 % intervals, and planted delays plus the common shift `shift_ns`.

    A delay far from all others is written at the upper edge. A delay without an interval is a circle. Tags of which
    only sums of delays are determined are left out; raises `UnanswerableError` if none remains.
    """
    known_std = calibration.interval_std_ns()
    if not known_std:
        raise UnanswerableError("no delay of a single tag is determined, so there is nothing to draw")
    axes, tags = axes or new_axes(), [*known_std]
    place = np.arange(len(tags), dtype=np.float64)
    values = np.array([calibration.delays_ns[tag] for tag in tags])
    half = TWO_SIDED_95 * np.array([*known_std.values()])
    inside = within_fence(values)
    bounded = inside & np.isfinite(half) & (half > 0)
    beside = 0.12 if planted_ns else 0.0
    if bounded.any():
        _intervals(axes, (place - beside)[bounded], values[bounded], half[bounded], "fitted, 95 % interval")
    if (inside & ~bounded).any():
        name, spots = "without an interval: pinned or undetermined", inside & ~bounded
        axes.plot((place - beside)[spots], values[spots], "o", ms=4, mfc="none", mec=BLUE, label=name)
    known = np.array([(planted_ns or {}).get(tag, np.nan) + shift_ns for tag in tags])
    if planted_ns:
        axes.plot(place + beside, known, "x", ms=5, mew=1.4, color=GREEN, label="planted, same gauge")
    near = np.concatenate([values[inside], known[inside & np.isfinite(known)]])
    # An interval that is much wider than the others is cut off.
    bar = min(half[bounded].max(), 4 * np.median(half[bounded])) if bounded.any() else 0.0
    margin = 0.08 * float(np.ptp(near)) + bar + 1e-6
    axes.set_ylim(near.min() - margin, near.max() + (1.0 if inside.all() else 2.2) * margin)
    for k in np.flatnonzero(~inside):
        where: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "top"}
        axes.annotate(f"{values[k]:+.1f} ns", (place[k], 0.97), color=BLUE, **where)
    every = slice(None, None, len(tags) // 24 + 1)
    axes.set_xticks(place[every], [str(tag) for tag in tags[every]])
    axes.margins(x=0.06)
    label(axes, "tag", "antenna delay (ns)")
    return _with_legend(axes)


def _intervals(axes: Axes, place: Any, values: Floats, half: Floats, text: str) -> None:
    """Draw points with their intervals, and a line at zero."""
    axes.errorbar(place, values, half, fmt="o", ms=3.5, capsize=2.5, color=BLUE, label=text)
    axes.axhline(0, color=PALE, lw=0.7, zorder=0)


def within_fence(values: Floats) -> Any:
    """Return a mask (n,) of the values that determine the limits of an axis.

    They lie within 12 median absolute deviations of the median, or eight standard deviations of a normal distribution.
    If more than half of the values are equal, all are inside.
    """
    away = np.abs(values - np.median(values))
    usual = float(np.median(away))
    return away <= (12.0 * usual if usual > 0 else np.inf)


def limit_without_outliers(axes: Axes, values: Floats, shown: ArrayLike = ()) -> None:
    """Set the limits of the vertical axis to values (n,) without outliers, and to the values `shown` (k,)."""
    inside = np.append(values[within_fence(values)], shown)
    margin = 0.12 * float(np.ptp(inside)) + 1e-9
    axes.set_ylim(inside.min() - margin, inside.max() + margin)


def patterns(width_in: float, calibration: Calibration, ranges: Ranges | None = None) -> Figure:
    """Draw the six patterns with the largest rms over azimuth, with 95 % bands, at elevations found in `ranges`."""
    largest = sorted(calibration.patterns, key=lambda one: -one.rms_m)[:6]
    polar: dict[str, Any] = {"subplot_kw": {"projection": "polar"}, "height_in": 3.2}
    figure, panels = sheet(width_in, len(largest), across=min(len(largest), int(width_in / 3)), **polar)
    around, reach_cm = np.radians(np.arange(0, 361, 3)), 0.0
    for axes, pattern in zip(panels, sorted(largest, key=lambda one: one.tags), strict=True):
        for k, up in enumerate(_elevations(calibration, ranges)):
            toward = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.full(len(around), np.sin(up))]
            values = pattern.values(np.column_stack(toward))
            longer = 100 * (values @ np.array(pattern.coefficients_m))
            low, high = (longer + side * 100 * TWO_SIDED_95 * pattern.std_m(values) for side in (-1, 1))
            reach_cm = max(reach_cm, -low.min(), high.max())
            line = {"color": look(k).colour, "ls": look(k).dashes}
            text = f"elevation {np.degrees(up):.0f}°".replace("-", "−")
            series(axes, around, longer, (low, high), band="" if k else "95 % band", label=text, **line)
        axes.plot(around, np.zeros(len(around)), color=MUTED, lw=1.0)
        axes.set_title(f"tag{'s' * (len(pattern.tags) > 1)} {first_few(map(str, pattern.tags))}: excess range (cm)")
    for axes in panels:
        axes.set(theta_zero_location="N", ylim=(-1.05 * reach_cm, 1.05 * reach_cm), rlabel_position=-22)
        axes.set_xticks(np.radians(np.arange(0, 360, 90)), ["ahead", "left", "behind", "right"])
        ticks = np.asarray(MaxNLocator(5).tick_values(-reach_cm, reach_cm))
        axes.set_yticks(ticks[np.abs(ticks) <= reach_cm])
        axes.spines["polar"].set_color(GRID)
    legend(figure)
    return figure


def _elevations(calibration: Calibration, ranges: Ranges | None) -> list[float]:
    """Return the median elevation in radians of the directions at tags with patterns.

    If the 10 % and 90 % quantiles are more than 30° apart, these follow it.
    """
    tags = [tag for one in calibration.patterns for tag in one.tags]
    z = np.zeros(1)
    if ranges is not None:
        seen = np.isin(ranges.ends, tags)
        z = ranges.toward[seen].astype(np.float64)[:, 2]
    low, middle, high = np.arcsin(np.nanquantile(z, (0.1, 0.5, 0.9)) if np.isfinite(z).any() else np.zeros(3)).tolist()
    return [middle, low, high] if high - low > np.radians(30) else [middle]


def new_axes() -> Axes:
    """Return the axes of a new pyplot figure."""
    from matplotlib import pyplot

    return pyplot.subplots(figsize=(WIDTHS["page"], 3.2), layout="constrained")[1]


def single_figure(draw: Callable[[Axes], Axes], width_in: float) -> Figure:
    """Return a figure with one pair of axes, into which `draw` draws."""
    figure, (axes,) = sheet(width_in, height_in=3.1)
    draw(axes)
    return figure


def _errors_cm(ranges: Ranges, applied: CorrectedRanges) -> dict[str, Floats]:
    return {stage: 100 * (getattr(applied, name) - ranges.truth_m) for stage, name in CORRECTION_STAGES.items()}


def _with_legend(axes: Axes) -> Axes:
    """Add a legend and return the axes. It is above axes that have their own figure, else inside."""
    figure = axes.figure
    if isinstance(figure, Figure) and len(figure.axes) == 1 and figure.get_layout_engine() is not None:
        legend(figure, axes)
    else:
        axes.legend(frameon=False)
    return axes


def distribution(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Draw the errors in the three stages: histograms, and distribution functions of absolute errors."""
    figure, (left, right) = sheet(width_in, 2)
    for axes in (histogram(ranges, applied, left), cumulative(ranges, applied, right)):
        axes.legend_ = None  # the figure has one legend for both
    legend(figure)
    return figure


def z_scores(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Draw errors divided by their sigma: a histogram with the normal density, and the share of larger errors."""
    z = (applied.corrected_m - ranges.truth_m) / applied.sigma_m
    figure, (left, right) = sheet(width_in, 2)
    grid = np.linspace(-6, 6, 61)
    density = np.histogram(z, grid)[0] / (len(z) * np.diff(grid))
    left.stairs(density, grid, fill=True, color=BLUE, alpha=0.55, label="ranges")
    left.plot(grid, norm.pdf(grid), color=INK, lw=1.2, label="noise alone (standard normal)")
    beyond = 100 * float(np.mean(np.abs(z) > 6))
    label(left, f"error divided by its σ ({beyond:.1f} % outside ± 6)", "density")
    size = np.sort(np.abs(z))
    # The tail has few errors and is noisy: the line ends where ten are left.
    shown = slice(None, max(1, len(size) - 10), len(size) // 1000 + 1)
    right.semilogy(size[shown], (100 * (1 - np.arange(len(size)) / len(size)))[shown], color=BLUE, lw=1.4)
    grid = np.linspace(0, 4, 81)
    right.plot(grid, 200 * norm.sf(grid), color=INK, lw=1.2)
    right.set(xlim=(0, None), ylim=(1000 / len(z), 100) if len(z) > 10 else None)
    right.yaxis.set_major_formatter("{x:g}")
    label(right, "absolute error divided by its σ", "ranges with larger errors (%)")
    legend(figure, left)
    return figure


def residuals(width_in: float, ranges: Ranges, applied: CorrectedRanges, alpha_dbm: float) -> Figure:
    """Draw calibrated errors over distance and over lifted power in dBm, with medians and the middle 68 %."""
    figure, panels = sheet(width_in, 2, sharey=True)
    error = 100 * (applied.corrected_m - ranges.truth_m)
    power = 10 * np.log10(np.maximum(applied.lifted, 1e-9)) + alpha_dbm
    over = ((ranges.truth_m, "true distance (m)"), (power, "lifted power, in dBm"))
    for panel, (x, name) in zip(panels, over, strict=True):
        dots(panel, x, error, color=PALE, zorder=0)
        groups = np.array_split(np.argsort(x), max(1, min(16, len(x) // 40)))
        middle = np.array([np.median(x[rows]) for rows in groups])
        low, median, high = np.array([np.quantile(error[rows], (0.16, 0.5, 0.84)) for rows in groups]).T
        line: dict[str, Any] = {"marker": "o", "ms": 2.8, "color": BLUE, "label": "median"}
        series(panel, middle, median, (low, high), band="middle 68 %", **line)
        panel.axhline(0, color=MUTED, lw=0.7)
        panel.set_xlim(*np.quantile(x, (0.001, 0.999)) + np.array([-1e-6, 1e-6]))
        # Labels such as -97.5 are wide, so fewer than by default fit.
        panel.locator_params(axis="x", nbins=7, steps=[1, 2, 5, 10])
        label(panel, name, "calibrated error (cm)" if panel is panels[0] or width_in < NARROW_IN else "")
    panels[0].set_ylim(*bulk(error))
    legend(figure, panels[0])
    return figure


def over_time(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Draw the calibrated errors of each pair over time, with the band that contains 95 % of direct ranges.

    If there are more than 24 pairs, those with the largest spread of errors are drawn.
    """
    error = 100 * (applied.corrected_m - ranges.truth_m)
    rows = {name: np.flatnonzero(own) for name, own in pair_rows(ranges).items()}
    spread = {name: np.ptp(np.quantile(error[own], (0.05, 0.95))) for name, own in rows.items()}
    names = sorted(rows, key=lambda name: -spread[name])[:MOST_PAIRS]
    time, across = (ranges.time_ns - ranges.time_ns.min()) * 1e-9, 2 if width_in < NARROW_IN else 4
    figure, panels = sheet(width_in, len(names), height_in=1.05, across=across, sharex=True, sharey=True)
    figure.set_figheight(figure.get_figheight() + 0.6)
    for panel, name in zip(panels, filter(names.__contains__, rows), strict=True):
        order = rows[name][np.argsort(time[rows[name]])]
        shown, some = order[:: max(1, len(order) // 800)], order[:: max(1, len(order) // 120)]
        panel.plot(time[shown], error[shown], ".", ms=1.3, color=BLUE, alpha=0.6, rasterized=True)
        half = 100 * TWO_SIDED_95 * applied.sigma_m[some]
        panel.plot(time[some], np.column_stack([-half, half]), color=INK, lw=0.6)
        panel.set_title(f"tags {name}", pad=2)
        label(panel, "", "")
    panels[0].set_ylim(*bulk(error))
    figure.supxlabel("time (s)", fontsize="medium")
    figure.supylabel("calibrated error (cm)", fontsize="medium")
    return figure


def errors_by_pair(width_in: float, found: Evaluation) -> Figure:
    """Draw the median error of each pair before and after correction, with bars of one robust standard deviation.

    If there are more than 24 pairs, those with the largest raw medians are drawn.
    """
    figure, (axes,) = sheet(width_in, height_in=2.2)
    farthest = sorted(found.pairs, key=lambda name: -abs(found.pairs[name].raw.median_m))[:MOST_PAIRS]
    names = [name for name in found.pairs if name in farthest]
    for beside, stage in ((-0.12, "raw"), (0.12, "full")):
        errors = [getattr(found.pairs[name], stage) for name in names]
        middle, bars = 100 * np.array([(one.median_m, one.robust_std_m) for one in errors]).reshape(-1, 2).T
        line = {key: STAGE_LINES[stage][key] for key in ("color", "label")}
        axes.errorbar(np.arange(len(names)) + beside, middle, bars, fmt="o", ms=3.5, capsize=2.5, **line)
    axes.axhline(0, color=PALE, lw=0.7, zorder=0)
    axes.set_xticks(range(len(names)), names, rotation=90 if len(names) > 12 else 0)
    label(axes, "tags", "range error (cm)")
    legend(figure)
    return figure


def differences(width_in: float, found: CalibrationComparison) -> Figure:
    """Draw the difference of each delay, second minus first, without the common shift, with 95 % intervals."""
    figure, (axes,) = sheet(width_in, height_in=2.6)
    tags = sorted(found.difference_ns)
    values = 1e3 * np.array([found.difference_ns[tag] for tag in tags])
    half = 1e3 * TWO_SIDED_95 * np.nan_to_num([found.std_ns[tag] for tag in tags])
    _intervals(axes, range(len(tags)), values, half, "difference, 95 % interval")
    limit_without_outliers(axes, np.concatenate([values - half, values + half, [0.0]]))
    axes.set_xticks(range(len(tags)), [str(tag) for tag in tags])
    label(axes, "tag", "difference of the delay (ps)")
    legend(figure)
    return figure


def both_curves(width_in: float, known: Sequence[Calibration], names: Sequence[str]) -> Figure:
    """Draw the curves of two calibrations over lifted power: bias, each minus its own mean, and sigma."""
    figure, (left, right) = sheet(width_in, 2)
    lines: tuple[dict[str, Any], ...] = ({"color": VERMILION, "ls": (0, (5, 1.5))}, {"color": BLUE})
    for one, name, line in zip(known, names, lines, strict=True):
        grid = np.linspace(*one.bias_curve.range, 200)
        bias = 100 * one.bias_curve(grid)
        _curve(left, one, "bias", grid, bias - bias.mean(), label=name, **line)
        grid = np.linspace(*one.sigma_curve.range, 200)
        _curve(right, one, "sigma", grid, 100 * one.sigma_curve(grid), label=name, **line)
    label(left, "lifted power", "bias, mean removed (cm)")
    label(right, "lifted power", "standard deviation (cm)")
    right.set_ylim(bottom=0)
    legend(figure, left, texts=names)
    return figure
