"""Ranges as the columns a calibration works with; the one place where exchanges or arrays become them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.carriers import ClocksApart, clocks_apart, farthest
from calib.errors import BadInputError, UnanswerableError
from calib.long_columns import joined, let_go, picked, spans
from calib.range_columns import columns_of, measured_powers
from calib.single_sided import LeftSkew, left_skew, worst
from uwblink.arrays import Bools, Floats, Ints
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, delay_of, delays_in_meta
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import Exchanges

IN_MEMORY: Final = "memory"
"""The source of ranges that come from no file."""


HALVES: Final = (0.5, 0.5)

LONGEST_M: Final = 1e4

CLOCK_NS: Final = 1_000_000_000 * 86_400 * 365 * 20
"""Times beyond this are those of a host's clock, in ns since 1970 (`uwblink record`), and others count from a start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranges:
    """Ranges with their truth as columns of length n; `from_exchanges` and `from_arrays` make them.

    `raw_m` is the range recomputed from the stamps, `truth_m` the distance between the antennas;
    `weight_initiator` and `weight_target` are the derivatives of the calibrated time of flight with
    respect to the two tags' antenna delays. `protocol` is "range" where a range came without stamps.
    `excluded` counts by reason what was left out; `planted` is what a simulation put in, for display only;
    `recordings` are name and `fingerprint` of each that they come from, empty where they come from none;
    `left_skew` says what clock skew may have left in single-sided ranges, None where there are none; `bodies` are tags
    with the body that carries each, as far as it is known; `antenna_delays` is what was programmed into tags when they
    ranged, as far as that is known. `session` numbers the sessions (n,), whose names are
    `sessions`: recordings that are joined, of which those that ran at the same time count as one.
    """

    source: str
    time_ns: Ints
    initiator: Ints
    target: Ints
    protocol: NDArray[np.str_]
    raw_m: Floats
    truth_m: Floats
    weight_initiator: Floats
    weight_target: Floats
    fpp1_dbm: Floats
    fpp2_dbm: Floats
    excluded: dict[str, int]
    planted: dict[str, Any] | None
    left_skew: LeftSkew | None = None
    clocks_apart: ClocksApart | None = None
    recordings: tuple[tuple[str, str], ...] = ()
    bodies: tuple[tuple[int, str], ...] = ()
    session: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    sessions: tuple[str, ...] = ()
    antenna_delays: AntennaDelays = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Put all ranges into one session where nothing else is said."""
        if len(self.session) != len(self.time_ns):
            object.__setattr__(self, "session", np.broadcast_to(np.int32(0), len(self.time_ns)))

    @classmethod
    def from_exchanges(
        cls,
        exchanges: Exchanges,
        truth_m: Floats | None = None,
        *,
        poses: Poses | None = None,
        tags: Sequence[Tag] = (),
        planted: Mapping[str, Any] | None = None,
        source: str = IN_MEMORY,
        antenna_delays: AntennaDelays | None = None,
    ) -> Ranges:
        """Return a row for every exchange, usable or not (`usable` leaves out those that a fit cannot use).

        True distances are `truth_m` (n,), or those of the exchanges; where there is neither they come from `poses` and
        the lever arms of `tags`. A power that cannot have been measured is NaN. Raises `BadInputError` where `truth_m`
        has another length than the exchanges.
        """
        given = exchanges.truth_m if truth_m is None else np.asarray(truth_m, dtype=np.float64)
        if given.shape != (len(exchanges),):
            raise BadInputError(f"has shape {given.shape}, expected ({len(exchanges)},)", parameter="truth_m")
        return cls(
            source=source,
            excluded={},
            planted=dict(planted) if planted else None,
            left_skew=left_skew(exchanges),
            clocks_apart=clocks_apart(exchanges),
            bodies=bodies_of(tags),
            antenna_delays=antenna_delays or {},
            **columns_of(exchanges, given, poses, tags),
        )

    @classmethod
    def from_arrays(  # noqa: PLR0913 - columns by name, most of which have a default
        cls,
        range_m: ArrayLike,
        *,
        initiator: ArrayLike,
        target: ArrayLike,
        fpp1_dbm: ArrayLike,
        fpp2_dbm: ArrayLike | None = None,
        truth_m: ArrayLike = math.nan,
        time_ns: ArrayLike = 0,
        protocol: str = "ds",
        weights: tuple[ArrayLike, ArrayLike] = HALVES,
        source: str = IN_MEMORY,
    ) -> Ranges:
        """Return a row for every range of arrays (n,), metres and dBm; a single number serves all rows.

        `truth_m` and `time_ns` are needed to fit, and not to correct. Where there is one power only it is `fpp1_dbm`.
        `weights` are those of the two delays (`uwblink.twr.delay_weights`): by default halves, as if both clocks ran
        alike, which no range notices by more than a hundredth of a millimetre. Raises `BadInputError` where the arrays
        do not fit each other.

        >>> from calib import Ranges
        >>> len(Ranges.from_arrays([3.1, 4.2], initiator=1, target=[2, 3], fpp1_dbm=-85.0))
        2
        """
        if protocol not in PROTOCOLS:
            raise BadInputError(f"found {protocol!r:.40}, allowed: {', '.join(PROTOCOLS)}", parameter="protocol")
        if len(weights) != 2:
            raise BadInputError(f"found {len(weights)}, expected those of initiator and target", parameter="weights")
        columns = {
            "raw_m": range_m,
            "truth_m": truth_m,
            "fpp1_dbm": fpp1_dbm,
            "fpp2_dbm": math.nan if fpp2_dbm is None else fpp2_dbm,
            "weight_initiator": weights[0],
            "weight_target": weights[1],
        }
        ids = {"initiator": initiator, "target": target, "time_ns": time_ns}
        try:
            floats = [np.asarray(column, dtype=np.float64) for column in columns.values()]
            ints = [np.asarray(column).astype(np.int64, casting="same_kind") for column in ids.values()]
            rows = np.broadcast_arrays(*np.atleast_1d(*floats, *ints))
        except (TypeError, ValueError) as error:
            raise BadInputError(f"arrays of ranges do not fit each other: {error}") from error
        if rows[0].ndim != 1:
            raise BadInputError(f"has shape {np.shape(range_m)}, expected one dimension", parameter="range_m")
        filled: dict[str, Any] = dict(zip([*columns, *ids], rows, strict=True))
        if np.any(filled["initiator"] == filled["target"]):
            row = int(np.argmax(filled["initiator"] == filled["target"]))
            raise BadInputError(f"row {row} is of tag {filled['target'][row]} with itself", parameter="target")
        filled |= {name: measured_powers(filled[name]) for name in ("fpp1_dbm", "fpp2_dbm")}
        kind = np.full(len(rows[0]), protocol)
        return cls(source=source, protocol=kind, excluded={}, planted=None, **filled)

    def __len__(self) -> int:
        """Return the number of ranges."""
        return len(self.time_ns)

    def __getitem__(self, rows: Bools | Ints | slice) -> Ranges:
        """Return the chosen rows, in their order."""
        columns: dict[str, Any] = {name: picked(getattr(self, name), rows) for name in COLUMNS}
        return replace(self, **columns)

    def __repr__(self) -> str:
        """Return how many ranges of which tags there are, and what was left out."""
        left = "".join(f", {count} left out: {reason}" for reason, count in self.excluded.items())
        return f"<Ranges of {self.source}: {len(self)} of tags {', '.join(map(str, self.tags()))}{left}>"

    def tags(self) -> list[int]:
        """Return the ids of the tags that range, in order."""
        counts = [np.bincount(ids) > 0 for ids in (self.initiator, self.target)]
        let_go(self.initiator, self.target)
        return sorted({*np.flatnonzero(counts[0]).tolist(), *np.flatnonzero(counts[1]).tolist()})

    def usable(self, why_no_truth: str = "", why_no_power: str = "", *, need_power: bool = True) -> Ranges:
        """Leave out what is of a tag with itself, has no true distance, no power or impossible stamps, and count it.

        Without `need_power`, ranges without any stay. Raises `UnanswerableError` where nothing is left, with
        `why_no_truth` or `why_no_power` where that is the reason.
        """
        found = usable_rows(self, need_power=need_power)
        require_some(self.source, len(self), found.excluded, why_no_truth, why_no_power)
        if found.keep.all():
            return self
        return replace(self[found.keep], excluded=self.excluded | {r: n for r, n in found.excluded.items() if n})


@dataclass(frozen=True, slots=True)
class Usable:
    """Which ranges can be used, (n,), and how many not for which reason, in the order in which they are looked for."""

    keep: Bools
    excluded: dict[str, int]


def usable_rows(ranges: Ranges, *, need_power: bool) -> Usable:
    """Return which of some ranges can be used, and how many not for which reason."""
    keep, excluded = np.ones(len(ranges), dtype=bool), Counter[str]()
    for rows in spans(len(ranges)):
        for reason, good in _good(ranges, rows, need_power=need_power):
            excluded[reason] += int(np.count_nonzero(keep[rows] & ~good))
            keep[rows] &= good
        let_go(ranges.initiator, ranges.target, ranges.truth_m, ranges.fpp1_dbm, ranges.fpp2_dbm, ranges.raw_m)
    return Usable(keep, dict(excluded))


def _good(ranges: Ranges, rows: slice, *, need_power: bool) -> Iterator[tuple[str, Bools]]:
    """Yield what some ranges may lack, and which of them do not."""
    yield "a tag with itself", ranges.initiator[rows] != ranges.target[rows]
    yield "no true distance", np.isfinite(ranges.truth_m[rows])
    powers = np.isfinite(ranges.fpp1_dbm[rows]) | np.isfinite(ranges.fpp2_dbm[rows])
    yield "no power", np.asarray(powers | (not need_power))
    raw = ranges.raw_m[rows]
    yield "impossible stamps", np.isfinite(raw) & (np.abs(raw) < LONGEST_M)


def require_some(
    source: str, count: int, excluded: Mapping[str, int], why_no_truth: str, why_no_power: str = ""
) -> None:
    """Raise `UnanswerableError` where there are no ranges, or all of so many were left out, and say for what."""
    if not count:
        raise UnanswerableError(f"{source}: holds no exchanges")
    if sum(excluded.values()) < count:
        return
    most = max(excluded, key=lambda reason: excluded[reason])
    hints = {
        "no true distance": why_no_truth
        or "it needs poses and lever arms (`uwblink poses`), or measured "
        "distances (gt_range_m of a table); without any see `calib survey`, or `calib fit --truth ranges`",
        "no power": why_no_power or "a calibration without a curve needs none: `calib fit --delays-only` makes one",
        "a tag with itself": "look at from_id and to_id of what was imported",
    }
    hint = f"; {hints[most]}" if most in hints else ""
    raise UnanswerableError(f"{source}: none of its {count} exchanges can be used: {most}{hint}")


APART: Final = (
    "source",
    "excluded",
    "planted",
    "left_skew",
    "clocks_apart",
    "recordings",
    "bodies",
    "sessions",
    "antenna_delays",
)
"""What is no column."""

COLUMNS = tuple(f.name for f in fields(Ranges) if f.name not in APART)


def concatenate(parts: Sequence[Ranges]) -> Ranges:
    """Join the ranges of several recordings, in their order.

    Raises `BadInputError` where other antenna delays were programmed into a tag in one of them than in another.
    """
    columns: dict[str, Any] = {name: joined([getattr(p, name) for p in parts]) for name in COLUMNS}
    columns["session"], names = _sessions(parts)
    reasons = sorted({reason for p in parts for reason in p.excluded})
    return Ranges(
        source=", ".join(p.source for p in parts),
        excluded={r: sum(p.excluded.get(r, 0) for p in parts) for r in reasons},
        planted=parts[0].planted,
        left_skew=worst([p.left_skew for p in parts]),
        clocks_apart=farthest(p.clocks_apart for p in parts),
        recordings=tuple(one for p in parts for one in p.recordings),
        bodies=_bodies_of_all(parts),
        sessions=names,
        antenna_delays=_antenna_delays_of_all(parts),
        **columns,
    )


def antenna_delays_in(meta: Mapping[str, Any], source: str) -> AntennaDelays:
    """Return what a recording's `meta` says was programmed; raises `BadInputError` where it cannot be understood."""
    try:
        return delays_in_meta(meta)
    except ValueError as error:
        raise BadInputError(f"{source}: {error}") from error


