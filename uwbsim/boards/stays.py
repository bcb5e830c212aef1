"""When boards that are carried from place to place stand still."""

from __future__ import annotations

import math

from uwbsim.scenario.model import Scenario
from uwbsim.scenario.motion import Carried


def stays_s(scenario: Scenario) -> list[tuple[float, float]]:
    """Return the stretches, (begin, end) in seconds, in which no body is being carried; none where none ever is.

    The last one has no end.
    """
    carried = [body.motion for body in scenario.bodies if isinstance(body.motion, Carried)]
    ways = sorted(
        (turn * (motion.stay_s + motion.carry_s) + motion.stay_s, (turn + 1) * (motion.stay_s + motion.carry_s))
        for motion in carried
        for turn in range(len(motion.places_m) - 1)
    )
    found, since = [], 0.0
    for begin, end in ways:
        if begin > since:
            found.append((since, begin))
        since = max(since, end)
    return [*found, (since, math.inf)] if carried else []
