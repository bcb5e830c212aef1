"""Reads what a calibration says of devices: the documented JSON (docs/architecture.md), by a reader of this package.

Nothing here is shared with what fits calibrations: a twin that carries their results must not carry their mistakes.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from uwblink.arrays import Floats
from uwblink.text_files import read_text
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import Exchanges, delay_weights, raw_range
from uwbsim.errors import ScenarioError
from uwbsim.scenario.radio import Radio, Spline
from uwbsim.units import NS
from uwbsim.world.radio import ALPHA_DBM, lifted, reception_bias_s

CalibrationSource = str | os.PathLike[str] | Mapping[str, Any] | Any
"""A calibration: its file, its JSON as nested tables, or an object that gives its JSON by `to_json`."""

LIFTS: Final = ("mean-of-lifted", "lift-of-mean")
POWER_AT: Final = ("exchange", "reception")
READ: Final = (1, 3)
"""Schema versions; in between is that of groups of tags with curves of their own."""

NO_TWIN: Final = {
    2: "groups: its tags have curves by group, and a scenario has one; fit one curve for all tags",
    4: "pair_offsets: it knows constants of pairs, and a scenario has delays of tags; fit delays",
}
"""Schema versions that no scenario can have, and why."""

LARGEST_DELAY_NS: Final = 1e4


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownDevices:
    """What a calibration knows: delays by tag in nanoseconds, and a bias curve over lifted power, `where` it is from.

    `power_at` says where the curve is taken, "exchange" or "reception"; `lift` how an exchange has one lifted power.
    """

    where: str
    delays_ns: dict[int, float]
    bias: Spline
    power_at: str
    lift: str

    def corrected_m(self, exchanges: Exchanges) -> Floats:
        """Return calibrated ranges in metres, (n,): c (w_i d_i + w_j d_j) for the delays, less the curve.

        Raises `ScenarioError` for tags that the calibration does not know.
        """
        self.require(np.unique([exchanges.initiator, exchanges.target]).tolist())
        weights = delay_weights(exchanges)
        ends = (exchanges.initiator, exchanges.target)
        delay_s = [np.array([self.delays_ns[int(tag)] for tag in tags.tolist()]) * NS for tags in ends]
        flight = sum(weight * delay for weight, delay in zip(weights, delay_s, strict=True))
        return np.asarray(raw_range(exchanges) + SPEED_OF_LIGHT * flight - self.bias_m(exchanges))

    def bias_m(self, exchanges: Exchanges) -> Floats:
        """Return what the curve says of exchanges (n,)."""
        radio, powers = Radio(bias=self.bias), (exchanges.fpp1_dbm, exchanges.fpp2_dbm)
        if self.power_at == "exchange":
            mean = np.mean(powers, axis=0)
            if self.lift == "mean-of-lifted":
                mean = ALPHA_DBM + 10 * np.log10(np.mean([lifted(power) for power in powers], axis=0))
            return reception_bias_s(radio, mean) * SPEED_OF_LIGHT
        return np.asarray(np.mean([reception_bias_s(radio, power) for power in powers], axis=0) * SPEED_OF_LIGHT)

    def require(self, tags: list[int]) -> None:
        """Raise `ScenarioError` where it does not know all of some tags."""
        missing = [tag for tag in tags if tag not in self.delays_ns]
        if missing:
            known = ", ".join(map(str, sorted(self.delays_ns)))
            raise ScenarioError(
                f"{self.where}: no delay for tag {', '.join(map(str, missing))} of the recording; it knows {known}; "
                "fit one from a recording with all tags"
            )


def read_calibration(source: CalibrationSource) -> KnownDevices:
    """Return what a calibration knows of devices; raises `ScenarioError`, one line that names file and key."""
    where = str(source) if isinstance(source, str | os.PathLike) else "calibration"
    table = _table(source, where)
    version = table.get("schema_version")
    if version is None:
        raise ScenarioError(f"{where}: not a calibration (no schema_version)")
    if version in NO_TWIN:
        raise ScenarioError(f"{where}: {NO_TWIN[version]}")
    if version not in READ:
        raise ScenarioError(f"{where}: schema version {version!r}, this uwbcal reads {READ[0]} and {READ[1]}")
    _check_light(table, where)
    return KnownDevices(
        where=where,
        delays_ns=_delays(table, where),
        bias=_curve(table, where, _number(table, "alpha_dbm", where)),
        power_at=_word(table, "power_at", POWER_AT, where, POWER_AT[0]),
        lift=_word(table, "lift", LIFTS, where),
    )


def _table(source: CalibrationSource, where: str) -> Mapping[str, Any]:
    if isinstance(source, Mapping):
        return source
    if hasattr(source, "to_json"):
        return _parsed(str(source.to_json()), where)
    if not isinstance(source, str | os.PathLike):
        raise ScenarioError(f"calibration: found {source!r:.60}, expected a file (.json) or a calibration")
    return _parsed(read_text(source, ScenarioError, "calibration file (.json)"), where)


def _parsed(text: str, where: str) -> Mapping[str, Any]:
    try:
        table = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{where}: not JSON ({error})") from error
    if not isinstance(table, dict):
        raise ScenarioError(f"{where}: not a calibration (no schema_version)")
    return table


def _value(table: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in table:
        raise ScenarioError(f"{where}: {key}: missing")
    return table[key]


def _number(table: Mapping[str, Any], key: str, where: str) -> float:
    value = _value(table, key, where)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ScenarioError(f"{where}: {key}: found {value!r:.60}, expected a finite number")
    return float(value)


def _word(table: Mapping[str, Any], key: str, allowed: tuple[str, ...], where: str, default: str | None = None) -> str:
    value = _value(table, key, where) if default is None else table.get(key, default)
    if value not in allowed:
        raise ScenarioError(f"{where}: {key}: found {value!r:.60}, allowed: {', '.join(allowed)}")
    return str(value)


def _check_light(table: Mapping[str, Any], where: str) -> None:
    speed = _number(table, "speed_of_light", where)
    if abs(speed / SPEED_OF_LIGHT - 1) > 1e-3:
        raise ScenarioError(f"{where}: speed_of_light: found {speed:g}, expected metres a second, {SPEED_OF_LIGHT:.0f}")


def _delays(table: Mapping[str, Any], where: str) -> dict[int, float]:
    found = _value(table, "delays_ns", where)
    if not isinstance(found, dict) or not all(isinstance(k, str) and k.isascii() and k.isdecimal() for k in found):
        raise ScenarioError(f"{where}: delays_ns: found {found!r:.60}, expected a table with tag ids as keys")
    delays = {int(tag): _number(found, tag, f"{where}: delays_ns") for tag in found}
    for tag, delay in delays.items():
        if abs(delay) > LARGEST_DELAY_NS:
            raise ScenarioError(f"{where}: delays_ns: {tag}: found {delay:g}, expected nanoseconds")
    return delays


def _curve(table: Mapping[str, Any], where: str, alpha_dbm: float) -> Spline:
    found = _value(table, "bias_curve", where)
    if not isinstance(found, dict):
        raise ScenarioError(f"{where}: bias_curve: found {found!r:.60}, expected a table")
    inner = {key: _value(found, key, f"{where}: bias_curve") for key in ("knots", "coefficients", "degree")}
    # Power is lifted about another level there: 10^((p - alpha)/10) times a constant is what it is here.
    scale = 10 ** ((alpha_dbm - ALPHA_DBM) / 10)
    try:
        curve = Spline.model_validate(inner, strict=False)
        return curve.model_copy(update={"knots": tuple(knot * scale for knot in curve.knots)})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"][:1]))
        message = str(first["msg"]).removeprefix("Value error, ")
        raise ScenarioError(f"{where}: bias_curve{'.' + key if key else ''}: {message}") from error
