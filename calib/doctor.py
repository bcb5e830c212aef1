"""Names the fault in a recording, with the evidence and the remedy.

Each examination looks for one fault. Those that suspect the truth (poses, lever arms, ids, clocks) work by trial: they
undo the suspected fault, and if the ranges then agree much better with the distances, it was there. The unit of
agreement is the robust spread of errors after each pair's own median, which neither delays nor a few outliers move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.delays import check_determined
from calib.errors import UnanswerableError
from calib.mixture import take_apart
from uwblink.alignment import find_offset
from uwblink.errors import ImportTableError
from uwblink.geometry import distances_m
from uwblink.listing import failures_by_pair
from uwblink.recording import Recording
from uwblink.schema import Fault, Poses, Tag
from uwblink.ticks import TICKS_PER_SECOND
from uwblink.twr import Exchanges, board_range, delay_weights, intervals, raw_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MUCH_BETTER: Final = 0.6
"""A suspected fault was there when undoing it shrinks the spread below this share of what it was."""

PLAUSIBLE_M: Final = 1000.0
LARGEST_OFFSET_S: Final = 3.0
VACUUM_OVER_AIR: Final = 299_792_458.0 / 299_702_547.0


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault: its name, what shows it, what to do, and how sure the doctor is (0 to 1)."""

    fault: str
    evidence: str
    remedy: str
    confidence: float


@dataclass(frozen=True, slots=True)
class Patient:
    """A recording as the examinations see it; `truth_m` (n,) is NaN where nothing says it."""

    name: str
    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    raw_m: Floats
    truth_m: Floats

    @property
    def error_m(self) -> Floats:
        """Range less truth, shape (n,)."""
        return self.raw_m - self.truth_m


def examine(path: Path) -> list[Finding]:
    """Return what is wrong with a recording, the surest first; raises what `Recording.open` raises."""
    with Recording.open(path) as recording:
        exchanges, poses, tags = recording.exchanges(), recording.poses(), recording.tags()
        faults = recording.faults()
    if not len(exchanges):
        return [Finding("empty", "the recording holds no exchanges", "record or import some", 1.0)]
    patient = _admitted(path.name, exchanges, poses, tags, faults)
    findings: list[Finding] = []
    for examination in GROSS:
        findings += examination(patient)
        if findings:
            return findings
    # Only stamps that make sense can say something about poses, and only right poses something about radios.
    for examination in GEOMETRY:
        findings += examination(patient)
    if not findings:
        for examination in RADIO:
            findings += examination(patient)
    for always in STRUCTURE:
        findings += always(patient)
    return sorted(findings, key=lambda f: -f.confidence)


def _admitted(name: str, e: Exchanges, poses: Poses, tags: list[Tag], faults: list[Fault]) -> Patient:
    with np.errstate(all="ignore"):
        raw = raw_range(e)
    truth = e.truth_m
    if not np.isfinite(truth).any() and len(poses):
        truth = distances_m(poses, tags, e.initiator, e.target, e.time_ns)
    return Patient(name, e, poses, tags, faults, raw, truth)


def _spread(patient: Patient, truth_m: Floats | None = None, raw_m: Floats | None = None) -> float:
    """Robust spread of errors after each pair's own median, metres; infinity where nothing is known."""
    error = (patient.raw_m if raw_m is None else raw_m) - (patient.truth_m if truth_m is None else truth_m)
    pair = _pair(patient.exchanges)
    good = np.isfinite(error)
    parts = [v - np.median(v) for p in np.unique(pair[good]) if len(v := error[good & (pair == p)]) > 10]
    return 1.4826 * float(np.median(np.abs(np.concatenate(parts)))) if parts else float("inf")


def _pair(e: Exchanges) -> Ints:
    return np.asarray(np.minimum(e.initiator, e.target) * 65_536 + np.maximum(e.initiator, e.target))


def _plausible(raw_m: Floats) -> float:
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.abs(raw_m) < PLAUSIBLE_M))


