"""Recordings of boards that stood still, in arrangements: surveyed, and what contradicts or weakens the survey."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.data.sources import Data
from calib.errors import UnanswerableError
from calib.findings import Candidate, Finding
from calib.surveys.knowledge import Knowledge
from calib.surveys.network import NARROWEST_DB, in_dbm
from calib.surveys.recordings import read_surveys
from calib.surveys.result import SurveyResult
from calib.surveys.survey import survey


def surveyed(recordings: list[Data]) -> Iterator[Candidate]:
    """Yield what a survey of recordings finds wrong: with what is known, with places, with powers.

    The survey itself has judged: what it says is not tested again.
    """
    contradictions: tuple[Finding, ...] = ()
    found: SurveyResult | None = None
    try:
        given = read_surveys(recordings, Knowledge())
        contradictions, lifted = given.findings, given.means.lifted
        if np.isfinite(lifted).all() and (lifted > 0).all() and np.ptp(in_dbm(lifted)) < NARROWEST_DB:
            yield Candidate(
                "powers that hardly vary",
                f"mean powers of pairs lie within {np.ptp(in_dbm(lifted)):.1f} dB, and a curve over power needs "
                f"{NARROWEST_DB:g}",
            )
        found = survey(recordings, regardless=True)
    except UnanswerableError as error:
        yield Candidate("survey determines nothing", str(error))
    for one in found.contradictions if found else contradictions:
        yield Candidate(one.fault, one.evidence)
    if found:
        yield from _weak(found)


def _weak(found: SurveyResult) -> Iterator[Candidate]:
    made, second = found.calibration.provenance, found.second_best
    if made["undetermined"]:
        who = ", ".join(map(str, made["undetermined"][0]))
        yield Candidate("delays that a survey leaves open", f"the arrangements do not determine the delays of {who}")
    likely = [f"{one.first}-{one.second} in {one.arrangement}" for one in found.reflected if one.chance > 0.5]
    if len(likely) > 0.1 * made["pairs"]:
        evidence = f"{len(likely)} of {made['pairs']} pairs are believed to be reflected: {', '.join(likely)}"
        yield Candidate("many reflected pairs", evidence)
    if second is not None and second.ambiguous:
        evidence = f"{second.arrangement}: boards {', '.join(map(str, second.tags))} could as well be elsewhere"
        yield Candidate("two solutions of a survey", evidence)
