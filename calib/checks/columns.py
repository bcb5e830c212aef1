"""Checks of the columns of a recording: stamps, protocols, ids and units, who ranges with whom, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from calib.calibration.document import known_of_splits
from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.checks.fitted import noise_of_readings
from calib.checks.recording_view import RecordingView
from calib.data.clocks import uncorrected_skew
from calib.data.ranges import Ranges
from calib.errors import BadInputError
from calib.estimator.identifiability import free_directions
from calib.findings import Candidate, exceeds, more_often
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats
from uwblink.protocols.table import PROTOCOLS, single_sided
from uwblink.recording import clock_skews, target_faster_ppm
from uwblink.recording.summary import failures_by_pair
from uwblink.ticks import SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import Exchanges, board_range, intervals, names_in, raw_range, without_stamps

PLAUSIBLE_M: Final = 1000.0
"""Longer than any range of a UWB radio."""

UNITS_A_METRE: Final = {"mm": 1000.0, "cm": 100.0, "in": 1 / 0.0254, "ft": 1 / 0.3048}
"""Units of length by their names in a map: the number of units in a metre."""

POWER_FACTORS: Final = {
    "256 steps a dBm": 1 / 256,
    "tenths of a dBm": 0.1,
    "hundredths of a dBm, and the other sign": -0.01,
    "hundredths of a dBm": 0.01,
    "the other sign": -1.0,
}
"""Factors that convert powers to dBm: firmwares print a loss, or integers. The last factor that fits is the
simplest."""

MIN_VALUES_OF_UNIT: Final = 20
"""Minimum number of ranges or powers to determine a unit: the median of 20 is known to 0.28 of their spread
(`calib.spread.STD_OF_MEDIAN` over the root of their number), and units differ by a factor of two or more."""


def arrivals(view: RecordingView) -> Iterator[Candidate]:
    """Find differences of arrival without stamps that cannot be fitted: wrong unit or sign, anchors without
    positions.
    """
    if len(view.differences.get("time_ns", ())):
        try:
            Ranges.from_differences(view.differences, poses=view.poses, tags=view.tags, source=view.name)
        except BadInputError as error:
            yield Candidate("wrong differences of arrival", str(error).removeprefix(f"{view.name}: "))


def empty(view: RecordingView) -> Iterator[Candidate]:
    """Find recordings without an exchange."""
    if not len(view.exchanges):
        count = len(view.differences.get("time_ns", ()))
        alone = f"{count} differences of arrival and " if count else ""
        yield Candidate("differences alone" if alone else "empty", f"the recording holds {alone}no exchanges")


def ticks(view: RecordingView) -> Iterator[Candidate]:
    """Find stamps in nanoseconds that were read as ticks: every duration is 64 times too short."""
    spans, third = intervals(view.exchanges), view.exchanges.tx3 != 0
    legs = [float(np.median(spans.dt41)), float(np.median(spans.dt53[third])) if third.any() else 0.0]
    longest_us, per_ns = max(legs) / TICKS_PER_SECOND * 1e6, TICKS_PER_SECOND * 1e-9
    if longest_us < 60 and longest_us * per_ns > 150 and len(np.unique(view.exchanges.tx1 % 512)) > 8:
        yield Candidate(
            "unit slip",
            f"the longest leg of an exchange lasts {longest_us:.1f} µs, too short for a frame; "
            f"read as nanoseconds it would be {longest_us * per_ns:.0f} µs",
        )


def single_as_double(view: RecordingView) -> Iterator[Candidate]:
    """Find double-sided exchanges without a third message."""
    e = view.exchanges
    double = ~np.isin(e.protocol, single_sided())
    empty = float(np.mean((e.tx3 | e.rx3)[double] == 0)) if double.any() else 0.0
    if empty > 0.5:
        yield Candidate(
            "single-sided data taken for double-sided",
            f"{100 * empty:.0f} % of the double-sided exchanges have no third message",
        )


def impossible(view: RecordingView) -> Bools:
    """Return which exchanges are impossible, or contradict their reported range or the clocks of their pair (n,)."""
    e, ratios = view.exchanges, _reported_over_stamps(view)
    with np.errstate(all="ignore"):
        bad = ~(np.abs(view.ranges.raw_m) < PLAUSIBLE_M) | ~_sound_clocks(e) | (e.initiator == e.target)
        # Where reported ranges are in another unit by more, none of them contradicts its stamps.
        if not len(ratios) or abs(np.median(ratios) - 1) <= 1e-4:
            bad |= np.abs(board_range(e) - e.range_m) > 0.01
        away = np.abs(view.ranges.error_m) > 50.0
    # Where most are far off, something else is wrong with all of them.
    return np.asarray(bad | away if np.mean(away) < 0.5 else bad)


def with_itself(view: RecordingView) -> Iterator[Candidate]:
    """Find exchanges of a tag with itself, which are impossible."""
    e = view.exchanges
    same = e.initiator == e.target
    if same.any():
        tags = ", ".join(map(str, np.unique(e.initiator[same])[:6].tolist()))
        yield Candidate(
            "a tag with itself", f"{np.count_nonzero(same)} of {len(e)} exchanges have one tag at both ends ({tags})"
        )


def doubled(view: RecordingView) -> Iterator[Candidate]:
    """Find repeated rows, as when two robots logged an exchange and both logs were imported."""
    if view.doubled:
        yield Candidate(
            "doubled exchanges", f"{view.doubled} of {view.doubled + len(view.exchanges)} rows repeat another one"
        )


def corrupted(view: RecordingView) -> Iterator[Candidate]:
    """Find exchanges that are impossible or contradict themselves; the other checks omit these."""
    bad = impossible(view)
    count = int(np.count_nonzero(bad))
    yield Candidate(
        "corrupted exchanges" if count < 0.5 * len(bad) else "impossible stamps",
        f"{count} of {len(bad)} exchanges have impossible stamps, or stamps that contradict the "
        "range reported with them or the clocks of their pair; all other findings are computed without these",
        more_often(count, len(bad), 0.001),
    )


def mixed(view: RecordingView) -> Iterator[Candidate]:
    """Find recordings that were merged by host time: initiators' stamps jump to another time and back from
    row to row.
    """
    e, half_s = view.exchanges, 2.0 ** (view.exchanges.bits - 1) / TICKS_PER_SECOND
    each = [e[e.initiator == tag] for tag in np.unique(e.initiator[e.tx1 != 0])]
    away_s = [
        (np.diff(own.tx1) / TICKS_PER_SECOND - np.diff(own.time_ns) * 1e-9 + half_s) % (2 * half_s) - half_s
        for own in each
    ]
    # USB is late by less than half a second, longer than a counter of 32 bits.
    returns = [one[1:][(np.abs(one[1:]) > 0.5) & (np.abs(one[1:] + one[:-1]) < 0.05)] for one in away_s]
    jumps_s = np.abs(np.concatenate([*returns, np.zeros(0)]))
    if len(jumps_s):
        # Damaged stamps jump by random times, stamps of another recording by a constant time.
        same = int(np.count_nonzero(np.abs(jumps_s - np.median(jumps_s)) < 0.1))
        yield Candidate(
            "recordings mixed by their times",
            f"in time order, stamps of initiators jump by {np.median(jumps_s):.1f} s and back at {same} of {len(e)} "
            "exchanges",
            more_often(same - 1, len(jumps_s) - 1, 0.2 / half_s),
        )


def rare_poses(view: RecordingView) -> Iterator[Candidate]:
    """Find poses so far apart in time that bodies do not move on a straight line between them."""
    rare = {
        body: one.position_m
        for body in names_in(view.poses.body)
        if np.ptp((one := view.poses[view.poses.body == body]).time_ns) > 5e7 * len(one) > 5e7 * 2
    }
    # In half of the time a constant acceleration moves a body by a quarter of the distance; noise of frequent poses is
    # not motion.
    off_m = {
        body: np.median(np.linalg.norm(at[1:-1] - (at[2:] + at[:-2]) / 2, axis=1)) / 4 for body, at in rare.items()
    }
    if bent := [f"{body} by {100 * off:.0f} cm" for body, off in off_m.items() if off > 0.02]:
        yield Candidate(
            "rare poses", f"bodies do not move on straight lines between two poses, but deviate: {', '.join(bent)}"
        )


def contradicting(view: RecordingView) -> Iterator[Candidate]:
    """Find exchanges that initiator and target report differently; both print the same numbers, so a line was
    damaged.
    """
    if view.contradictions:
        yield Candidate(
            "contradicting reports",
            f"both ends reported {view.reported_twice} exchanges, {len(view.contradictions)} of them differently; "
            f"the first: {view.contradictions[0]}",
        )


def _reported_over_stamps(view: RecordingView) -> Floats:
    """Return reported ranges over those from the stamps, where both are known and longer than a metre."""
    with np.errstate(all="ignore"):
        ratio = view.exchanges.range_m / view.ranges.raw_m
    return np.asarray(ratio[np.isfinite(ratio) & (np.abs(view.ranges.raw_m) > 1) & ~without_stamps(view.exchanges)])


def reported(view: RecordingView) -> Iterator[Candidate]:
    """Find reported ranges computed with the speed of light in vacuum, or in another unit than metres."""
    ratios = _reported_over_stamps(view)
    ratio = float(np.median(ratios)) if len(ratios) >= MIN_VALUES_OF_UNIT else 1.0
    evidence = f"reported ranges are {ratio:.5g} times those from the stamps"
    # Number of ratios that are needed to distinguish the speeds of light in air and in vacuum.
    if len(ratios) >= 100 and abs(ratio * SPEED_OF_LIGHT / 299_792_458.0 - 1) < 5e-5:
        yield Candidate("speed of light in vacuum", f"{evidence}: 299 792 458 m/s instead of 299 702 547")
    for unit, many in UNITS_A_METRE.items():
        # Delays of boards may change a range of some metres by this amount.
        if abs(ratio / many - 1) < 0.05:
            yield Candidate("unit of the reported ranges", evidence, words={"unit": unit})


def another(view: RecordingView) -> Iterator[Candidate]:
    """Find a wrong protocol or counter width: try each other protocol with the same number of messages, and each
    width.
    """
    e = view.exchanges[:: max(len(view.exchanges) // 4000, 1)]
    names, counts = np.unique(e.protocol, return_counts=True)
    given = str(names[int(np.argmax(counts))])
    third = bool(np.mean((e.tx3 | e.rx3) != 0) > 0.5)
    highest = max(int(stamps.max(initial=0)) for stamps in (e.tx1, e.rx1, e.tx2, e.rx2))
    tried = {
        (name, bits): _possible_share(replace(e, protocol=np.full(len(e), name), bits=bits))
        for name, row in PROTOCOLS.items()
        for bits in (32, 40)
        if highest < 1 << bits and (name, bits) != (given, e.bits) and (row.third_sender is not None) == third
    }
    if not tried:
        return
    name, bits = max(tried, key=lambda key: (round(tried[key], 2), key[1] == e.bits, key[0] == given))
    share, own = tried[name, bits], _possible_share(e)
    # A wrong width spoils only exchanges during which the counter wraps; a wrong protocol spoils most.
    if share < max(0.5, own + (0.01 if name == given else 0.2)):
        return
    numbers = f"{100 * share:.1f} % of the ranges are possible, {100 * own:.1f} % with the settings of the recording"
    if name == given:
        yield Candidate("timestamp width", f"as {bits}-bit stamps {numbers}", words={"bits": bits})
    else:
        alike = [n for n in PROTOCOLS if tried.get((n, bits), 0.0) > share - 0.01 and n not in (given, name)]
        also = f" (or {' or '.join(alike)})" if alike else ""
        width, setting = (f" with {bits} bits", f", bits = {bits}") if bits != e.bits else ("", "")
        yield Candidate(
            "another protocol",
            f"read as {name}{also}{width} {numbers} ({given})",
            words={"settings": f'protocol = "{name}"{setting}'},
        )


def _possible_share(e: Exchanges) -> float:
    """Return the share of exchanges whose range and clocks are possible."""
    with np.errstate(all="ignore"):
        return float(np.mean((np.abs(raw_range(e)) < PLAUSIBLE_M) & _sound_clocks(e)))


def _sound_clocks(e: Exchanges) -> Bools:
    """Return a mask (n,) of exchanges whose third leg gives a clock ratio that crystals can have; True without a third
    leg.
    """
    return np.asarray(np.isin(e.protocol, single_sided()) | (np.abs(target_faster_ppm(e)) < 100.0))


def lengths(view: RecordingView) -> Iterator[Candidate]:
    """Find ranges and true distances in different units.

    The unit is the one with the smallest residuals. If the ranges have no stamps and are longer than a radio can
    measure, their unit is wrong; otherwise that of the distances.
    """
    good = np.isfinite(view.ranges.raw_m) & np.isfinite(view.ranges.truth_m)
    raw, truth = view.ranges.raw_m[good], view.ranges.truth_m[good]
    bare = bool(without_stamps(view.exchanges).mean() > 0.5)
    if len(raw) < MIN_VALUES_OF_UNIT:
        if bare and np.nanmedian(np.abs(view.ranges.raw_m)) > PLAUSIBLE_M:
            evidence = f"half of the ranges are longer than {PLAUSIBLE_M:.0f} m, which no UWB radio measures"
            yield Candidate("unit of the ranges", evidence, words={"unit": "mm"})
    elif unit := _unit(raw, truth):
        whose = "poses" if view.posed else "true distances"
        evidence = (
            f"the median true distance is {np.median(truth):.6g}, the median range {np.median(raw):.6g} m: they "
            f"agree if {whose} are in {unit}"
        )
        yield Candidate(f"unit of the {whose}", evidence, words={"unit": unit, "many": f"{UNITS_A_METRE[unit]:g}"})
    elif bare and (unit := _unit(truth, raw)):
        evidence = f"ranges are in {unit} if true distances are in m: half of them are longer than {np.median(raw):.0f}"
        yield Candidate("unit of the ranges", evidence, words={"unit": unit})


def _unit(metres: Floats, others: Floats) -> str | None:
    """Return the unit of others (n,) in which they agree best with metres (n,); None if metres are as good."""
    left = {name: robust_spread(metres - others / many) for name, many in UNITS_A_METRE.items()}
    best = min(left, key=lambda name: left[name])
    # Distances unrelated to the ranges fit best with the largest divisor. Feet taken for metres leave two thirds of the
    # ranges' own spread; the right unit leaves noise and delays.
    if left[best] < 0.5 * min(robust_spread(metres - others), robust_spread(metres)):
        return best
    # With one distance, the unit that makes both equal.
    if robust_spread(metres) > 0.5 or np.median(others) < PLAUSIBLE_M:
        return None
    return min(UNITS_A_METRE, key=lambda name: abs(float(np.median(metres - others / UNITS_A_METRE[name]))))


def powers(view: RecordingView) -> Iterator[Candidate]:
    """Find powers that cannot be dBm at an antenna."""
    every = np.concatenate([view.exchanges.fpp1_dbm, view.exchanges.fpp2_dbm])
    known = np.isfinite(np.concatenate([view.ranges.fpp1_dbm, view.ranges.fpp2_dbm]))
    given = np.isfinite(every) & (every != 0)
    if np.count_nonzero(given) < MIN_VALUES_OF_UNIT or np.mean(known[given]) > 0.5:
        return
    middle = float(np.median(every[given]))
    guess, factor = "no usual factor explains them", "give fpp1 and fpp2 in dBm"
    for name, times in POWER_FACTORS.items():
        # From the sensitivity to the power at one metre.
        if -115 < times * middle < -55:
            guess = f"they are probably {name}: multiplied by {times:g} they would be {times * middle:.0f} dBm"
            factor = f"multiply fpp1 and fpp2 by {times:g}"
    yield Candidate(
        "unit of the powers",
        f"the median power is {middle:+.5g} dBm, but these radios receive -115 to -55; {guess}",
        words={"factor": factor},
    )


def undetermined(view: RecordingView) -> Iterator[Candidate]:
    """Find pairs that do not determine all antenna delays."""
    some = view.ranges[np.isfinite(view.ranges.weight_initiator) & np.isfinite(view.ranges.weight_target)]
    if len(some):
        _, free = free_directions(some.tags(), some)
        if free:
            yield Candidate("too few pairs", known_of_splits(free))


def silent(view: RecordingView) -> Iterator[Candidate]:
    """Find a tag with many more failed exchanges than others."""
    e, failed = view.exchanges, failures_by_pair(view.faults)
    tags = sorted({tag.tag for tag in view.tags})
    for tag in sorted(tags, key=lambda tag: -sum(n for pair, n in failed.items() if tag in pair)):
        bad = sum(n for pair, n in failed.items() if tag in pair)
        done = int(np.count_nonzero((e.initiator == tag) | (e.target == tag)))
        # Failures with a dead tag do not count for its partner.
        failed = {pair: n for pair, n in failed.items() if tag not in pair or bad <= done}
        others, others_bad = len(e) - done, sum(n for pair, n in failed.items() if tag not in pair)
        if others + others_bad:
            # A tag that answers half of the time may only be at the edge of the radio range.
            usual = max(0.5, others_bad / (others + others_bad))
            evidence = f"tag {tag} took part in {done} exchanges, {bad} failed"
            p_value = more_often(bad, bad + done, usual, tried=len(tags))
            yield Candidate("dead or deaf tag", evidence, p_value, {"tag": tag})


def still(view: RecordingView) -> Iterator[Candidate]:
    """Find recordings in which no distance changes."""
    if view.standing_m is not None:
        yield Candidate("static data", f"no distance changes by more than {100 * view.standing_m:.0f} cm")


def missing(view: RecordingView) -> Iterator[Candidate]:
    """Find recordings that mostly lack first-path powers, which a curve needs, or true distances."""
    powers, truth = np.stack([view.ranges.fpp1_dbm, view.ranges.fpp2_dbm]), view.ranges.truth_m
    powered, true = (100 * float(np.mean(known)) for known in (np.isfinite(powers).any(axis=0), np.isfinite(truth)))
    if powered < 50:
        yield Candidate("no powers", f"{powered:.0f} % of the exchanges have a first-path power")
    if true < 50 and not view.standing:
        yield Candidate(
            "no true distances",
            f"{true:.0f} % of the exchanges have a true distance: poses are missing or do not cover the recording",
        )


def confounded(view: RecordingView) -> Iterator[Candidate]:
    """Find power that depends only on distance: then a curve over power cannot be separated from distance.

    The noise of readings is subtracted from the variance of powers, and the share that groups of distances explain by
    chance (adjusted share): powers of a pair within 2 s count as nearly one.
    """
    lifted = lifted_power(view.ranges.fpp1_dbm, view.ranges.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    rows = np.flatnonzero(np.isfinite(lifted) & (view.ranges.truth_m > 0))
    if len(rows) < 300 or np.ptp(view.ranges.truth_m[rows]) < 0.5:
        return
    pairs = view.ranges.pairs.number
    rows = rows[np.lexsort((view.exchanges.time_ns[rows], pairs[rows]))]
    pair, time_ns, shares, groups = pairs[rows], view.exchanges.time_ns[rows], [0.0], 40
    alone = len(np.unique(np.column_stack([pair, time_ns // 2_000_000_000]), axis=0))
    # Lifted powers are dominated by short distances, decibels are not. Either share can be too large.
    for power in (lifted[rows], np.log(lifted[rows])):
        noise = noise_of_readings(power, pair, time_ns)
        parts = np.array_split(power[np.argsort(view.ranges.truth_m[rows], kind="stable")], groups)
        within, between = float(np.mean([np.var(one) for one in parts])), float(np.var([np.mean(one) for one in parts]))
        if between > within:
            share = between / (between + max(within - noise, 0.0))
            shares.append(1 - (1 - share) * max(alone - 1, groups) / max(alone - groups, 1))
    # Above this share, the variance of a curve over power is ten times as large (variance inflation, Marquardt 1970).
    if max(shares) > 0.9:
        yield Candidate(
            "power confounded with distance", f"distance explains {100 * max(shares):.0f} % of the power's variance"
        )


def swapped_roles(view: RecordingView) -> Iterator[Candidate]:
    """Find carrier readings and stamps that disagree about which clock of a pair is faster.

    The readings' constant offset of a tenth of a ppm does not hide a slope of 1.
    """
    known = [one for one in clock_skews(view.exchanges) if one.count > 15 and one.carrier_ppm is not None]
    stamps, readings, spread, count = np.array(
        [(one.stamps_ppm, one.carrier_ppm, one.residual_ppm, one.count) for one in known], dtype=float
    ).reshape(-1, 4).T  # fmt: skip
    weight = count / (np.pi / 2 * np.maximum(spread, 1e-4) ** 2)
    square = float(weight @ stamps**2)
    if count.sum() < 100 or not square > 0:
        return
    slope = float(weight @ (stamps * readings)) / square
    left = float(np.mean((readings - slope * stamps) ** 2 * weight))
    # A slope of a half is halfway between right and swapped roles.
    if slope < -0.5:
        yield Candidate(
            "swapped roles",
            "by the carrier readings the targets' clocks are slower where they are faster by the stamps, and vice "
            "versa",
            exceeds(slope, float(np.sqrt(max(left, 1.0) / square)), np.inf, tolerance=0.5),
        )


def unread(view: RecordingView) -> Iterator[Candidate]:
    """Find single-sided ranges without carrier readings, whose clock skew is unknown."""
    left = uncorrected_skew(view.exchanges)
    if left and not np.isfinite(left.read_m):
        yield Candidate("single-sided without carrier readings", str(left))


def carriers(view: RecordingView) -> Iterator[Candidate]:
    """Find carrier readings that do not agree with the clock ratios from the stamps."""
    known = sorted(
        (one.residual_ppm, one.count, one.pair)
        for one in clock_skews(view.exchanges)
        if one.residual_ppm and one.count >= 100
    )
    if known:
        # The scatter of most pairs: one noisy board is not the reference for all.
        scatter, count, pair = known[(len(known) - 1) // 2]
        # Standard error of the logarithm of a median absolute deviation (efficiency 0.37). Limit for a sound board:
        # with a reply of 1.5 ms it adds a third of a metre to a range.
        p_value = exceeds(max(np.log(scatter / 1.5), 0.0), float(1 / np.sqrt(2 * 0.37 * count)), np.inf)
        yield Candidate(
            "carrier readings that say little",
            f"they scatter by {scatter:.1f} ppm about their median (pair {pair}), and as much or more in half of the "
            "pairs",
            p_value,
        )