def _units(patient: Patient) -> Iterator[Finding]:
    """Stamps in nanoseconds taken for ticks make every duration 64 times too short."""
    spans, third = intervals(patient.exchanges), patient.exchanges.tx3 != 0
    legs = [float(np.median(spans.dt41)), float(np.median(spans.dt53[third])) if third.any() else 0.0]
    longest = max(legs) / TICKS_PER_SECOND
    per_ns = TICKS_PER_SECOND * 1e-9
    if longest < 60e-6 and longest * per_ns > 150e-6 and len(np.unique(patient.exchanges.tx1 % 512)) > 8:
        yield Finding(
            "unit slip",
            f"the longest leg of an exchange lasts {longest * 1e6:.1f} us, too short for a frame; "
            f"read as nanoseconds it would be {longest * per_ns * 1e6:.0f} us",
            'the stamps are nanoseconds, not ticks: import again with [units] stamps = "ns"',
            0.95,
        )


def _width(patient: Patient) -> Iterator[Finding]:
    e = patient.exchanges
    for bits in (32, 40):
        if bits == e.bits:
            continue
        with np.errstate(all="ignore"):
            other = raw_range(replace(e, bits=bits))
        gained = _plausible(other) - _plausible(patient.raw_m)
        if gained > 0.01:
            yield Finding(
                "timestamp width",
                f"with {e.bits}-bit stamps {100 * _plausible(patient.raw_m):.1f} % of the ranges are possible, with "
                f"{bits}-bit stamps {100 * _plausible(other):.1f} %",
                f"import again with bits = {bits}",
                0.95,
            )


def _single_as_double(patient: Patient) -> Iterator[Finding]:
    e = patient.exchanges
    empty = (e.protocol != "ss") & (e.tx3 == 0) & (e.rx3 == 0)
    if empty.mean() > 0.5:
        yield Finding(
            "single-sided data taken for double-sided",
            f"{100 * empty.mean():.0f} % of the double-sided exchanges have no third message",
            'import again with protocol = "ss"',
            0.98,
        )


def _corrupted(patient: Patient) -> Iterator[Finding]:
    with np.errstate(all="ignore"):
        said = np.abs(board_range(patient.exchanges) - patient.exchanges.range_m)
    bad = ~(np.abs(patient.raw_m) < PLAUSIBLE_M) | (np.isfinite(said) & (said > 0.01))
    share = float(np.mean(bad))
    if 0.002 < share < 0.5 and not _is_scaled(patient):
        yield Finding(
            "corrupted exchanges",
            f"{np.count_nonzero(bad)} of {len(bad)} exchanges have impossible stamps, or stamps that contradict the "
            "range reported with them",
            "a robust fit leaves them out; check cables and USB load, and decode the recording again if it has bytes",
            0.9,
        )


def _is_scaled(patient: Patient) -> bool:
    ratio = patient.exchanges.range_m / patient.raw_m
    good = np.isfinite(ratio) & (np.abs(patient.raw_m) > 1)
    return bool(good.any() and abs(np.median(ratio[good]) - 1) > 1e-4)


def _speed_of_light(patient: Patient) -> Iterator[Finding]:
    e = patient.exchanges
    good = np.isfinite(e.range_m) & (np.abs(patient.raw_m) > 1)
    if np.count_nonzero(good) < 100:
        return
    ratio = float(np.median(e.range_m[good] / patient.raw_m[good]))
    if abs(ratio / VACUUM_OVER_AIR - 1) < 5e-5:
        yield Finding(
            "speed of light in vacuum",
            f"reported ranges are {ratio:.5f} times those from the stamps: 299 792 458 m/s instead of 299 702 547",
            "nothing for a fit, which uses the stamps; multiply reported ranges by 0.9997 before using them",
            0.95,
        )


