"""What a survey returns: a calibration, where boards stood, and what both rest on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibration.model import Calibration
from calib.errors import BadInputError
from calib.information import Verdict
from calib.surveys.minima import SecondBest
from calib.surveys.surveyed import SurveyedArrangement, SurveyedBoard
from uwblink.output import write_bytes, write_text

FORMATS = {".toml": "toml", ".yaml": "yaml", ".yml": "yaml"}


PICTURES = (".svg", ".png", ".pdf")


@dataclass(frozen=True, slots=True)
class Contradiction:
    """What contradicts the ranges: "shape" (a line that is none), "distance", "labels" or "moved", and it in words."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class ReflectedPair:
    """A pair that is believed to be reflected in an arrangement: by how much its range is off, and how probable it is.

    `chance` below a half is for one that may be reflected instead of another.
    """

    arrangement: str
    first: int
    second: int
    longer_m: float
    chance: float

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON takes it."""
        return {
            "arrangement": self.arrangement,
            "between": [self.first, self.second],
            "longer_m": round(self.longer_m, 4),
            "chance": round(self.chance, 3),
        }


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurveyResult:
    """A calibration from boards that stood still, and where they stood.

    `pair_error_m` is the constant error that a pair has in an arrangement, as a standard deviation; `verdict` says what
    of the delays (in ns) is determined; `contradictions` are those between the ranges and what was said to be
    known; `warnings` what a user should know. `second_best` is the best other solution, `reflected` are
    pairs that are, or may be, reflected.

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
    contradictions: tuple[Contradiction, ...]
    warnings: tuple[str, ...]
    reflected: tuple[ReflectedPair, ...] = ()

    @property
    def findings(self) -> tuple[str, ...]:
        """The contradictions in words."""
        return tuple(one.text for one in self.contradictions)

    def __repr__(self) -> str:
        """Return the calibration as a table, below what it rests on, above the warnings."""
        lines = [self.headline(), repr(self.calibration), *(f"warning: {text}" for text in self.warnings)]
        return "\n".join(lines)

    def headline(self) -> str:
        """Return what the survey rests on, in one line."""
        count = len(self.arrangements)
        pairs = self.calibration.provenance["pairs"]
        return (
            f"Survey of {count} arrangement{'s' * (count > 1)}, {pairs} pairs: constant error of a pair "
            f"{100 * self.pair_error_m:.1f} cm"
        )

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the calibration as JSON, whole or not at all; replaces a file only with `force`."""
        self.calibration.save(path, force=force)

    def save_anchors(
        self, path: str | os.PathLike[str], *, arrangement: str | None = None, force: bool = False
    ) -> None:
        """Write where boards stood: `[[anchors]]` (.toml) or parameters for ROS (.yaml), with covariance.

        `arrangement` names which, where there are several. Raises `BadInputError`.
        """
        place = Path(path)
        form = FORMATS.get(place.suffix.lower())
        if form is None:
            raise BadInputError(f"found {place.suffix or 'no suffix'}, expected .toml or .yaml", parameter="anchors")
        lines = _toml if form == "toml" else _yaml
        write_text(place, "\n".join(lines(self.arrangement(arrangement))) + "\n", force=force)

    def save_picture(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Draw where boards stood, with the ellipses that hold them with 95 %, as .svg, .png or .pdf.

        Raises `BadInputError` for another suffix.
        """
        from calib.surveys.figures import board_picture

        place = Path(path)
        if place.suffix.lower() not in PICTURES:
            raise BadInputError(f"found {place.suffix or 'no suffix'}, expected .svg, .png or .pdf", parameter="plot")
        write_bytes(place, board_picture(self.arrangements, place.suffix.lower()[1:]), force=force)

    def arrangement(self, name: str | None = None) -> SurveyedArrangement:
        """Return an arrangement by name, the only one where none is given; raises `BadInputError`."""
        known = {one.name: one for one in self.arrangements}
        if name is None and len(known) == 1:
            return self.arrangements[0]
        if name not in known:
            found = "none is named" if name is None else f"found {name!r:.40}"
            raise BadInputError(f"{found}, there are {', '.join(known)}", parameter="arrangement")
        return known[name]


def _rows(found: SurveyedArrangement) -> Iterator[tuple[SurveyedBoard, list[float], list[float]]]:
    for board in found.boards:
        if board.determined:
            upper = board.covariance_m2[np.triu_indices(3)].tolist()
            yield board, [round(value, 5) for value in board.position_m], [float(f"{value:.6g}") for value in upper]


def _toml(found: SurveyedArrangement) -> Iterator[str]:
    yield f"# Arrangement {found.name}, surveyed from ranges. Frame: {found.frame}. Metres."
    yield "# covariance_m2: xx xy xz yy yz zz, m^2."
    for board, position, upper in _rows(found):
        yield ""
        yield "[[anchors]]"
        yield f"id = {board.tag}"
        yield f"position_m = [{', '.join(map(str, position))}]"
        yield f"covariance_m2 = [{', '.join(map(str, upper))}]"


def _yaml(found: SurveyedArrangement) -> Iterator[str]:
    yield f"# Arrangement {found.name}, surveyed from ranges. Frame: {found.frame}. Metres."
    yield "# covariance: xx xy xz yy yz zz, m^2."
    yield "/**:"
    yield "  ros__parameters:"
    yield "    anchors:"
    yield f"      ids: [{', '.join(str(board.tag) for board, _, _ in _rows(found))}]"
    for board, position, upper in _rows(found):
        yield f"      anchor_{board.tag}:"
        yield f"        position: [{', '.join(map(str, position))}]"
        yield f"        covariance: [{', '.join(map(str, upper))}]"
