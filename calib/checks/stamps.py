"""Checks of stamps, protocols, ids and reported ranges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from calib.checks.recording_view import PLAUSIBLE_M, RecordingView, plausible_share
from calib.findings import Candidate, more_often
from uwblink.arrays import Bools
from uwblink.protocols.table import PROTOCOLS, single_sided
from uwblink.recording import target_faster_ppm
from uwblink.ticks import SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import Exchanges, board_range, intervals, raw_range

FARTHEST_M: Final = 50.0
CONTRADICTS_M: Final = 0.01
LEAST_CORRUPT: Final = 0.001
"""Share of damaged rows of a sound recording."""

MOST_CORRUPT: Final = 0.5
VACUUM_OVER_AIR: Final = 299_792_458.0 / SPEED_OF_LIGHT


def ticks(view: RecordingView) -> Iterator[Candidate]:
    """Stamps in nanoseconds taken for ticks make every duration 64 times too short."""
    spans, third = intervals(view.exchanges), view.exchanges.tx3 != 0
    legs = [float(np.median(spans.dt41)), float(np.median(spans.dt53[third])) if third.any() else 0.0]
    longest = max(legs) / TICKS_PER_SECOND
    per_ns = TICKS_PER_SECOND * 1e-9
    if longest < 60e-6 and longest * per_ns > 150e-6 and len(np.unique(view.exchanges.tx1 % 512)) > 8:
        yield Candidate(
            "unit slip",
            f"the longest leg of an exchange lasts {longest * 1e6:.1f} µs, too short for a frame; "
            f"read as nanoseconds it would be {longest * per_ns * 1e6:.0f} µs",
        )


def single_as_double(view: RecordingView) -> Iterator[Candidate]:
    """Double-sided exchanges without a third message."""
    e = view.exchanges
    empty = ~np.isin(e.protocol, single_sided()) & (e.tx3 == 0) & (e.rx3 == 0)
    if empty.mean() > 0.5:
        yield Candidate(
            "single-sided data taken for double-sided",
            f"{100 * empty.mean():.0f} % of the double-sided exchanges have no third message",
        )


def impossible(view: RecordingView) -> Bools:
    """Return which exchanges are impossible, or contradict their reported range or the clocks of their pair (n,)."""
    e = view.exchanges
    with np.errstate(all="ignore"):
        said = np.abs(board_range(e) - e.range_m)
        bad = ~(np.abs(view.raw_m) < PLAUSIBLE_M) | ~sound_clocks(e) | (e.initiator == e.target)
        away = np.abs(view.error_m) > FARTHEST_M
    if not _is_scaled(view):
        bad |= np.isfinite(said) & (said > CONTRADICTS_M)
    # Where most are far off, something else is wrong with all of them.
    return np.asarray(bad | away if np.mean(away) < MOST_CORRUPT else bad)


def with_itself(view: RecordingView) -> Iterator[Candidate]:
    """Exchanges of a tag with itself, which no radio makes."""
    e = view.exchanges
    same = e.initiator == e.target
    if same.any():
        tags = ", ".join(map(str, np.unique(e.initiator[same])[:6].tolist()))
        told = f"{np.count_nonzero(same)} of {len(e)} exchanges have one tag at both ends ({tags})"
        yield Candidate("a tag with itself", told)


def doubled(view: RecordingView) -> Iterator[Candidate]:
    """Rows that repeat another one: two robots log an exchange, and both logs were imported."""
    if view.doubled:
        told = f"{view.doubled} of {view.doubled + len(view.exchanges)} rows repeat another one"
        yield Candidate("doubled exchanges", told)


def corrupted(view: RecordingView) -> Iterator[Candidate]:
    """Exchanges that are impossible, or contradict themselves; the other examinations do without them."""
    bad = impossible(view)
    count = int(np.count_nonzero(bad))
    if count < MOST_CORRUPT * len(bad):
        yield Candidate(
            "corrupted exchanges",
            f"{count} of {len(bad)} exchanges have impossible stamps, or stamps that contradict the "
            "range reported with them or the clocks of their pair; what else is said here is said without them",
            more_often(count, len(bad), LEAST_CORRUPT),
        )


def _is_scaled(view: RecordingView) -> bool:
    ratio = view.exchanges.range_m / view.raw_m
    good = np.isfinite(ratio) & (np.abs(view.raw_m) > 1)
    return bool(good.any() and abs(np.median(ratio[good]) - 1) > 1e-4)


def speed_of_light(view: RecordingView) -> Iterator[Candidate]:
    """Reported ranges that were computed with the speed of light in vacuum."""
    e = view.exchanges
    good = np.isfinite(e.range_m) & (np.abs(view.raw_m) > 1)
    if np.count_nonzero(good) < 100:
        return
    ratio = float(np.median(e.range_m[good] / view.raw_m[good]))
    if abs(ratio / VACUUM_OVER_AIR - 1) < 5e-5:
        told = f"reported ranges are {ratio:.5f} times those from the stamps: 299 792 458 m/s instead of 299 702 547"
        yield Candidate("speed of light in vacuum", told)


def contradicting(view: RecordingView) -> Iterator[Candidate]:
    """Initiator and target that report one exchange differently: they print the same numbers, so a line was damaged."""
    if view.contradictions:
        yield Candidate(
            "contradicting reports",
            f"both ends reported {view.reported_twice} exchanges, {len(view.contradictions)} of them differently; "
            f"the first: {view.contradictions[0]}",
        )


WIDTHS: Final = (32, 40)
POSSIBLE_SHARE: Final = 0.5
"""Another reading must make at least this share of the ranges possible, and `MORE_POSSIBLE` more than its own."""

MORE_POSSIBLE: Final = 0.2
MORE_BY_WIDTH: Final = 0.01
SKEW_PPM: Final = 100.0
TRIED: Final = 4000
"""Exchanges on which other protocols are tried."""


def another(view: RecordingView) -> Iterator[Candidate]:
    """Try every other protocol with as many messages, and every width of the counter."""
    e = view.exchanges[:: max(len(view.exchanges) // TRIED, 1)]
    own = _share(e)
    names, counts = np.unique(e.protocol, return_counts=True)
    said = str(names[int(np.argmax(counts))])
    tried = {
        (name, bits): _share(replace(e, protocol=np.full(len(e), name), bits=bits)) for name, bits in _others(e, said)
    }
    if not tried:
        return
    name, bits = max(tried, key=lambda key: (round(tried[key], 2), key[1] == e.bits, key[0] == said))
    share, wider = tried[name, bits], bits != e.bits
    gain = MORE_BY_WIDTH if name == said else MORE_POSSIBLE
    if share < POSSIBLE_SHARE or share < own + gain:
        return
    numbers = f"{100 * share:.1f} % of the ranges are possible, {100 * own:.1f} % as the recording has it"
    if name == said:
        yield Candidate("timestamp width", f"as {bits}-bit stamps {numbers}", words={"bits": bits})
        return
    alike = [n for n in PROTOCOLS if tried.get((n, bits), 0.0) > share - 0.01 and n != said]
    also = f" (or {' or '.join(n for n in alike if n != name)})" if len(alike) > 1 else ""
    yield Candidate(
        "another protocol",
        f"read as {name}{also}{f' with {bits} bits' if wider else ''} {numbers} ({said})",
        words={"settings": f'protocol = "{name}"' + (f", bits = {bits}" if wider else "")},
    )


def _others(e: Exchanges, said: str) -> Iterator[tuple[str, int]]:
    """Yield the protocols and widths that the stamps may be of, other than the recording's own."""
    third = bool(np.mean((e.tx3 | e.rx3) != 0) > POSSIBLE_SHARE)
    highest = max(int(stamps.max(initial=0)) for stamps in (e.tx1, e.rx1, e.tx2, e.rx2))
    for name, row in PROTOCOLS.items():
        for bits in WIDTHS:
            fits = highest < 1 << bits and (name != said or bits != e.bits)
            if fits and (row.third_sender is not None) == third:
                yield name, bits


def _share(e: Exchanges) -> float:
    """Return the share of exchanges whose range and clocks are possible."""
    with np.errstate(all="ignore"):
        raw = raw_range(e)
        return plausible_share(np.where(sound_clocks(e), raw, np.inf))


def sound_clocks(e: Exchanges) -> Bools:
    """Return where the third leg says that clocks run alike as crystals do, (n,); so they do where there is none."""
    names = [name for name in np.unique(e.protocol).tolist() if PROTOCOLS[name].third_sender is not None]
    return np.asarray(~np.isin(e.protocol, names) | (np.abs(target_faster_ppm(e)) < SKEW_PPM))
