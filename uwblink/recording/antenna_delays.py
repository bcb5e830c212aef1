"""Antenna delays that are programmed into devices: TOML files, entries in the `meta` of recordings, comparisons.

```toml
[antenna_delays]           # of all devices without a table of their own
tx = 16436                 # register of the transmitter, in ticks of 15.65 ps
rx = 16436                 # register of the receiver
reply = 16436              # added by the firmware to the time at which it schedules a reply

[antenna_delays.tags.7]    # of one device
tx = 16446
rx = 16449
reply = 16446
```

The chip adds `tx` to stamps of transmission and subtracts `rx` from stamps of reception. A delayed reply contains its
own stamp of transmission, which the firmware computes with a constant of its build (`TX_ANT_DLY`) instead of the
register. If the two differ, the stamps of a device have two different transmit delays.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from uwblink.display import first_few
from uwblink.errors import PlanError, raising
from uwblink.text_files import FileKey, TomlReader, is_number
from uwblink.ticks import ANTENNA_DELAY_TICKS, SPEED_OF_LIGHT, TICK_S
from uwblink.twr import LARGEST_ID

REGISTER_MAX: Final = 65_535
"""Largest antenna delay: registers have 16 bits (DW1000 User Manual 2.10, sections 7.2.25 and 7.2.40.4)."""

ALL: Final = "configured_antenna_delay_ticks"
BY_TAG: Final = "configured_antenna_delay_ticks_by_tag"
"""Keys of a recording's `meta`."""

ANTENNA_DELAY_KEYS: Final = tuple(
    FileKey(f"antenna_delays.{place}{name}", "whole number, ticks", default, meaning.format(whose))
    for place, default, whose in (("", "none", "devices not named"), ("tags.ID.", "as all", "one device"))
    for name, meaning in (
        ("tx", "Transmit antenna delay register of {}."),
        ("rx", "Receive antenna delay register of {}."),
        (
            "reply",
            "Constant that the firmware of {} adds to the stamps of its delayed replies; 16436, or the value of tx.",
        ),
    )
)


class AntennaDelay(NamedTuple):
    """Antenna delays of one device in ticks: both registers, and the firmware's constant for replies."""

    tx: int = ANTENNA_DELAY_TICKS
    rx: int = ANTENNA_DELAY_TICKS
    reply: int = ANTENNA_DELAY_TICKS

    def __str__(self) -> str:
        """Return both registers, and the constant for replies if it differs from the transmitter's register."""
        return f"{self.tx}/{self.rx}" + (f", replies {self.reply}" if self.reply != self.tx else "")


AntennaDelays = Mapping[int | None, AntennaDelay]
"""Delays by device; those of the key None apply to all other devices."""


def delay_of(delays: AntennaDelays, tag: int) -> AntennaDelay | None:
    """Return the delays of a device, None if unknown."""
    return delays.get(tag, delays.get(None))


def known_delays(delays: AntennaDelays, tags: Iterable[int]) -> AntennaDelays:
    """Return the known delays of some devices by id."""
    return {tag: delay for tag in tags if (delay := delay_of(delays, tag)) is not None}


def delays_in_meta(meta: Mapping[str, Any]) -> AntennaDelays:
    """Return the delays in the `meta` of a recording, empty if it has none; raises `ValueError` for a wrong form.

    The default of the constant for replies is the transmitter's register.
    """
    rows: dict[int | None, Any] = {None: meta[ALL]} if ALL in meta else {}
    wrong = f"has no usable antenna delays of its devices in {ALL}"
    with raising(ValueError, wrong, KeyError, TypeError, ValueError, AttributeError):
        rows |= {int(tag): row for tag, row in meta.get(BY_TAG, {}).items()}
        return {
            tag: AntennaDelay(int(row["tx"]), int(row["rx"]), int(row.get("reply", row["tx"])))
            for tag, row in rows.items()
        }


def meta_of_delays(delays: AntennaDelays) -> dict[str, Any]:
    """Return delays as entries for the `meta` of a recording."""
    rows = {tag: one._asdict() for tag, one in delays.items()}
    for row in rows.values():
        if row["reply"] == row["tx"]:
            del row["reply"]
    every = {ALL: rows.pop(None)} if None in rows else {}
    return every | ({BY_TAG: {str(tag): row for tag, row in rows.items()}} if rows else {})


