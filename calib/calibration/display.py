"""A calibration on one screen: a table of delays and of the curves, as text and as HTML."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import Final

import numpy as np

from calib.calibration.content import CalibrationContent
from calib.calibration.pair_offsets import named
from calib.calibration.parts import TagGroup
from calib.spread import TWO_SIDED_95

MOST_TAGS: Final = 40
"""Tags that are listed; of more, the first are."""

HEAD: Final = ("tag", "delay (ns)", "95 % interval")
PAIRS_HEAD: Final = ("pair", "constant (cm)", "95 % interval")
POINTS: Final = 6
"""Lifted powers at which the curves are shown."""


def as_text(calibration: CalibrationContent) -> str:
    """Return the calibration as lines of text."""
    lines = [_headline(calibration)]
    apart = calibration.pair_offsets and not any(calibration.delays_ns.values())
    for name, value, interval in () if apart else (HEAD, *delay_rows(calibration)):
        lines.append(f"  {name:>5}  {value:>11}  {interval}")
    if calibration.pair_offsets:
        for name, value, interval in (PAIRS_HEAD, *pair_rows(calibration)):
            lines.append(f"  {name:>9}  {value:>13}  {interval}")
    power, *curves = curve_rows(calibration)
    for name, *cells in (power, *curves):
        lines.append(f"  {name:18s}" + "".join(f"{cell:>9s}" for cell in cells))
    return "\n".join(lines)


def as_html(calibration: CalibrationContent) -> str:
    """Return the calibration as HTML tables, for notebooks."""
    delays = [HEAD, *delay_rows(calibration)]
    pairs = [PAIRS_HEAD, *pair_rows(calibration)] if calibration.pair_offsets else []
    tables: list[Sequence[tuple[str, ...]]] = [delays, pairs, curve_rows(calibration)]
    return f"<p>{escape(_headline(calibration))}</p>" + "".join(
        "<table>"
        + "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in rows)
        + "</table>"
        for rows in tables
        if rows
    )


def pair_rows(calibration: CalibrationContent) -> Iterator[tuple[str, str, str]]:
    """Yield each pair, the constant of its ranges in cm, and its interval in words."""
    rows = sorted(calibration.pair_offsets.items())
    for pair, one in rows[:MOST_TAGS]:
        yield named(pair), f"{100 * one.offset_m:+.2f}", f"± {100 * TWO_SIDED_95 * one.std_m:.2f}"
    if len(rows) > MOST_TAGS:
        yield "...", "", f"{len(rows) - MOST_TAGS} more"


def delay_rows(calibration: CalibrationContent) -> Iterator[tuple[str, str, str]]:
    """Yield tag, delay in ns, and its interval in words."""
    rows = sorted(calibration.delays_ns.items())
    for tag, delay in rows[:MOST_TAGS]:
        half = TWO_SIDED_95 * calibration.delays_std_ns.get(tag, math.nan)
        if math.isinf(half):
            interval = "undetermined"
        elif half == 0:
            interval = "pinned"
        else:
            interval = f"± {half:.4f}" if math.isfinite(half) else "unknown"
        yield str(tag), f"{delay:+.4f}", interval
    if len(rows) > MOST_TAGS:
        yield "...", "", f"{len(rows) - MOST_TAGS} more"


def curve_rows(calibration: CalibrationContent) -> list[tuple[str, ...]]:
    """Return lifted powers, and the curves there: of each group of tags, or the one of all."""
    shown = np.linspace(*calibration.bias_curve.range, POINTS)
    named: dict[str, CalibrationContent | TagGroup] = dict(calibration.groups) or {"": calibration}
    rows = [("lifted power", *(f"{power:.3g}" for power in shown))]
    for name, curves in named.items():
        of = f" {name}" if name else ""
        rows.append((f"bias (cm){of}", *(f"{100 * value:+.1f}" for value in curves.bias_curve(shown))))
        rows.append((f"sigma (cm){of}", *(f"{100 * value:.1f}" for value in curves.sigma_curve(shown))))
    return rows


def _headline(calibration: CalibrationContent) -> str:
    fitted = calibration.provenance.get("exchanges")
    of = f" from {fitted} ranges" if fitted else ""
    return (
        f"Calibration of {len(calibration.delays_ns)} tags{of}: {calibration.loss} loss, scale "
        f"{calibration.scale_ns:.3g} ns, {calibration.lift} power above {calibration.alpha_dbm:g} dBm"
        f"{'; NOT SETTLED, its fit stopped' if calibration.stopped else ''}"
    )
