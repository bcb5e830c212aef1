"""The survey: delays, power curve and places of boards that stood still, from the ranges among them alone."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Final

from threadpoolctl import threadpool_limits

from calib.calibration.model import Calibration
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.surveys.adjustment import Adjusted, averaged
from calib.surveys.assembling import assembled
from calib.surveys.doubts import misplaced, worst
from calib.surveys.gathering import Gathered, gather
from calib.surveys.knowledge import Knowledge, load_knowledge
from calib.surveys.minima import SecondBest, best
from calib.surveys.network import Network
from calib.surveys.outcome import arrangements_of, calibration_of
from calib.surveys.result import Contradiction, SurveyResult
from calib.surveys.saying import believed_reflected, reflections_in_words, said_of, verdict_of
from calib.surveys.scales import widened as student
from calib.surveys.taken_curve import TakenCurve, corrected, taken_curve, widened_by
from uwblink.recording.schema import SHAPES

MOST_DOUBTS: Final = 0.15


def survey(
    data: Data | Iterable[Data],
    *,
    known: Knowledge | str | os.PathLike[str] = "",
    fixed_ns: Mapping[int, float] | None = None,
    pair_error_m: float | None = None,
    delays_only: bool = False,
    curve_from: Calibration | str | os.PathLike[str] | None = None,
    regardless: bool = False,
) -> SurveyResult:
    """Return the delays, the power curve and the places of boards that stood still, from their ranges alone.

    `data` is what `load_ranges` takes; true distances are not needed and not looked at. Arrangements are those that
    recordings mark (`uwblink record --arrangement`), those whose times `known` gives, or stretches in which nothing
    moves. `known` is "line" or "plane" for all arrangements, the path of a TOML file (`load_knowledge`), or a
    `Knowledge`: shapes, distances and positions, which stay what they are within their sigmas. `fixed_ns` are delays
    that are known, `pair_error_m` is the constant error of a pair in an arrangement, estimated by default.
    `delays_only` looks for no curve over power; `curve_from` is a calibration, or its path, whose curve is taken over.

    The result holds only delays that the arrangements determine. Raises `UnanswerableError` where none is, with the
    reason, and where ranges contradict what is said to be known (a line that is none, a board that was moved, exchanged
    labels, a wrong distance), unless `regardless`; `BadInputError` for arguments that cannot be used.

    >>> import calib
    >>> result = calib.survey(calib.sample_arrangements(), known="line")
    >>> delay, planted = result.calibration.delays_ns[2], 0.1
    >>> abs(delay - planted) < 3 * result.calibration.delays_std_ns[2]
    True
    """
    knowledge = _knowledge(known)
    fixed = _fixed(fixed_ns)
    if pair_error_m is not None and not (math.isfinite(pair_error_m) and pair_error_m > 0):
        raise BadInputError(f"found {pair_error_m}, expected a positive number of metres", parameter="pair_error_m")
    taken = taken_curve(curve_from)
    if taken is not None and delays_only:
        raise BadInputError("a curve is taken over, and `delays_only` asks for none", parameter="curve_from")
    gathered = gather(data, knowledge)
    if taken is not None:
        means, said = corrected(gathered.means, taken)
        gathered = replace(gathered, means=means, warnings=(*gathered.warnings, *said))
    import_module("scipy.special")
    # Small matrices: several threads make them slower, and the last digits another.
    with threadpool_limits(limits=1, user_api="blas"):
        network, names = assembled(gathered, knowledge, fixed, delays_only=delays_only or taken is not None)
        settled = _without_doubts(network, names, pair_error_m)
        findings = (*gathered.findings, *settled.findings)
        if findings and not regardless:
            told = "; ".join(one.text for one in findings)
            raise UnanswerableError(f"{told} (`regardless` surveys all the same)")
        if taken is not None:
            settled = replace(settled, found=widened_by(settled.found, taken))
        return _result(gathered, settled, findings, taken)


@dataclass(frozen=True, slots=True)
class _Settled:
    """A solution that nothing contradicts any more, and what had to go for that."""

    found: Adjusted
    second: SecondBest | None
    findings: tuple[Contradiction, ...]


def _knowledge(known: Knowledge | str | os.PathLike[str]) -> Knowledge:
    if isinstance(known, Knowledge):
        return known
    if isinstance(known, str) and known in SHAPES:
        return Knowledge(shape=known)
    if isinstance(known, str | os.PathLike):
        return load_knowledge(known)
    raise BadInputError(f"found {known!r:.40}, expected line, plane, a path or a Knowledge", parameter="known")


def _fixed(fixed_ns: Mapping[int, float] | None) -> dict[int, float]:
    for tag, delay in (fixed_ns or {}).items():
        if not math.isfinite(delay):
            raise BadInputError(f"tag {tag} has {delay}, expected a finite number of ns", parameter="fixed_ns")
    return {int(tag): float(delay) for tag, delay in (fixed_ns or {}).items()}


def _without_doubts(network: Network, names: tuple[str, ...], pair_error_m: float | None) -> _Settled:
    """Return the best solution, less what contradicts the rest, one thing after the other."""
    found, second = best(network, pair_std_m=pair_error_m)
    findings: list[Contradiction] = []
    most = max(1, int(MOST_DOUBTS * len(network.means)))
    while len(findings) < most and (doubted := worst(found, names, pair_error_m)):
        findings.append(Contradiction(doubted[0].kind, doubted[0].text))
        found = doubted[1]
    if findings:
        found, second = best(found.network, pair_std_m=pair_error_m)
    findings += [Contradiction(kind, text) for kind, text in misplaced(found)]
    return _Settled(averaged(found), second, tuple(findings))


def _result(
    gathered: Gathered, settled: _Settled, findings: tuple[Contradiction, ...], taken: TakenCurve | None
) -> SurveyResult:
    found = settled.found
    verdict = verdict_of(found)
    free = verdict.named("delay")
    if len(free) == len(verdict.unknowns) - len(found.network.fixed_m):
        raise UnanswerableError(
            f"the arrangements determine no delay: {'; '.join(d.words for d in verdict.free)} can change without "
            "changing any range; `calib plan` says which arrangements or distances would tell",
            undetermined=[[int(tag) for tag in free]],
        )
    reflected = believed_reflected(found)
    warnings = [
        *gathered.warnings,
        *(one.text for one in findings),
        *reflections_in_words(reflected),
        *said_of(found, settled.second, verdict),
    ]
    widened = student(found.freedom)
    arrangements = arrangements_of(found, widened)
    more = {
        "surveyed": [one.to_dict() for one in arrangements],
        "reflected": [one.to_dict() for one in reflected],
        "findings": [one.text for one in findings],
        "second_best": None if settled.second is None else round(settled.second.worse, 2),
    }
    return SurveyResult(
        calibration=calibration_of(gathered, found, verdict, widened, warnings, more, taken),
        arrangements=arrangements,
        verdict=verdict,
        pair_error_m=found.pair_std_m,
        second_best=settled.second,
        contradictions=findings,
        warnings=tuple(warnings),
        reflected=reflected,
    )