def _swapped_roles(patient: Patient) -> Iterator[Finding]:
    """The target's clock against the initiator's: from the third leg, and as the carriers say."""
    e = patient.exchanges
    double = (e.protocol == "ds") & (e.tx3 != 0) & np.isfinite(e.skew1_ppm)
    if np.count_nonzero(double) < 100:
        return
    spans = intervals(e[double])
    with np.errstate(all="ignore"):
        target_faster = (spans.dt53 / spans.dt64 - 1) * 1e6
    told = e.skew1_ppm[double]
    pairs = _pair(e[double])
    first = e.initiator[double] < e.target[double]
    signs = [
        (np.median(target_faster[rows]), np.median(told[rows]))
        for p in np.unique(pairs)
        for way in (True, False)
        if np.count_nonzero(rows := (pairs == p) & (first == way)) > 20
    ]
    clear = [(a, b) for a, b in signs if abs(a) > 1.0]
    if clear and np.mean([np.sign(a) != np.sign(b) for a, b in clear]) > 0.8:
        yield Finding(
            "swapped roles",
            "the carriers say that the targets' clocks are slower where the stamps say faster, and the other way round",
            "initiator and target (ids, powers and skews) are exchanged: swap the columns on import",
            0.9,
        )


def _pose_clock(patient: Patient) -> Iterator[Finding]:
    if not len(patient.poses):
        return
    try:
        found = find_offset(patient.exchanges, patient.poses, patient.tags, within_s=LARGEST_OFFSET_S)
    except ImportTableError:
        return
    shift_s = found.offset_ns * 1e-9
    moved = distances_m(
        patient.poses, patient.tags, patient.exchanges.initiator, patient.exchanges.target,
        patient.exchanges.time_ns - found.offset_ns,
    )  # fmt: skip
    before, after = _spread(patient), _spread(patient, moved)
    if abs(shift_s) > 0.03 and after < 0.9 * before:
        yield Finding(
            "pose time offset",
            f"with the poses {shift_s:+.3f} s later the ranges' spread is {100 * after:.1f} cm instead of "
            f"{100 * before:.1f} cm",
            f"shift the poses: uwblink poses ... --offset {shift_s:.3f}",
            0.9,
        )


def _trials(patient: Patient) -> Iterator[tuple[Finding, Poses, list[Tag]]]:
    """Suspected faults of geometry, each with poses and tags as they would be without it."""
    bodies = sorted({tag.body for tag in patient.tags})
    for body in bodies:
        mine = [tag for tag in patient.tags if tag.body == body]
        if any(any(tag.lever_arm_m) for tag in mine):
            turned = [
                replace(t, lever_arm_m=(-t.lever_arm_m[0], -t.lever_arm_m[1], -t.lever_arm_m[2])) if t in mine else t
                for t in patient.tags
            ]
            yield (
                Finding("lever arm sign", f"of body {body}", f"change the sign of the lever arms of body {body}", 0.85),
                patient.poses,
                turned,
            )
        for a, b in combinations(mine, 2):
            arms = {a.tag: b.lever_arm_m, b.tag: a.lever_arm_m}
            swapped = [replace(t, lever_arm_m=arms.get(t.tag, t.lever_arm_m)) for t in patient.tags]
            yield (
                Finding("swapped tag ids", f"of tags {a.tag} and {b.tag}", f"exchange tags {a.tag} and {b.tag}", 0.85),
                patient.poses,
                swapped,
            )
    q = patient.poses.quaternion
    if len(q):
        yield (
            Finding("wxyz quaternion", "of the poses", "quaternions are w x y z: reorder the columns to x y z w", 0.9),
            replace(patient.poses, quaternion=q[:, [1, 2, 3, 0]]),
            patient.tags,
        )


def _geometry(patient: Patient) -> Iterator[Finding]:
    """Try every suspected fault of geometry; of those that explain the ranges, the one that does so best."""
    if not len(patient.poses) or np.isfinite(patient.exchanges.truth_m).any():
        return
    e = patient.exchanges
    before = _spread(patient)
    best: tuple[float, Finding] | None = None
    for finding, poses, tags in _trials(patient):
        after = _spread(patient, distances_m(poses, tags, e.initiator, e.target, e.time_ns))
        # One body of several, or one pair of tags, is a share of all ranges: compare what it can change.
        if after < _needed(finding.fault) * before and (best is None or after < best[0]):
            best = after, finding
    if best:
        after, finding = best
        evidence = (
            f"{finding.evidence}: undone, the ranges' spread is {100 * after:.1f} cm instead of {100 * before:.1f} cm"
        )
        yield replace(finding, evidence=evidence)


