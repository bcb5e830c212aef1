"""Draws docs/figures/first_result.svg, the README's picture: a flight's ranges before and after a calibration.

The calibration is fitted to the training flight of scenarios/icra2023 and drawn on the first test flight, which it has
not seen; both are simulated anew, so the picture is what the README's commands give.
"""

from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import calib
import uwbsim
from uwblink.arrays import Floats

PICTURE: Final = Path("docs/figures/first_result.svg")
# Okabe and Ito's colours; the two curves also differ by their dashes.
STYLES: Final = {"as reported": ("#D55E00", "--"), "corrected": ("#0072B2", "-")}
SHOWN_CM: Final = (-30.0, 60.0)
BINS: Final = 24
FEWEST: Final = 60


def errors_cm(train: str, test: str) -> tuple[dict[str, Floats], Floats]:
    """Return the errors (n,) of a test flight's ranges before and after, and their mean first-path powers in dBm."""
    calibration = calib.fit(uwbsim.simulate(uwbsim.load(train))).calibration
    ranges = calib.load_ranges(uwbsim.simulate(uwbsim.load(test)))
    applied = calibration.apply(ranges)
    stages = {"as reported": applied.raw_m, "corrected": applied.corrected_m}
    return {name: 100 * (m - ranges.truth_m) for name, m in stages.items()}, (ranges.fpp1_dbm + ranges.fpp2_dbm) / 2


def draw_shares(axes: Axes, errors: dict[str, Floats]) -> None:
    """Draw how the errors are distributed."""
    edges = np.arange(SHOWN_CM[0], SHOWN_CM[1] + 1, 2)
    for name, error in errors.items():
        colour, dashes = STYLES[name]
        weights = np.full(len(error), 100 / len(error))
        axes.hist(error, edges.tolist(), weights=weights, histtype="step", lw=1.8, color=colour, ls=dashes, label=name)
    axes.set(xlabel="range error (cm)", ylabel="share of ranges (%)", xlim=SHOWN_CM)


def draw_over_power(axes: Axes, errors: dict[str, Floats], power_dbm: Floats) -> None:
    """Draw the median error, and the middle two thirds, over received power."""
    edges = np.linspace(np.quantile(power_dbm, 0.002), np.quantile(power_dbm, 0.998), BINS)
    which = np.digitize(power_dbm, edges)
    full = [bin_ for bin_ in range(1, BINS) if np.sum(which == bin_) >= FEWEST]
    middle = np.array([np.median(power_dbm[which == bin_]) for bin_ in full])
    for name, error in errors.items():
        colour, dashes = STYLES[name]
        low, median, high = np.array([np.quantile(error[which == bin_], [1 / 6, 0.5, 5 / 6]) for bin_ in full]).T
        axes.fill_between(middle, low, high, color=colour, alpha=0.18, lw=0)
        axes.plot(middle, median, color=colour, ls=dashes, lw=1.8, label=name)
    axes.axhline(0, color="0.5", lw=0.8, zorder=0)
    axes.set(xlabel="first-path power (dBm)", ylabel="median error, middle 2/3 (cm)")


def main() -> None:
    """Simulate, fit, draw."""
    errors, power_dbm = errors_cm("scenarios/icra2023/train.toml", "scenarios/icra2023/test1.toml")
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "uwbcal"}):
        figure = Figure(figsize=(8.4, 3.3), layout="constrained")
        left, right = figure.subplots(1, 2)
        draw_shares(left, errors)
        draw_over_power(right, errors, power_dbm)
        for axes in (left, right):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.25)
        left.legend(frameon=False, loc="upper right")
        PICTURE.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(PICTURE, metadata={"Date": None})
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
