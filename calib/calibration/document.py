"""The JSON of a calibration, both ways: `calib.calibration.file_keys` says what each key is."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection
from dataclasses import asdict
from typing import Any, Final

from calib.calibration.content import CalibrationContent
from calib.calibration.error_model import read_errors
from calib.calibration.json_format import DELAY_NS, LIGHT, POWER_DBM, REGISTER, STD_NS, Reader, is_tag
from calib.calibration.pair_offsets import offsets_from, table_of
from calib.calibration.parts import TagGroup, Uncertainty
from calib.calibration.power_curves import LIFTS, Curve
from calib.errors import BadInputError
from uwblink.recording.antenna_delays import AntennaDelay

SCHEMA_VERSION: Final = 1
GROUPED_VERSION: Final = 2
"""A calibration with groups of tags says so by its version: whoever knows only one curve must not read it."""

RECEPTION_VERSION: Final = 3
"""And one whose curve is meant for each reception: whoever takes it at the mean power is wrong by up to a decimetre."""

PAIRS_VERSION: Final = 4
"""And one with constants of pairs."""

VERSIONS: Final = (SCHEMA_VERSION, GROUPED_VERSION, RECEPTION_VERSION, PAIRS_VERSION)
POWER_AT: Final = ("exchange", "reception")


def text_of(calibration: CalibrationContent) -> str:
    """Return a calibration as JSON text."""
    document: dict[str, Any] = {
        "schema_version": _version(calibration),
        "delays_ns": {str(t): d for t, d in sorted(calibration.delays_ns.items())},
        "delays_std_ns": {str(t): d if STD_NS.hold(d) else None for t, d in sorted(calibration.delays_std_ns.items())},
        "loss": calibration.loss,
        "scale_ns": calibration.scale_ns,
        "lift": calibration.lift,
        "alpha_dbm": calibration.alpha_dbm,
        "speed_of_light": calibration.speed_of_light,
        "bias_curve": _curve_table(calibration.bias_curve),
        "sigma_curve": _curve_table(calibration.sigma_curve),
        "provenance": calibration.provenance,
        **_what_not_all_have(calibration),
    }
    return _rows_on_lines(json.dumps(document, indent=1, allow_nan=False)) + "\n"


def _what_not_all_have(calibration: CalibrationContent) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if calibration.power_at != "exchange":
        found["power_at"] = calibration.power_at
    if calibration.groups:
        found["groups"] = {name: _group_table(group) for name, group in calibration.groups.items()}
    if calibration.errors:
        found["errors"] = calibration.errors.to_dict()
    if calibration.pair_offsets:
        found["pair_offsets"] = table_of(calibration.pair_offsets)
    if calibration.antenna_delays:
        found["antenna_delays"] = {
            str(tag): one._asdict() for tag, one in sorted(calibration.antenna_delays.items(), key=str)
        }
    if calibration.uncertainty:
        found["uncertainty"] = asdict(calibration.uncertainty)
    return found


def _version(calibration: CalibrationContent) -> int:
    if calibration.pair_offsets:
        return PAIRS_VERSION
    if calibration.power_at != "exchange":
        return RECEPTION_VERSION
    return GROUPED_VERSION if calibration.groups else SCHEMA_VERSION


def _curve_table(curve: Curve) -> dict[str, Any]:
    return {
        "knots": list(curve.knots),
        "coefficients": list(curve.coefficients),
        "degree": curve.degree,
        "range": list(curve.range),
    }


def _group_table(group: TagGroup) -> dict[str, Any]:
    return {
        "tags": list(group.tags),
        "bias_curve": _curve_table(group.bias_curve),
        "sigma_curve": _curve_table(group.sigma_curve),
    }


def _rows_on_lines(text: str) -> str:
    """Put lists of numbers on one line each: a matrix reads as rows."""
    return re.sub(
        r"\[[-+.e\d,\s]+\]", lambda found: " ".join(found[0].split()).replace("[ ", "[").replace(" ]", "]"), text
    )


def fields_of(text: str, where: str) -> dict[str, Any]:
    """Return what a `Calibration` is made of, by its fields; raises `BadInputError` that says `where`, and the key."""
    read = _reader(text, where)
    return {
        "lift": _one_of(read, "lift", LIFTS, where),
        "power_at": _one_of(read, "power_at", POWER_AT, where) if read.has("power_at") else "exchange",
        "delays_ns": read.delays("delays_ns", DELAY_NS),
        "delays_std_ns": read.delays("delays_std_ns", STD_NS, missing=math.inf),
        "loss": read.word("loss"),
        "scale_ns": read.number("scale_ns", STD_NS),
        "alpha_dbm": read.number("alpha_dbm", POWER_DBM),
        "speed_of_light": read.number("speed_of_light", LIGHT),
        "bias_curve": read.curve("bias_curve"),
        "sigma_curve": read.curve("sigma_curve", positive=True),
        "provenance": read.table("provenance"),
        "uncertainty": _uncertainty(read),
        "groups": _groups(read),
        "errors": read_errors(read.inside("errors")) if read.has("errors") else None,
        "antenna_delays": _antenna_delays(read) if read.has("antenna_delays") else {},
        "pair_offsets": offsets_from(read) if read.has("pair_offsets") else {},
    }


def _reader(text: str, where: str) -> Reader:
    try:
        table = json.loads(text, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{where}: not JSON ({error})") from error
    if not isinstance(table, dict) or "schema_version" not in table:
        raise BadInputError(f"{where}: not a calibration (no schema_version)")
    if table["schema_version"] not in VERSIONS:
        raise BadInputError(
            f"{where}: schema version {table['schema_version']!r}, this uwbcal reads "
            f"{', '.join(map(str, VERSIONS[:-1]))} and {VERSIONS[-1]}"
        )
    return Reader(table, where)


def _finite(text: str) -> float:
    """Return a number of JSON; raises `ValueError` for one that is none, which nothing could write again."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value


def _one_of(read: Reader, key: str, allowed: Collection[str], where: str) -> str:
    found = read.word(key)
    if found not in allowed:
        raise BadInputError(f"{where}: {key}: found {found!r}, allowed: {', '.join(allowed)}")
    return found


def _uncertainty(read: Reader) -> Uncertainty | None:
    if not read.has("uncertainty"):
        return None
    inner = read.inside("uncertainty")
    tags = tuple(int(tag) for tag in inner.numbers("tags", least=0))
    bias, sigma = (len(read.curve(name).coefficients) for name in ("bias_curve", "sigma_curve"))
    return Uncertainty(
        tags,
        inner.matrix("delays_ns2", len(tags)),
        inner.matrix("bias_m2", bias),
        inner.matrix("sigma_m2", sigma),
    )


def _antenna_delays(read: Reader) -> dict[int | None, AntennaDelay]:
    every, found = read.inside("antenna_delays"), dict[int | None, AntennaDelay]()
    for name in read.table("antenna_delays"):
        if not is_tag(name):
            raise read.wrong("antenna_delays", "tag ids as keys")
        inner = every.inside(name)
        found[int(name)] = AntennaDelay(*(int(inner.number(key, REGISTER)) for key in AntennaDelay._fields))
    return found


def _groups(read: Reader) -> dict[str, TagGroup]:
    if not read.has("groups"):
        return {}
    every, found = read.inside("groups"), {}
    for name in read.table("groups"):
        inner = every.inside(name)
        tags = tuple(int(tag) for tag in inner.numbers("tags"))
        found[name] = TagGroup(tags, inner.curve("bias_curve"), inner.curve("sigma_curve", positive=True))
    return found
