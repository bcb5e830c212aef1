"""Checks of the columns of a recording: stamps, protocols, ids, and units that contradict each other or physics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from calib.checks.geometry import MATERIAL
from calib.checks.recording_view import PLAUSIBLE_M, RecordingView
from calib.data.ranges import measured_powers
from calib.findings import Candidate, more_often
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats
from uwblink.protocols.table import PROTOCOLS, single_sided
from uwblink.recording import target_faster_ppm
from uwblink.ticks import SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import Exchanges, board_range, intervals, raw_range, without_stamps

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
    empty = 100 * float(np.mean(~np.isin(e.protocol, single_sided()) & (e.tx3 == 0) & (e.rx3 == 0)))
    if empty > 50:
        evidence = f"{empty:.0f} % of the double-sided exchanges have no third message"
        yield Candidate("single-sided data taken for double-sided", evidence)


def impossible(view: RecordingView) -> Bools:
    """Return which exchanges are impossible, or contradict their reported range or the clocks of their pair (n,)."""
    e, ratios = view.exchanges, _reported_over_stamps(view)
    with np.errstate(all="ignore"):
        bad = ~(np.abs(view.raw_m) < PLAUSIBLE_M) | ~_sound_clocks(e) | (e.initiator == e.target)
        # Where reported ranges are in another unit by more, none of them contradicts its stamps.
        if not len(ratios) or abs(np.median(ratios) - 1) <= 1e-4:
            bad |= np.abs(board_range(e) - e.range_m) > 0.01
        away = np.abs(view.error_m) > 50.0
    # Where most are far off, something else is wrong with all of them.
    return np.asarray(bad | away if np.mean(away) < 0.5 else bad)


def with_itself(view: RecordingView) -> Iterator[Candidate]:
    """Exchanges of a tag with itself, which no radio makes."""
    e = view.exchanges
    same = e.initiator == e.target
    if same.any():
        tags = ", ".join(map(str, np.unique(e.initiator[same])[:6].tolist()))
        evidence = f"{np.count_nonzero(same)} of {len(e)} exchanges have one tag at both ends ({tags})"
        yield Candidate("a tag with itself", evidence)


def doubled(view: RecordingView) -> Iterator[Candidate]:
    """Rows that repeat another one: two robots log an exchange, and both logs were imported."""
    if view.doubled:
        evidence = f"{view.doubled} of {view.doubled + len(view.exchanges)} rows repeat another one"
        yield Candidate("doubled exchanges", evidence)


def corrupted(view: RecordingView) -> Iterator[Candidate]:
    """Exchanges that are impossible, or contradict themselves; the other examinations do without them."""
    bad = impossible(view)
    count = int(np.count_nonzero(bad))
    if count < 0.5 * len(bad):
        yield Candidate(
            "corrupted exchanges",
            f"{count} of {len(bad)} exchanges have impossible stamps, or stamps that contradict the "
            "range reported with them or the clocks of their pair; what else is said here is said without them",
            more_often(count, len(bad), 0.001),
        )


def contradicting(view: RecordingView) -> Iterator[Candidate]:
    """Initiator and target that report one exchange differently: they print the same numbers, so a line was damaged."""
    if view.contradictions:
        yield Candidate(
            "contradicting reports",
            f"both ends reported {view.reported_twice} exchanges, {len(view.contradictions)} of them differently; "
            f"the first: {view.contradictions[0]}",
        )


def _reported_over_stamps(view: RecordingView) -> Floats:
    """Return reported ranges over those from the stamps, where both are known and longer than a metre."""
    with np.errstate(all="ignore"):
        ratio = view.exchanges.range_m / view.raw_m
    return np.asarray(ratio[np.isfinite(ratio) & (np.abs(view.raw_m) > 1) & ~without_stamps(view.exchanges)])


def reported(view: RecordingView) -> Iterator[Candidate]:
    """Reported ranges that were computed with the speed of light in vacuum, or are in another unit than metres."""
    ratios = _reported_over_stamps(view)
    ratio = float(np.median(ratios)) if len(ratios) >= RANGES_OF_A_UNIT else 1.0
    # So many medians of ratios tell the speed of light in air from that in vacuum.
    if len(ratios) >= 100 and abs(ratio / VACUUM_OVER_AIR - 1) < 5e-5:
        evidence = (
            f"reported ranges are {ratio:.5f} times those from the stamps: 299 792 458 m/s instead of 299 702 547"
        )
        yield Candidate("speed of light in vacuum", evidence)
    for unit, many in LENGTHS.items():
        # Delays of boards may change a range of some metres by so much.
        if abs(ratio / many - 1) < 0.05:
            evidence = f"reported ranges are {ratio:.5g} times those from the stamps"
            yield Candidate(REPORTED, evidence, words={"unit": unit})


POSSIBLE_SHARE: Final = 0.5
"""Another reading must make at least this share of the ranges possible, and `MORE_POSSIBLE` more than its own."""

MORE_POSSIBLE: Final = 0.2
MORE_BY_WIDTH: Final = 0.01


def another(view: RecordingView) -> Iterator[Candidate]:
    """Try every other protocol with as many messages, and every width of the counter."""
    e = view.exchanges[:: max(len(view.exchanges) // 4000, 1)]
    names, counts = np.unique(e.protocol, return_counts=True)
    said = str(names[int(np.argmax(counts))])
    third = bool(np.mean((e.tx3 | e.rx3) != 0) > POSSIBLE_SHARE)
    highest = max(int(stamps.max(initial=0)) for stamps in (e.tx1, e.rx1, e.tx2, e.rx2))
    own = _possible_share(e)
    tried = {
        (name, bits): _possible_share(replace(e, protocol=np.full(len(e), name), bits=bits))
        for name, row in PROTOCOLS.items()
        for bits in (32, 40)
        if highest < 1 << bits and (name, bits) != (said, e.bits) and (row.third_sender is not None) == third
    }
    if not tried:
        return
    name, bits = max(tried, key=lambda key: (round(tried[key], 2), key[1] == e.bits, key[0] == said))
    share = tried[name, bits]
    if share < max(POSSIBLE_SHARE, own + (MORE_BY_WIDTH if name == said else MORE_POSSIBLE)):
        return
    numbers = f"{100 * share:.1f} % of the ranges are possible, {100 * own:.1f} % as the recording has it"
    if name == said:
        yield Candidate("timestamp width", f"as {bits}-bit stamps {numbers}", words={"bits": bits})
    else:
        alike = [n for n in PROTOCOLS if tried.get((n, bits), 0.0) > share - 0.01 and n not in (said, name)]
        also = f" (or {' or '.join(alike)})" if alike else ""
        width, setting = (f" with {bits} bits", f", bits = {bits}") if bits != e.bits else ("", "")
        evidence = f"read as {name}{also}{width} {numbers} ({said})"
        yield Candidate("another protocol", evidence, words={"settings": f'protocol = "{name}"{setting}'})


def _possible_share(e: Exchanges) -> float:
    """Return the share of exchanges whose range and clocks are possible."""
    with np.errstate(all="ignore"):
        return float(np.mean((np.abs(raw_range(e)) < PLAUSIBLE_M) & _sound_clocks(e)))


def _sound_clocks(e: Exchanges) -> Bools:
    """Return where the third leg says that clocks run alike as crystals do, (n,); so they do where there is none."""
    names = [name for name in np.unique(e.protocol).tolist() if PROTOCOLS[name].third_sender is not None]
    return np.asarray(~np.isin(e.protocol, names) | (np.abs(target_faster_ppm(e)) < 100.0))


LENGTHS: Final = {"mm": 1000.0, "cm": 100.0, "in": 1 / 0.0254, "ft": 1 / 0.3048}
"""How many of a unit are a metre, by the names that a map takes."""

POWERS: Final = {
    "the other sign": -1.0,
    "hundredths of a dBm": 0.01,
    "hundredths of a dBm, and the other sign": -0.01,
    "tenths of a dBm": 0.1,
    "256 steps a dBm": 1 / 256,
}
"""What makes dBm of powers that are none: firmwares print a loss, or integers."""

USUAL_DBM: Final = (-115.0, -55.0)
"""First-path powers of these radios, from their sensitivity to a metre apart."""

RANGES_OF_A_UNIT: Final = 20

REPORTED: Final = "unit of the reported ranges"
POWER: Final = "unit of the powers"


def lengths(view: RecordingView) -> Iterator[Candidate]:
    """Ranges and true distances of which one is many times the other.

    The unit is the one that leaves the least between them; where the ranges have no stamps, and none that a radio can
    measure, theirs is wrong.
    """
    good = np.isfinite(view.raw_m) & np.isfinite(view.truth_m)
    raw, truth = view.raw_m[good], view.truth_m[good]
    bare = bool(without_stamps(view.exchanges).mean() > 0.5)
    if len(raw) < RANGES_OF_A_UNIT:
        if bare and np.nanmedian(np.abs(view.raw_m)) > PLAUSIBLE_M:
            evidence = f"half of the ranges are longer than {PLAUSIBLE_M:.0f} m, which no UWB radio measures"
            yield Candidate("unit of the ranges", evidence, words={"unit": "mm"})
    elif unit := _unit(raw, truth):
        name, whose = ("unit of the poses", "poses") if view.posed else ("unit of the true distances", "true distances")
        evidence = (
            f"true distances have a median of {np.median(truth):.6g}, ranges one of {np.median(raw):.6g} m: they agree "
            f"if {whose} are in {unit}"
        )
        yield Candidate(name, evidence, words={"unit": unit, "many": f"{LENGTHS[unit]:g}"})
    elif bare and (unit := _unit(truth, raw)):
        evidence = f"ranges are in {unit} if true distances are in m: half of them are longer than {np.median(raw):.0f}"
        yield Candidate("unit of the ranges", evidence, words={"unit": unit})


def _unit(metres: Floats, others: Floats) -> str | None:
    """Return the unit of others (n,) with which they agree best with metres (n,); None where metres are as good."""
    left = {name: robust_spread(metres - others / many) for name, many in LENGTHS.items()}
    best = min(left, key=lambda name: left[name])
    # Distances that say nothing are best when they are divided by most.
    # Feet taken for metres leave two thirds of the ranges' own spread, the right unit noise and delays.
    if left[best] < 0.5 * MATERIAL * min(robust_spread(metres - others), robust_spread(metres)):
        return best
    # Of one distance, the unit that makes both alike.
    if robust_spread(metres) > 0.5 or np.median(others) < PLAUSIBLE_M:
        return None
    return min(LENGTHS, key=lambda name: abs(float(np.median(metres - others / LENGTHS[name]))))


def powers(view: RecordingView) -> Iterator[Candidate]:
    """Powers that cannot be dBm at an antenna."""
    every = np.concatenate([view.exchanges.fpp1_dbm, view.exchanges.fpp2_dbm])
    every = every[np.isfinite(every) & (every != 0)]
    if len(every) < RANGES_OF_A_UNIT or np.mean(np.isfinite(measured_powers(every))) > 0.5:
        return
    middle = float(np.median(every))
    guess, factor = "no usual factor makes them so", "give fpp1 and fpp2 in dBm"
    for name, times in reversed(POWERS.items()):
        if USUAL_DBM[0] < times * middle < USUAL_DBM[1]:
            guess = f"they look like {name}: times {times:g} they would be {times * middle:.0f} dBm"
            factor = f"multiply fpp1 and fpp2 by {times:g}"
    evidence = f"the median power is {middle:+.5g} dBm, where these radios receive -115 to -55; {guess}"
    yield Candidate(POWER, evidence, words={"factor": factor})
