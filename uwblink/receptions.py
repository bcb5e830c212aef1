"""Receptions: one frame on the air as received by one listener; conversion of broadcasts to exchanges.

The reception stamp of a frame is its transmission stamp, moved to the listener's clock, plus the distance and both
antenna delays. Three such rows make an exchange, and two more what a third tag overhears of it. Tags that broadcast in
turn therefore make double-sided exchanges of every pair that hears each other: a frame of the initiator, the next frame
of the target, and the one after that, from which the initiator has the rate of the target's clock (ICRA 2023, Fig. 2).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median

from uwblink import arrays
from uwblink.arrays import Bools, Columns, ColumnTable, Floats, Ints
from uwblink.errors import ArgumentError
from uwblink.ticks import ANTENNA_DELAY_TICKS, COUNTER_BITS, METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S, elapsed
from uwblink.twr import BITS, LARGEST_ID, LATEST_NS, STAMPS, Exchanges

MAX_SKEW: Final = 100e-6
"""Two clocks differ by 40 ppm at most (IEEE 802.15.4: 20 ppm each); more is a counter that restarted."""

_MOST_FRAMES: Final = 1 << 31
"""Frames are numbered with 31 bits, so that a link of two ids and a frame are one number of 63."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Receptions(ColumnTable):
    """Received frames as columns of length n: a frame that three tags hear is three rows.

    `frame` (n,) numbers frames in the order in which they were sent. `tx` is the stamp of its `sender`, `rx` that of
    the `listener`, in ticks modulo 2**`bits` of their own clocks. `fpp_dbm` is the first-path power, `rxp_dbm` the
    total received power, `skew_ppm` how much faster the listener's clock runs by its carrier integrator; NaN if
    unknown.
    """

    time_ns: Ints
    frame: Ints
    sender: Ints
    listener: Ints
    tx: Ints
    rx: Ints
    fpp_dbm: Floats
    rxp_dbm: Floats
    skew_ppm: Floats
    bits: int = COUNTER_BITS

    @classmethod
    def from_arrays(  # noqa: PLR0913 - one parameter for each column, most of them optional
        cls,
        frame: ArrayLike,
        sender: ArrayLike,
        listener: ArrayLike,
        *,
        tx: ArrayLike,
        rx: ArrayLike,
        time_ns: ArrayLike = 0,
        fpp_dbm: ArrayLike | None = None,
        rxp_dbm: ArrayLike | None = None,
        skew_ppm: ArrayLike | None = None,
        bits: int = COUNTER_BITS,
    ) -> Receptions:
        """Return receptions from columns, each a list, an array, or one value for all rows.

        Raises `ArgumentError`, which names the column and the row, for ids and stamps that cannot be.

        >>> from uwblink.receptions import Receptions
        >>> len(Receptions.from_arrays([0, 0, 1], [1, 1, 2], [2, 3, 3], tx=[0, 0, 900], rx=[5, 7, 1000]))
        3
        """
        count = arrays.length("frame", frame)
        if bits not in BITS:
            raise ArgumentError(f"bits: found {bits!r:.40}, allowed: {', '.join(map(str, BITS))}")
        ends = {name: arrays.whole_numbers(name, given, count, 0, LARGEST_ID) for name, given in
                (("sender", sender), ("listener", listener))}  # fmt: skip
        arrays.reject("listener", ends["listener"], ends["listener"] == ends["sender"], "another tag than the sender")
        most = (1 << bits) - 1
        return cls(
            time_ns=arrays.whole_numbers("time_ns", time_ns, count, -LATEST_NS, LATEST_NS),
            frame=arrays.whole_numbers("frame", frame, count, 0, _MOST_FRAMES - 1),
            tx=arrays.whole_numbers("tx", tx, count, 0, most),
            rx=arrays.whole_numbers("rx", rx, count, 0, most),
            fpp_dbm=arrays.numbers("fpp_dbm", fpp_dbm, count),
            rxp_dbm=arrays.numbers("rxp_dbm", rxp_dbm, count),
            skew_ppm=arrays.numbers("skew_ppm", skew_ppm, count),
            bits=bits,
            **ends,
        )

    def _title(self) -> str:
        tags = np.unique(np.append(self.sender, self.listener))
        return f"{len(self)} receptions of {len(np.unique(self.frame))} frames by {len(tags)} tags"