def read_antenna_delays(
    file: TomlReader, ticks_per_unit: Mapping[str, float] | None = None
) -> dict[int | None, AntennaDelay]:
    """Return the section `[antenna_delays]` of a file, empty if it has none; raises the error of the file with the key.

    `reply` is required for devices whose transmit register is not 16436, because the firmware's constant does not
    follow from the registers. With `ticks_per_unit` the section describes devices of another maker: it has only `tx`
    and `rx`, 0 by default, and a `unit`, one of these names.
    """
    section, scale = file.section("antenna_delays"), None
    tags = section.pop("tags", {})
    if ticks_per_unit is not None:
        scale = ticks_per_unit[file.choice("antenna_delays.unit", section.pop("unit", "ticks"), ticks_per_unit)]
    file.check("antenna_delays.tags", tags, isinstance(tags, dict), "a table for each device")
    found: dict[int | None, AntennaDelay] = {}
    if section:
        found[None] = _delay(file, "antenna_delays", section, {}, scale)
    for name, row in tags.items():
        where = f"antenna_delays.tags.{name}"
        named = name.isascii() and name.isdecimal() and int(name) <= LARGEST_ID
        file.check(where, row, named and isinstance(row, dict), "a table with tx, rx and reply, named by an id")
        found[int(name)] = _delay(file, where, row, section, scale)
    return found


def _delay(
    file: TomlReader, where: str, row: Mapping[str, Any], every: Mapping[str, Any], scale: float | None
) -> AntennaDelay:
    names = AntennaDelay._fields if scale is None else ("tx", "rx")
    file.known(dict(row), names, f"{where}.")
    given = {**({} if scale is None else {"tx": 0, "rx": 0}), **every, **row}
    if given.get("tx") == ANTENNA_DELAY_TICKS:
        given.setdefault("reply", ANTENNA_DELAY_TICKS)
    found = {}
    for name in names:
        value: Any = given.get(name)
        good = is_number(value) and 0 <= value * (scale or 1) <= REGISTER_MAX and (scale or isinstance(value, int))
        why = f" ({ANTENNA_DELAY_TICKS} where only registers were programmed)" if name == "reply" else ""
        file.check(f"{where}.{name}", value, bool(good), f"a whole number of ticks, 0 to {REGISTER_MAX}{why}")
        found[name] = round(value * (scale or 1))
    return AntennaDelay(found["tx"], found["rx"], found.get("reply", found["tx"]))


def load_antenna_delays(path: Path) -> dict[int | None, AntennaDelay]:
    """Read a file of antenna delays, such as that of `calib export --to registers`; raises `PlanError`."""
    file = TomlReader(path, PlanError, "file of antenna delays (.toml)")
    file.known(file.table, ("antenna_delays",))
    found = read_antenna_delays(file)
    if not found:
        raise PlanError(f"{path}: contains no [antenna_delays]; `calib export` writes such a file, for registers")
    return found


def text_of_delays(delays: AntennaDelays) -> str:
    """Return the text of a file of antenna delays (.toml)."""
    rows = [
        f"[antenna_delays{'' if tag is None else f'.tags.{tag}'}]\ntx = {one.tx}\nrx = {one.rx}\nreply = {one.reply}\n"
        for tag, one in delays.items()
    ]
    return "\n".join(rows)


def delays_differ(then: AntennaDelays, now: AntennaDelays, tags: Iterable[int]) -> str:
    """Return a text on differences between known delays `then` and `now` of some tags; "" for none.

    A range contains half of the sum of a tag's registers, so a change of the sum causes half of its error in ranges.
    The division of the sum between the two registers has no effect.
    """
    longer_m: dict[str, float] = {}
    for tag in sorted(tags):
        old, new = delay_of(then, tag), delay_of(now, tag)
        if old is not None and new is not None:
            longer = new.tx + new.rx - old.tx - old.rx
            if longer or new.reply - new.tx != old.reply - old.tx:
                longer_m[f"tag {tag}: {old} then, {new} now"] = abs(longer) / 2 * TICK_S * SPEED_OF_LIGHT
    if not longer_m:
        return ""
    return (
        "it was fitted with other programmed antenna delays than those of these ranges, which causes errors of up to "
        f"{100 * max(longer_m.values()):.1f} cm for each tag ({first_few(longer_m, 3)}); fit again"
    )
