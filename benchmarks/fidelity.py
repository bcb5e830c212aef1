"""Write docs/fidelity.md: what simulated recordings look like beside measured ones (`make fidelity`)."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from calib.estimation.fitting import fit
from calib.evaluation.statistics import evaluate
from calib.ranges import concatenate
from calib.sources import load_ranges
from uwblink.arrays import Floats, Ints
from uwblink.ticks import TICK_S, elapsed
from uwblink.twr import intervals, raw_range, truncate4
from uwbsim.scenario.loading import load as load_scenario
from uwbsim.simulation.run import Simulated, simulate, write

ROOT = Path(__file__).parents[1]
ICRA = ROOT / "scenarios" / "icra2023"
BENCH = ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml"
TAIL_M = 0.3
LAG = "autocorrelation of a pair's errors to its next range; simulated: test1, lasting reflections"
TAIL = "errors more than 30 cm above the median; the same"
TRACE = "how much weaker their first paths are (dB); the same"
CLOCKS = "range noise of clocks with white noise of 0.01 ppm sqrt(s): DS, SS (mm)"
ALOHA = ROOT / "scenarios" / "collisions" / "aloha.toml"

HEAD = """# Fidelity

What a simulated recording looks like beside measured ones. This page is written by `make fidelity`; do not edit it.

Measured figures: the boards' timing and grids from 1833 exchanges of real boards (MILUV), raw and residual errors from Shalaby et al., ICRA 2023,
sections V and VI, dependence from 317 exchanges of one MILUV flight among obstacles (cirObstacles_3_random_0). Simulated: `scenarios/icra2023/test1.toml` and `test2.toml`, and the training flight for the calibration.

A figure is *built in* where the program follows the boards' arithmetic, *tuned* where a setting was chosen to hit it, and *predicted* where it follows from other settings.

| what | measured | simulated | how |
|---|---|---|---|
"""


def main() -> None:
    train, one, two = (simulate(load_scenario(ICRA / f"{n}.toml")) for n in ("train", "test1", "test2"))
    rows = [
        *timing_rows(train),
        *grid_rows(train),
        noise_row(),
        *error_rows(train, one, two),
        *dependence_rows(one),
        *success_rows(),
    ]
    rows += clock_rows()
    text = HEAD + "".join(f"| {' | '.join((*row, how))} |\n" for row, how in zip(rows, HOW, strict=True))
    text += NOTES
    (ROOT / "docs" / "fidelity.md").write_text(text, encoding="utf-8")
    print(text)


BUILT_IN, TUNED, PREDICTED = "built in", "tuned", "predicted"
HOW = (
    *(TUNED, BUILT_IN, BUILT_IN),
    *(BUILT_IN, PREDICTED, BUILT_IN, TUNED, TUNED),
    TUNED,
    *(TUNED, PREDICTED, PREDICTED),
    *(PREDICTED, TUNED, PREDICTED),
    PREDICTED,
    PREDICTED,
)
"""How each row came about, in their order."""

NOTES = """
What is not alike, or not known:

- The training scenario's raw errors are made to resemble the paper's by the choice of tail and powers; the curves and delays are the published ones.
- **The icra2023 scenarios have the tail twice.** Their curve of standard deviation is the published one, fitted to what was left after outliers were rejected (6.3 to 8.7 cm); the paper's samples have a core of 5.6 to 8.0 cm that is skewed itself
  (skewness 0.2 to 1.3 by power), and a tail of 12 % comes on top of the curve. Their median lifted power is 0.48 where the paper's samples
  have 0.81, and their powers span a range 6 to 8 dB above that of MILUV's boards.
