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

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from uwblink.errors import ImportTableError
from uwblink.ticks import TICKS_PER_SECOND
from uwblink.twr import PROTOCOLS, STAMPS

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
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ImportTableError(f"{path}: no such map file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ImportTableError(f"{path}: cannot be read as a map (.toml)") from error
    except tomllib.TOMLDecodeError as error:
        raise ImportTableError(f"{path}: not valid TOML: {error}") from error
    _known(path, "", table, KEYS)
    sections = {name: table.get(name, {}) for name in ("columns", "units", "constants")}
    for name, section in sections.items():
        if not isinstance(section, dict):
            raise ImportTableError(f"{path}: {name}: found {section!r}, expected a table")
    _known(path, "columns.", sections["columns"], NAMES)
    _known(path, "constants.", sections["constants"], NAMES)
    _known(path, "units.", sections["units"], ("stamps", "time"))
    for name, value in sections["columns"].items():
        _check(path, f"columns.{name}", value, isinstance(value, str), "the name of a column")
    for name, value in sections["constants"].items():
        _check(path, f"constants.{name}", value, _is_number(value), "a finite number")
    return ColumnMap(
        bits=_choice(path, "bits", table.get("bits", 32), (32, 40)),
        protocol=_choice(path, "protocol", table.get("protocol"), (None, *PROTOCOLS)),
        columns=sections["columns"],
        stamp_unit=_choice(path, "units.stamps", sections["units"].get("stamps", "ticks"), STAMP_UNITS),
        time_unit=_choice(path, "units.time", sections["units"].get("time", "s"), TIME_UNITS),
        constants={name: float(value) for name, value in sections["constants"].items()},
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _check(path: Path, key: str, value: Any, good: bool, expected: str) -> None:
    if not good:
        raise ImportTableError(f"{path}: {key}: found {value!r}, expected {expected}")


def _known(path: Path, prefix: str, table: dict[str, Any], names: tuple[str, ...]) -> None:
    for key in table:
        if key not in names:
            raise ImportTableError(f"{path}: {prefix}{key}: unknown key; known are {', '.join(names)}")


def _choice(path: Path, key: str, value: Any, allowed: Any) -> Any:
    if isinstance(value, bool | list | dict) or value not in allowed:
        names = ", ".join(str(a) for a in allowed if a is not None)
        raise ImportTableError(f"{path}: {key}: found {value!r}, allowed: {names}")
    return value
