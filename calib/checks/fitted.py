"""Checks of a fit by its residuals: whether one more unknown is significant, and its effect on the delays.

All tests share one false-alarm budget. Random offsets with one variance (pairs, sessions) are unknowns of the fit, so
the intervals always include their variance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.special import expit, ndtr

from calib.calibration.power_curves import basis
from calib.checks.places import place_covariance
from calib.estimator.arrival_rows import OFFSET_OF_PATH, PATH_SIGNS, ArrivalModel
from calib.estimator.covariance import of_few_draws
from calib.estimator.inverse import positive_part
from calib.estimator.known_distances import RangeFit
from calib.estimator.range_model import (
    METRES_A_NS,
    OFFSET_OF_BODIES,
    OFFSET_OF_PAIR,
    TYPICAL_OFFSET_M,
    RangeModel,
    free_ends,
)
from calib.estimator.range_rows import Mixture
from calib.estimator.score_tests import Derivative, Family, FoundOffset, Slopes, Tested, search, widening
from calib.estimator.score_tests import findings as offsets_of
from calib.estimator.time_blocks import FEWEST_STRETCHES
from calib.estimator.to_calibration import bias_curves
from calib.findings import FIT_LEVELS, NAMED_DETOUR_M, SMALLEST_NS, Finding, combined, warning
from calib.pairs import pairs_of_bodies
from calib.spread import less_medians
from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

OFFSET_SPANS, SPAN_S = 6, 20.0
"""Number of spans of time in which a tag may have an offset, and their minimum length: twice the longest memory of
errors in the worlds of `make worlds`, so that the memory can be estimated within a span. Six spans locate a change to a
sixth of the time."""

MATTERS, CLEARLY = 1.0, 4.0
"""A finding is named if it moves some delay by this number of standard errors (a smaller effect is within the
interval); a small offset needs the second number (one in 16 000 by chance)."""

SMALLEST_M = 0.01
"""A smaller offset may be an error of a lever arm measured by a ruler: it widens intervals, and is named only if its
effect is large."""

HIDDEN, OFTEN = 0.8, 0.45
"""Shares of reflected ranges from which a pair is named, and a tag (mean of its pairs). Judgements: delays depend on
the direct ranges."""

UNIT = np.ones((1, 1))
"""The derivative of a range by its own offset."""


def examine_fit(
    found: RangeFit, undetermined: Sequence[int] = (), *, corrected: bool = False
) -> tuple[Floats, list[Finding]]:
    """Test a fit against alternatives with one more unknown each.

    Delays of some tags may be `undetermined`; ranges may be `corrected` by a given curve.

    Returns the covariance (tags, tags) of the delays in ns^2, which includes the effect of misfits, and findings about
    them.
    """
    slopes, louder, alone = found.slopes, change_per_decibel(found), len(found.searches) > 1
    missing_m = None if alone else errors_of_readings(found.model, louder)
    readings = None if missing_m is None else missing_m / max(_root_mean_square(missing_m), 1e-12)
    group = pairs_of_bodies(found.model.pairs, dict(found.model.ranges.bodies))
    of_bodies = [] if group is None else list(_of_bodies(found, group))
    tested = slopes.tests([*of_bodies, *families(found, louder, beside_curve=not alone)], readings)
    if readings is not None:
        # Every recording has noise of powers, and alternatives are tested with it fitted.
        noise = replace(tested[-1], family=replace(tested[-1].family, kind="readings", names=["readings"]))
        noise = noise.combined(np.eye(len(noise.total))[-1:])
        tested = [*(one.with_fitted([-1]).combined(np.eye(len(one.total))[:-1]) for one in tested), noise]
    # Offsets of bodies are a separate question, with its own share of the false alarms.
    bodies = [tested.pop(0) for _ in of_bodies]
    if found.slopes_of_heard is not None and (arrivals := found.searches[0].arrivals) is not None:
        tested += found.slopes_of_heard.tests(_of_heard(found, arrivals))
    findings = _without_explained(search(tested, FIT_LEVELS["offsets"]))
    of_truth = list[Finding]()
    if missing_m is not None and not any("scale" in one.names for one in findings):
        of_truth = list(_beyond_noise(found.model, missing_m, noise, len(tested)))
    plain = found.covariances["delay"]
    for one in tested:
        if one.family.kind in ("pair", "session") and not len(one.family.fitted):
            plain = plain + widening(one)
    places_ns2, of_places = np.zeros_like(plain), list[Finding]()
    curved = corrected or found.model.curve is not None
    if group is not None and not alone and curved and found.model.settings.constants == "tag":
        pairs = next(one for one in tested if one.family.kind == "pair")
        bodies = bodies or [pairs.combined(np.eye(int(group.max()) + 1)[:, group])]
        places_ns2, of_places = place_covariance(found, slopes, bodies[0], group, plain, undetermined)
    covariance, named = _covariance_and_findings(plain, findings, places_ns2, of_places)
    # Few pairs determine the size of their offsets poorly. Variance that findings added already is not added again.
    optimum = found.searches[0].optimum
    few_ns2 = of_few_draws(optimum, optimum.layout.indices(["delay"]))
    covariance = covariance + positive_part(few_ns2 - (covariance - found.covariances["delay"]))
    return covariance, [
        *named,
        *of_truth,
        *_reflections(found),
        *_persistence(found),
        *_redundancy(found.model),
        *_confounding(found, slopes),
    ]


def families(found: RangeFit, louder_m: Floats, *, beside_curve: bool) -> Iterator[Family]:
    """Yield the alternatives: offsets of a pair, of a tag for a while, of either in one of several sessions, of a tag
    with its power, and of all ranges together.

    `louder_m` (n,) is the change of each range by a decibel more. Without a curve, errors of all tags may change
    equally with power, which is not a fault of one tag. Then follow an offset whose sign changes with the initiator, as
    by uncorrected clock skew, and offsets common to all ranges. A fit whose curve is fitted after its delays is not
    `beside_curve`: its errors contain the curve, which depends on distance like power.
    """
    model, ranges, count = found.model, found.model.ranges, len(found.model.ranges)
    tags = [f"tag {tag}" for tag in model.tags]
    ends = model.pairs.among(model.tags)

    def of_tags(kind: str, derivative: Floats) -> Family:
        return Family(kind=kind, names=tags, derivative=Derivative(ends, derivative, len(tags)))

    yield of_pairs(found)
    several = int(min(max(found.blocks.seconds / SPAN_S, 2), OFFSET_SPANS))
    span = np.arange(count) * several // count
    yield Family(
        kind="time",
        names=[name for name in tags for _ in range(several)],
        derivative=Derivative(ends * several + span[:, None], UNIT, len(tags) * several),
        spans=several,
    )
    if len(found.blocks.bounds) > 2:
        yield _of_sessions(found, tags, ends)
    if model.curve is not None:
        rank = np.argsort(np.argsort(model.lifted, kind="stable"))
        yield of_tags("power", np.linspace(-1, 1, count)[rank][:, None])
    size = _root_mean_square(louder_m)
    if size > 0:
        yield of_tags("decibels", louder_m[:, None] / size)
    forth = np.where(ranges.initiator < ranges.target, 1.0, -1.0)
    yield of_tags("skew", forth[:, None] * [1.0, -1.0])
    shared = errors_of_truth(model, scale=beside_curve)
    if shared:
        everyone = np.broadcast_to(np.arange(len(shared)), (count, len(shared)))
        values = np.column_stack(list(shared.values()))
        yield Family(kind="shared", names=list(shared), derivative=Derivative(everyone, values, len(shared)))


def _of_heard(found: RangeFit, arrivals: ArrivalModel) -> list[Family]:
    """Return offsets of differences of arrival: of targets, if their ranges contradict these, and of paths
    to listeners.
    """
    tags, fitted = found.model.tags, found.searches[0].optimum.layout.indices([OFFSET_OF_PATH])
    target = Derivative(np.searchsorted(tags, arrivals.targets)[:, None], UNIT, len(tags))
    path = Derivative(arrivals.path, PATH_SIGNS[None], len(arrivals.paths))
    return [
        Family(kind="heard", names=[f"tag {tag}" for tag in tags], derivative=target),
        Family(kind="path", names=arrivals.paths, derivative=path, fitted=fitted),
    ]


def _of_bodies(found: RangeFit, group: Ints) -> Iterator[Family]:
    """Yield offsets of all ranges between the same two bodies, if they are fitted; `group` (pairs,) is their number."""
    if len(fitted := found.searches[0].optimum.layout.indices([OFFSET_OF_BODIES])):
        derivative = Derivative(group[found.model.pairs.number][:, None], UNIT, len(fitted))
        yield Family(kind="bodies", names=list(map(str, range(len(fitted)))), derivative=derivative, fitted=fitted)


def of_pairs(found: RangeFit) -> Family:
    """Return the alternatives: an offset of each pair."""
    pairs = found.model.pairs
    return Family(
        kind="pair",
        names=[f"pair {a}-{b}" for a, b in pairs.ends.tolist()],
        derivative=Derivative(pairs.number[:, None], UNIT, len(pairs.ends)),
        fitted=found.searches[0].optimum.layout.indices([OFFSET_OF_PAIR]),
    )


def _of_sessions(found: RangeFit, tags: list[str], ends: Ints) -> Family:
    """Return offsets of tags, and of pairs, in one session; only of tags if the time is too short for both.

    Between sessions antennas are removed and mounted, and objects are moved.
    """
    model, sessions = found.model, found.model.ranges.sessions
    names, columns = tags, ends
    kinds, count = ["offset of tag in session", "offset of pair in session"], len(sessions)
    # The blocks of time must determine the covariance of this number of slopes.
    if (len(tags) + len(model.pairs.ends)) * count < found.blocks.count / 2:
        names = [*tags, *of_pairs(found).names]
        columns = np.column_stack([ends, model.pairs.number + len(tags)])
    if len(set(sessions)) < count:
        sessions = tuple(f"{name} ({k} of {count})" for k, name in enumerate(sessions, 1))
    return Family(
        kind="session",
        names=[name for name in names for _ in range(count)],
        derivative=Derivative(columns * count + model.ranges.session[:, None], UNIT, len(names) * count),
        fitted=found.searches[0].optimum.layout.indices(kinds if len(names) > len(tags) else kinds[:1]),
        sessions=sessions,
    )


def errors_of_truth(model: RangeModel, *, scale: bool = True) -> dict[str, Floats]:
    """Return the changes of ranges (n,) by true distances of another `scale`, or of another time ("late")."""
    truth_m, speeds = model.ranges.truth_m, distance_speeds(model)
    reach = float(np.ptp(truth_m))
    larger = {"scale": (truth_m - float(np.median(truth_m))) / reach} if scale and reach > 0 else {}
    return larger | ({"late": speeds / _root_mean_square(speeds)} if speeds.any() else {})


def errors_of_readings(model: RangeModel, louder_m: Floats) -> Floats | None:
    """Return the error (n,) by noise of power readings in metres, None if there is none.

    It is divided by the ratio of noise and signal.

    A part of the error that depends on power remains; it is proportional to the difference between the power expected
    from distance and the reading (regression calibration: Carroll et al. 2006, chapter 4). Without this alternative
    ranges seem to grow with distance, or pairs at some distances seem to have offsets. Large noise also leaves a
    non-linear part, so it is named together with such findings.
    """
    if not np.any(louder_m) or not np.ptp(model.ranges.truth_m) > 0:
        return None
    decibels = 10 * np.log10(np.maximum(model.lifted, 1e-4))
    far = np.log(np.maximum(model.ranges.truth_m, 0.1))
    slope, level = np.polyfit(far, decibels, 1)
    return np.asarray(louder_m * (slope * far + level - decibels))


def _beyond_noise(model: RangeModel, missing_m: Floats, noise: Tested, tried: int) -> Iterator[Finding]:
    """Yield a finding if errors beside the readings of power (`errors_of_readings`) are larger than their noise causes.

    They grow with distance. A scale of true distances has this effect, and so has noise that lasts, which differences
    of successive readings do not show. Such noise of up to a quarter of the signal is a tolerance: in nine kinds of
    sound flights (`make sound`), the ratio is up to 0.15.
    """
    size_m, ratio = _root_mean_square(missing_m), noise_to_signal(model)
    for one in offsets_of(noise, tried, FIT_LEVELS["offsets"], (0.25 + ratio) * size_m):
        # Noise makes ranges longer where powers are higher than expected from the distance.
        if one.offset_m > 0:
            evidence = (
                f"ranges depend on distance as with true distances of another scale; the noise of successive readings "
                f"of power, {ratio:.2f} of the variance of powers, is too small for this"
            )
            yield _with_noisy_powers(warning("scale of true distances", evidence, one.p_value))


def noise_of_readings(power: Floats, pair: Ints, time_ns: Ints) -> float:
    """Return the variance of the noise of powers (n,), sorted by pair and time; 0 if it cannot be estimated.

    Readings of a pair within 0.2 s, in which a robot turns its antenna by a few degrees, differ by noise.
    """
    together = (np.diff(pair) == 0) & (np.diff(time_ns) < 200_000_000)
    return float(np.mean(np.diff(power)[together] ** 2)) / 2 if np.count_nonzero(together) >= 100 else 0.0


def noise_to_signal(model: RangeModel) -> float:
    """Return the variance of the noise of power readings, divided by the variance of the powers of pairs without noise.

    A curve that is fitted to noisy powers lacks this multiple of itself (attenuation: Carroll et al. 2006, chapter 3).
    """
    pair, time_ns = model.pairs.number, model.ranges.time_ns
    power = less_medians(np.log(np.maximum(model.lifted, 1e-4)), pair)
    order = np.lexsort((time_ns, pair))
    noise = noise_of_readings(power[order], pair[order], time_ns[order])
    return noise / max(float(np.var(power)) - noise, 1e-12)


def distance_speeds(model: RangeModel) -> Floats:
    """Return the rate of change (n,) of the true distance of each range, in m/s, from neighbours of its pair."""
    ranges, pair = model.ranges, model.pairs.number
    order = np.argsort(pair, kind="stable")
    time_s, truth_m = ranges.time_ns[order] * 1e-9, ranges.truth_m[order]
    same = (np.diff(pair[order]) == 0) & (np.diff(ranges.session[order]) == 0)
    # Two ranges of a pair further apart do not determine a speed: bodies turn round within seconds.
    near = same & (np.diff(time_s) > 0) & (np.diff(time_s) < 1.0)
    # From the previous neighbour to the next one, or from the only one.
    run, way = (np.convolve(np.where(near, np.diff(one), 0.0), [1.0, 1.0]) for one in (time_s, truth_m))
    speeds = np.empty(len(order))
    speeds[order] = way / np.where(run > 0, run, 1.0)
    return speeds


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def change_per_decibel(found: RangeFit) -> Floats:
    """Return the change of ranges (n,) for powers that are a decibel higher."""
    curves, lifted = list(bias_curves(found).values()), found.model.lifted
    return np.asarray(np.mean([curve(10**0.1 * lifted) - curve(lifted) for curve in curves], axis=0))


def _without_explained(findings: list[FoundOffset]) -> list[FoundOffset]:
    """Leave out changes of a tag during a part of the time if a difference between sessions explains them better."""
    between = {name: abs(one.deviation) for one in findings if one.kind == "session" for name in one.names}
    return [
        one
        for one in findings
        if one.kind != "time" or not any(between.get(name, 0.0) > abs(one.deviation) for name in one.names)
    ]


def _covariance_and_findings(
    plain: Floats, findings: list[FoundOffset], places_ns2: Floats, of_places: list[Finding]
) -> tuple[Floats, list[Finding]]:
    """Return the delays' covariance (tags, tags) including offsets that were found, and findings about those that
    matter.

    `of_places` is the finding on errors of places, with a p-value if they are certain; `places_ns2` (tags, tags) is
    their covariance.
    """
    certain = any(one.p_value is not None for one in of_places)
    if certain:
        # Offsets of pairs are then random like the others; a single one is not a separate fault.
        findings = [one for one in findings if one.kind != "pair"]
    covariance, matter, places = plain + places_ns2, dict[tuple[str, tuple[str, ...]], FoundOffset](), of_places
    for one in findings:
        moved, large = _largest_shift(one, plain), abs(one.offset_m) > SMALLEST_M
        # True distances of another time or scale change ranges, but hardly delays.
        cause = one.kind == "shared" and (certain or large)
        if moved > MATTERS:
            covariance = covariance + one.spread_ns2
        if cause and "late" in one.names:
            # Then ranges between two bodies are wrong together, too: the more specific cause is named.
            places = []
        large = large or (moved > CLEARLY and one.largest_ns > SMALLEST_NS)
        # With noise of power readings the curve is right for the powers as read.
        if one.kind != "readings" and (cause or (moved > MATTERS and large)):
            # A tag that was moved is significant in more than one span of time: it is named once.
            matter.setdefault((one.kind, one.names), one)
    named = [*places, *map(finding_of, matter.values())]
    noisy = any(one.kind == "readings" for one in findings)
    return covariance, [_with_noisy_powers(one) if noisy and _may_be_noisy_powers(one) else one for one in named]


def _largest_shift(finding: FoundOffset, covariance: Floats) -> float:
    """Return the largest shift of a delay by a finding, in standard errors of the delay."""
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    if not np.any(np.diag(covariance) > 0):
        # Without delays in the fit the curve absorbs an offset.
        return np.inf if abs(finding.offset_m) > SMALLEST_M else 0.0
    if finding.kind == "time":
        # A delay that changed for a while is wrong by this change, then or at other times. The printed interval already
        # includes it: a permanent change looks like an error that lasts.
        return 2e9 * abs(finding.offset_m) / SPEED_OF_LIGHT / float(np.median(std))
    return float(np.max(np.abs(finding.effects_ns) / std, initial=0.0))


OFFSET_FAULTS = {
    "pair": (
        "offset of a pair",
        "{whose}: ranges are {size} too {way} compared with the other pairs, which changes {worst}",
    ),
    "time": (
        "delay changed for a time",
        "{whose}: ranges are {size} too {way} during a part of the recording, which changes {worst}",
    ),
    "session": (
        "delay changed between recordings",
        "{whose}: ranges in {own} are {size} {way}er than in {others} (p = {p:.1g}), which changes {worst}",
    ),
    "power": (
        "errors of one tag over power",
        "{whose}: errors change with power by {size}, unlike those of other tags, which changes {worst}",
    ),
    "decibels": (
        "power readings of a tag",
        "{whose}: its powers seem to be wrong by some decibels, which changes its ranges by {size} and {worst}",
    ),
    "skew": (
        "clock skew",
        "{whose}: ranges are {size} too {way} if it initiates, with the opposite sign if it responds, which changes "
        "{worst}: clock skew is not corrected, or corrected with the wrong sign",
    ),
    "heard": (
        "positions of listeners",
        "{whose}: overheard frames contradict its ranges by {size}, which changes {worst}",
    ),
    "path": (
        "positions of a target and a listener",
        "{whose}: paths of overheard frames are {size} too {way}, which changes {worst}",
    ),
    "scale": (
        "scale of true distances",
        "ranges grow with the distance by {size} too {growth} over the recorded distances, which changes {worst}",
    ),
    "late": (
        "time offset of true distances",
        "ranges change by {size} with the speed at which true distances change (root mean square): the times of true "
        "distances and ranges differ",
    ),
}
"""Faults and their evidence, by the kinds of offsets, or by the names of errors that all ranges share."""


def finding_of(offset: FoundOffset) -> Finding:
    """Return an offset as a finding; if two causes have the same effect, both are named."""
    own, others = offset.sessions
    words = {
        "whose": " or ".join(offset.names),
        "size": f"{100 * abs(offset.offset_m):.1f} cm",
        "way": "long" if offset.offset_m > 0 else "short",
        "growth": "much" if offset.offset_m > 0 else "little",
        "worst": f"delays by up to {1e3 * offset.largest_ns:.0f} ps" if offset.largest_ns > 5e-4 else "no delay",
        "p": offset.p_value,
        "own": own,
        "others": others,
    }
    names = [name for name in offset.names if name in OFFSET_FAULTS] if offset.kind == "shared" else [offset.kind]
    return combined(
        [warning(OFFSET_FAULTS[name][0], OFFSET_FAULTS[name][1].format(**words), offset.p_value) for name in names]
    )


def _may_be_noisy_powers(found: Finding) -> bool:
    """Return whether noise of power readings may have the same effect: on errors of places and of true distances."""
    return found.fault == "errors of places" or "true distances" in found.fault


def _with_noisy_powers(found: Finding) -> Finding:
    noise = warning("noisy powers", "the powers are noisy, which has the same effect", found.p_value)
    return combined([found, noise])


def _reflections(found: RangeFit) -> Iterator[Finding]:
    """Yield findings about pairs with hardly any direct range, or otherwise about a tag with about half of its ranges
    reflected.

    The log odds of a pair are compared with their standard errors, including errors that last.
    """
    values, optimum, ends = found.values, found.searches[-1].optimum, found.model.pairs.ends
    if not isinstance(found.searches[-1].rows.errors, Mixture) or "odds of pair" not in values:
        return
    which = np.zeros((len(optimum.x), len(ends)))
    which[optimum.layout.where["odds level"]], which[optimum.layout.where["odds of pair"]] = 1.0, np.eye(len(ends))
    odds = which.T @ optimum.x
    variance = found.persistence.factor * np.einsum("pk,pk->k", which, np.asarray(optimum.covariance @ which))
    detour_m = np.exp(values["least detour"]) + np.exp(values["detour level"] + values["detour of pair"])
    share, far = expit(odds), detour_m > NAMED_DETOUR_M
    p_values = np.minimum(len(ends) * ndtr(-odds / np.sqrt(variance)), 1.0)
    most = p_values < FIT_LEVELS["reflections"]
    hidden, tags = np.flatnonzero((share > HIDDEN) & far & most).tolist(), found.model.tags
    for number in hidden:
        a, b = ends[number].tolist()
        others = [tag for tag in tags if tag not in (a, b)]
        # With four tags, offsets of a pair and of the pair of the other two have the same effect.
        other = f" or pair {others[0]}-{others[1]}" if len(tags) == 4 else ""
        yield warning(
            "reflections of a pair",
            f"pair {a}-{b}{other}: {100 * share[number]:.0f} % of its ranges are reflected, or "
            f"{100 * detour_m[number]:.0f} cm too long",
            float(p_values[number]),
        )
    means = {tag: float(np.where(far, share, 0.0)[np.any(ends == tag, axis=1)].mean()) for tag in tags}
    often = [tag for tag in tags if means[tag] > OFTEN and not hidden]
    for tag in often[:1]:
        yield warning("reflections of a tag", f"tag {tag}: {100 * means[tag]:.0f} % of its ranges are reflected")


def _persistence(found: RangeFit) -> Iterator[Finding]:
    """Yield a finding if errors last so long that there are few independent stretches of time."""
    lasting = found.persistence
    if lasting.stretches < FEWEST_STRETCHES:
        yield warning(
            "few independent stretches",
            f"errors last for {lasting.stretch_s:.1f} s, so the recording holds only {lasting.stretches:.0f} "
            f"independent stretches of time; intervals are widened for this, and unreliable with fewer than "
            f"{FEWEST_STRETCHES:.0f} stretches",
        )


def _redundancy(model: RangeModel) -> Iterator[Finding]:
    """Yield a finding if there are so few pairs that offsets of pairs cannot be separated from delays."""
    count, fitted = len(model.pairs.ends), any(unknown.kind == OFFSET_OF_PAIR for unknown in model.unknowns)
    if model.settings.constants == "tag" and count > 2 and not fitted:
        slopes = 0.5 * METRES_A_NS * free_ends(model.pairs, model.tags, model.settings)
        moved_ns = TYPICAL_OFFSET_M * float(np.linalg.norm(np.linalg.pinv(slopes), axis=1).max())
        yield warning(
            "no redundant pairs",
            f"{count} pairs are just enough to determine the delays: offsets of pairs of "
            f"{100 * TYPICAL_OFFSET_M:.1f} cm, which walls cause, would change delays by up to {1e3 * moved_ns:.0f} "
            f"ps, which the intervals do not include",
        )


def _confounding(found: RangeFit, slopes: Slopes) -> Iterator[Finding]:
    """Yield a finding if a small error proportional to distance cannot be separated from a curve over power.

    The curve is fitted with such an error of 1 %, which true distances may have unnoticed (a judgement). It is named if
    it adds more to the variance of the curve than all other errors.
    """
    model, truth_m = found.model, found.model.ranges.truth_m
    if model.curve is None or len(found.searches) > 1 or not np.ptp(truth_m) > 0:
        return
    far = truth_m - np.median(truth_m)
    link = slopes.link(sparse.csr_matrix(far[:, None]))[0]
    taken = np.asarray(slopes.optimum.covariance @ link)
    own = float(slopes.information @ far[slopes.order] ** 2)
    known = (own - float(taken @ link)) / found.persistence.factor
    slope = 1 / np.sqrt(0.01**-2 + max(known, 0.0))
    rows = basis(np.quantile(model.lifted, np.linspace(0.02, 0.98, 25)), model.curve.knots)
    count = len(model.curve_kinds())
    rows = np.tile(rows - rows.mean(axis=0), count) / count
    more = float(np.sqrt(np.mean((rows @ taken[slopes.optimum.layout.indices(model.curve_kinds())] * slope) ** 2)))
    band = float(np.sqrt(max(np.mean(np.einsum("ij,jk,ik->i", rows, found.covariances["curve"], rows)), 0.0)))
    if more >= band:
        yield warning(
            "power confounded with distance",
            f"power and distance are confounded: an error of 1 % in true distances would change the curve by "
            f"{1e3 * more:.0f} mm, more than its band of {1e3 * band:.0f} mm",
        )
