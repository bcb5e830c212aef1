"""Summary of a recording, as text, HTML and JSON; its exchanges without second reports, and the rates of its clocks.

If targets report too, a recording has each exchange twice. Both boards report the same stamps, so that pair and a stamp
of either clock identify two reports of one exchange. The first report is used. Differences of the second one are
faults, because both are of the same frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.display import as_html, cut, first_few, printable
from uwblink.recording.schema import TABLES, Fault, Tag
from uwblink.twr import STAMPS, Exchanges, intervals, names_in, of_protocol, without_stamps

if TYPE_CHECKING:
    from uwblink.recording.file import Recording

IMPOSSIBLE_PPM: Final = 1000.0
"""A larger skew is due to a damaged stamp: boards differ by up to 40 ppm (20 ppm each, DW1000 data sheet, table 7)."""


SIGNS: Final = {True: "same sign", False: "OTHER SIGN", None: ""}
"""Words for whether the skews by stamps and by carriers have the same sign; None: too small to tell."""

APART_NS: Final = 60_000_000
"""Largest time between reports of one exchange; stamps of others can be equal after the wrap, 67 ms."""

COMPARED: Final = (*STAMPS, "range_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")
"""Columns that both reports have in common."""


@dataclass(frozen=True, slots=True)
class SingleReports:
    """Exchanges without second reports, in their order; `repeated` is the number of those.

    `differing` (k, 2) are the rows of reports that differ, the initiator's first, among the given exchanges.
    """

    exchanges: Exchanges
    repeated: int
    differing: Ints


def single_reports(exchanges: Exchanges) -> SingleReports:
    """Return each exchange once: the initiator's report if there is one, else the target's."""
    e, partner = exchanges, np.full(len(exchanges), -1, dtype=np.int64)
    for name in ("tx2", "tx1"):  # a stamp of each clock, in case that one is damaged
        one, other = _neighbours(e, [getattr(e, name), e.target, e.initiator])
        theirs = np.where(e.reporter[one] == e.target[one], one, other)
        mine = one + other - theirs
        pairs = (e.reporter[mine] == e.initiator[mine]) & (e.reporter[theirs] == e.target[theirs])
        pairs &= (e.reporter[mine] != e.reporter[theirs]) & (np.abs(e.time_ns[mine] - e.time_ns[theirs]) < APART_NS)
        partner[theirs[pairs]] = mine[pairs]
    repeated = partner >= 0
    if not repeated.any():
        return SingleReports(exchanges, 0, np.empty((0, 2), dtype=np.int64))
    first, second = partner[repeated], np.flatnonzero(repeated)
    differs = np.any([_unequal(getattr(e, name), first, second) for name in COMPARED], axis=0)
    return SingleReports(e[~repeated], len(second), np.column_stack([first, second])[differs])


def repeated_rows(exchanges: Exchanges) -> Bools:
    """Return which exchanges (n,) repeat another row of the same pair and reporter in all stamps and readings.

    Ranges without stamps must also have the same time, to a millisecond: readings of a centimetre and a decibel are
    soon equal by chance.
    """
    e = exchanges
    columns = [e.initiator, e.target, e.reporter, *(getattr(e, name) for name in COMPARED)]
    before, row = _neighbours(e, [np.nan_to_num(column, nan=-1e300) for column in columns])
    same = ~without_stamps(e)[row] | (e.time_ns[row] - e.time_ns[before] < 1_000_000)
    again = np.zeros(len(e), dtype=bool)
    again[row[same]] = True
    return again


def _neighbours(e: Exchanges, columns: Sequence[NDArray[Any]]) -> tuple[Ints, Ints]:
    """Return rows that are equal in some columns, each (k,) with the next in time."""
    order = np.lexsort((e.time_ns, *columns))
    same = np.all([np.diff(column[order]) == 0 for column in columns], axis=0)
    return order[:-1][same], order[1:][same]


def single_report_blocks(recording: Recording) -> Iterator[SingleReports]:
    """Yield the exchanges of a recording, each once, in blocks.

    A recording with reports of targets is one block, because the two reports of an exchange can be apart.
    """
    ends = recording.tally("exchanges", "initiator", "target", "reporter")
    twice = any(reporter == target != initiator for initiator, target, reporter in ends)
    return map(single_reports, [recording.exchanges()] if twice else recording.exchange_blocks())


def differences(exchanges: Exchanges, first: int, second: int) -> list[str]:
    """Return the differences of two reports, one text for each column: "range_m 3.0122 and 3.0177"."""
    pairs = [(name, getattr(exchanges, name)) for name in COMPARED]
    rows = np.array([first]), np.array([second])
    return [f"{name} {column[first]} and {column[second]}" for name, column in pairs if _unequal(column, *rows)[0]]


def _unequal(column: Ints, first: Ints, second: Ints) -> Bools:
    a, b = column[first], column[second]
    return np.asarray((a != b) & ~((a != a) & (b != b)))


@dataclass(frozen=True, slots=True)
class ClockSkew:
    """Relative rate of the clocks of a pair, the smaller id first, in ppm; positive if the second clock is faster.

    `stamps_ppm` is that by the third leg of `count` exchanges, `carrier_ppm` by readings of the carriers, None without
    any; `residual_ppm` is the scatter of readings about their median. `slope`, the ratio of the second to the first,
    and `same_sign` are None if the skew is too small. `drift_ppm` is by how much the skew by stamps grows from the
    first tenth of the exchanges to the last, as crystals that warm up drift.
    """

    pair: str
    count: int
    stamps_ppm: float
    carrier_ppm: float | None
    residual_ppm: float | None
    slope: float | None
    same_sign: bool | None
    drift_ppm: float = 0.0

    def __str__(self) -> str:
        """Return stamps, carriers, slope, residual and sign in one line."""
        start = f"pair {self.pair}: {self.stamps_ppm:+.2f} ppm by the stamps, drift {self.drift_ppm:+.2f}"
        if self.carrier_ppm is None:
            return f"{start}, carriers not read"
        slope, sign = ("", "") if self.slope is None else (f", slope {self.slope:.3f}", f", {SIGNS[self.same_sign]}")
        return f"{start}, {self.carrier_ppm:+.2f} by the carriers{slope}, residual {self.residual_ppm:.2f}{sign}"


def target_faster_ppm(exchanges: Exchanges) -> Floats:
    """Return the rate of the target's clock relative to the initiator's in ppm, by stamps of three messages (n,).

    Not finite for exchanges of two messages. Two messages of one sender have the same distance in time at the receiver:
    the second and the third if the target sends both, else the first and the third. Antenna delays cancel.
    """
    spans = intervals(exchanges)
    from_target = of_protocol(exchanges.protocol, lambda row: row.third_sender == "target")
    with np.errstate(all="ignore"):
        target = np.where(from_target, spans.dt53, spans.dt32 + spans.dt64)
        initiator = np.where(from_target, spans.dt64, spans.dt41 + spans.dt53)
        return np.asarray((target / initiator - 1) * 1e6)


def clock_skews(exchanges: Exchanges | Iterable[Exchanges]) -> list[ClockSkew]:
    """Return the skew of every pair with at least five double-sided exchanges, in the pairs' order.

    `exchanges` are all of them, or blocks as from `Recording.exchange_blocks`.
    """
    found = [np.empty((3, 0))]
    for some in [exchanges] if isinstance(exchanges, Exchanges) else exchanges:
        double = of_protocol(some.protocol, lambda row: row.third_sender is not None) > 0
        e = some[double & ((some.tx3 | some.rx3) != 0)]
        low, high = np.sort([e.initiator, e.target], axis=0)
        sign = np.where(e.initiator == low, 1.0, -1.0)
        readings = sign * target_faster_ppm(e), sign * (e.skew1_ppm - e.skew2_ppm) / 2
        found.append(np.array([low * 65_536 + high, *readings])[:, np.abs(readings[0]) < IMPOSSIBLE_PPM])
    pair, by_stamps, by_carriers = np.concatenate(found, axis=1)
    ids, counts = np.unique(pair, return_counts=True)
    return [_skew(int(one), by_stamps[pair == one], by_carriers[pair == one]) for one in ids[counts >= 5]]


def _skew(pair: int, by_stamps: Floats, by_carriers: Floats) -> ClockSkew:
    stamps, known = float(np.median(by_stamps)), by_carriers[np.isfinite(by_carriers)]
    carrier = float(np.median(known)) if len(known) else None
    # Between 16 and 84 percent lies one standard deviation to either side.
    spread = float(np.ptp(np.percentile(known, (16, 84)))) / 2 if len(known) else None
    # The sign of a skew below 0.5 ppm cannot be compared with readings of the carriers, which scatter by 0.2 ppm.
    slope = None if carrier is None or abs(stamps) <= 0.5 else carrier / stamps
    sign = None if slope is None else slope > 0
    tenth = len(by_stamps) // 10 + 1
    drift = float(np.median(by_stamps[-tenth:]) - np.median(by_stamps[:tenth]))
    return ClockSkew(f"{pair >> 16}-{pair & 0xFFFF}", len(by_stamps), stamps, carrier, spread, slope, sign, drift)


def skew_summary(skews: Sequence[ClockSkew]) -> str:
    """Return pairs' skews in one line: how well carriers agree with stamps, and how many pairs have the other sign."""
    slopes = [one.slope for one in skews if one.slope is not None]
    if not slopes:
        return f"{len(skews)} pairs by the stamps, no carriers to compare with"
    residual = np.median([one.residual_ppm for one in skews if one.residual_ppm is not None])
    other = sum(one.same_sign is False for one in skews)
    sign = "same sign" if not other else f"OTHER SIGN in {other} of {len(skews)} pairs"
    return f"carriers over stamps {np.median(slopes):.3f}, residual {residual:.2f} ppm, {sign}"


