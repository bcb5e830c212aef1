"""Facts about devices for importers: chips (powers from registers, clock offsets, limits), and printed lines.

DW1000: User Manual 2.18, section 4.7.1 for the first path, 10 log10((F1^2 + F2^2 + F3^2) / N^2) - A, and 4.7.2 for the
total, 10 log10(C 2^17 / N^2) - A, with A = 113.77 dB or 121.74 dB at a pulse repetition frequency of 16 or 64 MHz.
DW3000: User Manual, section 4.7: 6 D dB are added for the decision D of the digital gain control, amplitudes have two
fractional bits, C is multiplied by 2^21, and A = 113.8 dB or 121.7 dB. These were taken from the vendor's driver, whose
comments refer to the manual; 2^21 holds for the DW3000, 2^17 for later chips of the family. No board with a DW3000 was
tried. The vendor's examples contradict each other on the sign of its clock offset: it is positive for a faster clock of
the receiver in the example of crystal trimming ("offset"), for a slower one in the example of single-sided ranging
("-offset"). Both chips count ticks of 15.65 ps with 40 bits.

Lines are templates that `uwblink import guess` tries, and that a map can name. The forms are from public firmware: the
shell of the DWM1001 (`les`, `lec`), AT commands of ESP32 modules, examples of the Arduino library for the DW1000, and
the reports of EVK1000 and TREK1000 (hexadecimal millimetres, a bit of the mask for each range).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import log10
from typing import Any, Final


@dataclass(frozen=True, slots=True)
class Chip:
    """A chip: formula of its powers, its clock offsets in ppm per unit, and the powers that it reports."""

    offset_db: Mapping[int, float]
    """A, by pulse repetition frequency in MHz; none for chips whose registers are not known."""
    skew_ppm: Mapping[str, float]
    """Clock skew, positive if the receiver's clock is faster, by the unit of `units.skew`."""
    fraction: float = 1.0
    """Amplitude of the first path per count of its registers."""
    cir_bits: int = 17
    """The power of the impulse response is in units of 2^`cir_bits`."""
    gain_db: float = 0.0
    """Power for each step of the gain register."""
    power_dbm: tuple[float, float] = (-150.0, 0.0)
    """Limits of received powers; transmitted power is at most -41.3 dBm/MHz by law, -14 dBm in 500 MHz."""


_PPM: Final = {"ppm": 1.0, "-ppm": -1.0}
_CHANNELS: Final = {
    # Carrier offset per unit of the carrier integrator at 850 kb/s and 6.8 Mb/s, by the vendor's driver; positive if
    # the receiver's clock is faster.
    f"integrator-{n}": 998.4e6 / 2 / 1024 / 131072 * 1e6 / hz
    for n, hz in ((2, 3993.6e6), (5, 6489.6e6), (9, 7987.2e6))
}

CHIPS: Final = {
    # The data sheets give sensitivities down to -106 dBm.
    "dw1000": Chip({16: 113.77, 64: 121.74}, _PPM | _CHANNELS, power_dbm=(-125.0, -40.0)),
    "dw3000": Chip(
        {16: 113.8, 64: 121.7},
        _PPM | _CHANNELS | {"offset": 1e6 / 2**26, "-offset": -1e6 / 2**26},
        0.25,
        21,
        6.0,
        power_dbm=(-125.0, -40.0),
    ),
    "other": Chip({}, _PPM),
}

REGISTERS: Final = ("f1", "f2", "f3", "n", "c", "d")
"""Registers for powers: amplitudes of the first path, preamble count, power of the impulse response, gain decision."""


def power_sql(chip: Chip, prf_mhz: int, cells: Mapping[str, str]) -> str:
    """Return SQL of a power in dBm from SQL of registers: first-path power if `f1` is given, else total power (`c`)."""
    if "f1" in cells:
        energy = " + ".join(f"pow({cells[name]} * {chip.fraction!r}, 2)" for name in ("f1", "f2", "f3"))
        offset = 0.0
    else:
        energy, offset = cells["c"], 10 * log10(2) * chip.cir_bits
    level = f"10 * log10(nullif({energy}, 0) / nullif(pow({cells['n']}, 2), 0)) + {offset - chip.offset_db[prf_mhz]!r}"
    return f"{level} + {chip.gain_db!r} * {cells['d']}" if "d" in cells else level


_AT: Final = "AT+RANGE=tid:{from_id},mask:{mask:hex},seq:{_},range:({r[8]}){*}"
_REPORT: Final = " {mask:hex} {r0:hex} {r1:hex} {r2:hex} {r3:hex} {_} {_} {_} {_}{from_id:int}:"


LINES: Final[dict[str, dict[str, Any]]] = {
    "dwm1001-lec": {
        "line": "DIST,{_},AN{_},",
        "each": "AN{_},{to_id},{_},{_},{_},{range_m}",
        "units": {"distance": "m"},
    },
    "dwm1001-les": {
        "line": "{_}[{_},{_},{_}]={_}",
        "each": "{to_id}[{_},{_},{_}]={range_m}",
        "units": {"distance": "m"},
    },
    "at-range-ids": {
        "line": _AT + "ancid:({a[8]})",
        "wide": {"range_m": "r.{_}", "to_id": "a.{_}"},
        "units": {"distance": "cm"},
    },
    "at-range-power": {
        "line": _AT + "rssi:({p[8]})",
        "wide": {"range_m": "r.{to_id}", "rxp2": "p.{to_id}"},
        "units": {"distance": "cm"},
    },
    "at-range": {"line": _AT, "wide": {"range_m": "r.{to_id}"}, "units": {"distance": "cm"}},
    "arduino": {"line": "from: {to_id} Range: {range_m} m RX power: {rxp2} dBm", "units": {"distance": "m"}},
    "trek-corrected": {"line": f"mc{_REPORT}", "wide": {"range_m": "r{to_id}"}, "units": {"distance": "mm"}},
    "trek-raw": {"line": f"mr{_REPORT}", "wide": {"range_m": "r{to_id}"}, "units": {"distance": "mm"}},
}
"""Fields of `ColumnMap` by the name of a form; the first match is used, so longer forms are first."""
