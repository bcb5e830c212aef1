"""What a recording holds: a summary that prints itself, and as JSON; and how fast its clocks run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.display import as_html, cut, first_few, printable
from uwblink.protocols.table import PROTOCOLS, third_from_target
from uwblink.recording.schema import TABLES, Fault, Tag
from uwblink.recording.target_reports import single_report_blocks
from uwblink.twr import Exchanges, intervals, names_in

if TYPE_CHECKING:
    from uwblink.recording.file import Recording

IMPOSSIBLE_PPM: Final = 1000.0
"""Skew beyond this is of a damaged stamp: boards differ by 40 ppm at most (20 ppm each, DW1000 data sheet, table 7)."""

CLEAR_PPM: Final = 0.5
"""A smaller skew has no sign that readings of the carriers, which scatter by 0.2 ppm, could have the wrong way."""


@dataclass(frozen=True, slots=True)
class ClockSkew:
    """A pair, the smaller id first: by how many ppm the second's clock is faster than the first's.

    `stamps_ppm` says so by the third leg of `count` exchanges, `carrier_ppm` by the carriers' readings, None where
    there are none; `slope` is the one over the other, `residual_ppm` how far single ones scatter about their median,
    `same_sign` None where the skew is too small to tell.
    """

    pair: str
    count: int
    stamps_ppm: float
    carrier_ppm: float | None
    residual_ppm: float | None
    same_sign: bool | None

    @property
    def slope(self) -> float | None:
        """Return carrier over stamps, None where the skew is too small to tell."""
        if self.carrier_ppm is None or abs(self.stamps_ppm) <= CLEAR_PPM:
            return None
        return self.carrier_ppm / self.stamps_ppm

    def __str__(self) -> str:
        """Return stamps, carriers, slope, residual and sign in one line."""
        if self.carrier_ppm is None or self.residual_ppm is None:
            return f"pair {self.pair}: {self.stamps_ppm:+.2f} ppm by the stamps, carriers not read"
        signs = {True: ", same sign", False: ", OTHER SIGN", None: ""}
        slope = "" if self.slope is None else f", slope {self.slope:.3f}"
        return (
            f"pair {self.pair}: {self.stamps_ppm:+.2f} ppm by the stamps, {self.carrier_ppm:+.2f} by the carriers"
            f"{slope}, residual {self.residual_ppm:.2f}{signs[self.same_sign]}"
        )


def target_faster_ppm(exchanges: Exchanges) -> Floats:
    """Return by how much the target's clock is faster, by the stamps of three messages (n,); of two, no number.

    Two messages of one sender are as far apart where they are received: the second and the third, if the target sends
    both, else the first and the third. Antenna delays cancel.
    """
    spans = intervals(exchanges)
    from_target = np.isin(exchanges.protocol, third_from_target(names_in(exchanges.protocol)))
    with np.errstate(all="ignore"):
        target = np.where(from_target, spans.dt53, spans.dt32 + spans.dt64)
        initiator = np.where(from_target, spans.dt64, spans.dt41 + spans.dt53)
        return np.asarray((target / initiator - 1) * 1e6)


def clock_skews(exchanges: Exchanges | Iterable[Exchanges]) -> list[ClockSkew]:
    """Return the skew of every pair with at least five double-sided exchanges, in the pairs' order.

    `exchanges` are all, or come some at a time, as from `Recording.exchange_blocks`.
    """
    pairs, stamps, carriers = [np.empty(0, np.uint32)], [np.empty(0)], [np.empty(0)]
    for some in [exchanges] if isinstance(exchanges, Exchanges) else exchanges:
        double = [name for name in names_in(some.protocol) if PROTOCOLS[name].third_sender is not None]
        e = some[np.isin(some.protocol, double) & ((some.tx3 | some.rx3) != 0)]
        forth = np.where(e.initiator < e.target, 1.0, -1.0)
        by_stamps = forth * target_faster_ppm(e)
        good = np.isfinite(by_stamps) & (np.abs(by_stamps) < IMPOSSIBLE_PPM)
        pair = np.minimum(e.initiator, e.target) << 16 | np.maximum(e.initiator, e.target)
        pairs.append(pair[good].astype(np.uint32))
        stamps.append(by_stamps[good])
        carriers.append((forth * (e.skew1_ppm - e.skew2_ppm) / 2)[good])
    all_pairs, all_stamps, all_carriers = np.concatenate(pairs), np.concatenate(stamps), np.concatenate(carriers)
    ids, counts = np.unique(all_pairs, return_counts=True)
    mine = ((int(one), all_pairs == one) for one in ids[counts >= 5])
    return [_skew(one, all_stamps[rows], all_carriers[rows]) for one, rows in mine]


def _skew(pair: int, by_stamps: Floats, by_carriers: Floats) -> ClockSkew:
    stamps, known = float(np.median(by_stamps)), by_carriers[np.isfinite(by_carriers)]
    carrier = float(np.median(known)) if len(known) else None
    # Between 16 and 84 percent lies one standard deviation to either side.
    spread = float(np.ptp(np.percentile(known, (16, 84)))) / 2 if len(known) else None
    alike = None
    if carrier is not None and abs(stamps) > CLEAR_PPM:
        alike = bool(np.sign(stamps) == np.sign(carrier))
    return ClockSkew(f"{pair >> 16}-{pair & 0xFFFF}", len(by_stamps), stamps, carrier, spread, alike)


def _told(skews: Sequence[ClockSkew]) -> str:
    """Return pairs' skews in one line: how well carriers follow the stamps, and in how many pairs by the other sign."""
    slopes = [one.slope for one in skews if one.slope is not None]
    residuals = [one.residual_ppm for one in skews if one.residual_ppm is not None]
    if not slopes or not residuals:
        return f"{len(skews)} pairs by the stamps, no carriers to compare with"
    other = sum(one.same_sign is False for one in skews)
    sign = "same sign" if not other else f"OTHER SIGN in {other} of {len(skews)} pairs"
    return f"carriers over stamps {np.median(slopes):.3f}, residual {np.median(residuals):.2f} ppm, {sign}"


@dataclass(frozen=True, slots=True)
class PairSummary:
    """Exchanges of one pair: how many were recorded and failed, and how many a second (None: all at once)."""

    initiator: int
    target: int
    exchanges: int
    failed: int
    rate_hz: float | None

    @property
    def success(self) -> float | None:
        """Return the share of exchanges that did not fail, None where there are none."""
        tried = self.exchanges + self.failed
        return self.exchanges / tried if tried else None


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
            *([f"  clock skew: {_told(self.skews)}"] if self.skews else []),
        ]


def summarize(recording: Recording) -> Summary:
    """Return what a recording holds, read some of it at a time; raises what its readers raise."""
    pairs, protocols, times = Counter[tuple[int, int]](), Counter[str](), list[int]()
    repeated = contradictory = 0

    def counting() -> Iterator[Exchanges]:
        nonlocal repeated, contradictory
        for reports, _ in single_report_blocks(recording):
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


def _hertz(pair: PairSummary) -> str:
    return "" if pair.rate_hz is None else f"{pair.rate_hz:.1f}"


def _rate(pair: PairSummary) -> str:
    rate = "" if pair.rate_hz is None else f", {_hertz(pair)} Hz"
    return f"{rate}, {pair.failed} failed" if pair.failed else rate