@dataclass(frozen=True, slots=True)
class PairSummary:
    """Numbers of recorded and of failed exchanges of a pair, and their rate (None: all at one time)."""

    initiator: int
    target: int
    exchanges: int
    failed: int
    rate_hz: float | None

    @property
    def success(self) -> float | None:
        """Return the share of exchanges that did not fail, None without exchanges."""
        tried = self.exchanges + self.failed
        return self.exchanges / tried if tried else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Summary of a recording: rows by table, tags, pairs, exchanges by protocol, faults by kind, poses by body.

    An exchange counts once: `reported_twice` is the number of exchanges with reports of both ends, `contradictory` that
    of those with different reports. `span_s` is the time from the first to the last exchange, or difference of arrival;
    `provenance` are the entries of `meta` without scenario and planted values. `skews` are those of pairs with
    double-sided exchanges.
    """

    file: str
    span_s: float
    counts: dict[str, int]
    tags: tuple[Tag, ...]
    pairs: tuple[PairSummary, ...]
    protocols: dict[str, int]
    faults: dict[str, int]
    poses: dict[str, int]
    provenance: dict[str, Any]
    reported_twice: int = 0
    contradictory: int = 0
    skews: tuple[ClockSkew, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwblink show --json` prints."""
        tags = [asdict(tag) | {"lever_arm_m": list(tag.lever_arm_m)} for tag in self.tags]
        return asdict(self) | {"tags": tags, "pairs": [asdict(pair) for pair in self.pairs]}

    def headline(self) -> str:
        """Return file, number of exchanges (or differences, where there is none), span and protocols in one line."""
        kind = "differences" if self.counts["differences"] and not self.counts["exchanges"] else "exchanges"
        protocols = f", protocols {counted(self.protocols)}" if kind == "exchanges" else ""
        return f"{printable(self.file)}: {self.counts[kind]} {kind} in {self.span_s:.1f} s{protocols}"

    def tables(self) -> list[list[list[str]]]:
        """Return tags, pairs and clock skews as tables of texts, each with its header."""
        tags = [[str(t.tag), t.body, " ".join(f"{v:+.3f}" for v in t.lever_arm_m)] for t in self.tags]
        pairs = [
            [
                *map(str, (p.initiator, p.target, p.exchanges, p.failed)),
                _number(p.rate_hz, ".1f"),
                _number(p.success, ".1%"),
            ]
            for p in self.pairs
        ]
        forms = {"stamps_ppm": "+.2f", "carrier_ppm": "+.2f", "slope": ".3f", "residual_ppm": ".2f"}
        skews = [
            [s.pair, *(_number(getattr(s, name), form) for name, form in forms.items()), SIGNS[s.same_sign]]
            for s in self.skews
        ]
        return [
            [["tag", "body", "lever arm (m)"], *tags],
            [["initiator", "target", "exchanges", "failed", "rate (Hz)", "success"], *pairs],
            [["pair", "by stamps (ppm)", "by carriers", "slope", "residual", "sign"], *skews],
        ]

    def lines(self) -> list[str]:
        """Return lines about what the tables do not show: exchanges with two reports, poses, faults, other tables."""
        rows = {
            name: n for name, n in self.counts.items() if n and name not in ("exchanges", "tags", "poses", "faults")
        }
        twice = f"{self.reported_twice} reported by both ends, {self.contradictory} of them differently"
        return [
            *([twice] if self.reported_twice else []),
            f"poses: {counted(self.poses)}",
            f"faults: {counted(self.faults)}",
            *([f"also: {counted(rows)}"] if rows else []),
        ]

    def __str__(self) -> str:
        """Return at most 24 lines of 79 characters."""
        tags = first_few(f"{tag.tag} on {printable(tag.body)}" for tag in self.tags)
        skews = [f"clock skew: {skew_summary(self.skews)}"] if self.skews else []
        shown = self.pairs[:12]
        pairs = [f"{p.initiator:>5} -> {p.target:<5} {p.exchanges:>9} exchanges{_rate(p)}" for p in shown]
        more = [f"and {len(self.pairs) - len(shown)} pairs more"] if len(self.pairs) > len(shown) else []
        lines = [f"tags: {tags}", *self.lines(), *skews, *pairs, *more]
        return "\n".join([cut(self.headline()), *(cut(f"  {line}") for line in lines)])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        _, pairs, _ = self.tables()
        return as_html("; ".join([self.headline(), *self.lines()]), pairs)


