"""Rooms of other layouts: a partition, a cabinet, an anchor and three flying robots at drawn places."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Box = tuple[Floats, Floats]
MATERIALS: Final = ["drywall", "wood", "brick", "glass"]
"""Materials of partitions: those of the simulator that are usual in rooms and that waves pass."""


def furnish(table: dict[str, Any], seed: int) -> None:
    """Replace the obstacles and the bodies' places of scenarios/room/room.toml by drawn ones."""
    rng = np.random.default_rng([seed, 0x1A70])
    low, high = (np.array(table["room"][name]) for name in ("min_m", "max_m"))
    cabinet, partition = table["obstacles"]
    boxes = None
    while boxes is None:
        boxes = _places(rng, low, high)
    for one, box in zip((partition, cabinet), boxes, strict=False):
        one["min_m"], one["max_m"] = (corner.tolist() for corner in box)
    partition["material"] = str(rng.choice(MATERIALS))
    mast, *robots = (body["motion"] for body in table["bodies"])
    mast["position_m"] = np.mean(boxes[2], axis=0).tolist()
    for robot, box in zip(robots, boxes[3:], strict=True):
        robot["box_min_m"], robot["box_max_m"] = (corner.tolist() for corner in box)


def _places(rng: np.random.Generator, low: Floats, high: Floats) -> list[Box] | None:
    """Return boxes of a partition from a wall, a cabinet, a mast and three robots that are apart from each other, or
    None if robots have no room.
    """
    along, across = rng.permutation(2)
    wall, length = (low.copy(), high.copy()), rng.uniform(1.5, 3.5)
    wall[0][across] = rng.uniform(-1.5, 1.5)
    wall[1][across], wall[1][2] = wall[0][across] + 0.1, rng.uniform(2.0, 2.6)
    if rng.random() < 0.5:
        wall[1][along] = low[along] + length
    else:
        wall[0][along] = high[along] - length
    cabinet = _box(rng, low + 0.5, high - 0.5, np.array([*rng.permutation([0.8, 0.5]), 1.8]), floor=0.0)
    corner = np.where(rng.random(3) < 0.5, low + 0.3, high - 0.3)
    corner[2] = rng.uniform(1.2, 2.4)
    boxes = [wall, cabinet, (corner - 0.05, corner + 0.05)]
    if not all(_apart(a, b, 0.1) for a, b in ((wall, cabinet), (wall, boxes[2]), (cabinet, boxes[2]))):
        return None
    for _ in range(400):
        box = _box(rng, low + 0.6, high - 0.6, rng.uniform([1.4, 1.4, 1.8], [2.4, 3.0, 2.2]), floor=0.4)
        if len(boxes) < 6 and all(_apart(box, other, 0.35) for other in boxes):
            boxes.append(box)
    return boxes if len(boxes) == 6 else None


def _box(rng: np.random.Generator, low: Floats, high: Floats, size: Floats, *, floor: float) -> Box:
    """Return a box of a size somewhere between two corners, at a height above the floor."""
    corner = np.append(rng.uniform(low[:2], (high - size)[:2]), floor)
    return corner, corner + size


def _apart(a: Box, b: Box, gap_m: float) -> bool:
    """Return whether two boxes are apart by a gap along an axis."""
    return bool(np.any(a[1] + gap_m <= b[0]) or np.any(b[1] + gap_m <= a[0]))
