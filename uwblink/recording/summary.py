"""Summaries of recordings as text, HTML and JSON, exchanges without second reports, and relative clock rates.

If targets report, too, a recording has two reports of each exchange. Both contain the same stamps, so the pair and a
stamp of either clock identify reports of the same exchange. The initiator's report is used. Other values in the second
one are faults, because both are of the same frames.
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
from uwblink.twr import STAMPS, Exchanges, intervals, of_protocol, without_stamps

if TYPE_CHECKING:
    from uwblink.recording.file import Recording

IMPOSSIBLE_PPM: Final = 1000.0
"""Skews above this are due to damaged stamps: clock rates differ by up to 40 ppm (20 ppm each, DW1000 data sheet, table
7)."""


SIGNS: Final = {True: "same sign", False: "OTHER SIGN", None: ""}
"""Words for `ClockSkew.same_sign`, whether skews by stamps and by carriers have the same sign; None: too small."""

APART_NS: Final = 60_000_000
"""Largest time between two reports of one exchange. Stamps of 32 bits repeat after 67 ms."""

COMPARED: Final = (*STAMPS, "range_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")
"""Columns that are equal in both reports of an exchange."""


@dataclass(frozen=True, slots=True)
class SingleReports:
    """Exchanges without second reports, in their order; `repeated` is the number of second reports.

    `differing` (k, 2) are the rows of reports with different values among the given exchanges, the initiator's first.
    """

    exchanges: Exchanges
    repeated: int
    differing: Ints


def single_reports(exchanges: Exchanges) -> SingleReports:
    """Return each exchange once: the initiator's report if there is one, else the target's."""
    e, partner = exchanges, np.full(len(exchanges), -1, dtype=np.int64)
    for name in ("tx2", "tx1"):  # a stamp of each clock, because one may be damaged
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
    """Return a mask (n,) of exchanges with the pair, reporter, stamps and readings of an earlier row.

    Ranges without stamps must also have times within a millisecond, because readings that are rounded to a centimetre
    and a decibel are often equal by chance.
    """
    e = exchanges
    columns = [e.initiator, e.target, e.reporter, *(getattr(e, name) for name in COMPARED)]
    before, row = _neighbours(e, [np.nan_to_num(column, nan=-1e300) for column in columns])
    same = ~without_stamps(e)[row] | (e.time_ns[row] - e.time_ns[before] < 1_000_000)
    again = np.zeros(len(e), dtype=bool)
    again[row[same]] = True
    return again


def _neighbours(e: Exchanges, columns: Sequence[NDArray[Any]]) -> tuple[Ints, Ints]:
    """Return pairs of rows (k,), (k,) that are equal in some columns and successive in time."""
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
    """Return the differences of two reports, one text per column, such as "range_m 3.0122 and 3.0177"."""
    pairs = [(name, getattr(exchanges, name)) for name in COMPARED]
    rows = np.array([first]), np.array([second])
    return [f"{name} {column[first]} and {column[second]}" for name, column in pairs if _unequal(column, *rows)[0]]


def _unequal(column: Ints, first: Ints, second: Ints) -> Bools:
    a, b = column[first], column[second]
    return np.asarray((a != b) & ~((a != a) & (b != b)))


@dataclass(frozen=True, slots=True)
class ClockSkew:
    """Relative rate of the clocks of a pair, the smaller id first, in ppm; positive if the second clock is faster.

    `stamps_ppm` is the median skew by the stamps of `count` exchanges with three messages. `carrier_ppm` is the median
    of readings of the carrier integrators, and `residual_ppm` their spread; None without readings. `slope` is
    `carrier_ppm` / `stamps_ppm`; it and `same_sign` are None if the skew is too small. `drift_ppm` is the change of the
    skew by stamps from the first tenth of the exchanges to the last, for example while crystals warm up.
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

    It is not finite for exchanges of two messages. The interval between two messages of one sender, measured by both
    clocks, gives the rate: the second and third message if the target sends both, else the first and third. Antenna
    delays cancel.
    """
    spans = intervals(exchanges)
    from_target = of_protocol(exchanges.protocol, lambda row: row.third_sender == "target")
    with np.errstate(all="ignore"):
        target = np.where(from_target, spans.dt53, spans.dt32 + spans.dt64)
        initiator = np.where(from_target, spans.dt64, spans.dt41 + spans.dt53)
        return np.asarray((target / initiator - 1) * 1e6)


def clock_skews(exchanges: Exchanges | Iterable[Exchanges]) -> list[ClockSkew]:
    """Return the skew of every pair with at least five exchanges of three messages, in the order of pairs.

    `exchanges` are all exchanges, or blocks such as those of `Recording.exchange_blocks`.
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
    # The 16 % and 84 % quantiles of a normal distribution are one standard deviation from the mean.
    spread = float(np.ptp(np.percentile(known, (16, 84)))) / 2 if len(known) else None
    # Readings of the carriers have a noise of 0.2 ppm, so signs of skews below 0.5 ppm are not compared.
    slope = None if carrier is None or abs(stamps) <= 0.5 else carrier / stamps
    sign = None if slope is None else slope > 0
    tenth = len(by_stamps) // 10 + 1
    drift = float(np.median(by_stamps[-tenth:]) - np.median(by_stamps[:tenth]))
    return ClockSkew(f"{pair >> 16}-{pair & 0xFFFF}", len(by_stamps), stamps, carrier, spread, slope, sign, drift)