def _needed(fault: str) -> float:
    return 0.85 if fault in ("lever arm sign", "swapped tag ids") else MUCH_BETTER


def _skew(patient: Patient) -> Iterator[Finding]:
    """Errors that follow the relative skew of a pair times its reply delay, as uncorrected single-sided ones do."""
    e = patient.exchanges
    single = (e.protocol == "ss") & np.isfinite(patient.error_m) & np.isfinite(e.skew1_ppm)
    if np.count_nonzero(single) < 100:
        return
    dt32_s = intervals(e[single]).dt32 / TICKS_PER_SECOND
    expected = -0.5 * 299_702_547.0 * e.skew1_ppm[single] * 1e-6 * dt32_s
    error = patient.error_m[single]
    slope = float(np.polyfit(expected, error, 1)[0]) if np.std(expected) > 0.05 else 0.0
    if 0.5 < slope < 1.5:
        yield Finding(
            "skew in single-sided ranges",
            f"errors follow c/2 times skew times reply delay with slope {slope:.2f}, over {np.ptp(expected):.1f} m",
            "use double-sided ranging, or correct single-sided ranges with the measured skew",
            0.9,
        )


def _moved_delay(patient: Patient) -> Iterator[Finding]:
    """A tag all of whose pairs shift at one time: the largest change of medians between before and after."""
    e, error = patient.exchanges, patient.error_m
    good = np.isfinite(error)
    if np.count_nonzero(good) < 1000:
        return
    time = (e.time_ns - e.time_ns[good].min()) * 1e-9
    length = float(time[good].max())
    if length < 10:
        return
    pair = _pair(e)
    centred = error.copy()
    for p in np.unique(pair):
        centred[pair == p] -= np.nanmedian(error[pair == p])
    spread, moved = _spread(patient), []
    for tag in sorted({*e.initiator.tolist(), *e.target.tolist()}):
        mine = good & ((e.initiator == tag) | (e.target == tag))
        rest = good & ~mine
        best, at = 0.0, 0.0
        for cut in np.linspace(0.15, 0.85, 15) * length:
            step = _step(centred, mine, time, cut) - (_step(centred, rest, time, cut) if rest.any() else 0.0)
            if abs(step) > abs(best):
                best, at = step, float(cut)
        if abs(best) > 0.12 and abs(best) > 12 * spread / np.sqrt(np.count_nonzero(mine) / 4):
            moved.append((abs(best), tag, best, at))
    # Partners of the tag that moved shift with it, by less.
    for _, tag, best, at in sorted(moved)[-1:]:
        yield Finding(
            "delay changed mid-flight",
            f"ranges of tag {tag} shift by {100 * best:+.1f} cm about {at:.0f} s after the start, others do not",
            f"look for a loose antenna or another voltage on tag {tag}; calibrate the two parts apart",
            0.8,
        )


def _step(values: Floats, rows: NDArray[np.bool_], time: Floats, cut: float) -> float:
    before, after = values[rows & (time < cut)], values[rows & (time >= cut)]
    return float(np.median(after) - np.median(before)) if len(before) > 50 and len(after) > 50 else 0.0


def _reflections(patient: Patient) -> Iterator[Finding]:
    good = np.isfinite(patient.error_m) & (np.abs(patient.error_m) < 20)
    if np.count_nonzero(good) < 300:
        return
    error = patient.error_m[good]
    for p in np.unique(_pair(patient.exchanges)[good]):
        rows = _pair(patient.exchanges)[good] == p
        error[rows] -= np.median(error[rows])
    makeup = take_apart(error, np.zeros(len(error), dtype=np.int64), 1)
    if makeup.tail_share > 0.3 and makeup.tail_mean_m > 3 * makeup.sigma_m[0]:
        yield Finding(
            "reflections",
            f"about {100 * makeup.tail_share:.0f} % of the ranges are longer than noise explains, by "
            f"{100 * makeup.tail_mean_m:.0f} cm on average",
            "move antennas away from bodies and walls, or fit with --loss mixture",
            0.75,
        )