- In them reflections are drawn for each exchange alone, leave no trace in power and last for no time. The model "two-state" has all three (`scenarios/lasting_reflections`); its settings were fitted to nothing.
- The real flight has 317 exchanges of 30 pairs, whose next range comes 0.42 s later: too few to tell shares of pairs apart, and its lives of reflections are shorter than that.
- Success against the number of initiators was not measured on boards; the simulated figures follow from frame durations, capture and preamble time-out.
- The boards' receive noise was measured among obstacles; in the icra2023 scenarios all noise is in the published curve of standard deviation.
- Capture (6 dB) and the first-path detector's dynamic range (15 dB) are typical values, not measured ones; materials are round values from ITU-R P.2040-3.
- The chip is not said to go deaf after a reception error without a reset. What temperature and voltage do to delays is the manual's typical figure, without a sign there.
"""


def timing_rows(run: Simulated) -> list[tuple[str, str, str]]:
    spans = intervals(run.exchanges)
    us = spans.dt32 * TICK_S * 1e6
    q = np.quantile(us, [0, 0.5, 0.9, 0.95, 1])
    exact = np.mean(spans.dt53 == 65536 * 1500 + 16384)
    grid = np.mean([np.mean(stamp % 512 == 52) for stamp in (run.exchanges.tx1, run.exchanges.tx2, run.exchanges.tx3)])
    return [
        (
            "dt32 of DS-TWR: min, median, 90 %, 95 %, max (us)",
            "303.4, 305.4, 308.7, 347.6, 386.3",
            ", ".join(f"{v:.1f}" for v in q),
        ),
        ("dt53 = 65536 n + 16384 ticks, exactly", "100 %", f"{100 * exact:.1f} %"),
        ("tx mod 512 = 52", "100 %", f"{100 * grid:.1f} %"),
    ]


def grid_rows(run: Simulated) -> list[tuple[str, str, str]]:
    e = run.exchanges
    counts = 10 ** ((e.fpp1_dbm + 121.74) / 10)
    on_power = np.mean(np.abs(truncate4(10 * np.log10(np.maximum(np.rint(counts), 1)) - 121.74) - e.fpp1_dbm) < 2e-4)
    steps = np.rint(e.skew1_ppm / 9.3132e-4)
    near = [np.abs(truncate4((steps + k) * 9.3132e-4) - e.skew1_ppm) < 2e-4 for k in (-1, 0, 1)]
    both = e.skew1_ppm + e.skew2_ppm
    return [
        ("first-path powers on the integer grid", "98-99 %", f"{100 * on_power:.1f} %"),
        ("span of first-path powers (dBm)", "-104.2 to -80.0", f"{e.fpp1_dbm.min():.1f} to {e.fpp1_dbm.max():.1f}"),
        ("skews on the carrier-integrator grid", "99.9 %", f"{100 * np.mean(np.any(near, axis=0)):.1f} %"),
        ("median of skew1 + skew2 (ppm)", "-0.27", f"{np.median(both):.2f}"),
        ("noise of a skew reading (ppm)", "0.20", f"{np.std(both) / np.sqrt(2):.2f}"),
    ]


def noise_row() -> tuple[str, str, str]:
    """From consecutive ratios dt64/dt53, as it was measured: each has the noise of two receptions."""
    bench = load_scenario(ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml")
    e = simulate(bench).exchanges
    ratio = elapsed(e.rx3, e.rx2) / elapsed(e.tx3, e.tx2)
    noise = np.std(np.diff(ratio)) * np.mean(elapsed(e.tx3, e.tx2)) * TICK_S / 2
    return "noise of a receive stamp, from consecutive dt64/dt53 (ps)", "116", f"{noise * 1e12:.0f}"


def error_rows(train: Simulated, one: Simulated, two: Simulated) -> list[tuple[str, str, str]]:
    with tempfile.TemporaryDirectory() as folder:
        parts = []
        for name, run in (("train", train), ("test1", one), ("test2", two)):
            write(run, Path(folder) / f"{name}.uwb")
            parts.append(load_ranges(Path(folder) / f"{name}.uwb"))
    tests = concatenate(parts[1:])
    error = tests.raw_m - tests.truth_m
    skewness = np.mean(((error - error.mean()) / error.std()) ** 3)
    found = evaluate(tests, fit(parts[0]).calibration)
    accepted = [group.accepted for group in found.pairs.values()]
    return [
        (
            "raw range error of the tests: mean, std (cm)",
            "11.1, 19.0",
            f"{100 * error.mean():.1f}, {100 * error.std():.1f}",
        ),
        ("its skewness", "positive", f"{skewness:+.1f}"),
        (
            "calibrated, after a chi-square test at 95 %: largest mean and std of a pair (cm)",
            "at most about 4 and 8",
            f"{100 * max(abs(a.mean_m) for a in accepted):.1f} and {100 * max(a.std_m for a in accepted):.1f}",
        ),
    ]


def dependence_rows(flight: Simulated) -> list[tuple[str, str, str]]:
    """How errors of a pair hang together: in the flight of icra2023 as it is, and with reflections that last."""
    lasting = simulate(load_scenario(ROOT / "scenarios" / "lasting_reflections" / "hall.toml"))
    found = [(raw_range(run.exchanges) - run.truth_m, run.exchanges) for run in (flight, lasting)]
    told = ", ".join(f"{lag_one(error, e.initiator * 1000 + e.target):.2f}" for error, e in found)
    tails = ", ".join(f"{100 * np.mean(error - np.median(error) > TAIL_M):.0f} %" for error, _ in found)
    drops = ", ".join(f"{trace_db(error, e.fpp1_dbm):.1f}" for error, e in found)
    return [
        (LAG, "0.16 raw, 0.04 calibrated (0.06 uncertain)", told),
        (TAIL, "12 %", tails),
        (TRACE, "not known", drops),
    ]


def lag_one(error: Floats, pair: Ints) -> float:
    """Return the autocorrelation of errors, cut at a metre, from one range of a pair to its next."""
    above = below = 0.0
    for key in np.unique(pair):
        mine = error[pair == key]
        mine = np.clip(mine - np.median(mine), -1, 1)
        above, below = above + float(mine[1:] @ mine[:-1]), below + float(mine[1:] @ mine[1:])
    return above / below


def trace_db(error: Floats, power_dbm: Floats) -> float:
    """Return by how much ranges of the tail have less first-path power than the others, in the median."""
    tail = error - np.median(error) > TAIL_M
    return float(np.median(power_dbm[~tail]) - np.median(power_dbm[tail]))


def clock_rows() -> list[tuple[str, str, str]]:
    """Standard deviation of ranges between clocks of 0.01 ppm sqrt(s), all else noiseless."""
    noiseless = [
        "radio.rx_noise_ps=0",
        "radio.sigma=none",
        "radio.quantize=false",
        "ranging.reply={model='fixed',delay_us=305}",
    ]
    noisy = [f"tags.{k}.white_ppm_sqrt_s=0.01" for k in range(2)]
    spreads = []
    for protocol in ("ds", "ss"):
        run = simulate(load_scenario(BENCH, [f"ranging.protocol={protocol}", *noiseless, *noisy]))
        spreads.append(f"{1000 * np.std(raw_range(run.exchanges) - run.truth_m):.0f}")
    return [(CLOCKS, "40, 83 by closed form", ", ".join(spreads))]


def success_rows() -> list[tuple[str, str, str]]:
    """Random talk of 20 exchanges a second by each initiator."""
    shares = []
    for count in (1, 2, 4, 6):
        pairs = [[k + 1, k % 6 + 2 if k < 5 else 1] for k in range(count)]
        settings = [f"ranging.pairs={pairs}", f"ranging.rate_hz={20 * count}"]
        run = simulate(load_scenario(ALOHA, settings))
        shares.append(len(run.exchanges) / (len(run.exchanges) + len(run.faults)))
    told = ", ".join(f"{100 * share:.0f} %" for share in shares)
    return [("success of 1, 2, 4, 6 initiators that talk at random, 20 exchanges a second each", "not measured", told)]


if __name__ == "__main__":
    main()
