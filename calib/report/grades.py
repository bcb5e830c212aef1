"""Criteria and their grades, and the sentence that they come to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from calib.report.blocks import Block, Table, Text

GOOD: Final = "good"
DOUBT: Final = "doubt"
BAD: Final = "bad"
MARKS: Final = {GOOD: "✓ yes", DOUBT: "! in part", BAD: "✗ no"}


class Criterion(NamedTuple):
    """A question, what is asked for, what was found, how well that is (good, doubt, bad), and it in a few words."""

    question: str
    asked: str
    found: str
    grade: str
    told: str


def graded(good: bool, tolerable: bool) -> str:
    """Return the grade of what is good, or at least tolerable."""
    return GOOD if good else DOUBT if tolerable else BAD


def judgement(found: Sequence[Criterion]) -> list[Block]:
    """Return a sentence on criteria, and the table behind it."""
    kind, text = _sentence(found)
    rows = [[one.question, MARKS[one.grade], one.found, one.asked] for one in found]
    return [Text(text, kind), Table(["criterion", "met", "found", "asked for"], rows, words=True)]


def _sentence(found: Sequence[Criterion]) -> tuple[str, str]:
    bad = [one.told for one in found if one.grade == BAD]
    doubt = [one.told for one in found if one.grade == DOUBT]
    if bad:
        more = f" Also: {_listed(doubt)}." if doubt else ""
        return BAD, f"Not fit for use. {_begun(_listed(bad))}.{more}"
    if doubt:
        return DOUBT, f"Fit for use, with reservations. {_begun(_listed(doubt))}."
    return GOOD, f"Fit for use. All {len(found)} criteria are met: {_listed([one.told for one in found])}."


def _listed(texts: Sequence[str]) -> str:
    return "; ".join(texts)


def _begun(text: str) -> str:
    return text[:1].upper() + text[1:]