class _Links:
    """Receptions by link (sender and listener) and frame, for looking rows up."""

    def __init__(self, receptions: Receptions) -> None:
        keys = self.keys(receptions.sender, receptions.listener, receptions.frame)
        self.keys_in_order, self.row = np.unique(keys, return_index=True)
        self.link = self.keys_in_order // _MOST_FRAMES

    @staticmethod
    def keys(sender: Ints, listener: Ints, frame: Ints) -> Ints:
        """Return a number (n,) for each link and frame; those of a link follow each other in order of frames."""
        return np.asarray(((sender << 16) | listener) * _MOST_FRAMES + frame)

    def find(self, sender: Ints, listener: Ints, frame: Ints, step: int = 0) -> tuple[Ints, Bools]:
        """Return the rows (n,) of frames by links, and whether there are such.

        With `step` -1 those of the last frame before, with 1 those of the first frame after, the given ones.
        """
        wanted = self.keys(sender, listener, frame)
        at = np.searchsorted(self.keys_in_order, wanted, side="right" if step > 0 else "left") + min(step, 0)
        inside = np.clip(at, 0, len(self.keys_in_order) - 1)
        if not len(self.row):
            return at, at < 0
        there = (at == inside) & (self.link[inside] == wanted // _MOST_FRAMES)
        if not step:
            there &= self.keys_in_order[inside] == wanted
        return self.row[inside], there


def times_by_stamps(receptions: Receptions) -> Ints:
    """Return when the frames of rows (n,), in order of frames, were sent, in ns after the first, by their stamps.

    A frame is as long after an earlier one as the clock says that stamped both, of several clocks the one that stamped
    last; a clock counts up to half of its range. A frame that shares no clock with earlier ones follows at once.

    >>> from uwblink.receptions import Receptions, times_by_stamps
    >>> heard = Receptions.from_arrays([0, 1], [1, 2], [2, 1], tx=[0, 63897700], rx=[100, 63897600])
    >>> (times_by_stamps(heard) / 1e6).round(3).tolist()
    [0.0, 1.0]
    """
    half, whole = 1 << (receptions.bits - 1), 1 << receptions.bits
    columns = [getattr(receptions, name).tolist() for name in ("frame", "sender", "tx", "listener", "rx")]
    seen: dict[int, tuple[int, int]] = {}
    now, found = 0, []
    for _, rows in itertools.groupby(zip(*columns, strict=True), key=lambda row: row[0]):
        heard = list(rows)
        stamps = {heard[0][1]: heard[0][2]} | {row[3]: row[4] for row in heard}
        if known := [(*seen[clock], clock) for clock in stamps if clock in seen]:
            then, stamp, clock = max(known)
            now = then + (stamps[clock] - stamp + half) % whole - half
        found += [now] * len(heard)
        seen |= {clock: (now, stamp) for clock, stamp in stamps.items()}
    return np.rint(np.array(found, dtype=np.float64) * TICK_S * 1e9).astype(np.int64)


def exchanges_in(receptions: Receptions) -> tuple[Exchanges, Columns]:
    """Return the exchanges in broadcasts, and the frames of these that third tags overheard, in order of time.

    A frame of i that j hears is a poll, j's first frame after it the response, j's next frame the final: an exchange of
    protocol `ds`. Of both roles a pair gets the one with the shorter replies, so that no stamp of a poll or response
    counts twice. `rx3` is moved to where a clock stamps it that keeps the rate between poll and response. The second
    result has the columns of the table `overheard`. Frames between which a clock restarted, or its counter wrapped,
    make no exchange, nor do `contradicted` stamps. Raises `ArgumentError` where there is none.

    >>> from uwblink.receptions import Receptions, exchanges_in
    >>> frames, tags = [0, 1, 2], ([1, 2, 2], [2, 1, 1])
    >>> heard = Receptions.from_arrays(frames, *tags, tx=[0, 2000, 9000], rx=[100, 2100, 9100])
    >>> found, overheard = exchanges_in(heard)
    >>> found.initiator.tolist(), found.range_m.round(3).tolist()
    ([1], [0.469])
    """
    receptions = receptions[~contradicted(receptions)]
    r, links = receptions, _Links(receptions)
    poll, polled = links.find(r.listener, r.sender, r.frame, -1)
    first, _ = links.find(r.sender, r.listener, r.frame[poll], 1)
    final, ended = links.find(r.sender, r.listener, r.frame, 1)
    found = np.flatnonzero(polled & ended & (first == np.arange(len(r))))
    rows = np.column_stack([poll[found], found, final[found]])
    reply = elapsed(r.tx[rows[:, 1]], r.rx[rows[:, 0]], r.bits)
    sent, heard = (elapsed(stamp[rows[:, 2]], stamp[rows[:, 1]], r.bits) for stamp in (r.tx, r.rx))
    round_trip = elapsed(r.rx[rows[:, 1]], r.tx[rows[:, 0]], r.bits)
    # 150 m, farther than these radios reach, and antenna delays that were not programmed
    farthest = 2 * (150 / METRES_PER_TICK + 2 * ANTENNA_DELAY_TICKS)
    steady = (
        _within(r, rows[:, 0], rows[:, 2])
        & (np.abs(heard - sent) <= MAX_SKEW * sent)
        & (np.abs(round_trip - reply) <= MAX_SKEW * reply + farthest)
    )
    rows, reply = rows[steady], reply[steady]
    if not len(rows):
        raise ArgumentError(
            f"{len(r)} receptions contain no exchange: two tags must hear each other, and one of them twice in a row"
        )
    rows = rows[_shorter_replies(r.sender[rows[:, 0]], r.sender[rows[:, 1]], reply)]
    rows = rows[np.argsort(r.time_ns[rows[:, 0]], kind="stable")]
    p, s, f = rows.T
    rx3 = _without_drift(r, links, s, f, elapsed(r.tx[s], r.rx[p], r.bits))
    stamps = {"tx1": r.tx[p], "rx1": r.rx[p], "tx2": r.tx[s], "rx2": r.rx[s], "tx3": r.tx[f], "rx3": rx3}
    exchanges = Exchanges.from_arrays(
        r.sender[p],
        r.sender[s],
        time_ns=r.time_ns[p],
        protocol="ds",
        fpp1_dbm=r.fpp_dbm[p],
        fpp2_dbm=r.fpp_dbm[s],
        skew1_ppm=r.skew_ppm[p],
        skew2_ppm=r.skew_ppm[s],
        bits=r.bits,
        **stamps,
    )
    heard_by = [_heard_by(k, receptions, links, rows, exchanges) for k in np.unique(r.listener).tolist()]
    return exchanges, arrays.in_time_order(heard_by)


def _without_drift(r: Receptions, links: _Links, second: Ints, third: Ints, reply: Ints) -> Ints:
    """Return rx3 (n,) as stamped by a clock that keeps the rate it has between poll and response.

    `second` and `third` are the rows of response and final. A line through the rates before and after the response
    gives the rate between poll and response, which is earlier than the final tells (docs/theory.md, drift).
    """
    before, there = links.find(r.sender[second], r.listener[second], r.frame[second], -1)
    ends = (before, second), (second, third)
    (sent0, heard0), (sent, heard) = ([elapsed(t[b], t[a], r.bits) for t in (r.tx, r.rx)] for a, b in ends)
    there &= (np.abs(heard0 - sent0) <= MAX_SKEW * sent0) & _within(r, before, second)
    bend = (heard0 - sent0) / np.maximum(sent0, 1) - (heard - sent) / np.maximum(sent, 1)
    moved = np.rint((reply + sent) / np.maximum(sent0 + sent, 1) * bend * sent)
    return (r.rx[third] + np.where(there, moved, 0.0).astype(np.int64)) % (1 << r.bits)


def _within(r: Receptions, first: Ints, last: Ints) -> Bools:
    """Return whether counters wrap at most once between rows (n,)."""
    return np.asarray(r.time_ns[last] - r.time_ns[first] < 2**r.bits * TICK_S * 1e9)


MAX_ACCELERATION, MAX_DRIFT, LONGEST_DETOUR_M = 50.0, 0.2e-6, 10.0
"""Judgements: robots accelerate by less than 5 g (m/s^2), and a reflection in a room is no longer than 10 m. The rate
of a clock changes by less than 0.2e-6 a second: in logs of DWM1001 boards that warm up by 0.12e-6."""


def contradicted(receptions: Receptions) -> Bools:
    """Return which receptions (n,) have a stamp that those near it on their link contradict, or that none supports."""
    left = np.arange(len(receptions))
    # Without the worst stamps those are seen that they outvoted. A clock that jumps costs three stamps on both sides.
    for _ in range(3):
        left = left[~_off_the_line(receptions[left])]
    return np.isin(np.arange(len(receptions)), left, invert=True)


def _off_the_line(r: Receptions) -> Bools:
    """Return which receptions (n,) bend at least as many lines with two neighbours as they fit, or fit none.

    The reception stamp less the transmission stamp changes with the clocks' rates and the distance, so that three of
    them lie on a line but for reflections, and for acceleration and drift: three times what nine of ten triples show,
    within what is possible. Triples whose tolerance hides an error of four reflections do not count.
    """
    links = _Links(r)
    row, count = links.row, len(links.row)
    late, sent = elapsed(r.rx[row], r.tx[row], r.bits), r.tx[row]
    half, whole = 1 << (r.bits - 1), 1 << r.bits
    at = np.arange(count)

    def apart(one: int, other: int) -> tuple[Floats, Floats, Bools]:
        """Return the change of the difference and the time from one neighbour to another (n,), and where both are."""
        a, b = np.clip(at + one, 0, count - 1), np.clip(at + other, 0, count - 1)
        span = elapsed(sent[b], sent[a], r.bits).astype(np.float64)
        step = ((late[b] - late[a] + half) % whole - half).astype(np.float64)
        # A counter that restarted or wrapped between them is no wrong stamp.
        within = _within(r, row[a], row[b]) & (np.abs(step) <= MAX_SKEW * span)
        return step, span, (b - a == other - one) & (links.link[a] == links.link[b]) & within

    triples = []
    # Three on each side: wrong stamps are few, so that most of six are right.
    for pair in itertools.combinations((-3, -2, -1, 1, 2, 3), 2):
        one, two, three = sorted((*pair, 0))
        (step1, span1, there1), (step2, span2, there2) = apart(one, two), apart(two, three)
        both = np.maximum(span1 + span2, 1.0)
        weight = {one: span2 / both, two: np.ones(count), three: span1 / both}[0]
        bend = np.abs(step1 * span2 - step2 * span1) / both
        triples.append((there1 & there2, bend, span1 * span2 * TICK_S / 2, weight))
    there, bend, curved, weight = (np.array(column) for column in zip(*triples, strict=True))
    usual = np.quantile((bend / np.maximum(curved, 1e-9))[there], 0.9) if there.any() else np.inf
    bent = min(MAX_ACCELERATION / SPEED_OF_LIGHT + MAX_DRIFT, 3 * usual)
    detour = LONGEST_DETOUR_M / METRES_PER_TICK
    allowed = detour + bent * curved
    told = there & (allowed <= 4 * detour * weight)
    straight, bends = ((told & side).sum(axis=0) for side in (bend <= allowed, bend > allowed))
    alone = straight == 0
    wrong = np.zeros(len(r), dtype=bool)
    # Where all are far apart, more than a tenth are alone and sound.
    wrong[row] = (bends > 0) & (bends >= straight) | (alone & (np.mean(alone) < 0.1))
    return wrong


def _shorter_replies(initiator: Ints, target: Ints, reply: Ints) -> Bools:
    """Return which exchanges (n,) have the roles with which their pair has the shorter replies."""
    key = (initiator << 16) | target
    ends, number = np.unique(key, return_inverse=True)
    middle = np.asarray(median(reply, number, np.arange(len(ends))))
    other = ((ends & 0xFFFF) << 16) | (ends >> 16)
    place = np.clip(np.searchsorted(ends, other), 0, len(ends) - 1)
    of_other = np.where(ends[place] == other, middle[place], np.inf)
    return np.asarray(((middle < of_other) | ((middle == of_other) & (ends < other)))[number])


def _heard_by(listener: int, r: Receptions, links: _Links, rows: Ints, exchanges: Exchanges) -> Columns:
    """Return the rows of the table `overheard` of one listener, from the frames of exchanges, as `rows` (n, 3)."""
    me = np.full(len(rows), listener)
    found = [links.find(r.sender[row], me, r.frame[row]) for row in rows.T]
    good = np.logical_and.reduce([there for _, there in found]) & (r.listener[rows[:, :2]] != listener).all(axis=1)
    e = exchanges[good]
    columns: Columns = {"time_ns": e.time_ns, "listener": me[good]}
    columns |= {"initiator": e.initiator, "target": e.target} | {f"{name}_n": getattr(e, name) for name in STAMPS}
    first, second, third = (row[good] for row, _ in found)
    rx3 = _without_drift(r, links, second, third, elapsed(e.tx2, e.rx1, r.bits))
    for k, (own, rx) in enumerate(((first, r.rx[first]), (second, r.rx[second]), (third, rx3)), 1):
        columns |= {f"rx{k}": rx, f"fpp{k}_dbm": r.fpp_dbm[own], f"skew{k}_ppm": r.skew_ppm[own]}
    return columns | {
        f"{w}{k}_n_{u}": getattr(e, f"{w}{k}_{u}") for w, u in (("fpp", "dbm"), ("skew", "ppm")) for k in (1, 2)
    }


def exchange_of(exchanges: Exchanges, overheard: Mapping[str, NDArray[Any]]) -> Ints:
    """Return the row of the exchange that each overheard one (n,) belongs to, -1 where it is not there.

    Both have the target's stamps of poll and response, which the frames of boards bring; those of the initiator may not
    be there.
    """
    e, h, within = exchanges, overheard, (1 << exchanges.bits) - 1
    first, second = (
        np.unique(np.append(there, here).astype(np.int64) << exchanges.bits | stamps & within, return_inverse=True)[1]
        for there, here, stamps in (
            (e.initiator, h["initiator"], np.append(e.rx1, h["rx1_n"])),
            (e.target, h["target"], np.append(e.tx2, h["tx2_n"])),
        )
    )
    number = np.unique(first * (int(second.max(initial=-1)) + 1) + second, return_inverse=True)[1]
    row = np.full(int(number.max(initial=-1)) + 1, -1)
    row[number[: len(e)]] = np.arange(len(e))
    return row[number[len(e) :]]
