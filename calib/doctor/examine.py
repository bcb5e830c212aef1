"""Names the fault in a recording, with the evidence and the remedy.

Each examination looks for one fault. Those that suspect the truth (poses, lever arms, ids, clocks) work by trial: they
undo the suspected fault, and if the ranges then agree much better with the distances, it was there. The unit of
agreement is the robust spread of errors after each pair's own median, which neither delays nor a few outliers move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from calib.doctor import geometry, pairs, radio, timestamps
from calib.doctor.base import Finding, RecordingView
from calib.sources import Data, opened
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.recording.target_reports import differences, single_reports
from uwblink.twr import Exchanges, raw_range


def examine(data: Data) -> list[Finding]:
    """Return what is wrong with a recording, the surest first: each fault with its evidence and what to do about it.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`; ranges
    alone do not say enough. Raises what `Recording.open` raises.

    >>> import calib
    >>> [finding.fault for finding in calib.examine(calib.sample_flight())]
    []
    """
    with opened(data) as (name, source):
        exchanges, poses, tags = source.exchanges, source.poses, list(source.tags)
        faults = list(getattr(source, "faults", ()))
    if not len(exchanges):
        return [Finding("empty", "the recording holds no exchanges", "record or import some", 1.0)]
    view = _admitted(name, exchanges, poses, tags, faults)
    findings: list[Finding] = []
    for examination in GROSS:
        findings += examination(view)
        if findings:
            return findings
    # Only stamps that make sense can say something about poses, and only right poses something about radios.
    for examination in GEOMETRY:
        findings += examination(view)
    if not findings:
        for examination in RADIO:
            findings += examination(view)
    for always in STRUCTURE:
        findings += always(view)
    found = {finding.fault for finding in findings}
    # Where nothing moves, every pair has one distance and one power, and the one explains the other.
    implied = {radio.CONFOUNDED} if pairs.STATIC in found else set()
    return sorted((f for f in findings if f.fault not in implied), key=lambda f: -f.confidence)


def _admitted(name: str, both: Exchanges, poses: Poses, tags: list[Tag], faults: list[Fault]) -> RecordingView:
    reports = single_reports(both)
    e = reports.exchanges
    with np.errstate(all="ignore"):
        raw = raw_range(e)
    truth = e.truth_m
    if not np.isfinite(truth).any() and len(poses):
        truth = distances_m(poses, tags, e.initiator, e.target, e.time_ns)
    told = tuple(", ".join(differences(both, a, b)) for a, b in reports.differing.tolist())
    return RecordingView(
        name=name,
        exchanges=e,
        poses=poses,
        tags=tags,
        faults=faults,
        raw_m=raw,
        truth_m=truth,
        reported_twice=reports.repeated,
        contradictions=told,
    )


Examination = Callable[[RecordingView], Iterator[Finding]]
GROSS: Final[tuple[Examination, ...]] = (timestamps.single_as_double, timestamps.units, timestamps.width)
GEOMETRY: Final[tuple[Examination, ...]] = (geometry.pose_clock, geometry.geometry)
RADIO: Final[tuple[Examination, ...]] = (radio.skew, radio.moved_delay, radio.reflections)
STRUCTURE: Final[tuple[Examination, ...]] = (
    timestamps.swapped_roles,
    timestamps.speed_of_light,
    timestamps.corrupted,
    timestamps.contradicting,
    pairs.pairs,
    pairs.silent,
    pairs.still,
    radio.confounded,
    pairs.no_truth,
)
