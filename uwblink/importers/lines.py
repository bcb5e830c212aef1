"""Lines that boards print: the templates that `uwblink import guess` tries, and that a map can name.

The forms are those of public firmware: the shell of the DWM1001 (`les`, `lec`), AT commands of ESP32 modules, examples
of the Arduino library for the DW1000, and the reports of EVK1000 and TREK1000 (hexadecimal millimetres, a bit of the
mask for each range).
"""

from __future__ import annotations

from typing import Any, Final

_AT: Final = "AT+RANGE=tid:{from_id},mask:{mask:hex},seq:{_},range:({r[8]}){*}"
_REPORT: Final = " {mask:hex} {r0:hex} {r1:hex} {r2:hex} {r3:hex} {_} {_} {_} {_}{from_id:int}:"


def _line(line: str, distance: str, each: str | None = None, **wide: str) -> dict[str, Any]:
    """Return the keys of a map."""
    found = {"line": line, "each": each, "wide": wide, "units": {"distance": distance}}
    return {key: value for key, value in found.items() if value}


LINES: Final = {
    "dwm1001-lec": _line("DIST,{_},AN{_},", "m", "AN{_},{to_id},{_},{_},{_},{range_m}"),
    "dwm1001-les": _line("{_}[{_},{_},{_}]={_}", "m", "{to_id}[{_},{_},{_}]={range_m}"),
    "at-range-ids": _line(_AT + "ancid:({a[8]})", "cm", range_m="r.{_}", to_id="a.{_}"),
    "at-range-power": _line(_AT + "rssi:({p[8]})", "cm", range_m="r.{to_id}", rxp2="p.{to_id}"),
    "at-range": _line(_AT, "cm", range_m="r.{to_id}"),
    "arduino": _line("from: {to_id} Range: {range_m} m RX power: {rxp2} dBm", "m"),
    "trek-corrected": _line(f"mc{_REPORT}", "mm", range_m="r{to_id}"),
    "trek-raw": _line(f"mr{_REPORT}", "mm", range_m="r{to_id}"),
}
"""Keys of a map by the name of a form; the first that matches is taken, so longer ones come first."""
