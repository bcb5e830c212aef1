"""Where boards stood, as a survey found it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True)
class SurveyedBoard:
    """Where a tag's antenna was: metres, and the covariance (3, 3); zero along what the frame or the shape fixes.

    `determined` is whether the ranges determine the place.
    """

    tag: int
    position_m: tuple[float, float, float]
    covariance_m2: Floats
    determined: bool = True


@dataclass(frozen=True, slots=True)
class SurveyedArrangement:
    """An arrangement: its name, what was said of it ("line", "plane" or ""), its boards, and the frame in words."""

    name: str
    known: str
    boards: tuple[SurveyedBoard, ...]
    frame: str

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON takes it, in metres."""
        boards = [
            {
                "tag": board.tag,
                "position_m": [round(value, 5) for value in board.position_m],
                "covariance_m2": [[float(f"{value:.4g}") for value in line] for line in board.covariance_m2.tolist()],
                "determined": board.determined,
            }
            for board in self.boards
        ]
        return {"name": self.name, "known": self.known, "frame": self.frame, "boards": boards}

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> SurveyedArrangement:
        """Return the arrangement that `to_dict` wrote."""
        boards = []
        for one in row["boards"]:
            x, y, z = map(float, one["position_m"])
            covariance = np.array(one["covariance_m2"], dtype=float)
            boards.append(SurveyedBoard(int(one["tag"]), (x, y, z), covariance, bool(one["determined"])))
        return cls(str(row["name"]), str(row["known"]), tuple(boards), str(row["frame"]))
