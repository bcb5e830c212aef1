"""What a table of exchanges calls its columns, and in which units: the TOML map of `import csv`.

```toml
bits = 32                  # of the counter that the stamps come from, 32 or 40
protocol = "ss"            # a protocol of uwblink.twr; guessed from the columns where not given
[columns]                  # our name = "their name"
tx1 = "poll_tx_ticks"
[units]
stamps = "ticks"           # or "ns", "s"
time = "s"                 # or "ms", "us", "ns"
[constants]                # columns that the table does not have
from_id = 1
```
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from uwblink.errors import ImportTableError
from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import TICKS_PER_SECOND
from uwblink.toml import TomlReader, is_number
from uwblink.twr import STAMPS

POSITIONS: Final = tuple(f"{end}_{axis}_m" for end in ("from", "to") for axis in "xyz")
LEVELS: Final = ("fpp1", "fpp2", "skew1", "skew2", "gt_range_m")
NAMES: Final = ("time_s", "from_id", "to_id", *STAMPS, *LEVELS, *POSITIONS)

STAMP_UNITS: Final = {"ticks": 1.0, "ns": TICKS_PER_SECOND * 1e-9, "s": float(TICKS_PER_SECOND)}
TIME_UNITS: Final = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
KEYS: Final = ("bits", "protocol", "columns", "units", "constants")


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """How to read a table: names of its columns, units, and values for columns it lacks."""

    bits: int = 32
    protocol: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    stamp_unit: str = "ticks"
    time_unit: str = "s"
    constants: dict[str, float] = field(default_factory=dict)

    def header(self, name: str) -> str:
        """Return what the table calls one of `NAMES`."""
        return self.columns.get(name, name)


def load_map(path: Path) -> ColumnMap:
    """Read a map; raises `ImportTableError` that names the key."""
    file = TomlReader(path, ImportTableError, "map")
    file.known(file.table, KEYS)
    columns, units, constants = (file.section(name) for name in ("columns", "units", "constants"))
    file.known(columns, NAMES, "columns.")
    file.known(constants, NAMES, "constants.")
    file.known(units, ("stamps", "time"), "units.")
    for name, value in columns.items():
        file.check(f"columns.{name}", value, isinstance(value, str), "the name of a column")
    for name, value in constants.items():
        file.check(f"constants.{name}", value, is_number(value), "a finite number")
    return ColumnMap(
        bits=file.choice("bits", file.table.get("bits", 32), (32, 40)),
        protocol=file.choice("protocol", file.table.get("protocol"), (None, *PROTOCOLS)),
        columns=columns,
        stamp_unit=file.choice("units.stamps", units.get("stamps", "ticks"), STAMP_UNITS),
        time_unit=file.choice("units.time", units.get("time", "s"), TIME_UNITS),
        constants={name: float(value) for name, value in constants.items()},
    )
