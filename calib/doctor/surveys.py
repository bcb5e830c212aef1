"""Recordings of boards that stood still, in arrangements: surveyed, and what contradicts or weakens the survey."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.doctor.base import Finding
from calib.errors import UnanswerableError
from calib.sources import Data
from calib.surveys.gathering import gather
from calib.surveys.knowledge import Knowledge
from calib.surveys.power import NARROWEST_DB, in_dbm
from calib.surveys.result import Contradiction, SurveyResult
from calib.surveys.surveying import survey

FAULTS: Final = {
    "moved": ("board moved within an arrangement", "record that arrangement again, or end it before"),
    "shape": ("arrangement not as it is said to be", "put the boards straight, or record without `known`"),
    "distance": ("wrong known distance", "measure it again, antenna to antenna, or leave it out"),
    "labels": ("exchanged labels", "look at the labels of these two boards"),
}
"""What a contradiction is called, and what to do about it."""

MANY: Final = 0.1
"""Share of pairs that are believed to be reflected, from which places are worth a change."""


def surveyed(recordings: list[Data]) -> Iterator[Finding]:
    """Yield what a survey of recordings finds wrong: with what is known, with places, with powers."""
    yield from _powers(recordings)
    try:
        found = survey(recordings, regardless=True)
    except UnanswerableError as error:
        yield from _contradicted(gather(recordings, Knowledge()).findings)
        yield Finding("survey determines nothing", str(error), "make the arrangements that calib plan advises", 0.95)
        return
    yield from _contradicted(found.contradictions)
    yield from _weak(found)


def _contradicted(found: tuple[Contradiction, ...]) -> Iterator[Finding]:
    for one in found:
        fault, remedy = FAULTS[one.kind]
        yield Finding(fault, one.text.partition("; ")[0], remedy, 0.9)


def _weak(found: SurveyResult) -> Iterator[Finding]:
    made = found.calibration.provenance
    if made["undetermined"]:
        who = ", ".join(map(str, made["undetermined"][0]))
        yield Finding(
            "delays that a survey leaves open",
            f"the arrangements do not determine the delays of {who}",
            "make another arrangement, or tape a distance: calib plan says which",
            0.95,
        )
    likely = [one for one in found.reflected if one.chance > 0.5]
    if len(likely) > MANY * made["pairs"]:
        who = ", ".join(f"{one.first}-{one.second} in {one.arrangement}" for one in likely)
        yield Finding(
            "many reflected pairs",
            f"{len(likely)} of {made['pairs']} pairs are believed to be reflected: {who}",
            "put boards where they see each other, away from walls and metal",
            0.8,
        )
    if found.second_best is not None and found.second_best.ambiguous:
        who = ", ".join(map(str, found.second_best.tags))
        yield Finding(
            "two solutions of a survey",
            f"{found.second_best.arrangement}: boards {who} could as well be elsewhere",
            "tape a distance that tells them apart, and give it as known",
            0.7,
        )


def _powers(recordings: list[Data]) -> Iterator[Finding]:
    try:
        lifted = gather(recordings, Knowledge()).means.lifted
    except UnanswerableError:
        return
    if np.isfinite(lifted).all() and (lifted > 0).all() and np.ptp(in_dbm(lifted)) < NARROWEST_DB:
        yield Finding(
            "powers that hardly vary",
            f"mean powers of pairs lie within {np.ptp(in_dbm(lifted)):.1f} dB, and a curve over power needs "
            f"{NARROWEST_DB:g}",
            "make arrangements with nearer and farther boards, or take the curve of another calibration (`curve_from`)",
            0.8,
        )
