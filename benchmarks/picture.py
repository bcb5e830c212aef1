"""Draw docs/figures/first_result.svg, the figure of the README: range errors of two flights before and after
calibration.

Left: the first test flight of scenarios/icra2023, calibrated with its training flight. Both are simulated, so the
figure shows the results of the commands in the README. Right: the second flight of STAR-loc, calibrated with the first;
it needs the folder of public data sets (see `benchmarks.scoreboard`) and is left out without it.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

import calib
import uwbsim
from benchmarks.scoreboard import DATA_SETS, Lab
from uwblink.arrays import Floats

PICTURE: Final = Path("docs/figures/first_result.svg")
# Colours of Okabe and Ito; the two curves also have different dashes.
STYLES: Final = {"as reported": ("#D55E00", "--"), "corrected": ("#0072B2", "-")}
SHOWN_CM: Final = (-30.0, 60.0)
BINS: Final = 24
FEWEST: Final = 60


Errors = tuple[dict[str, Floats], Floats]
"""Errors (n,) of the ranges of a flight in cm, before and after calibration, and mean first-path powers (n,) in dBm."""


def errors_cm(calibration: calib.Calibration, ranges: calib.Ranges) -> Errors:
    """Return the errors of ranges by a calibration."""
    applied = calibration.apply(ranges)
    stages = {"as reported": applied.raw_m, "corrected": applied.corrected_m}
    return {name: 100 * (m - ranges.truth_m) for name, m in stages.items()}, (ranges.fpp1_dbm + ranges.fpp2_dbm) / 2


def simulated() -> Errors:
    """Simulate two flights, fit the first and return the errors of the second."""
    train, test = (uwbsim.simulate(uwbsim.load(f"scenarios/icra2023/{name}.toml")) for name in ("train", "test1"))
    return errors_cm(calib.fit(train).calibration, calib.load_ranges(test))


def recorded(data: Path) -> Errors:
    """Run the recipe of STAR-loc up to the calibration with the first flight, and return the errors of the second."""
    starloc = next(one for one in DATA_SETS if one.name == "STAR-loc")
    with tempfile.TemporaryDirectory() as folder:
        lab = Lab(Path(folder))
        first, second = starloc.prepare(data / starloc.archive, lab.folder)
        for flight in (first, second):
            lab.run(f"uwblink import guess {flight}.csv -o {flight}.toml")
            lab.run(f"uwblink import csv {flight}.csv --map {flight}.toml -o {flight}.uwb")
        lab.run(f"calib fit {first}.uwb -o {first}.json")
        calibration = calib.load_calibration(lab.folder / f"{first}.json")
        return errors_cm(calibration, calib.load_ranges(lab.folder / f"{second}.uwb"))


def draw_shares(axes: Axes, errors: dict[str, Floats]) -> None:
    """Draw the distributions of errors."""
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


def main(arguments: list[str] | None = None) -> None:
    """Simulate, fit and draw."""
    options = argparse.ArgumentParser(prog="benchmarks.picture", description=f"Draw {PICTURE}.")
    options.add_argument("data", type=Path, nargs="?", help="folder with the archive of STAR-loc")
    data = options.parse_args(arguments).data
    flights = {"simulated flight": simulated()}
    if data is None:
        print("without a folder of data, the real flight is left out")
    else:
        flights["recorded flight (STAR-loc)"] = recorded(data)
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "uwbcal"}):
        figure = Figure(figsize=(8.4, 5.6), layout="constrained")
        grid = figure.subplots(2, len(flights), squeeze=False, sharey="row")
        for number, (title, (errors, power_dbm)) in enumerate(flights.items()):
            shares, over_power = grid[:, number]
            shares.set_title(title)
            draw_shares(shares, errors)
            draw_over_power(over_power, errors, power_dbm)
        for axes in grid.flat:
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.25)
            axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
            axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        for axes in grid[:, 1:].flat:
            axes.set_ylabel("")
        grid[0, 0].legend(frameon=False, loc="upper right")
        PICTURE.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(PICTURE, metadata={"Date": None})
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