def _antenna_delays_of_all(parts: Sequence[Ranges]) -> AntennaDelays:
    found: dict[int | None, AntennaDelay] = {}
    where: dict[int, str] = {}
    for part in parts:
        for tag in part.tags():
            delay = delay_of(part.antenna_delays, tag)
            if delay is None:
                continue
            if found.setdefault(tag, delay) != delay:
                raise BadInputError(
                    f"{part.source}: tag {tag} had antenna delays of {delay} ticks programmed, and {found[tag]} in "
                    f"{where[tag]}; take recordings with the same ones"
                )
            where.setdefault(tag, part.source)
    return found


def _sessions(parts: Sequence[Ranges]) -> tuple[Ints, tuple[str, ...]]:
    """Return the session of each range of recordings that are joined (n,), and the names of the sessions.

    Recordings that ran at the same time, by the hosts' clocks, are one session.
    """
    number, names, ends = list[Ints](), list[str](), list[tuple[int, int]]()
    for part in parts:
        begin, end = (int(part.time_ns.min()), int(part.time_ns.max())) if len(part) else (0, 0)
        together = [k for k, (first, last) in enumerate(ends) if begin > CLOCK_NS and begin <= last and first <= end]
        if together and len(part.sessions) < 2:
            k = together[0]
            names[k], ends[k] = f"{names[k]}, {part.source}", (min(ends[k][0], begin), max(ends[k][1], end))
        else:
            k = len(names)
            names += part.sessions or (part.source,)
            ends += [(begin, end)] * max(len(part.sessions), 1)
        number.append(np.asarray(part.session + k, dtype=np.int32))
    return np.concatenate(number), tuple(names)


