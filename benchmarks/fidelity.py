"""Write a section of docs/accuracy.md: simulated recordings beside measured ones (`make fidelity`)."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.fidelity_detours import detour_rows
from benchmarks.fidelity_errors import (
    BUILT_IN,
    DATA,
    PREDICTED,
    TUNED,
    Row,
    dependence_rows,
    error_rows,
    power_rows,
    twin_verdicts,
)
from uwblink.ticks import TICK_S, elapsed
from uwblink.twr import intervals, truncate4
from uwbsim import Simulated, simulate
from uwbsim.scenario.loading import load as load_scenario

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "accuracy.md"
ICRA = ROOT / "scenarios" / "icra2023"
BENCH = ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml"
ALOHA = ROOT / "scenarios" / "collisions" / "aloha.toml"

BEGIN, END = "<!-- fidelity -->", "<!-- end of fidelity -->"
HEAD = """`make fidelity`. Measured: 1833 exchanges of real boards (MILUV); raw and residual errors of Shalaby et al., ICRA 2023, sections V and VI; 17 118 samples published with the paper; 317 exchanges of one MILUV flight among obstacles. Simulated: the flights of `scenarios/icra2023`. A figure is *built in* if the program follows the boards' arithmetic, *tuned* if a setting was chosen to hit it, *predicted* if it follows from other settings.

| what | measured | simulated | how |
|---|---|---|---|
"""


def main() -> None:
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the measured data are not there (or set UWBCAL_DATA)")
    train, one, two = (simulate(load_scenario(ICRA / f"{n}.toml")) for n in ("train", "test1", "test2"))
    rows = [
        *timing_rows(train),
        *grid_rows(train),
        noise_row(),
        *power_rows(train),
        *error_rows(train, one, two),
        *dependence_rows(one),
        *success_rows(),
        *detour_rows(),
    ]
    text = HEAD + _table(rows) + f"{TWIN}{'; '.join(twin_verdicts())}.\n"
    page = PAGE.read_text(encoding="utf-8")
    block = f"{BEGIN}\n{text}{END}"
    PAGE.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: block, page, flags=re.DOTALL), encoding="utf-8")
    print(text)


TWIN = """
**A recorded flight and its twin.** `uwbsim twin` fitted a scenario to the MILUV flight, so this shows what the simulator can express and predicts nothing. Largest difference of shares: """


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


def grid_rows(run: Simulated) -> list[Row]:
    e = run.exchanges
    counts = 10 ** ((e.fpp1_dbm + 121.74) / 10)
    on_power = np.mean(np.abs(truncate4(10 * np.log10(np.maximum(np.rint(counts), 1)) - 121.74) - e.fpp1_dbm) < 2e-4)
    steps = np.rint(e.skew1_ppm / 9.3132e-4)
    near = [np.abs(truncate4((steps + k) * 9.3132e-4) - e.skew1_ppm) < 2e-4 for k in (-1, 0, 1)]
    both = e.skew1_ppm + e.skew2_ppm
    return [
        ("first-path powers on the integer grid", "98-99 %", f"{100 * on_power:.1f} %", BUILT_IN),
        (
            "span of first-path powers (dBm)",
            "-104.2 to -80.0",
            f"{e.fpp1_dbm.min():.1f} to {e.fpp1_dbm.max():.1f}",
            TUNED,
        ),
        ("skews on the carrier-integrator grid", "99.9 %", f"{100 * np.mean(np.any(near, axis=0)):.1f} %", BUILT_IN),
        ("median of skew1 + skew2 (ppm)", "-0.27", f"{np.median(both):.2f}", TUNED),
        ("noise of a skew reading (ppm)", "0.20", f"{np.std(both) / np.sqrt(2):.2f}", TUNED),
    ]


def noise_row() -> Row:
    """From consecutive ratios dt64/dt53, as it was measured: each has the noise of two receptions."""
    bench = load_scenario(ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml")
    e = simulate(bench).exchanges
    ratio = elapsed(e.rx3, e.rx2) / elapsed(e.tx3, e.tx2)
    noise = np.std(np.diff(ratio)) * np.mean(elapsed(e.tx3, e.tx2)) * TICK_S / 2
    return "noise of a receive stamp, from consecutive dt64/dt53 (ps)", "116", f"{noise * 1e12:.0f}", TUNED


def success_rows() -> list[Row]:
    """Random talk of 20 exchanges a second by each initiator."""
    shares = []
    for count in (1, 2, 4, 6):
        pairs = [[k + 1, k % 6 + 2 if k < 5 else 1] for k in range(count)]
        settings = [f"ranging.pairs={pairs}", f"ranging.rate_hz={20 * count}"]
        run = simulate(load_scenario(ALOHA, settings))
        shares.append(len(run.exchanges) / (len(run.exchanges) + len(run.faults)))
    told = ", ".join(f"{100 * share:.0f} %" for share in shares)
    return [
        (
            "success of 1, 2, 4, 6 initiators that talk at random, 20 exchanges a second each",
            "not measured",
            told,
            PREDICTED,
        )
    ]


if __name__ == "__main__":
    main()
