"""Write a section of docs/accuracy.md: simulated recordings compared with measured ones (`make fidelity`)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.fidelity_detours import detour_rows
from benchmarks.fidelity_errors import (
    TUNED,
    Row,
    dependence_rows,
    error_rows,
    power_rows,
    twin_verdicts,
)
from benchmarks.nlos import SHARED
from benchmarks.studies import write_section
from uwblink.ticks import TICK_S, elapsed
from uwblink.twr import intervals
from uwbsim import Simulated, simulate
from uwbsim.scenario.loading import load as load_scenario

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "accuracy.md"
ICRA = ROOT / "scenarios" / "icra2023"
BENCH = ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml"

HEAD = """`make fidelity`. Measured: 1833 exchanges of real boards (MILUV); raw and residual errors of Shalaby et al., ICRA 2023, sections V and VI; 17 118 samples published with the paper; 317 exchanges of one MILUV flight among obstacles. Simulated: the flights of `scenarios/icra2023`. A figure is *tuned* if a setting was chosen to match it, *predicted* if it follows from other settings.

| what | measured | simulated | how |
|---|---|---|---|
"""


def main() -> None:
    if not SHARED.is_dir():
        sys.exit(f"{SHARED}: the measured data are not there (or set UWBCAL_DATA)")
    train, one, two = (simulate(load_scenario(ICRA / f"{n}.toml")) for n in ("train", "test1", "test2"))
    rows = [
        *timing_rows(train),
        *reading_rows(train),
        noise_row(),
        *power_rows(train),
        *error_rows(train, one, two),
        *dependence_rows(one),
        *detour_rows(),
    ]
    text = HEAD + _table(rows) + f"{TWIN}{'; '.join(twin_verdicts())}.\n"
    write_section(PAGE, "fidelity", text)
    print(text)


TWIN = """
**A recorded flight and its twin.** `uwbsim twin` fitted a scenario to the MILUV flight, so this shows what the simulator can represent, not predict. Largest difference of shares: """


def _table(rows: Sequence[Sequence[str]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def timing_rows(run: Simulated) -> list[Row]:
    spans = intervals(run.exchanges)
    us = spans.dt32 * TICK_S * 1e6
    q = np.quantile(us, [0, 0.5, 0.9, 0.95, 1])
    return [
        (
            "dt32 of DS-TWR: min, median, 90 %, 95 %, max (us)",
            "303.4, 305.4, 308.7, 347.6, 386.3",
            ", ".join(f"{v:.1f}" for v in q),
            TUNED,
        ),
    ]


def reading_rows(run: Simulated) -> list[Row]:
    e = run.exchanges
    both = e.skew1_ppm + e.skew2_ppm
    return [
        (
            "span of first-path powers (dBm)",
            "-104.2 to -80.0",
            f"{e.fpp1_dbm.min():.1f} to {e.fpp1_dbm.max():.1f}",
            TUNED,
        ),
        ("median of skew1 + skew2 (ppm)", "-0.27", f"{np.median(both):.2f}", TUNED),
        ("noise of a skew reading (ppm)", "0.20", f"{np.std(both) / np.sqrt(2):.2f}", TUNED),
    ]


def noise_row() -> Row:
    """Return the noise of consecutive ratios dt64/dt53; each ratio has the noise of two receptions."""
    bench = load_scenario(ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml")
    e = simulate(bench).exchanges
    ratio = elapsed(e.rx3, e.rx2) / elapsed(e.tx3, e.tx2)
    noise = np.std(np.diff(ratio)) * np.mean(elapsed(e.tx3, e.tx2)) * TICK_S / 2
    return "noise of a receive stamp, from consecutive dt64/dt53 (ps)", "116", f"{noise * 1e12:.0f}", TUNED


if __name__ == "__main__":
    main()