def summarize(recording: Recording) -> Summary:
    """Return the summary of a recording, which is read in blocks; raises what its readers raise."""
    pairs, protocols, times = Counter[tuple[int, int]](), Counter[str](), list[int]()
    repeated = contradictory = 0

    def counting() -> Iterator[Exchanges]:
        nonlocal repeated, contradictory
        for reports in single_report_blocks(recording):
            e = reports.exchanges
            repeated += reports.repeated
            contradictory += len(reports.differing)
            times.extend([int(e.time_ns.min()), int(e.time_ns.max())] if len(e) else [])
            ids, counts = np.unique(e.initiator << 16 | e.target, return_counts=True)
            for pair, count in zip(ids.tolist(), counts.tolist(), strict=True):
                pairs[pair >> 16, pair & 0xFFFF] += count
            protocols.update({name: int(np.count_nonzero(e.protocol == name)) for name in names_in(e.protocol)})
            yield e

    skews = clock_skews(counting())
    times = times or recording.columns("differences")["time_ns"].tolist()
    span_s = (max(times) - min(times)) * 1e-9 if times else 0.0
    failed = recording.tally("faults", "initiator", "target")
    return Summary(
        file=recording.path.name,
        span_s=span_s,
        counts={t: recording.count(t) for t in TABLES if t != "meta"} | {"exchanges": pairs.total()},
        tags=tuple(recording.tags()),
        pairs=tuple(
            PairSummary(pair[0], pair[1], pairs[pair], failed.get(pair, 0), pairs[pair] / span_s if span_s else None)
            for pair in sorted({*pairs, *failed})
        ),
        protocols=dict(sorted(protocols.items())),
        faults=_words(recording.tally("faults", "kind")),
        poses=_words(recording.tally("poses", "body")),
        provenance={k: v for k, v in recording.meta().items() if k not in {"scenario", "planted"}},
        reported_twice=repeated,
        contradictory=contradictory,
        skews=tuple(skews),
    )


def _words(found: Mapping[tuple[Any, ...], int]) -> dict[str, int]:
    return dict(sorted((str(word), count) for (word,), count in found.items()))


def failures_by_pair(faults: list[Fault]) -> dict[tuple[int, int], int]:
    """Count failed exchanges by (initiator, target)."""
    ends = ((fault.initiator, fault.target) for fault in faults)
    return dict(Counter((i, j) for i, j in ends if i is not None and j is not None))


def counted(counts: Mapping[str, int]) -> str:
    """Return names with their numbers, or `none`."""
    return ", ".join(f"{printable(name)} {count}" for name, count in counts.items()) or "none"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else f"{value:{form}}"


def _rate(pair: PairSummary) -> str:
    rate = "" if pair.rate_hz is None else f", {pair.rate_hz:.1f} Hz"
    return f"{rate}, {pair.failed} failed" if pair.failed else rate
