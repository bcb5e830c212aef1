"""The survey: delays, power curve and places of boards that stood still, from the ranges among them alone."""

from __future__ import annotations

import math
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
from calib.surveys.network import DIMENSIONS, Boards, CurvePrior, Known, Network, numbered
from calib.surveys.outcome import result_of, widened_by
from calib.surveys.recordings import LIFT, SurveyData, read_surveys
from calib.surveys.result import SurveyResult
from calib.surveys.solution import averaged, solve
from uwblink.recording.schema import SHAPES, KnownDistance

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
        most = len(findings) + max(1, int(MOST_FINDINGS * len(network.means)))
        while len(findings) < most and (fault := likeliest_fault(found)):
            finding, found = fault
            findings.append(finding)
        if len(findings) > len(gathered.findings):
            found, second = solve(found.network)
        findings += wrong_orders(found)
        if findings and not asked.regardless:
            text = "; ".join(one.text for one in findings)
            raise UnanswerableError(f"{text} (`regardless` surveys all the same)")
        found = averaged(found)
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
    known = given_calibration(curve_from, "curve_from")
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
    means = gathered.means
    tags = [sorted(set(means.ends[means.arrangement == k].ravel().tolist())) for k in range(len(gathered.arrangements))]
    there = {one.name: set(own) for one, own in zip(gathered.arrangements, tags, strict=True)}
    check_knowledge(knowledge, there)
    missing = sorted(set(fixed_ns) - set(means.tags()))
    if missing:
        raise BadInputError(f"tag {missing[0]} is not in the recordings", parameter="fixed_ns")
    used = [k for k, own in enumerate(tags) if own]
    arrangements = tuple(_boards(gathered, knowledge, k, tuple(tags[k])) for k in used)
    distances = (*gathered.distances, *knowledge.distances)
    return Network(
        means=replace(means, arrangement=np.searchsorted(used, means.arrangement)),
        arrangements=arrangements,
        tags=tuple(means.tags()),
        known=_known(arrangements, knowledge, distances),
        fixed_ns=dict(fixed_ns),
        curve=CurvePrior.at(means.lifted) if curve else None,
    )


def _boards(gathered: SurveyData, knowledge: Knowledge, number: int, tags: tuple[int, ...]) -> Boards:
    one = gathered.arrangements[number]
    shape, order = knowledge.shape_of(one), knowledge.order_of(one)
    heights = {p.position_m[2] for p in knowledge.positions if p.arrangement in ("", one.name) and p.tag in tags}
    if heights and shape == "line":
        raise BadInputError(
            f"{one.name}: positions are for a plane or for space; on a line give distances", parameter="known"
        )
    if shape == "plane" and len(heights) > 1:
        raise BadInputError(f"{one.name}: a plane is that of x and y; its positions differ in z", parameter="known")
    strangers = sorted(set(order) - set(tags))
    if strangers or len(set(order)) < len(order):
        who = f"tag {strangers[0]}, which does not range there" if strangers else "a tag twice"
        raise BadInputError(f"{one.name}: its order of boards has {who}", parameter="known")
    return Boards(one.name, DIMENSIONS[shape], tags, order)


def _known(arrangements: tuple[Boards, ...], knowledge: Knowledge, distances: tuple[KnownDistance, ...]) -> Known:
    """Return what is known as columns. What holds in several arrangements is one reading, not several."""
    number = numbered(arrangements)
    lengths, places = [], []
    for statement, d in enumerate(distances):
        held = [
            k
            for k, boards in enumerate(arrangements)
            if d.arrangement in ("", boards.name) and {d.first, d.second} <= set(boards.tags)
        ]
        sigma = d.sigma_m * math.sqrt(len(held))
        lengths += [(number[k, d.first], number[k, d.second], d.distance_m, sigma, statement) for k in held]
    for p in knowledge.positions:
        held = [
            k for k, boards in enumerate(arrangements) if p.arrangement in ("", boards.name) and p.tag in boards.tags
        ]
        for k in held:
            height = 0.0 if arrangements[k].dimensions == 2 else p.position_m[2]
            places.append((number[k, p.tag], *p.position_m[:2], height, p.sigma_m * math.sqrt(len(held))))
    ends, at = np.array(lengths).reshape(-1, 5), np.array(places).reshape(-1, 5)
    return Known(
        ends=ends[:, :2].astype(np.int64),
        distance_m=ends[:, 2],
        distance_std_m=ends[:, 3],
        statement=ends[:, 4].astype(np.int64),
        at=at[:, 0].astype(np.int64),
        position_m=at[:, 1:4],
        position_std_m=at[:, 4],
        names=tuple(
            f"the known distance of {d.first} and {d.second}{' in ' + d.arrangement if d.arrangement else ''}"
            for d in distances
        ),
    )
