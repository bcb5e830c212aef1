"""Ranges as factors of GTSAM (extra `gtsam`). Poses and changes of delays are variables, reflections are modelled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.errors import BadInputError
from calib.online import DelayStates, RangeUpdate
from uwblink.arrays import Floats

__all__ = ["Antenna", "range_factor"]


@dataclass(frozen=True, slots=True)
class Antenna:
    """One end of a range: an antenna at `place_m` (3,), in metres.

    With a `key`, the place is in the frame of the `Pose3` under this key; without, it is in the frame of the world.
    """

    place_m: Floats
    key: int | None = None


def range_factor(update: RangeUpdate, delays: DelayStates, key: int, first: Antenna, second: Antenna) -> Any:
    """Return a `gtsam.CustomFactor` for one range, from the antenna of its initiator to that of its target.

    Its keys are those of the antennas that have one, and `key`, the vector of the changes of delays in metres. The
    caller adds a prior (`DelayStates.covariance_m2`) and a random walk for this vector. Half of the squared error is
    the negative logarithm of the range's likelihood relative to its maximum; reflections and outliers are included
    (`RangeUpdate.whiten`). So a robust loss is not needed; those of GTSAM are symmetric, but reflections only lengthen
    ranges. Raises `BadInputError` if GTSAM is not installed, and if `update` has not exactly one range.
    """
    try:
        import gtsam
    except ImportError:
        raise BadInputError("GTSAM is not installed: pip install 'uwbcal[gtsam]'") from None
    if len(update.measured_m) != 1:
        raise BadInputError(
            f"found an update of {len(update.measured_m)} ranges, expected one range: `update.at([row])`"
        )
    slopes, ends = delays.slopes(update.ends, update.delay_slopes)[0], (first, second)

    def error(_: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        poses = [gtsam.Pose3() if end.key is None else values.atPose3(end.key) for end in ends]
        points = [
            pose.rotation().matrix() @ end.place_m + pose.translation() for pose, end in zip(poses, ends, strict=True)
        ]
        innovation_m, along = update.innovation(*points)
        residual, slope = update.whiten(innovation_m - slopes @ values.atVector(key))
        if jacobians is not None:
            rows = []
            for pose, end, sign in zip(poses, ends, (-1.0, 1.0), strict=True):
                own = sign * along[0] @ pose.rotation().matrix()
                rows += [] if end.key is None else [np.append(np.cross(end.place_m, own), own)]
            for number, row in enumerate((*rows, -slopes)):
                jacobians[number] = np.atleast_2d(slope * row)
        return residual

    keys = [end.key for end in ends if end.key is not None]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [*keys, key], error)
