"""The plan: which arrangements to make with what one has, and how well each delay will be known then."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np

from calib.errors import BadInputError, UnanswerableError
from calib.information import Unknown, Verdict, judge
from calib.surveys.candidates import Layout, delay_information, layouts
from calib.surveys.network import DIMENSIONS
from calib.surveys.scales import DELAY_SCALE_NS, M_PER_NS, widened
from uwblink.arrays import Floats

CANDIDATES: Final = 60
MOST_ARRANGEMENTS: Final = 12
WORTH_IT: Final = 0.06
"""Share by which one arrangement more must narrow the mean interval to be planned, where no number is given."""

SIZES_M: Final = {"line": (5.0, 0.0, 0.0), "plane": (3.0, 2.0, 0.0), "": (6.0, 5.0, 2.5)}
GUESS_M: Final = 0.45
RANGES_A_PAIR: Final = 60
FEWEST_S: Final = 30.0
TWO_SIDED_95: Final = 1.959963984540054
NAMES: Final = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
SHAPE_OF: Final = {"line": "line", "plane": "plane", "space": ""}


@dataclass(frozen=True, slots=True)
class PlannedArrangement:
    """One arrangement: its name, where about the boards stand (metres, by tag), and distances to tape, by pairs."""

    name: str
    place_m: Mapping[int, tuple[float, float, float]]
    taped: tuple[tuple[int, int], ...]

    def order(self) -> tuple[int, ...]:
        """Return the tags in the order in which they lie along x."""
        return tuple(sorted(self.place_m, key=lambda tag: self.place_m[tag]))


@dataclass(frozen=True, slots=True)
class NextBest:
    """What one more measurement would bring: what it is, and the mean half interval (ns) it leaves, of how much.

    Of a delay that nothing determines 1.5 ns are taken for known.
    """

    what: str
    mean_ns: float
    instead_of_ns: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A procedure in steps, and the interval (ns, half of 95 %) that each delay will have; infinite where none.

    `verdict` says what the arrangements determine; `common_ns` is the half interval of what all delays share, to which
    every absolute distance owes as much; `next_best` are the next arrangement and the next taped distance. With
    `known_beside`, distances or places are known that a survey must be told.

    >>> import calib
    >>> plan = calib.plan(4, on="line", arrangements=6)
    >>> len(plan.arrangements), plan.undetermined
    (6, ())
    >>> print(plan.arrangements[0].order())
    (1, 2, 3, 4)
    """

    on: str
    tags: tuple[int, ...]
    arrangements: tuple[PlannedArrangement, ...]
    half_ns: Mapping[int, float]
    common_ns: float
    verdict: Verdict
    next_best: tuple[NextBest, ...]
    seconds_each: float
    pair_error_m: float
    known_beside: bool
    steps: tuple[str, ...]

    @property
    def undetermined(self) -> tuple[int, ...]:
        """The tags whose delay the arrangements leave open."""
        return tuple(int(tag) for tag in self.verdict.named("delay"))

    def __str__(self) -> str:
        """Return the steps, the pictures and the intervals."""
        return "\n".join([*self.steps, "", *self._intervals()])

    def _intervals(self) -> list[str]:
        lines = [f"Promised, if the constant error of a pair is {100 * self.pair_error_m:.1f} cm:"]
        for tag in self.tags:
            half = self.half_ns[tag]
            lines.append(f"  tag {tag:3d}  " + (f"± {half:.3f} ns (95 %)" if math.isfinite(half) else "undetermined"))
        if math.isfinite(self.common_ns):
            lines.append(f"  what all share ± {self.common_ns:.3f} ns")
        if self.undetermined:
            lines += [f"not determined: {direction.words}" for direction in self.verdict.free]
        lines.append(
            "Where a curve over power is fitted along, what all share is known less well, and differences as well."
        )
        for best in self.next_best:
            lines.append(f"next best: {best.what}: ± {best.mean_ns:.3f} ns on average, not {best.instead_of_ns:.3f}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON takes it; null where nothing is determined."""
        known = {str(tag): half if math.isfinite(half) else None for tag, half in self.half_ns.items()}
        return {
            "on": self.on,
            "seconds_each": self.seconds_each,
            "pair_error_m": self.pair_error_m,
            "half_interval_ns": known,
            "common_ns": self.common_ns if math.isfinite(self.common_ns) else None,
            "undetermined": list(self.undetermined),
            "arrangements": [
                {"name": a.name, "place_m": {str(t): list(p) for t, p in a.place_m.items()}, "taped": list(a.taped)}
                for a in self.arrangements
            ],
            "next_best": [
                {"what": b.what, "mean_ns": b.mean_ns, "instead_of_ns": b.instead_of_ns} for b in self.next_best
            ],
            "steps": list(self.steps),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class _Given:
    """What one has, checked."""

    tags: tuple[int, ...]
    on: str
    size_m: tuple[float, float, float]
    taped: int
    tape_sigma_m: float
    pair_error_m: float
    anchors: tuple[int, ...]
    anchor_sigma_m: float
    seed: int

    def information(self, layout: Layout) -> Floats:
        known = {self.tags.index(tag): self.anchor_sigma_m for tag in self.anchors}
        return delay_information(layout, self.pair_error_m, self.tape_sigma_m, known)


def plan(  # noqa: PLR0913 - what somebody may have, each with its default
    boards: int | Sequence[int],
    *,
    on: str = "line",
    arrangements: int | None = None,
    size_m: Sequence[float] | None = None,
    taped: int = 0,
    tape_sigma_m: float = 0.005,
    anchors: Sequence[int] = (),
    anchor_sigma_m: float = 0.01,
    pair_error_m: float = 0.02,
    rate_hz: float = 50.0,
    seed: int = 1,
) -> Plan:
    """Return how to calibrate boards without true distances: which arrangements to make, and what comes of them.

    `boards` is how many there are, or their ids; `on` is "line" (a string), "plane" (a table) or "space" (a room), of
    `size_m` (up to three lengths). `taped` distances will be measured, to `tape_sigma_m`; `anchors` are boards that
    stay where they are, at places known to `anchor_sigma_m`. Each of `arrangements` (by default as many as are worth
    it, at most 12) is the best of sixty random ones after those before it. `pair_error_m` is the constant error that a
    pair has in an arrangement. Raises `BadInputError` for what cannot be.

    >>> import calib
    >>> calib.plan(3, on="line", arrangements=1).undetermined
    (1, 3)
    """
    given = _given(boards, on, size_m, taped, tape_sigma_m, anchors, anchor_sigma_m, pair_error_m, seed)
    if arrangements is not None and not 1 <= arrangements <= len(NAMES):
        raise BadInputError(f"found {arrangements}, expected 1 to {len(NAMES)}", parameter="arrangements")
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise BadInputError(f"found {rate_hz}, expected more than 0", parameter="rate_hz")
    candidates = _candidates(given)
    informations = [given.information(layout) for layout in candidates]
    chosen = _chosen(informations, arrangements)
    layouts_chosen = [candidates[k] for k in chosen]
    layouts_chosen = _taped(given, layouts_chosen)
    total = np.sum([given.information(layout) for layout in layouts_chosen], axis=0)
    verdict = _verdict(total, given.tags)
    wide = widened(_freedom(given, layouts_chosen))
    made = tuple(_named(NAMES[k], layout, given.tags) for k, layout in enumerate(layouts_chosen))
    pairs = len(list(combinations(given.tags, 2)))
    seconds = max(FEWEST_S, math.ceil(RANGES_A_PAIR * pairs / rate_hz / 10) * 10.0)
    halves = {tag: TWO_SIDED_95 * wide * float(s) for tag, s in zip(given.tags, verdict.std, strict=True)}
    return Plan(
        on=given.on,
        tags=given.tags,
        arrangements=made,
        half_ns=halves,
        common_ns=TWO_SIDED_95 * wide * _common(verdict),
        verdict=verdict,
        next_best=tuple(_next_best(given, informations, candidates, layouts_chosen, total, wide)),
        seconds_each=seconds,
        pair_error_m=given.pair_error_m,
        known_beside=bool(given.anchors) or given.taped > 0,
        steps=tuple(_steps(given, made, seconds)),
    )


def _given(  # noqa: PLR0913 - what `plan` takes, checked
    boards: int | Sequence[int],
    on: str,
    size_m: Sequence[float] | None,
    taped: int,
    tape_sigma_m: float,
    anchors: Sequence[int],
    anchor_sigma_m: float,
    pair_error_m: float,
    seed: int,
) -> _Given:
    tags = tuple(range(1, boards + 1)) if isinstance(boards, int) else tuple(int(tag) for tag in boards)
    if not 2 <= len(tags) <= 30 or len(set(tags)) < len(tags):
        raise BadInputError(f"found {boards!r:.60}, expected 2 to 30 boards, each once", parameter="boards")
    if on not in SHAPE_OF:
        raise BadInputError(f"found {on!r:.40}, allowed: {', '.join(SHAPE_OF)}", parameter="on")
    on = SHAPE_OF[on]
    for name, value in (
        ("tape_sigma_m", tape_sigma_m),
        ("anchor_sigma_m", anchor_sigma_m),
        ("pair_error_m", pair_error_m),
    ):
        if not (math.isfinite(value) and value > 0):
            raise BadInputError(f"found {value}, expected more than 0", parameter=name)
    if taped < 0:
        raise BadInputError(f"found {taped}, expected 0 or more", parameter="taped")
    strangers = sorted(set(anchors) - set(tags))
    if strangers:
        raise BadInputError(f"{strangers[0]} is none of the boards", parameter="anchors")
    if anchors and on == "line":
        raise BadInputError(
            "stand in a plane or in space; on a line say how many distances are taped", parameter="anchors"
        )
    return _Given(
        tags=tags,
        on=on,
        size_m=_size(on, size_m, len(tags)),
        taped=taped,
        tape_sigma_m=tape_sigma_m,
        pair_error_m=pair_error_m,
        anchors=tuple(anchors),
        anchor_sigma_m=anchor_sigma_m,
        seed=seed,
    )


def _size(on: str, size_m: Sequence[float] | None, boards: int) -> tuple[float, float, float]:
    lengths = list(SIZES_M[on][: DIMENSIONS[on]] if size_m is None else size_m)
    if len(lengths) != DIMENSIONS[on] or not all(math.isfinite(v) and v > 0 for v in lengths):
        text = f"found {lengths}, expected as many lengths in metres as it has dimensions, {DIMENSIONS[on]}"
        raise BadInputError(text, parameter="size_m")
    if size_m is None and on == "line":
        lengths = [max(lengths[0], 0.8 * (boards - 1))]
    x, y, z = (*map(float, lengths), 0.0, 0.0)[:3]
    return x, y, z


def _candidates(given: _Given) -> list[Layout]:
    found = layouts(len(given.tags), DIMENSIONS[given.on], given.size_m, CANDIDATES, given.seed)
    if not found:
        raise UnanswerableError(f"{len(given.tags)} boards find no room: they must stand 0.4 m from each other")
    if not given.anchors:
        return found
    # Anchors stay where they are; the corners of the room are as good a guess as any.
    rows = [given.tags.index(tag) for tag in given.anchors]
    fixed = found[0].place_m[rows]
    moved = []
    for layout in found:
        place = layout.place_m.copy()
        place[rows] = fixed
        moved.append(replace(layout, place_m=place))
    return moved


def _mean_std(information: Floats) -> float:
    """Return the root mean variance of the delays, metres, of which a little is known without any data.

    To a nanometre, so that mirror images are equally good on every machine and the first of them is taken.
    """
    guess = np.eye(len(information)) / GUESS_M**2
    return round(float(np.sqrt(np.trace(np.linalg.inv(information + guess)) / len(information))), 9)


def _chosen(informations: list[Floats], count: int | None) -> list[int]:
    """Return which arrangements, one after the other: each the best after those before it."""
    total = np.zeros_like(informations[0])
    found: list[int] = []
    while len(found) < (count or MOST_ARRANGEMENTS):
        # The same once more would have the same errors, unless boards were taken away in between.
        left = [k for k in range(len(informations)) if k not in found] or list(range(len(informations)))
        best = min(left, key=lambda k: _mean_std(total + informations[k]))
        before, after = _mean_std(total), _mean_std(total + informations[best])
        if count is None and len(found) >= 2 and after > (1 - WORTH_IT) * before:
            break
        found.append(best)
        total = total + informations[best]
    return found


def _taped(given: _Given, chosen: list[Layout]) -> list[Layout]:
    """Return the arrangements with the distances to tape in them: each where it brings most."""
    found = list(chosen)
    for _ in range(given.taped):
        best = _best_tape(given, found)
        if best is None:
            break
        k, pair = best
        found[k] = replace(found[k], taped=(*found[k].taped, pair))
    return found


def _best_tape(given: _Given, chosen: list[Layout]) -> tuple[int, tuple[int, int]] | None:
    each = [given.information(layout) for layout in chosen]
    total = np.sum(each, axis=0)
    options = [
        (_mean_std(total - each[k] + given.information(replace(layout, taped=(*layout.taped, pair)))), k, pair)
        for k, layout in enumerate(chosen)
        for pair in combinations(range(len(given.tags)), 2)
        if pair not in layout.taped
    ]
    if not options:
        return None
    _, k, pair = min(options)
    return k, pair


def _verdict(total: Floats, tags: tuple[int, ...]) -> Verdict:
    return judge(total * M_PER_NS**2, [Unknown("delay", str(tag), DELAY_SCALE_NS) for tag in tags])


def _common(verdict: Verdict) -> float:
    """Return how well the mean of all delays is known, in ns; infinite where one of them is not."""
    if not verdict.determined.all():
        return math.inf
    share = np.full(len(verdict.std), 1 / len(verdict.std))
    return math.sqrt(float(share @ verdict.covariance @ share))


def _freedom(given: _Given, chosen: list[Layout]) -> float:
    """Return the degrees of freedom that will be left to tell the errors of pairs."""
    boards, dimensions = len(given.tags), DIMENSIONS[given.on]
    motions = 0 if given.anchors else {1: 1, 2: 3, 3: 6}[dimensions]
    rows = boards * (boards - 1) // 2
    unknown = boards * dimensions - motions
    left = sum(rows + len(c.taped) + len(given.anchors) * dimensions - min(unknown, rows) for c in chosen)
    return max(left - boards, 0.0)


def _next_best(
    given: _Given,
    informations: list[Floats],
    candidates: list[Layout],
    chosen: list[Layout],
    total: Floats,
    wide: float,
) -> list[NextBest]:
    def mean_ns(information: Floats) -> float:
        return TWO_SIDED_95 * wide * _mean_std(information) / M_PER_NS

    now = mean_ns(total)
    k = min(range(len(informations)), key=lambda n: _mean_std(total + informations[n]))
    more = _named(NAMES[min(len(chosen), len(NAMES) - 1)], candidates[k], given.tags)
    found = [NextBest(f"an arrangement {_where(given.on, more)}", mean_ns(total + informations[k]), now)]
    tape = _best_tape(given, chosen)
    if tape:
        n, pair = tape
        before = given.information(chosen[n])
        after = given.information(replace(chosen[n], taped=(*chosen[n].taped, pair)))
        i, j = given.tags[pair[0]], given.tags[pair[1]]
        found.append(
            NextBest(f"the distance of {i} and {j} in {NAMES[n]} by tape", mean_ns(total - before + after), now)
        )
    return [one for one in found if one.mean_ns < now]


def _named(name: str, layout: Layout, tags: tuple[int, ...]) -> PlannedArrangement:
    place = {tag: (float(p[0]), float(p[1]), float(p[2])) for tag, p in zip(tags, layout.place_m, strict=True)}
    return PlannedArrangement(name, place, tuple((tags[i], tags[j]) for i, j in layout.taped))


def _where(on: str, one: PlannedArrangement) -> str:
    if on == "line":
        return "in the order " + " ".join(map(str, one.order()))
    axes = DIMENSIONS[on]
    spots = ", ".join(f"{t} at ({', '.join(f'{v:.1f}' for v in p[:axes])})" for t, p in one.place_m.items())
    return f"with {spots}"


def _steps(given: _Given, made: tuple[PlannedArrangement, ...], seconds: float) -> list[str]:
    """Return what to do, a line each, pictures between."""
    held = {"line": "Stretch a string and keep it straight", "plane": "Take a flat table or floor", "": "Use the room"}
    lines = [f"1. {held[given.on]}. Places are guides: nothing but what is taped is measured, orders matter."]
    for k, one in enumerate(made, start=2):
        lines.append(f"{k}. Arrangement {one.name}: boards {_where(given.on, one)}.")
        lines += picture(given.on, one)
        for i, j in one.taped:
            lines.append(f"   Tape the distance of {i} and {j}, antenna to antenna.")
        lines.append(f"   Record all pairs as arrangement {one.name} for {seconds:.0f} s.")
    shape = f", known to be on a {given.on}" if given.on else ""
    lines.append(f"{len(made) + 2}. Survey all recordings together{shape}.")
    if given.taped or given.anchors:
        lines.append("   A file says what is known beside: the taped distances, the anchors' places.")
    return lines


def picture(on: str, one: PlannedArrangement, width: int = 56, height: int = 9) -> list[str]:
    """Return the arrangement drawn with letters, seen from above: a line of text for a line, a box for others."""
    xs = [p[0] for p in one.place_m.values()]
    span = max(max(xs) - min(xs), 1e-6)
    rows = 1 if on == "line" else height
    ys = [p[1] for p in one.place_m.values()]
    tall = max(max(ys) - min(ys), 1e-6)
    cells = [["-" if on == "line" else " "] * width for _ in range(rows)]
    for tag, (x, y, _) in one.place_m.items():
        column = round((x - min(xs)) / span * (width - 3))
        row = rows - 1 - round((y - min(ys)) / tall * (rows - 1))
        for k, letter in enumerate(str(tag)):
            cells[row][min(column + k, width - 1)] = letter
    return ["     " + "".join(line).rstrip() for line in cells]
