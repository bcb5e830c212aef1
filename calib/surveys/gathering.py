"""From recordings to arrangements: marked, named in a file, or found from the ranges; then to means of pairs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePath
from typing import Final

import numpy as np

from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data, antenna_delays_of, each, opened
from calib.errors import BadInputError, UnanswerableError
from calib.surveys.knowledge import Knowledge
from calib.surveys.pair_means import PairMeans, pair_means
from calib.surveys.result import Contradiction
from calib.surveys.stillness import moved, stretches_ns
from uwblink.arrays import Ints
from uwblink.recording.antenna_delays import AntennaDelays
from uwblink.recording.schema import Arrangement, KnownDistance
from uwblink.recording.target_reports import single_reports

LONGEST_M: Final = 1e4


@dataclass(frozen=True, slots=True, kw_only=True)
class Gathered:
    """Means of pairs, the arrangements whose numbers they carry, distances that recordings state, and what to say."""

    means: PairMeans
    arrangements: tuple[Arrangement, ...]
    distances: tuple[KnownDistance, ...]
    sources: tuple[str, ...]
    exchanges: int
    findings: tuple[Contradiction, ...]
    warnings: tuple[str, ...]
    antenna_delays: AntennaDelays


def gather(data: Data | Iterable[Data], knowledge: Knowledge) -> Gathered:
    """Return the means of pairs of one or more recordings by arrangement.

    Raises `BadInputError` for two arrangements of one name, `UnanswerableError` where no boards stood still.
    """
    recordings = [_load(one) for one in each(data)]
    if knowledge.spans_s and len(recordings) > 1:
        raise BadInputError("gives times of arrangements, which is for one recording only", parameter="known")
    several = len(recordings) > 1
    found: list[Arrangement] = []
    parts: list[tuple[Ranges, Ints]] = []
    distances: list[KnownDistance] = []
    findings: list[Contradiction] = []
    for ranges, marked, stated in recordings:
        mine = _stretches(ranges, marked, knowledge, several=several)
        number = np.full(len(ranges), -1)
        for k, one in enumerate(mine):
            rows = (ranges.time_ns >= one.start_ns) & (ranges.time_ns < one.end_ns)
            number[rows] = len(found) + k
            findings += _moved(one, ranges[rows])
        found += mine
        parts.append((ranges, number))
        distances += stated
    _check_names(found)
    whole = concatenate([ranges for ranges, _ in parts])
    means, few = pair_means(whole, np.concatenate([number for _, number in parts]))
    if not len(means):
        raise UnanswerableError(f"{whole.source}: no two boards range five times while all stand still")
    warnings = [f"{few} pairs of an arrangement have less than 5 ranges and are left out"] if few else []
    return Gathered(
        means=means,
        arrangements=tuple(found),
        distances=tuple(distances),
        sources=tuple(ranges.source for ranges, _ in parts),
        exchanges=int(means.count.sum()),
        findings=tuple(findings),
        warnings=tuple(warnings),
        antenna_delays=whole.antenna_delays,
    )


def _load(data: Data) -> tuple[Ranges, list[Arrangement], list[KnownDistance]]:
    if isinstance(data, Ranges):
        return _finite(data), [], []
    with opened(data) as (name, source):
        exchanges = single_reports(source.exchanges).exchanges
        marked = list(getattr(source, "arrangements", ()))
        stated = list(getattr(source, "known_distances", ()))
        delays = antenna_delays_of(source, name)
    if not len(exchanges):
        raise UnanswerableError(f"{name}: holds no exchanges")
    unknown = np.full(len(exchanges), np.nan)
    ranges = Ranges.from_exchanges(exchanges, unknown, source=name, antenna_delays=delays)
    return _finite(ranges), marked, stated


def _finite(ranges: Ranges) -> Ranges:
    good = np.isfinite(ranges.raw_m) & (np.abs(ranges.raw_m) < LONGEST_M)
    if not good.any():
        raise UnanswerableError(f"{ranges.source}: none of its {len(ranges)} exchanges has possible stamps")
    return ranges[good]


def _stretches(ranges: Ranges, marked: list[Arrangement], knowledge: Knowledge, *, several: bool) -> list[Arrangement]:
    if knowledge.spans_s:
        start = int(ranges.time_ns.min())
        spans = [(n, start + round(a * 1e9), start + round(b * 1e9)) for n, (a, b) in knowledge.spans_s.items()]
        return [Arrangement(name, a, b) for name, a, b in spans]
    if marked:
        return marked
    found = stretches_ns(ranges)
    if not found:
        raise UnanswerableError(
            f"{ranges.source}: boards never stand still for 15 s; record while they do, or mark when they did"
        )
    stem = PurePath(ranges.source).stem
    if len(found) == 1:
        return [Arrangement(stem, *found[0])]
    return [Arrangement(f"{stem}-{k}" if several else str(k), *span) for k, span in enumerate(found, start=1)]


def _moved(one: Arrangement, ranges: Ranges) -> list[Contradiction]:
    motion = moved(ranges)
    if motion is None:
        return []
    steps = ", ".join(f"{100 * step:+.0f} cm to {tag}" for tag, step in sorted(motion.steps_m.items()))
    after_s = (motion.time_ns - int(ranges.time_ns.min())) * 1e-9
    text = (
        f"{one.name}: board {motion.tag} was moved {after_s:.0f} s after its beginning (ranges changed by {steps}); "
        "record that arrangement again, or end it before"
    )
    return [Contradiction("moved", text)]


def _check_names(found: list[Arrangement]) -> None:
    names = [one.name for one in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInputError(f"two arrangements are called {twice[0]!r:.40}; give each its own name", parameter="data")
