"""What a robot has on board: ranges to fixed anchors, inertial readings, heights; poses are truth to judge by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.calibration.model import Calibration
from calib.data.ranges import MAX_RANGE_M, Ranges, require_some
from calib.data.sources import Data, opened, require_times
from calib.errors import UnanswerableError
from calib.evaluation.range_updates import RangeErrors
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Poses
from uwblink.recording.target_reports import single_reports

STILL_M: Final = 0.1
"""A body whose poses reach no further is an anchor."""

FEWEST_ANCHORS: Final = 3
UNKNOWN_ERRORS: Final = RangeErrors(share=0.1, least_m=0.0, detour_m=0.3, outlier=0.01, outlier_m=3.0)
"""What is reckoned with where a calibration does not say: a tenth reflected, by 30 cm on average."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Readings:
    """One body's: ranges (n,) in order of time with lever arms and anchors (n, 3), inertial readings, heights.

    `gyro` in rad/s and `force` in m/s^2 are (m, 3) in the axes of the body. `truth` are its poses, or None.
    """

    source: str
    body: str
    time_s: Floats
    range_m: Floats
    noise_m: Floats
    errors: RangeErrors
    arm_m: Floats
    anchor_m: Floats
    imu_s: Floats
    gyro: Floats
    force: Floats
    height_s: Floats
    height_m: Floats
    truth: Poses | None
    began_ns: int


def readings(data: Data, calibration: Calibration) -> list[Readings]:
    """Return the readings of every body that is no anchor; times are seconds since the first exchange.

    An anchor is a body whose poses stay in one place. Raises `UnanswerableError` where there are fewer than three, or
    nothing ranges with them.
    """
    with opened(data) as (name, source):
        exchanges = single_reports(source.exchanges).exchanges
        poses, tags = source.poses, list(source.tags)
        imu, heights = (dict(getattr(source, table, None) or {}) for table in ("imu", "height"))
    ranges = Ranges.from_exchanges(exchanges, source=name)
    powered = np.isfinite(ranges.fpp1_dbm) | np.isfinite(ranges.fpp2_dbm) | (not calibration.needs_power)
    possible = np.isfinite(ranges.raw_m) & (np.abs(ranges.raw_m) < MAX_RANGE_M)
    excluded = {"no power": int(np.sum(~powered)), "impossible stamps": int(np.sum(powered & ~possible))}
    require_some(name, len(ranges), excluded, "")
    ranges = ranges[powered & possible]
    anchors = _anchors(poses)
    fixed = {tag.tag: anchors[tag.body] + tag.lever_arm_m for tag in tags if tag.body in anchors}
    if len(fixed) < FEWEST_ANCHORS:
        raise UnanswerableError(
            f"{name}: {len(fixed)} tags stay in one place by its poses, at least {FEWEST_ANCHORS} are needed as "
            "anchors; 'uwblink poses' adds them"
        )
    arms = {tag.tag: (tag.body, np.array(tag.lever_arm_m)) for tag in tags if tag.body not in anchors}
    bodies = sorted({body for body, _ in arms.values()})
    found = [_of_body(body, ranges, calibration, arms, fixed, imu, heights, poses) for body in bodies]
    kept = [one for one in found if len(one.time_s)]
    if not kept:
        raise UnanswerableError(f"{name}: no moving body ranges with a fixed anchor, so there is nothing to localize")
    return kept


def _anchors(poses: Poses) -> dict[str, Floats]:
    """Return where the bodies are that stay in one place."""
    found = {}
    for body in sorted(set(poses.body.tolist())):
        place = poses.position_m[poses.body == body]
        if np.ptp(place, axis=0).max() <= STILL_M:
            found[body] = np.asarray(np.median(place, axis=0))
    return found


def _of_body(
    body: str,
    ranges: Ranges,
    calibration: Calibration,
    arms: Mapping[int, tuple[str, Floats]],
    fixed: Mapping[int, Floats],
    imu: Mapping[str, NDArray[Any]],
    heights: Mapping[str, NDArray[Any]],
    poses: Poses,
) -> Readings:
    mine = [tag for tag, (owner, _) in arms.items() if owner == body]
    first = np.isin(ranges.initiator, mine) & np.isin(ranges.target, list(fixed))
    second = np.isin(ranges.target, mine) & np.isin(ranges.initiator, list(fixed))
    some = ranges[np.flatnonzero(first | second)]
    some = some[np.argsort(some.time_ns, kind="stable")]
    own = np.where(np.isin(some.initiator, mine), some.initiator, some.target)
    other = np.where(np.isin(some.initiator, mine), some.target, some.initiator)
    corrected, noise, errors = _corrected(some, calibration)
    require_times(ranges)
    began = int(ranges.time_ns.min())
    imu_rows, height_rows = _rows(imu, body), _rows(heights, body)
    has_truth = np.any(poses.body == body)
    return Readings(
        source=ranges.source,
        body=body,
        time_s=np.asarray((some.time_ns - began) * 1e-9, dtype=np.float64),
        range_m=corrected,
        noise_m=noise,
        errors=errors,
        arm_m=np.array([arms[tag][1] for tag in own.tolist()]).reshape(-1, 3),
        anchor_m=np.array([fixed[tag] for tag in other.tolist()]).reshape(-1, 3),
        imu_s=_seconds(imu, imu_rows, began),
        gyro=_columns(imu, imu_rows, ("wx", "wy", "wz")),
        force=_columns(imu, imu_rows, ("ax", "ay", "az")),
        height_s=_seconds(heights, height_rows, began),
        height_m=_columns(heights, height_rows, ("height_m",)).ravel(),
        truth=poses[poses.body == body] if has_truth else None,
        began_ns=began,
    )


def _corrected(ranges: Ranges, calibration: Calibration) -> tuple[Floats, Floats, RangeErrors]:
    """Return corrected ranges (n,), the noise of direct ones (n,), and what their errors are made of besides."""
    from calib.evaluation.tracking_filters import range_errors

    if not len(ranges):
        return np.zeros(0), np.zeros(0), UNKNOWN_ERRORS.times(0)
    applied = calibration.apply(ranges)
    if calibration.errors is None:
        return applied.corrected_m, applied.sigma_m, UNKNOWN_ERRORS.times(len(ranges))
    return (applied.corrected_m - calibration.errors.location_m, *range_errors(calibration, ranges))


def _rows(table: Mapping[str, NDArray[Any]], body: str) -> Ints:
    if not table:
        return np.zeros(0, dtype=np.int64)
    mine: Bools = np.asarray(table["body"] == body)
    rows = np.flatnonzero(mine)
    return rows[np.argsort(table["time_ns"][rows], kind="stable")]


def _seconds(table: Mapping[str, NDArray[Any]], rows: Ints, began_ns: int) -> Floats:
    return np.asarray((table["time_ns"][rows] - began_ns) * 1e-9) if table else np.zeros(0)


def _columns(table: Mapping[str, NDArray[Any]], rows: Ints, names: tuple[str, ...]) -> Floats:
    if not table:
        return np.zeros((0, len(names)))
    return np.column_stack([np.asarray(table[name][rows], dtype=np.float64) for name in names])