def skew_summary(skews: Sequence[ClockSkew]) -> str:
    """Return a line on the skews of pairs: agreement of carriers and stamps, number of pairs with another sign."""
    slopes = [one.slope for one in skews if one.slope is not None]
    if not slopes:
        return f"{len(skews)} pairs by the stamps, no carriers to compare with"
    residual = np.median([one.residual_ppm for one in skews if one.residual_ppm is not None])
    other = sum(one.same_sign is False for one in skews)
    sign = "same sign" if not other else f"OTHER SIGN in {other} of {len(skews)} pairs"
    return f"carriers over stamps {np.median(slopes):.3f}, residual {residual:.2f} ppm, {sign}"


@dataclass(frozen=True, slots=True)
class PairSummary:
    """Numbers of recorded and of failed exchanges of a pair, and the rate of the recorded ones.

    The rate is None if all exchanges of the recording have the same time.
    """

    initiator: int
    target: int
    exchanges: int
    failed: int
    rate_hz: float | None

    @property
    def success(self) -> float | None:
        """The share of exchanges that did not fail, None without exchanges."""
        tried = self.exchanges + self.failed
        return self.exchanges / tried if tried else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Summary of a recording: rows by table, tags, pairs, exchanges by protocol, faults by kind, poses by body.

    Exchanges with two reports are counted once: `reported_twice` is their number, and `contradictory` the number of
    those with different reports. `span_s` is the time from the first to the last exchange, or difference of arrival if
    there are no exchanges; the protocol of exchanges without stamps is "unknown"; `provenance` are the entries of
    `meta` without scenario and planted values. `skews` are those of pairs with exchanges of three messages.
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
        """Return file, number of exchanges (or of differences, if there are none), span and protocols in one line."""
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
        """Return lines on data that are not in `tables`: exchanges with two reports, poses, faults, other tables."""
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
    """Return the summary of a recording, which is read in blocks; raises `RecordingError` if that fails."""
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
            # Ranges without stamps do not show their protocol.
            names, counts = np.unique(np.where(without_stamps(e), "unknown", e.protocol), return_counts=True)
            protocols.update(dict(zip(names.tolist(), counts.tolist(), strict=True)))
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
    """Return the number of failed exchanges by (initiator, target)."""
    ends = ((fault.initiator, fault.target) for fault in faults)
    return dict(Counter((i, j) for i, j in ends if i is not None and j is not None))


def counted(counts: Mapping[str, int]) -> str:
    """Return names with their numbers as a text, "none" without any."""
    return ", ".join(f"{printable(name)} {count}" for name, count in counts.items()) or "none"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else f"{value:{form}}"


def _rate(pair: PairSummary) -> str:
    rate = "" if pair.rate_hz is None else f", {pair.rate_hz:.1f} Hz"
    return f"{rate}, {pair.failed} failed" if pair.failed else rate
