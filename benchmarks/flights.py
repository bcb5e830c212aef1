"""Flights with stamps, poses and lever arms for tests of the doctor, which share no code with the simulator.

Bodies move on sums of sines and turn; some have two tags on lever arms; anchors stand still. Stamps are those of clocks
with errors of some ppm, computed from the true times of the exchange; powers depend on distance, antennas that turn,
and noise; errors have a part that depends on power, noise, and the detours of reflections, which may last. Seeds below
`FIRST_REPORTED` were used to choose the thresholds of the doctor; only later ones are reported.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds import reflected_s
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.twr import Exchanges

Floats = NDArray[np.float64]

FIRST_REPORTED: Final = 10_000
LIGHT: Final = 299_702_547.0
TICKS: Final = 128 * 499.2e6
REPLY_S: Final = {"ds": 305e-6, "ds-alt": 305e-6, "ss": 1538.7e-6, "ss-cfo": 1538.7e-6}
THIRD_S: Final = 1538.7e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Parameters of a flight; the `share` of ranges is reflected, and a reflection lasts `lasts_s` on average (0: each
    range is independent).
    """

    bodies: int = 3
    tags_a_body: int = 2
    anchors: int = 0
    seconds: float = 120.0
    per_second: float = 100.0
    protocol: str = "ds"
    bits: int = 32
    noise_m: float = 0.05
    share: float = 0.08
    lasts_s: float = 0.0
    detour_m: float = 0.35
    turning_db: float = 4.0
    skew_ppm: float = 4.0
    carriers: bool = True
    among_anchors: bool = False


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight in the form that the doctor takes in place of a recording."""

    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault] = field(default_factory=list)
    name: str = "flight"


def fly(plan: Plan, seed: int, boards: int | None = None, moved: tuple[int, Floats] | None = None) -> Flight:
    """Draw a flight; flights with the same `boards` have the same delays and anchors.

    An anchor (its number) that was `moved` by some metres (3,) is not at its recorded position.
    """
    rng = np.random.default_rng([seed, 4711])
    own = np.random.default_rng([seed if boards is None else boards, 1174])
    tags = _tags(plan)
    count = int(plan.seconds * plan.per_second)
    pairs = _pairs(tags, among_anchors=plan.among_anchors)
    which = rng.integers(0, len(pairs), count)
    ends = pairs[which]
    ends = np.where((rng.random(count) < 0.5)[:, None], ends[:, ::-1], ends)
    time_s = np.sort(rng.uniform(0, plan.seconds, count))
    tracks = _Tracks(plan, rng, own)
    recorded = tracks.anchor.copy()
    if moved is not None:
        tracks.anchor[moved[0]] += moved[1]
    first, second = (tracks.antennas(tags, ids, time_s) for ids in ends.T)
    tracks.anchor = recorded
    away = np.linalg.norm(first - second, axis=1)
    powers = _powers(plan, rng, time_s, ends, away)
    lifted = np.mean(10 ** ((powers + 82) / 10), axis=0)
    error = 0.10 * np.exp(-lifted / 0.4) - 0.02 * lifted + plan.noise_m * rng.standard_t(9, count)
    error += _detours(plan, rng, time_s, which, len(pairs))
    size = max(tag.tag for tag in tags) + 1
    delay_ns = own.uniform(-0.4, 0.3, size)
    skew = own.normal(0, plan.skew_ppm * 1e-6, size)
    return Flight(_exchanges(plan, rng, time_s, ends, away, error, powers, delay_ns, skew), tracks.poses(), tags)


def _tags(plan: Plan) -> list[Tag]:
    found = []
    for body in range(plan.bodies):
        for k in range(plan.tags_a_body):
            side = (1 if k == 0 else -1) if plan.tags_a_body > 1 else 0.5
            found.append(Tag(10 * (body + 1) + k, f"drone{body + 1}", (0.17 * side, -0.12 * side, -0.04)))
    return found + [Tag(100 + k, f"anchor{k}", (0.0, 0.0, 0.0)) for k in range(plan.anchors)]


def _pairs(tags: list[Tag], *, among_anchors: bool) -> NDArray[np.int64]:
    """Return all pairs of tags of different bodies; one of them moves unless anchors range with each other."""
    return np.array([
        (a.tag, b.tag) for k, a in enumerate(tags) for b in tags[k + 1 :]
        if a.body != b.body and (among_anchors or a.tag < 100 or b.tag < 100)
    ])  # fmt: skip


class _Tracks:
    """Positions and attitudes of bodies."""

    def __init__(self, plan: Plan, rng: np.random.Generator, own: np.random.Generator) -> None:
        self.plan = plan
        shape = (plan.bodies, 3, 3)
        self.rate, self.phase = rng.uniform(0.2, 1.1, shape), rng.uniform(0, 6.28, shape)
        self.size = rng.uniform(0.25, 0.8, shape) / (0.4 + self.rate)
        angle = 2 * np.pi * (np.arange(plan.bodies) + 0.3 * rng.random(plan.bodies)) / plan.bodies
        self.home = np.column_stack([2.2 * np.cos(angle), 2.2 * np.sin(angle), rng.uniform(0.8, 1.8, plan.bodies)])
        self.turn = rng.uniform(0.25, 0.8, (plan.bodies, 3))
        around = 2 * np.pi * (np.arange(max(plan.anchors, 1)) + 0.2 * own.random(max(plan.anchors, 1)))
        around = around / max(plan.anchors, 1)
        self.anchor = np.column_stack([4.5 * np.cos(around), 4.5 * np.sin(around), own.uniform(0.3, 2.8, len(around))])

    def place(self, body: int, time_s: Floats) -> Floats:
        waves = np.sin(self.rate[body] * time_s[:, None, None] + self.phase[body]) * self.size[body]
        return np.asarray(self.home[body] + waves.sum(axis=2))

    def quaternion(self, body: int, time_s: Floats) -> Floats:
        """Return a yaw that oscillates over all directions, with small roll and pitch, as x y z w."""
        a, b, c = self.turn[body]
        yaw, roll, pitch = 3.0 * np.sin(0.4 * a * time_s + a), 0.25 * np.sin(b * time_s), 0.2 * np.sin(c * time_s + 1)
        cy, sy, cr, sr, cp, sp = (f(v / 2) for v in (yaw, roll, pitch) for f in (np.cos, np.sin))
        return np.column_stack([
            sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy,
        ])  # fmt: skip

    def antennas(self, tags: list[Tag], ids: Any, time_s: Floats) -> Floats:
        found = np.zeros((len(ids), 3))
        for tag in tags:
            rows = ids == tag.tag
            if tag.tag >= 100:
                found[rows] = self.anchor[tag.tag - 100]
                continue
            body = int(tag.body[5:]) - 1
            found[rows] = self.place(body, time_s[rows]) + _turned(
                self.quaternion(body, time_s[rows]), np.array(tag.lever_arm_m)
            )
        return found

    def poses(self) -> Poses:
        time_s = np.arange(-0.5, self.plan.seconds + 0.5, 0.02)
        parts = [(f"drone{k + 1}", time_s, self.place(k, time_s), self.quaternion(k, time_s)) for k in
                 range(self.plan.bodies)]  # fmt: skip
        for k in range(self.plan.anchors):
            parts.append((f"anchor{k}", time_s[:1], self.anchor[k : k + 1], np.array([[0.0, 0.0, 0.0, 1.0]])))
        return Poses(
            np.concatenate([np.rint((t + 1) * 1e9).astype(np.int64) for _, t, _, _ in parts]),
            np.concatenate([np.full(len(t), name) for name, t, _, _ in parts]),
            np.concatenate([p for _, _, p, _ in parts]),
            np.concatenate([q for _, _, _, q in parts]),
        )


def _turned(q: Floats, arm: Floats) -> Floats:
    """Rotate a vector by quaternions (n, 4)."""
    v = q[:, :3]
    across = 2 * np.cross(v, np.broadcast_to(arm, v.shape))
    return np.asarray(arm + q[:, 3:] * across + np.cross(v, across))


def _powers(plan: Plan, rng: np.random.Generator, time_s: Floats, ends: Any, away: Floats) -> Floats:
    gain = np.zeros(len(time_s))
    rate, phase = rng.uniform(0.3, 2.0, (200, 3)), rng.uniform(0, 6.28, (200, 3))
    for ids in ends.T:
        gain += np.sin(rate[ids] * time_s[:, None] + phase[ids]).sum(axis=1)
    shared = -82.0 - 20 * np.log10(away / 3.5) + gain * plan.turning_db / 3
    return np.asarray(shared + rng.normal(0, 0.15 * plan.turning_db + 0.03, (2, len(time_s))))


def _detours(plan: Plan, rng: np.random.Generator, time_s: Floats, which: Any, pairs: int) -> Floats:
    count = len(time_s)
    if not plan.lasts_s:
        return np.asarray(np.where(rng.random(count) < plan.share, rng.gamma(1.5, plan.detour_m / 1.5, count), 0.0))
    found = np.zeros(count)
    for pair in range(pairs):
        rows, share = np.flatnonzero(which == pair), float(np.clip(plan.share * rng.uniform(0.3, 1.7), 0.01, 0.9))
        for begin, end in reflected_s(rng, share, plan.lasts_s, plan.seconds):
            some = rows[(time_s[rows] >= begin) & (time_s[rows] < end)]
            found[some] = rng.gamma(1.5, plan.detour_m / 1.5) * rng.gamma(9, 1 / 9, len(some))
    return found


def _exchanges(  # noqa: PLR0913 - all that an exchange is made of
    plan: Plan, rng: Any, time_s: Floats, ends: Any, away: Floats, error: Floats, powers: Floats, delay_ns: Floats,
    skew: Floats,
) -> Exchanges:  # fmt: skip
    """Return stamps: a stamp is the true time by its clock, which starts at noon, plus the delay."""
    first, second = ends.T
    flight = away / LIGHT
    longer = 2 * error / LIGHT
    reply = REPLY_S[plan.protocol] + rng.uniform(0, 2e-6, len(time_s))
    offset = rng.uniform(0, 60, 200)

    def stamp(tag: Any, after_s: Floats, sent: bool, late_s: Floats | float = 0.0) -> Any:
        # Seconds and their fractions are counted separately, because float64 of their sum would lose ticks.
        start = np.rint((time_s + offset[tag]) * TICKS).astype(np.int64)
        slow = np.rint(time_s * skew[tag] * TICKS).astype(np.int64)
        share = 0.44 if sent else -0.56
        small = (after_s * (1 + skew[tag]) + late_s + share * delay_ns[tag] * 1e-9) * TICKS
        return (start + slow + np.rint(small).astype(np.int64)) & ((1 << plan.bits) - 1)

    zero = np.zeros(len(time_s))
    t2, t3 = flight, flight + reply
    t4 = t3 + flight
    columns = {
        "tx1": stamp(first, zero, True), "rx1": stamp(second, t2, False), "tx2": stamp(second, t3, True),
        "rx2": stamp(first, t4, False, longer),
    }  # fmt: skip
    none = np.zeros(len(time_s), dtype=np.int64)
    if plan.protocol == "ds":
        t5 = t3 + THIRD_S
        columns |= {"tx3": stamp(second, t5, True), "rx3": stamp(first, t5 + flight, False, longer)}
    elif plan.protocol == "ds-alt":
        t5 = t4 + THIRD_S
        columns |= {"tx3": stamp(first, t5, True), "rx3": stamp(second, t5 + flight, False)}
    else:
        columns |= {"tx3": none, "rx3": none}
    relative = 1e6 * (skew[second] - skew[first])
    told = [sign * relative + rng.normal(0, 0.08, len(time_s)) for sign in (1, -1)]
    if not plan.carriers:
        told = [np.full(len(time_s), np.nan)] * 2
    made = Exchanges(
        time_ns=np.rint((time_s + 1) * 1e9).astype(np.int64), initiator=first.astype(np.int64),
        target=second.astype(np.int64), protocol=np.full(len(time_s), plan.protocol), reporter=first.astype(np.int64),
        range_m=np.full(len(time_s), np.nan), fpp1_dbm=powers[0], fpp2_dbm=powers[1], skew1_ppm=told[0],
        skew2_ppm=told[1], truth_m=np.full(len(time_s), np.nan), bits=plan.bits, **columns,
    )  # fmt: skip
    return replace(made, range_m=_told_by_device(plan, made))


def _told_by_device(plan: Plan, e: Exchanges) -> Floats:
    """Return the range of the device, by the formula of textbooks, rounded down to four decimals."""
    half, mask = 1 << (plan.bits - 1), (1 << plan.bits) - 1

    def less(a: Any, b: Any) -> Floats:
        return np.asarray((((a - b) + half) & mask) - half, dtype=np.float64)

    round_trip, reply = less(e.rx2, e.tx1), less(e.tx2, e.rx1)
    if plan.protocol == "ds":
        ticks = (round_trip - less(e.rx3, e.rx2) / less(e.tx3, e.tx2) * reply) / 2
    elif plan.protocol == "ds-alt":
        again, wait = less(e.rx3, e.tx2), less(e.tx3, e.rx2)
        total = round_trip + again + reply + wait
        ticks = (reply * (again - wait) + wait * (round_trip - reply) + (round_trip - reply) * (again - wait)) / total
    else:
        ticks = np.trunc((round_trip - reply) / 2)
        if plan.protocol == "ss-cfo":
            ticks = (round_trip - reply - np.nan_to_num(e.skew2_ppm) * 1e-6 * reply) / 2
    return np.trunc(ticks / TICKS * LIGHT * 1e4) / 1e4
