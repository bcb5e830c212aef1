"""How fast delays drift from day to day, by fits over sessions whose dates are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from calib.data.ranges import of_host_clock
from calib.estimator.known_distances import KnownDistances
from calib.estimator.range_model import OFFSETS
from calib.estimator.score_tests import Derivative, Family
from calib.fitting.covariates import log_likelihood


def drift_of(found: KnownDistances) -> dict[str, Any]:
    """Return how fast what a tag adds to ranges drifts, for the provenance of a fit; {} where nothing can be said.

    Delays are random walks of one variance a day (`m2_per_day`: the likeliest, with its 95 % interval by the likelihood
    ratio). It is `told` where no drift at all is improbable (p < 0.01), and `by_age` where it is likelier than offsets
    of sessions that do not grow with time by a factor of e^2.
    """
    ranges, layout = found.model.ranges, found.searches[0].optimum.layout
    count, tags, pairs = len(ranges.sessions), found.model.tags, found.model.pairs
    fitted = layout.indices(["offset of tag in session"])
    if not (len(fitted) and of_host_clock(int(ranges.time_ns.min()))):
        return {}
    ends = np.searchsorted(tags, pairs.ends)[pairs.number]
    offsets = Derivative(ends * count + ranges.session[:, None], np.ones((1, 1)), len(tags) * count)
    tested = found.slopes.test(Family(kind="session", names=(), derivative=offsets, fitted=fitted))
    # What lasts within a session is in the offsets of its pairs, whose variance the information contains.
    tested = replace(tested, total=tested.total + tested.pulled, covariance=0.0 * tested.covariance)
    totals = [np.bincount(ranges.session, weights, count) for weights in (ranges.time_ns / 86_400e9, None)]
    # A session that is held out has no ranges; its date does not matter.
    days = np.maximum(totals[0] / np.maximum(totals[1], 1), ranges.time_ns.min() / 86_400e9)
    order = np.argsort(days)
    steps = np.zeros((count, count - 1))
    steps[order] = np.tri(count, count - 1, -1) * np.sqrt(np.diff(days[order]))
    variances = np.geomspace(*OFFSETS[1:], 400) ** 2
    # Rates are such that a thousand days make as much.
    rates = variances / 1000
    walk = log_likelihood(tested, np.asarray(np.kron(np.eye(len(tags)), steps)), rates)
    scatter = log_likelihood(tested, np.eye(len(tags) * count), variances)
    within = rates[walk > walk.max() - chdtri(1, 0.05) / 2]
    told = bool(walk.max() > chdtri(1, 0.02) / 2)
    return {
        "sessions": count,
        "days": round(float(np.ptp(days)), 3),
        "m2_per_day": [float(f"{one:.3g}") for one in (within[0] * told, rates[walk.argmax()], within[-1])],
        "told": told,
        "by_age": bool(walk.max() > scatter.max() + 2),
    }
