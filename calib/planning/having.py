"""What one has to calibrate boards that stand still: how many, where they may stand, tapes and anchors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from calib.errors import BadInputError
from calib.planning.candidates import Layout, delay_information
from calib.surveys.network import DIMENSIONS
from uwblink.arrays import Floats

SIZES_M: Final = {"line": (5.0, 0.0, 0.0), "plane": (3.0, 2.0, 0.0), "": (6.0, 5.0, 2.5)}
MOST_REFLECTED: Final = 0.3
"""Share of reflected pairs beyond which nobody could tell which they are."""

SHAPE_OF: Final = {"line": "line", "plane": "plane", "space": ""}


@dataclass(frozen=True, slots=True, kw_only=True)
class Having:
    """What one has, checked: `on` is "line", "plane" or "" (a room), as a survey knows it; lengths in metres."""

    tags: tuple[int, ...]
    on: str
    size_m: tuple[float, float, float]
    taped: int
    tape_sigma_m: float
    pair_error_m: float
    anchors: tuple[int, ...]
    anchor_sigma_m: float
    seed: int
    reflected: float = 0.0

    @property
    def known_places(self) -> dict[int, float]:
        """Boards whose place is known, by number, and how well."""
        return {self.tags.index(tag): self.anchor_sigma_m for tag in self.anchors}

    def information(self, layout: Layout) -> Floats:
        """Return what an arrangement of these boards says of their delays (boards, boards), in 1/m^2."""
        return delay_information(layout, self.pair_error_m, self.tape_sigma_m, self.known_places)


def having(  # noqa: PLR0913 - what `plan` takes, checked
    boards: int | Sequence[int],
    on: str,
    size_m: Sequence[float] | None,
    taped: int,
    tape_sigma_m: float,
    anchors: Sequence[int],
    anchor_sigma_m: float,
    pair_error_m: float,
    seed: int,
    reflected: float,
) -> Having:
    """Return what `calib.plan` was given; raises `BadInputError` for what cannot be."""
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
    if not 0 <= reflected <= MOST_REFLECTED:
        raise BadInputError(f"found {reflected}, expected 0 to {MOST_REFLECTED}", parameter="reflected")
    strangers = sorted(set(anchors) - set(tags))
    if strangers:
        raise BadInputError(f"{strangers[0]} is none of the boards", parameter="anchors")
    if anchors and on == "line":
        raise BadInputError(
            "stand in a plane or in space; on a line say how many distances are taped", parameter="anchors"
        )
    return Having(
        tags=tags,
        on=on,
        size_m=_size(on, size_m, len(tags)),
        taped=taped,
        tape_sigma_m=tape_sigma_m,
        pair_error_m=pair_error_m,
        anchors=tuple(anchors),
        anchor_sigma_m=anchor_sigma_m,
        seed=seed,
        reflected=reflected,
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