def _pairs(patient: Patient) -> Iterator[Finding]:
    e = patient.exchanges
    with np.errstate(all="ignore"):
        first, second = delay_weights(e)
    good = np.isfinite(first) & np.isfinite(second)
    if not good.any():
        return
    tags = sorted({*e.initiator[good].tolist(), *e.target[good].tolist()})
    place = np.array(tags)
    matrix = np.zeros((np.count_nonzero(good), len(tags)))
    rows = np.arange(len(matrix))
    matrix[rows, np.searchsorted(place, e.initiator[good])] += first[good]
    matrix[rows, np.searchsorted(place, e.target[good])] += second[good]
    try:
        check_determined(matrix, tags, e.initiator[good], e.target[good])
    except UnanswerableError as error:
        groups = "; ".join(", ".join(map(str, group)) for group in error.undetermined)
        yield Finding(
            "too few pairs",
            f"the pairs do not determine the delays of tags {groups}",
            "record three tags that all range with each other, or pin a known delay with --fix TAG=NS",
            0.99,
        )


def _silent(patient: Patient) -> Iterator[Finding]:
    e = patient.exchanges
    failed = failures_by_pair(patient.faults)
    for tag in sorted({t.tag for t in patient.tags}):
        bad = sum(n for pair, n in failed.items() if tag in pair)
        done = int(np.count_nonzero((e.initiator == tag) | (e.target == tag)))
        others = len(e) + sum(failed.values()) - bad - done
        if bad > 20 and bad > 3 * done and others:
            yield Finding(
                "dead or deaf tag",
                f"tag {tag} took part in {done} exchanges, {bad} failed",
                f"check power, antenna and USB of tag {tag}",
                0.9,
            )


def _still(patient: Patient) -> Iterator[Finding]:
    pair = _pair(patient.exchanges)
    good = np.isfinite(patient.truth_m)
    spans = [float(np.ptp(patient.truth_m[good & (pair == p)])) for p in np.unique(pair[good])]
    if spans and max(spans) < 0.1:
        yield Finding(
            "static data",
            f"no distance changes by more than {100 * max(spans):.0f} cm",
            "move the tags while recording, so that powers and reflections vary",
            0.9,
        )


def _confounded(patient: Patient) -> Iterator[Finding]:
    """Power that is a function of distance and nothing else lets the curve learn distance."""
    e = patient.exchanges
    power = np.nanmean(np.stack([e.fpp1_dbm, e.fpp2_dbm]), axis=0) if np.isfinite(e.fpp1_dbm).any() else e.fpp2_dbm
    good = np.isfinite(power) & np.isfinite(patient.truth_m) & (patient.truth_m > 0)
    if np.count_nonzero(good) < 300 or np.ptp(patient.truth_m[good]) < 0.5:
        return
    order = np.argsort(patient.truth_m[good])
    groups = np.array_split(power[good][order], 40)
    within = np.median([np.var(g) for g in groups])
    between = np.var([np.mean(g) for g in groups])
    if within < 0.12 * (within + between):
        yield Finding(
            "power confounded with distance",
            f"distance explains {100 * between / (within + between):.0f} % of the power's variance",
            "turn the antennas while recording; until then the curve may hold what belongs to distance",
            0.8,
        )


def _no_truth(patient: Patient) -> Iterator[Finding]:
    known = float(np.mean(np.isfinite(patient.truth_m)))
    if known < 0.5:
        yield Finding(
            "no true distances",
            f"{100 * known:.0f} % of the exchanges have one: poses are missing or do not cover the recording",
            "add motion capture with uwblink poses, or measured distances in gt_range_m",
            0.95,
        )


Examination = Callable[[Patient], Iterator[Finding]]
GROSS: Final[tuple[Examination, ...]] = (_single_as_double, _units, _width)
GEOMETRY: Final[tuple[Examination, ...]] = (_pose_clock, _geometry)
RADIO: Final[tuple[Examination, ...]] = (_skew, _moved_delay, _reflections)
STRUCTURE: Final[tuple[Examination, ...]] = (
    _swapped_roles,
    _speed_of_light,
    _corrupted,
    _pairs,
    _silent,
    _still,
    _confounded,
    _no_truth,
)
