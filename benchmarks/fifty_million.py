"""Fit a recording that is longer than memory: `python -m benchmarks.fifty_million 50000000` writes it and fits it.

It is the icra2023 training flight over and over, a second apart, each time with other noise on a stamp; written by
DuckDB alone, so that it takes minutes and not the memory that is to be measured. Time and peak memory are those that
the system counted for `calib fit` as a process of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import duckdb

ROOT = Path(__file__).parents[1]
TRAIN = ROOT / "scenarios" / "icra2023" / "train.toml"
APART_S = 241
NOISE_TICKS = 4.0
AT_ONCE = 20
COLUMNS = "initiator, target, protocol, reporter, range_m, tx1, rx1, tx2"
REST = "tx3, rx3, fpp1_dbm, fpp2_dbm, skew1_ppm, skew2_ppm, truth_m"


def main() -> None:
    """Write a recording of so many exchanges, fit it, and print a row of the table in docs/speed.md."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000_000
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as folder:
        path = Path(folder) / "long.uwb"
        written(path, count, Path(folder))
        done = fitted(path, sys.argv[2:])
        print(f"| {count:,} | {path.stat().st_size / 1e9:.1f} GB | {done} |".replace(",", " "), flush=True)


def written(path: Path, count: int, folder: Path) -> None:
    """Write a recording of at least so many exchanges."""
    bin_ = Path(sys.executable).parent
    subprocess.run([bin_ / "uwbsim", "run", TRAIN, "-o", path, "--force"], check=True, stdout=subprocess.DEVNULL)
    with duckdb.connect(str(path)) as db:
        db.execute("SET memory_limit = '2GB'")
        db.execute(f"SET temp_directory = '{folder}'")
        db.execute("CREATE TEMP TABLE e AS SELECT rowid AS row, * FROM exchanges")
        db.execute("CREATE TEMP TABLE p AS SELECT rowid AS row, * FROM poses ORDER BY time_ns, body")
        (each,) = db.execute("SELECT count(*) FROM e").fetchone() or (1,)
        db.execute("SELECT setseed(0.5)")
        copies = -(-count // each)
        for begin in range(1, copies, AT_ONCE):
            _copy(db, begin, min(begin + AT_ONCE, copies))
        db.execute("CHECKPOINT")


def _copy(db: duckdb.DuckDBPyConnection, begin: int, end: int) -> None:
    """Append the flight with some numbers, in order of time."""
    several = f"FROM range({begin}, {end}) AS many(k)"
    later = f"time_ns + k * {APART_S}000000000"
    normal = f"{NOISE_TICKS} * sqrt(-2 * ln(1 - random())) * cos(2 * pi() * random())"
    db.execute(
        f"INSERT INTO exchanges (time_ns, {COLUMNS}, rx2, {REST}) "
        f"SELECT {later}, {COLUMNS}, (rx2 + {normal}::BIGINT + 4294967296) % 4294967296, {REST} "
        f"{several}, e ORDER BY k, row"
    )
    names = "body, x, y, z, qx, qy, qz, qw"
    db.execute(f"INSERT INTO poses (time_ns, {names}) SELECT {later}, {names} {several}, p ORDER BY k, time_ns, body")


def fitted(path: Path, words: list[str]) -> str:
    """Return time and peak memory of the command as cells, and print what it prints."""
    command = [
        str(Path(sys.executable).parent / "calib"),
        "fit",
        str(path),
        "-o",
        str(path.with_suffix(".json")),
        *words,
    ]
    began = time.monotonic()
    child = subprocess.Popen(command)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        sys.exit(f"calib fit ended with {status}")
    cpu = usage.ru_utime + usage.ru_stime
    return f"{time.monotonic() - began:.0f} s | {cpu:.0f} s | {usage.ru_maxrss / 1e6:.2f} GB"


if __name__ == "__main__":
    main()
