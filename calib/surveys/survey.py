"""The survey: delays, power curve and places of boards that stood still, from the ranges among them alone."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib.calibration.model import Calibration, given_calibration
from calib.calibration.power_curves import ALPHA_DBM, Curve
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.settings import SurveySettings
from calib.surveys.checks import likeliest_fault, wrong_orders
from calib.surveys.knowledge import Knowledge, check_knowledge, load_knowledge
from calib.surveys.network import DIMENSIONS, Boards, CurvePrior, Network
from calib.surveys.outcome import in_frames, result_of, widened_by
from calib.surveys.recordings import LIFT, SurveyData, read_surveys
from calib.surveys.result import SurveyResult
from calib.surveys.solution import averaged, solve
from uwblink.recording.schema import SHAPES

MOST_FINDINGS = 0.15
"""Share of the means, as a number of findings, after which no more is looked for."""


def survey(data: Data | Iterable[Data], settings: SurveySettings | None = None, **changes: Any) -> SurveyResult:
    """Return the delays, the power curve and the places of boards that stood still, from their ranges alone.

    `data` is what `load_ranges` takes; true distances are not needed and not looked at. Arrangements are those that
    recordings mark (`uwblink record --arrangement`), those whose times `known` gives, or stretches in which nothing
    moves. `settings` and keyword arguments named like its fields (`SurveySettings`, which explains them) say what is
    known and what is fitted.

    The result holds only delays that the arrangements determine. Raises `UnanswerableError` where none is, with the
    reason, and where ranges contradict what is said to be known (a line that is none, a board that was moved, exchanged
    labels, a wrong distance), unless `regardless`; `BadInputError` for arguments that cannot be used.

    >>> import calib
    >>> result = calib.survey(calib.sample_arrangements(), known="line")
    >>> delay, planted = result.calibration.delays_ns[2], 0.1
    >>> abs(delay - planted) < 3 * result.calibration.delays_std_ns[2]
    True
    """
    asked = replace(settings or SurveySettings(), **changes)
    knowledge, taken = _knowledge(asked.known), _checked_curve(asked.curve_from)
    # Small matrices: several threads make them slower, and the last digits another.
    with threadpool_limits(limits=1, user_api="blas"):
        gathered = read_surveys(data, knowledge)
        if taken is not None:
            gathered = _less_curve(gathered, taken.bias_curve)
        network = network_of(gathered, knowledge, asked.fixed_ns, curve=not asked.delays_only and taken is None)
        found, second = solve(replace(network, pair_m=asked.pair_error_m))
        findings = list(gathered.findings)
        most = len(findings) + max(1, int(MOST_FINDINGS * len(network.means.range_m)))
        while len(findings) < most and (fault := likeliest_fault(found)):
            finding, found = fault
            findings.append(finding)
        if len(findings) > len(gathered.findings):
            found, second = solve(found.network)
        findings += wrong_orders(found)
        if findings and not asked.regardless:
            text = "; ".join(one.text for one in findings)
            raise UnanswerableError(f"{text} (`regardless` surveys all the same)")
        found = averaged(in_frames(found))
        if taken is not None:
            found = widened_by(found, taken)
        return result_of(gathered, found, second, tuple(findings), taken, asked)


def _knowledge(known: Knowledge | str | os.PathLike[str]) -> Knowledge:
    if isinstance(known, Knowledge):
        return known
    if isinstance(known, str) and known in SHAPES:
        return Knowledge(shape=known)
    if isinstance(known, str | os.PathLike):
        return load_knowledge(known)
    raise BadInputError(f"found {known!r:.40}, expected line, plane, a path or a Knowledge", parameter="known")


def _checked_curve(curve_from: Calibration | str | os.PathLike[str] | None) -> Calibration | None:
    """Return the calibration whose curve is taken over.

    Raises `BadInputError` for one of another lifting, and for one that has no curve.
    """
    known = None if curve_from is None else given_calibration(curve_from, "curve_from")
    if known is not None and (known.lift != LIFT or known.alpha_dbm != ALPHA_DBM):
        text = f"it lifts powers by {known.lift} above {known.alpha_dbm:g} dBm, expected {LIFT} above {ALPHA_DBM:g} dBm"
        raise BadInputError(text, parameter="curve_from")
    if known is not None and known.bias_curve.flat:
        raise BadInputError("it has no curve over power", parameter="curve_from")
    return known


def _less_curve(gathered: SurveyData, curve: Curve) -> SurveyData:
    """Return the means less a curve, with a warning of powers that it was not fitted at."""
    means = gathered.means
    if not np.isfinite(means.lifted).all():
        raise UnanswerableError("pairs have no power, so no curve can be taken off (`curve_from`)")
    beyond = int(np.count_nonzero(~curve.inside(means.lifted)))
    more = (f"{beyond} pairs have powers that the curve taken over was not fitted at",) if beyond else ()
    less = replace(means, range_m=means.range_m - curve(means.lifted))
    return replace(gathered, means=less, warnings=(*gathered.warnings, *more))


def network_of(gathered: SurveyData, knowledge: Knowledge, fixed_ns: Mapping[int, float], *, curve: bool) -> Network:
    """Return the network of means and of what is known beside them."""
    means, arrangements = gathered.means, list[Boards]()
    tags = [tuple(np.unique(means.ends[means.arrangement == k]).tolist()) for k in range(len(gathered.arrangements))]
    check_knowledge(knowledge, {one.name: set(own) for one, own in zip(gathered.arrangements, tags, strict=True)})
    everyone = tuple(np.unique(means.ends).tolist())
    missing = sorted(set(fixed_ns) - set(everyone))
    if missing:
        raise BadInputError(f"tag {missing[0]} is not in the recordings", parameter="fixed_ns")
    used = [k for k, own in enumerate(tags) if own]
    for k in used:
        one, order = gathered.arrangements[k], knowledge.order_of(gathered.arrangements[k])
        boards = Boards(one.name, DIMENSIONS[knowledge.shape_of(one)], tags[k], order)
        heights = {
            p.position_m[2] for p in knowledge.positions if p.arrangement in ("", one.name) and p.tag in boards.tags
        }
        for wrong, text in (
            (heights and boards.dimensions == 1, "positions are for a plane or for space; on a line give distances"),
            (len(heights) > 1 and boards.dimensions == 2, "a plane is that of x and y; its positions differ in z"),
            (set(order) - set(tags[k]), "its order of boards has a tag that does not range there"),
            (len(set(order)) < len(order), "its order of boards has a tag twice"),
        ):
            if wrong:
                raise BadInputError(f"{one.name}: {text}", parameter="known")
        arrangements.append(boards)
    return Network(
        means=replace(means, arrangement=np.searchsorted(used, means.arrangement)),
        arrangements=tuple(arrangements),
        tags=everyone,
        distances=(*gathered.distances, *knowledge.distances),
        positions=knowledge.positions,
        fixed_ns=dict(fixed_ns),
        curve=CurvePrior.at(means.lifted) if curve else None,
    )
