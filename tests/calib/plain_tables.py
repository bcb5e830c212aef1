"""Tables of ranges as written by another program, with planted constants; shares no code with the project."""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

LIGHT = 0.299702547  # metres per nanosecond, in air
DELAYS_NS = {1: -0.35, 2: 0.12, 3: -0.05, 11: 0.2, 12: -0.15, 13: 0.05}
ANCHORS = {11: (0.0, 0.0, 2.4), 12: (6.0, 0.3, 2.2), 13: (2.8, 5.5, 0.4)}
COLUMNS = "time_s,from_id,to_id,range_m,fpp1,fpp2,from_x_m,from_y_m,from_z_m,to_x_m,to_y_m,to_z_m"


@dataclass
class Plan:
    """Content of a table: ranges among robots and anchors, by their pairs."""

    count: int = 3000
    seed: int = 1
    anchors: bool = True
    noise_m: float = 0.04
    bias: Callable[[float], float] | None = None
    power_dbm: Callable[[float], float] | None = None
    pair_m: dict[tuple[int, int], float] = field(default_factory=dict)
    robots: tuple[int, ...] = (1, 2, 3)


def place(tag, time_s):
    if tag in ANCHORS:
        return ANCHORS[tag]
    a = 0.31 * time_s + 2.1 * tag
    return (
        3 + 1.9 * math.sin(1.1 * a + tag) + 0.4 * math.cos(3.3 * a),
        2.7 + 1.8 * math.cos(0.83 * a) - 0.3 * math.sin(2.9 * a),
        1.3 + 0.5 * math.sin(0.57 * a + 0.4 * tag),
    )


def bias_m(power_dbm):
    """Return a bias of some centimetres at low power."""
    return 0.05 * math.tanh((-88 - power_dbm) / 3)


def rows(plan):
    rng = random.Random(plan.seed)
    ends = [*plan.robots, *(ANCHORS if plan.anchors else ())]
    pairs = [(a, b) for k, a in enumerate(ends) for b in ends[k + 1 :] if not (a in ANCHORS and b in ANCHORS)]
    for k in range(plan.count):
        time_s = 100 + 0.02 * k
        a, b = pairs[rng.randrange(len(pairs))]
        a, b = (a, b) if rng.random() < 0.5 else (b, a)
        away = math.dist(place(a, time_s), place(b, time_s))
        power = rng.uniform(-95, -82) if plan.power_dbm is None else plan.power_dbm(away)
        measured = away - LIGHT * (DELAYS_NS[a] + DELAYS_NS[b]) / 2 + rng.gauss(0, plan.noise_m)
        measured += (plan.bias or (lambda _: 0.0))(power) + plan.pair_m.get((min(a, b), max(a, b)), 0.0)
        if rng.random() < 0.05:
            measured += rng.expovariate(1 / 0.4)
        yield (time_s, a, b, measured, power, *place(a, time_s), *place(b, time_s))


def write(path, plan, *, power=True):
    """Write a CSV of ranges with positions and, by default, powers."""
    lines = [COLUMNS]
    for time_s, a, b, measured, dbm, *places in rows(plan):
        levels = f"{dbm:.2f},{dbm:.2f}" if power else ","
        lines.append(f"{time_s:.3f},{a},{b},{measured:.4f},{levels}," + ",".join(f"{v:.5f}" for v in places))
    path.write_text("\n".join(lines) + "\n")
    return path


def pair_constant_m(a, b):
    """Return the excess of the ranges of a pair, from its delays."""
    return -LIGHT * (DELAYS_NS[a] + DELAYS_NS[b]) / 2
