"""What a recording holds: a summary that prints itself, and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uwblink.display import as_html, cut, first_few, printable
from uwblink.recording.relative_clocks import ClockSkew, SkewReadings, told
from uwblink.recording.schema import TABLES, Fault, Tag
from uwblink.recording.target_reports import SingleReports, single_report_blocks
from uwblink.twr import LATEST_NS, names_in

if TYPE_CHECKING:
    from uwblink.recording.file import Recording


@dataclass(frozen=True, slots=True)
class PairSummary:
    """Exchanges of one pair: how many were recorded and failed, and how many a second (None: all at once)."""

    initiator: int
    target: int
    exchanges: int
    failed: int
    rate_hz: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What a recording holds: rows by table, tags, pairs, exchanges by protocol, faults by kind, poses by body.

    An exchange counts once: `reported_twice` are those that both ends reported, `contradictory` those of them whose two
    reports differ. `span_s` is the time from the first to the last exchange; `provenance` is what `meta` says of where
    it comes from, without the scenario and what was planted. `skews` are those of pairs that range double-sided.
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
        """Return file, number of exchanges, span and protocols in one line."""
        return (
            f"{printable(self.file)}: {self.counts['exchanges']} exchanges in {self.span_s:.1f} s, "
            f"protocols {counted(self.protocols)}"
        )

    def __str__(self) -> str:
        """Return at most 24 lines of 79 characters."""
        shown = self.pairs[:12]
        pairs = [f"  {p.initiator:>5} -> {p.target:<5} {p.exchanges:>9} exchanges{_rate(p)}" for p in shown]
        more = [f"  and {len(self.pairs) - len(shown)} pairs more"] if len(self.pairs) > len(shown) else []
        return "\n".join(map(cut, [self.headline(), *self._lines(), *pairs, *more]))

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        names = ["initiator", "target", "exchanges", "failed", "rate (Hz)"]
        rows = [[str(p.initiator), str(p.target), str(p.exchanges), str(p.failed), _hertz(p)] for p in self.pairs]
        return as_html("; ".join([self.headline(), *(line.strip() for line in self._lines())]), [names, *rows])

    def _lines(self) -> list[str]:
        rows = {
            name: n for name, n in self.counts.items() if n and name not in ("exchanges", "tags", "poses", "faults")
        }
        twice = f"  {self.reported_twice} reported by both ends, {self.contradictory} of them differently"
        return [
            *([twice] if self.reported_twice else []),
            f"  tags: {first_few(f'{tag.tag} on {printable(tag.body)}' for tag in self.tags)}",
            f"  poses: {counted(self.poses)}",
            f"  faults: {counted(self.faults)}",
            *([f"  also: {counted(rows)}"] if rows else []),
            *([f"  clock skew: {told(self.skews)}"] if self.skews else []),
        ]


def summarize(recording: Recording) -> Summary:
    """Return what a recording holds, read some of it at a time; raises what its readers raise."""
    read = _Counted()
    for reports, _ in single_report_blocks(recording):
        read.add(reports)
    span_s, done = read.span_s(), read.pairs
    failed = recording.tally("faults", "initiator", "target")
    return Summary(
        file=recording.path.name,
        span_s=span_s,
        counts={t: recording.count(t) for t in TABLES if t != "meta"} | {"exchanges": done.total()},
        tags=tuple(recording.tags()),
        pairs=tuple(
            PairSummary(pair[0], pair[1], done[pair], failed.get(pair, 0), done[pair] / span_s if span_s else None)
            for pair in sorted({*done, *failed})
        ),
        protocols=dict(sorted(read.protocols.items())),
        faults=_words(recording.tally("faults", "kind")),
        poses=_words(recording.tally("poses", "body")),
        provenance={k: v for k, v in recording.meta().items() if k not in {"scenario", "planted"}},
        reported_twice=read.repeated,
        contradictory=read.contradictory,
        skews=tuple(read.readings.skews()),
    )


class _Counted:
    """What is counted as exchanges are read."""

    def __init__(self) -> None:
        self.pairs: Counter[tuple[int, int]] = Counter()
        self.protocols: Counter[str] = Counter()
        self.readings = SkewReadings()
        self.repeated = self.contradictory = 0
        self._first_ns, self._last_ns = LATEST_NS, -LATEST_NS

    def add(self, reports: SingleReports) -> None:
        e = reports.exchanges
        self.repeated += reports.repeated
        self.contradictory += len(reports.differing)
        if not len(e):
            return
        ids, counts = np.unique(e.initiator << 16 | e.target, return_counts=True)
        self.pairs.update(
            {(pair >> 16, pair & 0xFFFF): n for pair, n in zip(ids.tolist(), counts.tolist(), strict=True)}
        )
        self.protocols.update({name: int(np.count_nonzero(e.protocol == name)) for name in names_in(e.protocol)})
        self.readings.add(e)
        self._first_ns, self._last_ns = (
            min(self._first_ns, int(e.time_ns.min())),
            max(self._last_ns, int(e.time_ns.max())),
        )

    def span_s(self) -> float:
        """Return the time from the first to the last exchange, in seconds."""
        return max(self._last_ns - self._first_ns, 0) * 1e-9


def _words(found: Mapping[tuple[Any, ...], int]) -> dict[str, int]:
    return dict(sorted((str(word), count) for (word,), count in found.items()))


def failures_by_pair(faults: list[Fault]) -> dict[tuple[int, int], int]:
    """Count failed exchanges by (initiator, target)."""
    ends = ((fault.initiator, fault.target) for fault in faults)
    return dict(Counter((i, j) for i, j in ends if i is not None and j is not None))


def counted(counts: Mapping[str, int]) -> str:
    """Return names with their numbers, or `none`."""
    return ", ".join(f"{printable(name)} {count}" for name, count in counts.items()) or "none"


def _hertz(pair: PairSummary) -> str:
    return "" if pair.rate_hz is None else f"{pair.rate_hz:.1f}"


def _rate(pair: PairSummary) -> str:
    rate = "" if pair.rate_hz is None else f", {_hertz(pair)} Hz"
    return f"{rate}, {pair.failed} failed" if pair.failed else rate
