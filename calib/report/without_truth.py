"""What a calibration rests on that was made without known distances: criteria of its own, and a section of a report.

Both are read from the calibration's provenance, so that they stand in the report of every evaluation as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np

from calib.calibration.model import Calibration, rests_on
from calib.report.blocks import Block, Heading, Picture, Table, Text
from calib.report.grades import Criterion, graded
from calib.spread import TWO_SIDED_95
from calib.surveys.surveyed import SurveyedArrangement

MOST_REFLECTED: Final = 0.05
WORST_REFLECTED: Final = 0.2
"""Share of pairs that may be reflected: where they are more, some hide in the places of boards."""

MOST_PAIR_ERROR_M: Final = 0.03
WORST_PAIR_ERROR_M: Final = 0.06
LEAST_FREEDOM: Final = 10.0
FEW_FREEDOM: Final = 4.0
"""Ranges beyond what the unknowns take: with few, a wrong one is not seen, and the spread of errors is a guess."""

MOST_DISTANCE_M: Final = 0.02
WORST_DISTANCE_M: Final = 0.05
SHARED_NS: Final = 0.1
"""How well what all delays share is to be known: 3 cm of every range."""

CLEARLY: Final = 9.0


def foundations(calibration: Calibration) -> list[Block]:
    """Return the section on what stands in the place of known distances; nothing where distances were known."""
    made = calibration.provenance
    if made.get("recipe") == "survey":
        return [Heading("What it rests on"), *_of_survey(calibration)]
    if told := rests_on(made):
        return [Heading("What it rests on"), *_of_flight(made, told)]
    return []


def criteria(calibration: Calibration) -> list[Criterion]:
    """Return what is asked of a calibration without known distances beside what is asked of all."""
    made = calibration.provenance
    if made.get("recipe") == "survey":
        return [one for ask in OF_SURVEYS for one in ask(calibration)]
    return _distances_found(calibration) if rests_on(made) else []


def _redundant(calibration: Calibration) -> list[Criterion]:
    freedom = float(calibration.provenance["rests_on"]["freedom"])
    pairs = int(calibration.provenance["pairs"])
    return [
        Criterion(
            "Do the arrangements check each other?",
            f"at least {LEAST_FREEDOM:g} ranges of pairs more than the unknowns take",
            f"{freedom:.0f} more, of {pairs}",
            graded(freedom >= LEAST_FREEDOM, freedom >= FEW_FREEDOM),
            f"{freedom:.0f} of {pairs} ranges of pairs are left to check the rest",
        )
    ]


def _pair_error(calibration: Calibration) -> list[Criterion]:
    error = float(calibration.provenance["rests_on"]["pair_error_m"])
    return [
        Criterion(
            "Are the constant errors of pairs those of such boards?",
            f"at most {100 * MOST_PAIR_ERROR_M:g} cm, beside reflections",
            f"{100 * error:.1f} cm",
            graded(error <= MOST_PAIR_ERROR_M, error <= WORST_PAIR_ERROR_M),
            f"a pair has a constant error of {100 * error:.1f} cm in an arrangement",
        )
    ]


def _reflected(calibration: Calibration) -> list[Criterion]:
    made = calibration.provenance
    pairs = int(made["pairs"])
    count = sum(float(row["chance"]) for row in made.get("reflected", []))
    share = count / max(pairs, 1)
    return [
        Criterion(
            "Are few pairs reflected?",
            f"at most {100 * MOST_REFLECTED:g} % of them",
            f"{count:.1f} of {pairs} ({100 * share:.0f} %)",
            graded(share <= MOST_REFLECTED, share <= WORST_REFLECTED),
            f"{100 * share:.0f} % of the pairs are believed to be reflected",
        )
    ]


def _only_one(calibration: Calibration) -> list[Criterion]:
    worse = calibration.provenance.get("second_best")
    clear = worse is None or float(worse) >= CLEARLY
    said = "none was found" if worse is None else f"{float(worse):.0f} worse"
    return [
        Criterion(
            "Is there no other solution?",
            f"the second-best worse by at least {CLEARLY:g} in -2 log likelihood: three standard deviations",
            said,
            graded(clear, True),
            "no other places of boards agree with the ranges" if clear else "other places of boards agree as well",
        )
    ]


def _contradicted(calibration: Calibration) -> list[Criterion]:
    found = list(map(str, calibration.provenance.get("findings", [])))
    return [
        Criterion(
            "Do the ranges agree with what is said to be known?",
            "no line that is none, no wrong tape, no exchanged labels, no board that was moved",
            "; ".join(found) or "they do",
            graded(not found, False),
            f"{len(found)} contradiction{'s' * (len(found) > 1)} to what is known" if found else "nothing contradicts",
        )
    ]


def _shared(calibration: Calibration) -> list[Criterion]:
    known = calibration.uncertainty
    if known is None or not known.tags:
        return []
    half = TWO_SIDED_95 * math.sqrt(max(float(np.mean(np.array(known.delays_ns2))), 0.0))
    return [
        Criterion(
            "Is what all delays share known?",
            f"95 % interval of their mean within ± {SHARED_NS:g} ns; a taped distance or a known delay tells it",
            f"± {half:.3f} ns",
            graded(half <= SHARED_NS, half <= 3 * SHARED_NS),
            f"what all delays share is known to ± {half:.2f} ns",
        )
    ]


def _distances_found(calibration: Calibration) -> list[Criterion]:
    off = calibration.provenance.get("distance_std_m")
    if not isinstance(off, int | float):
        return []
    return [
        Criterion(
            "Are the distances that stand for the true ones known well enough?",
            f"standard error at most {100 * MOST_DISTANCE_M:g} cm",
            f"{100 * off:.1f} cm",
            graded(off <= MOST_DISTANCE_M, off <= WORST_DISTANCE_M),
            f"distances were found to {100 * off:.1f} cm",
        )
    ]


OF_SURVEYS: Final[tuple[Callable[[Calibration], list[Criterion]], ...]] = (
    _contradicted,
    _redundant,
    _pair_error,
    _reflected,
    _only_one,
    _shared,
)


def _of_survey(calibration: Calibration) -> list[Block]:
    made = calibration.provenance
    rests = made["rests_on"]
    surveyed = [SurveyedArrangement.from_dict(row) for row in made.get("surveyed", [])]
    beside = [
        _counted(int(rests.get("known_distances", 0)), "known distance"),
        _counted(int(rests.get("known_positions", 0)), "known position"),
        _counted(len(made.get("fixed_ns", {})), "known delay"),
    ]
    blocks: list[Block] = [
        Text(
            f"No true distance was known. {_counted(int(made['pairs']), 'mean range')} of pairs in "
            f"{_counted(len(rests['arrangements']), 'arrangement')} of boards that stood still must fit together in "
            f"space, with {', '.join(beside)}. A pair has a constant error of {100 * float(rests['pair_error_m']):.1f} "
            f"cm in an arrangement; {float(rests['freedom']):.0f} degrees of freedom are left."
        )
    ]
    if not surveyed:
        return blocks
    blocks += [
        Table(["arrangement", "boards", "said to be", "places within (95 %)", "frame"],
              [_row(one) for one in surveyed], words=True),
        Picture(
            "places",
            partial(_draw, surveyed),
            "Where boards stood, from above, with ellipses that hold them with 95 %; ten times as large and dashed "
            "where they would not be seen.",
        ),
    ]  # fmt: skip
    reflected = [
        [row["arrangement"], "-".join(map(str, row["between"])), f"{100 * row['longer_m']:+.0f}",
         f"{100 * row['chance']:.0f} %"]
        for row in made.get("reflected", [])
    ]  # fmt: skip
    if reflected:
        blocks += [
            Text("Pairs that are, or may be, longer by a reflection; they count for less by as much:"),
            Table(["arrangement", "pair", "longer by (cm)", "probability"], reflected),
        ]
    return blocks


def _draw(surveyed: list[SurveyedArrangement], width_in: float) -> Any:
    from calib.surveys.figures import board_figure

    return board_figure(surveyed, width_in)


def _row(one: SurveyedArrangement) -> list[str]:
    known = [board for board in one.boards if board.determined]
    far = [TWO_SIDED_95 * math.sqrt(max(float(board.covariance_m2.trace()), 0.0)) for board in known]
    within = f"± {100 * max(far):.1f} cm" if far else "undetermined"
    return [one.name, ", ".join(str(board.tag) for board in one.boards), one.known or "nothing", within, one.frame]


def _of_flight(made: Mapping[str, Any], told: str) -> list[Block]:
    rests = made["rests_on"]
    rows = [
        ["moving bodies", _names(rests.get("moving"))],
        ["positions known for", f"{float(rests.get('known_s', 0.0)):.1f} s"],
        ["anchors at given places", _names(rests.get("anchors_given"))],
        ["anchors whose places were found", _names(rests.get("anchors_sought"))],
        ["attitudes from", str(rests.get("attitudes", "nowhere"))],
        ["distances by tape", str(rests.get("distances", 0))],
        ["heights of", _names(rests.get("heights"))],
    ]
    off = made.get("distance_std_m")
    if isinstance(off, int | float):
        rows.append(["distances found to (standard error)", f"{100 * off:.1f} cm"])
    if made.get("left_open"):
        rows.append(["left open", str(made["left_open"])])
    return [
        Text(f"No true distance was known: {told}. Trajectories were found together with the delays."),
        Table(["what", "of this calibration"], [row for row in rows if row[1]], words=True),
    ]


def _names(found: object) -> str:
    return ", ".join(map(str, found)) if isinstance(found, list) and found else "none"


def _counted(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'s' * (count != 1)}"
