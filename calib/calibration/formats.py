"""Calibrations in other formats: register values, tables, MILUV's JSON, YAML for ROS."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from calib.calibration.c_header import c_header
from calib.calibration.document import finite
from calib.calibration.error_model import ErrorModel
from calib.calibration.model import Calibration, require_calibration
from calib.calibration.power_curves import ALPHA_DBM
from calib.data.sources import antenna_delays_in
from calib.errors import BadInputError
from uwblink.output import write_text
from uwblink.recording.antenna_delays import (
    REGISTER_MAX,
    AntennaDelay,
    AntennaDelays,
    delay_of,
    delays_differ,
    load_antenna_delays,
    text_of_delays,
)
from uwblink.recording.file import Recording
from uwblink.text_files import read_text
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S

TX_SHARE: Final = 0.44
"""The transmitter's share of an aggregate delay; the receiver has the rest (APS014, section 2; the authors' code)."""


def programmed(path: str | os.PathLike[str]) -> AntennaDelays:
    """Return the antenna delays that were programmed into devices, from a recording or a file (.toml).

    Raises what `Recording.open` and `load_antenna_delays` raise.
    """
    if Path(path).suffix == ".toml":
        return load_antenna_delays(Path(path))
    with Recording.open(path) as opened:
        found = antenna_delays_in(opened.meta(), str(path))
    if not found:
        raise BadInputError(f"{path}: does not say what was programmed into its devices")
    return found


def registers(
    calibration: Calibration, base: AntennaDelays | None = None, *, firmware: bool = False
) -> dict[int | None, AntennaDelay]:
    """Return what to program into tags, on top of what was programmed when they were recorded.

    These are the calibration's `antenna_delays`, or `base` (`programmed`) where it has none. The chip adds the
    transmitter's register to transmit stamps and takes the receiver's from receive stamps. A recorded stamp is the
    true one plus d_t = 0.44 d or d_r = -0.56 d, so both registers grow by their share of -d (docs/theory.md). With
    `firmware`, its constant for the stamps of delayed replies is that of the transmitter; without, it stays as it was.
    Raises `BadInputError` for a value that 16 bits do not hold, for delays that the data left free (a device ranges
    with any other, and its register would be right with some of them alone), where the programmed delays are unknown,
    and where calibration and `base` contradict each other.
    """
    free = free_delays(calibration)
    if free:
        raise BadInputError(
            f"the data leave the delay of tag {', '.join(map(str, free))} free, so no register is right; fix one that "
            "is known (`fixed_ns`), or fit ranges between more tags (csv and json say what is known)",
            parameter="to",
        )
    found = _on_top(calibration, base)
    unknown = [tag for tag in calibration.delays_ns if tag not in found]
    if unknown:
        raise BadInputError(
            f"the antenna delays of tag {', '.join(map(str, sorted(unknown)))} that were programmed when the "
            "calibration was fitted are unknown; give the recording that it was fitted to, or a file of antenna delays",
            parameter="base",
        )
    if firmware:
        return {tag: one._replace(reply=one.tx) for tag, one in found.items()}
    return found


def antenna_delays_warning(calibration: Calibration, path: str | os.PathLike[str]) -> str:
    """Return a warning where a recording's tags had other antenna delays programmed than those of a calibration.

    Returns "" where they were the same or are unknown; raises what `Recording.open` raises.
    """
    with Recording.open(path) as opened:
        now, tags = antenna_delays_in(opened.meta(), str(path)), [tag.tag for tag in opened.tags()]
    return delays_differ(calibration.antenna_delays, now, tags)


def free_delays(calibration: Calibration) -> list[int]:
    """Return the tags whose delays the data left free: sums with those of some others may be known, they are not."""
    return [tag for tag, std in sorted(calibration.delays_std_ns.items()) if not math.isfinite(std)]


def _on_top(calibration: Calibration, base: AntennaDelays | None) -> dict[int | None, AntennaDelay]:
    """Return what to program by tag, determined or not; nothing for tags whose programmed delays are unknown.

    The sum of both registers is rounded once: it is what ranges are made of.
    """
    tags = sorted(calibration.delays_ns)
    if base is not None and (differ := delays_differ(calibration.antenna_delays, base, tags)):
        raise BadInputError(differ, parameter="base")
    then, found = {**(base or {}), **calibration.antenna_delays}, dict[int | None, AntennaDelay]()
    for tag in tags:
        before, ticks = delay_of(then, tag), round(-calibration.delays_ns[tag] * 1e-9 / TICK_S)
        if before is None:
            continue
        tx = round(TX_SHARE * ticks)
        found[tag] = AntennaDelay(before.tx + tx, before.rx + ticks - tx, before.reply)
        if not all(0 <= value <= REGISTER_MAX for value in found[tag]):
            raise BadInputError(
                f"tag {tag}: its registers would be {found[tag]}, which 16 bits do not hold; give the recording that "
                "the calibration was fitted to",
                parameter="base",
            )
    return found


REGISTERS_HEAD: Final = """\
# Antenna delays to program, in ticks of 15.65 ps: the transmitter's register, the receiver's, and the firmware's
# constant for the stamps of delayed replies (TX_ANT_DLY). `uwblink record --antenna-delays` takes this file.
"""


def _csv(calibration: Calibration) -> str:
    rows = [
        f"{tag},{delay!r},{calibration.delays_std_ns.get(tag, '')!s}"
        for tag, delay in sorted(calibration.delays_ns.items())
    ]
    return "\n".join(["tag,delay_ns,delay_std_ns", *rows]) + "\n"


def _miluv(calibration: Calibration) -> str:
    original = calibration.provenance.get("miluv")
    document = dict(original) if isinstance(original, dict) else {}
    document["delays_ns"] = {str(t): d for t, d in sorted(calibration.delays_ns.items())}
    for key, curve in zip(CURVES_OF_MILUV, (calibration.bias_curve, calibration.sigma_curve), strict=True):
        document[key] = {"knots": list(curve.knots), "coeffs": list(curve.coefficients), "degree": curve.degree}
    document.setdefault("tx_rx_split", {"tx": TX_SHARE, "rx": round(1 - TX_SHARE, 2)})
    document.setdefault("c_mps", SPEED_OF_LIGHT)
    return json.dumps(document, indent=1) + "\n"


def _ros_yaml(calibration: Calibration, base: AntennaDelays | None) -> str:
    to_program = _on_top(calibration, base)
    tags: dict[str, Any] = {}
    for tag, delay in sorted(calibration.delays_ns.items()):
        tags[str(tag)] = {"delay_ns": delay}
        if tag in to_program:
            registers = {"tx_antenna_delay": to_program[tag].tx, "rx_antenna_delay": to_program[tag].rx}
            tags[str(tag)] |= registers
    document: dict[str, Any] = {
        "alpha_dbm": calibration.alpha_dbm,
        "lift": calibration.lift,
        "power_at": calibration.power_at,
        "tags": tags,
        "bias_curve": asdict(calibration.bias_curve),
        "sigma_curve": asdict(calibration.sigma_curve),
    }
    if calibration.errors:
        document["errors"] = _error_tables(calibration.errors)
    text: str = yaml.safe_dump({"uwb_calibration": document}, sort_keys=False, default_flow_style=None, width=math.inf)
    return text


def _error_tables(model: ErrorModel) -> dict[str, Any]:
    """Return the error model by pair and lifted power, as tables for interpolation."""
    lifted, pairs = np.array(model.lifted), {}
    for name in [*model.pairs, "other"]:
        ends = [0, 0] if name == "other" else [int(end) for end in name.split("-")]
        first, second = (np.full(len(lifted), end) for end in ends)
        shapes = model.shapes(lifted, first, second)
        low, high = model.quantiles((0.025, 0.975), lifted, first, second).T
        rows = {
            "sigma_total_m": model.total_m(shapes),
            "mean_error_m": model.mean_m(shapes),
            "tail_share": shapes.tail_share,
            "low95_m": low,
            "high95_m": high,
        }
        pairs[name] = {key: row.tolist() for key, row in rows.items()}
    return {"lifted": list(model.lifted), "pairs": pairs}


FORMATS: Final[dict[str, Callable[[Calibration, AntennaDelays | None], str]]] = {
    "registers": lambda calibration, base: REGISTERS_HEAD + text_of_delays(registers(calibration, base)),
    "firmware": lambda calibration, base: REGISTERS_HEAD + text_of_delays(registers(calibration, base, firmware=True)),
    "json": lambda calibration, _: calibration.to_json(),
    "csv": lambda calibration, _: _csv(calibration),
    "miluv": lambda calibration, _: _miluv(calibration),
    "ros-yaml": lambda calibration, base: _ros_yaml(calibration, base),
    "c-header": lambda calibration, _: c_header(calibration),
}
"""Functions from a calibration and programmed delays to text, by format."""

ONE_CURVE: Final = ("miluv", "ros-yaml", "c-header")
"""Formats that have one curve for all tags."""


def export(
    calibration: Calibration,
    to: str,
    path: str | os.PathLike[str] | None = None,
    *,
    base: AntennaDelays | None = None,
    force: bool = False,
) -> str:
    """Return a calibration as text in another form, and write it to `path` where one is given.

    `to` is "registers" (values for the DW1000's antenna-delay registers, as TOML), "firmware" (those, and the constants
    of its build), "json", "csv" (delays), "miluv", "ros-yaml" or "c-header" (tables and a function that corrects a
    range). Registers are on top of what was programmed when the devices were recorded: the calibration's
    `antenna_delays`, or `base` (`programmed`). Raises `BadInputError` for another form, for a calibration with groups
    of tags in a form that has one curve, and for registers of tags whose delays the data left free.

    >>> import calib
    >>> print(calib.export(calib.fit(calib.sample_flight()).calibration, "registers").splitlines()[2])
    [antenna_delays.tags.1]
    """
    require_calibration(calibration)
    if to not in FORMATS:
        raise BadInputError(f"found {to!r}, allowed: {', '.join(FORMATS)}", parameter="to")
    if calibration.pair_offsets and to != "json":
        raise BadInputError(f"{to} has no place for constants of pairs; export it as json", parameter="to")
    if calibration.groups and to in ONE_CURVE:
        raise BadInputError(
            f"{to} has one curve for all tags, this calibration one for each of the groups "
            f"{', '.join(calibration.groups)}; export it as json",
            parameter="to",
        )
    text = FORMATS[to](calibration, base)
    if path is not None:
        write_text(Path(path), text, force=force)
    return text


CURVES_OF_MILUV: Final = ("bias_spline_m", "std_spline_m")


def read_miluv(path: Path) -> Calibration:
    """Read the JSON form of MILUV's published calibration; raises `BadInputError`.

    Its bias curve is meant for each reception (`power_at="reception"`), ours for the mean of an exchange's lifted
    powers, and its delays are on top of 16436 in both registers, as the boards had them. What has no place here is
    kept, so that exporting gives it back.
    """
    text = read_text(path, BadInputError, "calibration of MILUV (.json)")
    try:
        table = json.loads(text, parse_float=finite, parse_constant=finite)
        bias, sigma = (_curve_table(table[key]) for key in CURVES_OF_MILUV)
        document = {
            "schema_version": 3,
            "delays_ns": table["delays_ns"],
            "delays_std_ns": {},
            "loss": "cauchy",
            "scale_ns": 0.1,
            "lift": "mean-of-lifted",
            "alpha_dbm": ALPHA_DBM,
            "speed_of_light": table.get("c_mps", SPEED_OF_LIGHT),
            "bias_curve": bias,
            "sigma_curve": sigma,
            "power_at": "reception",
            "antenna_delays": {tag: AntennaDelay()._asdict() for tag in table["delays_ns"]},
            "provenance": {
                "imported_from": path.name,
                "miluv": table | dict.fromkeys(("delays_ns", *CURVES_OF_MILUV)),
            },
        }
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise BadInputError(f"{path}: not a MILUV calibration ({type(error).__name__}: {error!s:.200})") from error
    return Calibration.from_json(json.dumps(document), str(path))


def _curve_table(spline: dict[str, Any]) -> dict[str, Any]:
    knots = spline["knots"]
    return {
        "knots": knots,
        "coefficients": spline["coeffs"],
        "degree": spline["degree"],
        "range": [knots[0], knots[-1]],
    }
