"""What one has to fly, checked: robots with their tags, room, speed, anchors, seconds and exchanges a second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from calib.errors import BadInputError
from calib.planning.rehearsal import Flown

MOST_TAGS: Final = 60
MOST_RANGES: Final = 200_000
BOUNDS: Final = {
    "seconds": (5.0, 3600.0),
    "rate_hz": (0.5, 2000.0),
    "speed_m_s": (0.05, 10.0),
    "apart_m": (0.0, 3.0),
}


def flying(  # noqa: PLR0913 - keyword-only, as `plan_flight` takes them
    robots: int | Sequence[Sequence[int]],
    anchors: Sequence[int],
    *,
    seconds: float,
    rate_hz: float,
    size_m: Sequence[float],
    speed_m_s: float,
    apart_m: float,
    still_s: float,
    inertial: bool,
    seed: int,
) -> Flown:
    """Return how robots will fly; raises `BadInputError` for what cannot be."""
    given = {"seconds": seconds, "rate_hz": rate_hz, "speed_m_s": speed_m_s, "apart_m": apart_m}
    for name, (least, most) in BOUNDS.items():
        if not least <= given[name] <= most:
            raise BadInputError(f"found {given[name]}, expected {least:g} to {most:g}", parameter=name)
    if seconds * rate_hz > MOST_RANGES:
        raise BadInputError(
            f"{seconds * rate_hz:.0f} ranges are more than a plan takes, {MOST_RANGES}", parameter="seconds"
        )
    if still_s > seconds / 2:
        raise BadInputError(f"found {still_s:g}, expected at most half of the {seconds:g} s", parameter="still_s")
    if len(size_m) != 3 or not all(math.isfinite(v) and 0 < v <= 1000 for v in size_m):
        raise BadInputError(f"found {list(size_m)}, expected three lengths of a room in metres", parameter="size_m")
    x, y, z = map(float, size_m)
    return Flown(
        robots=_robots(robots, anchors),
        apart_m=apart_m,
        size_m=(x, y, z),
        speed_m_s=speed_m_s,
        seconds=seconds,
        still_s=still_s,
        rate_hz=rate_hz,
        anchors=tuple(map(int, anchors)),
        inertial=inertial,
        seed=seed,
    )


def _robots(robots: int | Sequence[Sequence[int]], anchors: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    found = (
        tuple((2 * k + 1, 2 * k + 2) for k in range(robots))
        if isinstance(robots, int)
        else tuple(tuple(map(int, tags)) for tags in robots)
    )
    tags = [tag for robot in found for tag in robot]
    if not found or not all(found) or len(set(tags)) < len(tags) or len(tags) + len(anchors) > MOST_TAGS:
        text = f"found {robots!r:.60}, expected robots with a tag or more each, every tag once, at most {MOST_TAGS}"
        raise BadInputError(text, parameter="robots")
    if len(set(anchors)) < len(anchors) or set(anchors) & set(tags):
        raise BadInputError(f"found {list(anchors)}, expected other tags than those of robots", parameter="anchors")
    if len(found) == 1 and not anchors:
        raise BadInputError("a single robot without anchors ranges with nobody", parameter="robots")
    if any(not 0 < tag < 65536 for tag in (*tags, *anchors)):
        raise BadInputError("found a tag that is none, expected ids of 1 or more", parameter="robots")
    return found
