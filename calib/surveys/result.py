"""The result of a survey: a calibration, the positions of the boards, and the known facts behind both."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibration.model import Calibration, CalibrationResult
from calib.errors import BadInputError
from calib.findings import Finding
from calib.information import Verdict
from calib.spread import radius_95
from uwblink.arrays import Floats
from uwblink.output import write_bytes, write_text

ANCHORS = {
    ".toml": (
        "# covariance_m2: xx xy xz yy yz zz, m^2.\n",
        "\n[[anchors]]\nid = {}\nposition_m = [{}]\ncovariance_m2 = [{}]\n",
    ),
    **dict.fromkeys(
        (".yaml", ".yml"),
        (
            "# covariance: xx xy xz yy yz zz.\n/**:\n  ros__parameters:\n    anchors:\n      ids: [{}]\n",
            "      anchor_{}:\n        position: [{}]\n        covariance: [{}]\n",
        ),
    ),
}
"""Head and rows of files of anchors: of all ids, and of id, position and upper triangle of the covariance."""


@dataclass(frozen=True, slots=True)
class SurveyedBoard:
    """The position of a tag's antenna: metres, and the covariance (3, 3); zero along directions that the frame or the
    shape fixes.

    `determined` is whether the ranges determine the place.
    """

    tag: int
    position_m: tuple[float, float, float]
    covariance_m2: Floats
    determined: bool = True

    @property
    def within_m(self) -> float:
        """The radius around the position that contains the antenna with a probability of 95 %."""
        return radius_95(self.covariance_m2)


@dataclass(frozen=True, slots=True)
class SurveyedArrangement:
    """An arrangement: its name, its stated shape ("line", "plane" or ""), its boards, and a description of
    the frame.
    """

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
        boards = tuple(
            SurveyedBoard(
                int(one["tag"]), (x, y, z), np.array(one["covariance_m2"], dtype=float), bool(one["determined"])
            )
            for one in row["boards"]
            for x, y, z in [map(float, one["position_m"])]
        )
        return cls(str(row["name"]), str(row["known"]), boards, str(row["frame"]))


@dataclass(frozen=True, slots=True)
class SecondBest:
    """The best other solution: the arrangement in which it differs, its tags, and the increase of -2 log likelihood."""

    arrangement: str
    tags: tuple[int, ...]
    worse: float

    @property
    def ambiguous(self) -> bool:
        """Whether the ranges hardly distinguish it from the best one."""
        # Three standard deviations of one value, in -2 log likelihood.
        return self.worse < 9.0


@dataclass(frozen=True, slots=True)
class ReflectedPair:
    """A pair that is probably reflected in an arrangement: the error of its range, and the probability.

    `chance` below a half is for one that may be reflected instead of another.
    """

    arrangement: str
    first: int
    second: int
    longer_m: float
    chance: float

    @property
    def likely(self) -> bool:
        """Whether it is more likely than not."""
        return self.chance >= 0.5

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON takes it."""
        return {
            "arrangement": self.arrangement,
            "between": [self.first, self.second],
            "longer_m": round(self.longer_m, 4),
            "chance": round(self.chance, 3),
        }


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurveyResult(CalibrationResult):
    """The result of `survey`: a calibration, and the positions of the boards.

    `pair_error_m` is the constant error that a pair has in an arrangement, as a standard deviation; `verdict` states
    which delays (in ns) are determined; `findings` are contradictions between the ranges and stated facts, and limits
    of the survey. `second_best` is the best other solution, `reflected` are pairs that are, or may be,
    reflected.

    >>> import calib
    >>> result = calib.survey(calib.sample_arrangements(), known="line")
    >>> sorted(result.calibration.delays_ns)
    [1, 2, 3, 4]
    """

    calibration: Calibration
    arrangements: tuple[SurveyedArrangement, ...]
    verdict: Verdict
    pair_error_m: float
    second_best: SecondBest | None
    findings: tuple[Finding, ...]
    reflected: tuple[ReflectedPair, ...] = ()

    @property
    def contradictions(self) -> tuple[Finding, ...]:
        """The findings between the ranges and stated facts."""
        return tuple(one for one in self.findings if one.p_value is not None)

    def headline(self) -> str:
        """Return the inputs of the survey, in one line."""
        count = len(self.arrangements)
        pairs = self.calibration.provenance["pairs"]
        return (
            f"Survey of {count} arrangement{'s' * (count > 1)}, {pairs} pairs: constant error of a pair "
            f"{100 * self.pair_error_m:.1f} cm"
        )

    def save_anchors(
        self, path: str | os.PathLike[str], *, arrangement: str | None = None, force: bool = False
    ) -> None:
        """Write the places of boards: `[[anchors]]` (.toml) or parameters for ROS (.yaml), with covariance.

        `arrangement` names one of several. Raises `BadInputError`.
        """
        place, one = Path(path), self.arrangement(arrangement)
        if place.suffix.lower() not in ANCHORS:
            raise BadInputError(f"found {place.suffix or 'no suffix'}, expected .toml or .yaml", parameter="anchors")
        head, row = ANCHORS[place.suffix.lower()]
        boards = [board for board in one.boards if board.determined]
        ids = ", ".join(str(board.tag) for board in boards)
        text = f"# Arrangement {one.name}, surveyed from ranges. Frame: {one.frame}. Metres.\n" + head.format(ids)
        for board in boards:
            upper = board.covariance_m2[np.triu_indices(3)].tolist()
            covariance = ", ".join(str(float(f"{value:.6g}")) for value in upper)
            text += row.format(board.tag, ", ".join(str(round(value, 5)) for value in board.position_m), covariance)
        write_text(place, text, force=force)

    def save_picture(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Draw the places of boards with their 95 % ellipses, as .svg, .png or .pdf.

        Raises `BadInputError` for another suffix.
        """
        from calib.surveys.figures import board_figure
        from uwblink.pages.figures import picture

        place = Path(path)
        if place.suffix.lower() not in (".svg", ".png", ".pdf"):
            raise BadInputError(f"found {place.suffix or 'no suffix'}, expected .svg, .png or .pdf", parameter="plot")
        write_bytes(place, picture(lambda _: board_figure(self.arrangements), place.suffix.lower()[1:]), force=force)

    def arrangement(self, name: str | None = None) -> SurveyedArrangement:
        """Return an arrangement by name, the only one where none is given; raises `BadInputError`."""
        known = {one.name: one for one in self.arrangements}
        if name is None and len(known) == 1:
            return self.arrangements[0]
        if name not in known:
            found = "no name was given" if name is None else f"found {name!r:.40}"
            raise BadInputError(f"{found}, there are {', '.join(known)}", parameter="arrangement")
        return known[name]