def bodies_of(tags: Iterable[Tag]) -> tuple[tuple[int, str], ...]:
    """Return tags with the body that carries each."""
    return tuple((tag.tag, tag.body) for tag in tags)


def _bodies_of_all(parts: Sequence[Ranges]) -> tuple[tuple[int, str], ...]:
    """Return the bodies of tags that sit on the same ones in all recordings; none where some tag changes its body."""
    every = {one for part in parts for one in part.bodies}
    return tuple(sorted(every)) if len({tag for tag, _ in every}) == len(every) else ()


STATIC = "static"
STATIC_S = 2.0
STATIC_M = 0.02


def without_static(ranges: Ranges) -> Ranges:
    """Leave out spans of two seconds in which a pair's distance stays within two centimetres.

    A flight that waits on the ground repeats one geometry, and with it one error. Raises `UnanswerableError` where
    nothing ever moves.
    """
    low, high = np.minimum(ranges.initiator, ranges.target), np.maximum(ranges.initiator, ranges.target)
    span = (ranges.time_ns - ranges.time_ns.min()) // int(STATIC_S * 1e9)
    order = np.lexsort((span, high, low))
    keys = np.column_stack([low, high, span])[order]
    starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=keys[:1] - 1) != 0, axis=1))
    truth = ranges.truth_m[order]
    reach = np.maximum.reduceat(truth, starts) - np.minimum.reduceat(truth, starts)
    moves = np.empty(len(ranges), dtype=bool)
    moves[order] = np.repeat(reach > STATIC_M, np.diff(starts, append=len(ranges)))
    if not moves.any():
        raise UnanswerableError(f"{ranges.source}: nothing moves, so `trim_static` leaves nothing")
    count = int(np.count_nonzero(~moves))
    return replace(ranges[moves], excluded=ranges.excluded | ({STATIC: count} if count else {}))
