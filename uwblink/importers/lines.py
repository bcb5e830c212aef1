"""Lines that boards print: the templates that `uwblink import guess` tries, and that a map can name.

The forms are those of public firmware: the shell of the DWM1001 (`les`, `lec`), AT commands of ESP32 modules, examples
of the Arduino library for the DW1000, and the reports of EVK1000 and TREK1000 (hexadecimal millimetres, a bit of the
mask for each range).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final


@dataclass(frozen=True, slots=True)
class Line:
    """A form of lines, as the keys of a map: `line`, `each` and tables of it."""

    line: str
    each: str | None = None
    wide: Mapping[str, str] = field(default_factory=dict)
    distance: str = "m"
    note: str = ""

    def entries(self) -> dict[str, Any]:
        """Return the keys of a map."""
        found = {"line": self.line, "each": self.each, "wide": dict(self.wide), "units": {"distance": self.distance}}
        return {key: value for key, value in found.items() if value}


_AT: Final = "AT+RANGE=tid:{from_id},mask:{mask:hex},seq:{_},range:({r[8]}){*}"
_REPORT: Final = " {mask:hex} {r0:hex} {r1:hex} {r2:hex} {r3:hex} {_} {_} {_} {_}{from_id:int}:"

LINES: Final = {
    "dwm1001-lec": Line("DIST,{_},AN{_},", "AN{_},{to_id},{_},{_},{_},{range_m}", note="DWM1001's lec"),
    "dwm1001-les": Line("{_}[{_},{_},{_}]={_}", "{to_id}[{_},{_},{_}]={range_m}", note="DWM1001's les"),
    "at-range-ids": Line(
        _AT + "ancid:({a[8]})", None, {"range_m": "r.{_}", "to_id": "a.{_}"}, "cm", "AT+RANGE with ids of anchors"
    ),
    "at-range-power": Line(
        _AT + "rssi:({p[8]})", None, {"range_m": "r.{to_id}", "rxp2": "p.{to_id}"}, "cm", "AT+RANGE with powers"
    ),
    "at-range": Line(_AT, None, {"range_m": "r.{to_id}"}, "cm", "AT+RANGE"),
    "arduino": Line("from: {to_id} Range: {range_m} m RX power: {rxp2} dBm", note="Arduino library for the DW1000"),
    "trek-corrected": Line(f"mc{_REPORT}", None, {"range_m": "r{to_id}"}, "mm", "TREK1000, corrected ranges"),
    "trek-raw": Line(f"mr{_REPORT}", None, {"range_m": "r{to_id}"}, "mm", "TREK1000, raw ranges"),
}
"""Templates by name; the first that matches is taken, so longer ones come first."""
