"""Faults planted in flights that share no code with simulator and doctor, and the findings of the doctor.

Writes the table of docs/doctor.md: detected faults, and other findings. Seeds start at `FIRST_REPORTED`; they were not
used to choose thresholds. `--tuning` uses the earlier seeds, which were.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

import calib
from benchmarks.flights import FIRST_REPORTED, LIGHT, TICKS, Flight, Plan, fly
from benchmarks.studies import write_section
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Fault
from uwbsim import simulate
from uwbsim.scenario.loading import load

PAGE = Path(__file__).parents[1] / "docs" / "doctor.md"
SEEDS: Final = 4
CLEAN_SEEDS: Final = 10
OF_FAULTS: Final = 700
"""First seeds of the other faults."""

SCENARIO: Final = Path(__file__).parents[1] / "scenarios" / "icra2023" / "test1.toml"
VACUUM: Final = 299_792_458.0 / LIGHT
STAMPS: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of fault: the flight, a function that plants it, and the names of findings that count as detection."""

    name: str
    plan: Plan
    plant: Callable[[Flight, np.random.Generator], Flight | list[Flight]]
    expected: frozenset[str]
    also: frozenset[str] = frozenset()


def changed(flight: Flight, **columns: Any) -> Flight:
    """Return a flight with other columns in its exchanges."""
    return replace(flight, exchanges=replace(flight.exchanges, **columns))


def of_tag(flight: Flight, tag: int) -> Any:
    """Return a mask of the exchanges of a tag."""
    return (flight.exchanges.initiator == tag) | (flight.exchanges.target == tag)


def seconds(flight: Flight) -> Any:
    """Return the times of exchanges in seconds."""
    return flight.exchanges.time_ns * 1e-9 - 1


def longer(flight: Flight, metres: Any) -> Flight:
    """Return a flight whose ranges (n,) are longer, by later receive stamps of the initiator."""
    e = flight.exchanges
    late, mask = np.rint(2 * np.broadcast_to(metres, len(e)) / LIGHT * TICKS).astype(np.int64), (1 << e.bits) - 1
    third = (e.protocol == "ds") & (e.rx3 != 0)
    rx2, rx3 = (e.rx2 + late) & mask, np.where(third, (e.rx3 + late) & mask, e.rx3)
    return changed(flight, rx2=rx2, rx3=rx3, range_m=np.trunc((e.range_m + late / TICKS * LIGHT / 2) * 1e4) / 1e4)


def corrupt(flight: Flight, rng: np.random.Generator, share: float) -> Flight:
    """Replace stamps of some rows by random numbers."""
    hit = rng.random(len(flight.exchanges)) < share
    which, e = rng.integers(0, 6, len(hit)), flight.exchanges
    found = {
        name: np.where(hit & (which == k), rng.integers(0, 2**32, len(hit)), getattr(e, name))
        for k, name in enumerate(STAMPS)
    }
    return changed(flight, **found)


def stepped(flight: Flight, rng: np.random.Generator) -> Flight:
    """Change the delay of a tag by 0.3 to 1.2 ns at some time."""
    size = float(rng.choice([-1, 1]) * rng.uniform(0.3, 1.2)) * LIGHT * 1e-9 / 2
    at = rng.uniform(0.2, 0.8) * seconds(flight).max()
    return longer(flight, np.where(of_tag(flight, tag_of(flight, rng)) & (seconds(flight) > at), size, 0.0))


def drifting(flight: Flight, rng: np.random.Generator) -> Flight:
    """Let the delay of a tag drift by a nanosecond."""
    part = seconds(flight) / seconds(flight).max()
    return longer(flight, np.where(of_tag(flight, tag_of(flight, rng)), 0.15 * part, 0.0))


def tag_of(flight: Flight, rng: np.random.Generator) -> int:
    """Return a tag on a moving body."""
    return int(rng.choice([tag.tag for tag in flight.tags if tag.tag < 100]))


def longer_pair(flight: Flight, rng: np.random.Generator, metres: float | None = None) -> Flight:
    """Lengthen the ranges of one pair, by default by 12 to 30 cm."""
    e = flight.exchanges
    pairs = np.unique(np.sort(np.column_stack([e.initiator, e.target]), axis=1), axis=0)
    a, b = pairs[rng.integers(0, len(pairs))]
    size = rng.uniform(0.12, 0.3) if metres is None else metres
    return longer(flight, np.where(of_tag(flight, a) & of_tag(flight, b), size, 0.0))


def swapped_roles(flight: Flight, rng: np.random.Generator) -> Flight:
    """Exchange initiators and targets, and their measurements."""
    e = flight.exchanges
    return changed(
        flight, initiator=e.target, target=e.initiator, fpp1_dbm=e.fpp2_dbm, fpp2_dbm=e.fpp1_dbm,
        skew1_ppm=e.skew2_ppm, skew2_ppm=e.skew1_ppm,
    )  # fmt: skip


def arms(flight: Flight, change: Callable[[Any], Any]) -> Flight:
    """Return a flight with other lever arms."""
    return replace(flight, tags=[replace(tag, lever_arm_m=change(tag)) for tag in flight.tags])


def swapped_tags(flight: Flight, rng: np.random.Generator) -> Flight:
    """Exchange the two tags of a body."""
    body, by_tag = int(rng.integers(1, 4)) * 10, {tag.tag: tag.lever_arm_m for tag in flight.tags}
    other = {body: body + 1, body + 1: body}
    return arms(flight, lambda tag: by_tag[other.get(tag.tag, tag.tag)])


def turned_arms(flight: Flight, rng: np.random.Generator) -> Flight:
    """Change the signs of the lever arms of a body."""
    body = f"drone{rng.integers(1, 4)}"
    return arms(flight, lambda tag: tuple(-v for v in tag.lever_arm_m) if tag.body == body else tag.lever_arm_m)


def wxyz(flight: Flight, rng: np.random.Generator) -> Flight:
    """Write quaternions in the order w, x, y, z."""
    return replace(flight, poses=replace(flight.poses, quaternion=flight.poses.quaternion[:, [3, 0, 1, 2]]))


def inverse_attitudes(flight: Flight, rng: np.random.Generator) -> Flight:
    """Write quaternions that rotate from the world to the body."""
    return replace(flight, poses=replace(flight.poses, quaternion=flight.poses.quaternion * [-1, -1, -1, 1]))


def turned_attitudes(flight: Flight, rng: np.random.Generator, *, body: str = "") -> Flight:
    """Rotate the attitudes in the world by 30 to 150 degrees, or those of a body about its own vertical axis."""
    # A rotation about the line through the tags of a body has no effect; one by 180 degrees exchanges the tags.
    axis, given = np.array([0.0, 0.0, 1.0]) if body else rng.normal(size=3), Rotation.from_quat(flight.poses.quaternion)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(np.pi / 6, 5 * np.pi / 6))
    turned = (given * turn if body else turn * given).as_quat()
    mine = (flight.poses.body == body)[:, None] | (body == "")
    return replace(flight, poses=replace(flight.poses, quaternion=np.where(mine, turned, flight.poses.quaternion)))


def turned_arm(flight: Flight, rng: np.random.Generator) -> Flight:
    """Change the sign of one lever arm."""
    mine = tag_of(flight, rng)
    return arms(flight, lambda tag: tuple(-v for v in tag.lever_arm_m) if tag.tag == mine else tag.lever_arm_m)


def missing_arm(flight: Flight, rng: np.random.Generator) -> Flight:
    """Leave out one lever arm."""
    mine = tag_of(flight, rng)
    return arms(flight, lambda tag: (0.0, 0.0, 0.0) if tag.tag == mine else tag.lever_arm_m)


def other_origin(flight: Flight, rng: np.random.Generator) -> Flight:
    """Write the poses of a body relative to another origin, 0.4 to 0.8 m away."""
    mine, way = flight.poses.body == f"drone{rng.integers(1, 4)}", rng.uniform(0, 2 * np.pi)
    shift = rng.uniform(0.4, 0.8) * np.array([np.cos(way), np.sin(way), 0.0])
    position_m = flight.poses.position_m + np.where(mine[:, None], shift, 0.0)
    return replace(flight, poses=replace(flight.poses, position_m=position_m))


def rare_poses(flight: Flight, rng: np.random.Generator) -> Flight:
    """Keep one pose per two seconds."""
    kept = [np.flatnonzero(flight.poses.body == body) for body in np.unique(flight.poses.body)]
    every = [rows[:: round(2e9 / np.median(np.diff(flight.poses.time_ns[rows])))] for rows in kept]
    return replace(flight, poses=flight.poses[np.sort(np.concatenate(every))])


def frozen_poses(flight: Flight, rng: np.random.Generator, *, bodies: int) -> Flight:
    """Repeat the last pose of bodies for 1 to 6 s, five times."""
    poses = flight.poses
    position_m, quaternion = poses.position_m.copy(), poses.quaternion.copy()
    for body in (f"drone{k + 1}" for k in range(bodies)):
        own = np.flatnonzero(poses.body == body)
        for start_ns in rng.uniform(poses.time_ns.min(), poses.time_ns.max(), 5):
            lost = own[(poses.time_ns[own] > start_ns) & (poses.time_ns[own] < start_ns + rng.uniform(1e9, 6e9))]
            position_m[lost], quaternion[lost] = position_m[lost[:1]], quaternion[lost[:1]]
    return replace(flight, poses=replace(poses, position_m=position_m, quaternion=quaternion))


def clock_set_back(flight: Flight, rng: np.random.Generator) -> Flight:
    """Set the host's clock back by 3 to 9 s in the middle, and sort by its times."""
    e, at_ns = flight.exchanges, np.median(flight.exchanges.time_ns)
    told_ns = np.where(e.time_ns > at_ns, e.time_ns - rng.integers(3, 9) * 10**9, e.time_ns)
    return replace(flight, exchanges=replace(e, time_ns=told_ns)[np.argsort(told_ns, kind="stable")])


def late_poses(flight: Flight, rng: np.random.Generator) -> Flight:
    """Shift the clock of the poses."""
    shift = int(rng.choice([-1, 1]) * rng.uniform(0.15, 1.5) * 1e9)
    return replace(flight, poses=replace(flight.poses, time_ns=flight.poses.time_ns + shift))


def late_truths(flight: Flight, by_ns: int) -> Flight:
    """Replace poses by true distances in the table, taken at later times."""
    e = flight.exchanges
    truth_m = distances_m(flight.poses, flight.tags, e.initiator, e.target, e.time_ns + by_ns)
    return replace(changed(flight, truth_m=truth_m), poses=flight.poses[:0])


def dead(flight: Flight, rng: np.random.Generator) -> Flight:
    """Let a tag fail in nearly all of its exchanges."""
    mine = of_tag(flight, tag_of(flight, rng)) & (rng.random(len(flight.exchanges)) < 0.97)
    e = flight.exchanges
    failed = [
        Fault(int(t), "1", "lost frame", "message 1 below sensitivity", initiator=int(a), target=int(b))
        for t, a, b in zip(e.time_ns[mine], e.initiator[mine], e.target[mine], strict=True)
    ]
    return replace(flight, exchanges=e[~mine], faults=failed)


def moved_anchor(flight: Flight, rng: np.random.Generator, *, plan: Plan, both: bool) -> Flight | list[Flight]:
    """Displace an anchor by 20 to 60 cm from its recorded position; in the second of two recordings, if `both`."""
    away = rng.normal(size=3)
    away *= rng.uniform(0.2, 0.6) / np.linalg.norm(away)
    which = int(rng.integers(0, plan.anchors))
    seed = int(rng.integers(0, 2**31))
    second = fly(plan, seed + 1, 1, (which, away))
    return [named(fly(plan, seed, 1), "first"), named(second, "second")] if both else second


def all_anchors_off(flight: Any, rng: np.random.Generator) -> Any:
    """Displace each anchor by 10 cm from its recorded position, in a random direction."""
    position_m = flight.poses.position_m.copy()
    for body in np.unique(flight.poses.body):
        away = rng.normal(size=3)
        if body.startswith("anchor"):
            position_m[flight.poses.body == body] += 0.1 * away / np.linalg.norm(away)
    return replace(flight, poses=replace(flight.poses, position_m=position_m))


def named(flight: Flight, name: str) -> Flight:
    """Return a flight with a name."""
    return replace(flight, name=name)


def other_delay(flight: Flight, rng: np.random.Generator, *, plan: Plan) -> list[Flight]:
    """Change the delay of a tag by 0.5 to 1.2 ns between two recordings."""
    seed = int(rng.integers(0, 2**31))
    second = fly(plan, seed + 1, 1)
    size = float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.2)) * LIGHT * 1e-9 / 2
    second = longer(second, np.where(of_tag(second, tag_of(second, rng)), size, 0.0))
    return [named(fly(plan, seed, 1), "first"), named(second, "second")]


def two(flight: Flight, rng: np.random.Generator, *, plan: Plan) -> list[Flight]:
    """Return two recordings of the same boards without a fault."""
    seed = int(rng.integers(0, 2**31))
    return [named(fly(plan, seed + k, 1), str(k)) for k in range(2)]


def few_pairs(flight: Flight, rng: np.random.Generator) -> Flight:
    """Keep two bodies, whose tags range only with each other's, and corrupt 130 rows."""
    e = flight.exchanges
    some = replace(flight, exchanges=e[(e.initiator < 30) & (e.target < 30)])
    return corrupt(some, rng, 130 / len(some.exchanges))


def still(flight: Flight, rng: np.random.Generator) -> Flight:
    """Replace true distances by constants, as measured with a tape, and move ranges near them."""
    e = flight.exchanges
    tape = 2.0 + 0.1 * ((e.initiator + e.target) % 17)
    known = calib.Ranges.from_exchanges(e, poses=flight.poses, tags=flight.tags).truth_m
    return changed(longer(flight, tape - known), truth_m=tape)


def still_open(flight: Flight, rng: np.random.Generator) -> Flight:
    """Let nothing move, and make the ranges of a pair 45 cm longer than the measured distance."""
    return longer_pair(still(flight, rng), rng, 0.45)


def in_unit(flight: Flight, rng: np.random.Generator) -> Flight:
    """Write poses in mm, cm, inches or feet."""
    many = float(rng.choice([1000.0, 100.0, 1 / 0.0254, 1 / 0.3048]))
    return replace(flight, poses=replace(flight.poses, position_m=flight.poses.position_m * many))


def scaled(flight: Flight, rng: np.random.Generator) -> Flight:
    """Make positions 2 to 6 % too large or too small."""
    size = 1 + float(rng.choice([-1, 1]) * rng.uniform(0.02, 0.06))
    return replace(flight, poses=replace(flight.poses, position_m=flight.poses.position_m * size))


def warming(flight: Flight, rng: np.random.Generator) -> Flight:
    """Let all ranges become 8 to 25 cm longer while the boards warm up, within the first half or steadily."""
    share = seconds(flight) / seconds(flight).max()
    course = 1 - np.exp(-share / 0.2) if rng.random() < 0.5 else share
    return longer(flight, float(rng.uniform(0.08, 0.25)) * course)


def arms_in_mm(flight: Flight, rng: np.random.Generator) -> Flight:
    """Write lever arms in mm."""
    return arms(flight, lambda tag: tuple(1000 * v for v in tag.lever_arm_m))


def without_stamps(flight: Flight, rng: np.random.Generator, *, many: float) -> Flight:
    """Keep ranges without stamps, in another unit."""
    none = np.zeros(len(flight.exchanges), dtype=np.int64)
    ranges = flight.exchanges.range_m * many
    kept: dict[str, Any] = dict.fromkeys(STAMPS, none)
    return as_read(changed(flight, range_m=ranges, **kept), rng, protocol="ss")


def other_powers(flight: Flight, rng: np.random.Generator) -> Flight:
    """Write powers as path losses, or in hundredths of a dBm."""
    e, factor = flight.exchanges, float(rng.choice([-1.0, 100.0, -100.0, 256.0]))
    return changed(flight, fpp1_dbm=e.fpp1_dbm * factor, fpp2_dbm=e.fpp2_dbm * factor)


def doubled(flight: Flight, rng: np.random.Generator) -> Flight:
    """Repeat a third of the exchanges, as in logs of two robots."""
    e = flight.exchanges
    twice = np.sort(np.concatenate([np.arange(len(e)), np.flatnonzero(rng.random(len(e)) < 0.35)]))
    return replace(flight, exchanges=e[twice])


def exchanged_anchors(flight: Flight, rng: np.random.Generator, *, given: bool, count: int = 2) -> Flight:
    """Give each of some anchors the position of the next one, in the poses or in `given` true distances."""
    some = rng.permutation(4)[:count].tolist()
    number = {f"anchor{a}": f"anchor{b}" for a, b in zip(some, [*some[1:], some[0]], strict=True)}
    body = np.array([number.get(name, name) for name in flight.poses.body.tolist()])
    wrong = replace(flight, poses=replace(flight.poses, body=body))
    if not given:
        return wrong
    truth = calib.Ranges.from_exchanges(wrong.exchanges, poses=wrong.poses, tags=wrong.tags).truth_m
    return replace(changed(wrong, truth_m=truth), poses=wrong.poses[:0])


def noisy_powers(flight: Flight, rng: np.random.Generator) -> Flight:
    """Make powers a function of distance plus noise of readings; distance then explains 59 % of the variance."""
    e = flight.exchanges
    truth = calib.Ranges.from_exchanges(e, poses=flight.poses, tags=flight.tags).truth_m
    shared = -82.0 - 20 * np.log10(truth / 3.5)
    noise = np.std(shared) * np.sqrt(2 * (1 / 0.59 - 1)) * rng.standard_normal((2, len(e)))
    return changed(flight, fpp1_dbm=shared + noise[0], fpp2_dbm=shared + noise[1])


def other_anchor(flight: Flight, rng: np.random.Generator, *, plan: Plan, gap: bool) -> Flight | list[Flight]:
    """Change the delay of an anchor by 1.5 ns between two sessions, in two recordings or in one with a gap of a day."""
    seed, tag = int(rng.integers(0, 2**31)), 100 + int(rng.integers(0, plan.anchors))
    size = float(rng.choice([-1, 1])) * 1.5 * LIGHT * 1e-9 / 2
    first, second = fly(plan, seed, 1), fly(plan, seed + 1, 1)
    if not gap:
        return [named(first, "first"), named(longer(second, np.where(of_tag(second, tag), size, 0.0)), "second")]
    day = 86_400 * 10**9
    late, late_poses = (
        times > 1e9 * (1 + plan.seconds / 2) for times in (first.exchanges.time_ns, first.poses.time_ns)
    )
    both = longer(first, np.where(of_tag(first, tag) & late, size, 0.0))
    both = changed(both, time_ns=both.exchanges.time_ns + np.where(late, day, 0))
    return replace(both, poses=replace(both.poses, time_ns=both.poses.time_ns + np.where(late_poses, day, 0)))


def as_read(flight: Flight, rng: np.random.Generator, **columns: Any) -> Flight:
    """Return a flight as a wrong import would read it."""
    whole = {
        name: np.full(len(flight.exchanges), value) if name == "protocol" else value for name, value in columns.items()
    }
    return changed(flight, **whole)


def in_ns(flight: Flight, rng: np.random.Generator) -> Flight:
    """Read nanoseconds as ticks."""
    return changed(flight, **{n: np.rint(getattr(flight.exchanges, n) * 1e9 / TICKS).astype(np.int64) for n in STAMPS})


def simulated(flight: Flight, rng: np.random.Generator, *, settings: tuple[str, ...] = ()) -> Any:
    """Return a simulated flight of a minute instead."""
    seed = f"run.seed={rng.integers(0, 2**31)}"
    return simulate(load(SCENARIO, [seed, "run.duration_s=60", *settings]))


def nothing(flight: Flight, rng: np.random.Generator) -> Flight:
    """Plant nothing."""
    return flight


def names(*words: str) -> frozenset[str]:
    """Return the names of faults."""
    return frozenset(words)


SCALE: Final = names("scale of true distances", "scale of true distances or reflections")
BASE: Final = Plan()
ANCHORS: Final = Plan(anchors=4, tags_a_body=1)
LASTING: Final = "reflections that last"
SHORT: Final = Plan(seconds=2)
ONE: Final = Plan(tags_a_body=1, bodies=5)
RIG: Final = Plan(bodies=1, anchors=6)
FEW: Final = "too few pairs"

CLEAN: Final = (
    *(Case(name, plan, nothing, frozenset(), also)
    for name, plan, also in (
        ("three bodies with two tags, 2 minutes", BASE, names()),
        ("20 s", Plan(seconds=20), names()),
        ("5 minutes", Plan(seconds=300), names()),
        ("three tags", Plan(tags_a_body=1), names()),
        ("five tags, reflections that last 4 s, 15 %", replace(ONE, share=0.15, lasts_s=4.0), names(LASTING)),
        ("reflections that last 15 s, 10 %", Plan(share=0.1, lasts_s=15.0, seconds=240), names(LASTING)),
        ("four anchors", ANCHORS, names()),
        ("third message from the initiator", Plan(protocol="ds-alt"), names()),
        ("single-sided, corrected by the carriers", Plan(protocol="ss-cfo"), names()),
        ("40-bit stamps, no carriers", Plan(bits=40, carriers=False), names()),
    )),
    Case("two recordings of the same boards", ANCHORS, partial(two, plan=ANCHORS), frozenset()),
    Case("simulator: the flight of ICRA 2023, a minute", SHORT, simulated, frozenset()),
)  # fmt: skip

FAULTS: Final = (
    Case("3 % corrupt stamps", BASE, partial(corrupt, share=0.03), names("corrupted exchanges")),
    Case("two bodies only, and 130 corrupt rows", BASE, few_pairs, names("too few pairs"),
         names("corrupted exchanges")),
    Case("`ds` read as `ds-alt`", BASE, partial(as_read, protocol="ds-alt"), names("another protocol")),
    Case("`ds-alt` read as `ds`", Plan(protocol="ds-alt"), partial(as_read, protocol="ds"), names("another protocol")),
    Case("32-bit stamps read as 40", BASE, partial(as_read, bits=40), names("timestamp width")),
    Case("nanoseconds read as ticks", BASE, in_ns, names("unit slip")),
    Case("`ss` read as `ds`", Plan(protocol="ss-cfo"), partial(as_read, protocol="ds"),
         names("single-sided data taken for double-sided")),
    Case("initiator and target exchanged", BASE, swapped_roles, names("swapped roles")),
    Case("tags of a body exchanged", BASE, swapped_tags, names("swapped tag ids", "lever arm sign")),
    Case("lever arms of a body with the wrong sign", BASE, turned_arms, names("lever arm sign", "swapped tag ids")),
    Case("quaternions w x y z", BASE, wxyz, names("wxyz quaternion")),
    Case("from world to body", BASE, inverse_attitudes, names("inverse quaternion")),
    Case("attitudes turned by 30 to 150 degrees", BASE, turned_attitudes, names("attitudes in another frame")),
    Case("attitudes of a body turned about its vertical", BASE, partial(turned_attitudes, body="drone2"),
         names("attitudes in another frame")),
    Case("of a tag, with the wrong sign", BASE, turned_arm, names("wrong lever arm")),
    Case("of a tag, left out", BASE, missing_arm, names("wrong lever arm")),
    Case("its poses 0.4 to 0.8 m off", BASE, other_origin, names("body stands elsewhere")),
    Case("one in two seconds", BASE, rare_poses, names("rare poses")),
    Case("poses of a body repeat for 1 to 6 s", BASE, partial(frozen_poses, bodies=1), names("frozen poses")),
    Case("poses of all bodies repeat", BASE, partial(frozen_poses, bodies=3), names("frozen poses")),
    Case("poses of a body among anchors repeat", ANCHORS, partial(frozen_poses, bodies=1), names("frozen poses")),
    Case("a clock set back", Plan(bits=40), clock_set_back, names("recordings mixed by their times")),
    Case("`rx2` rounded to 10⁷", BASE, lambda f, _: changed(f, rx2=f.exchanges.rx2 // 10**7 * 10**7),
         names("impossible stamps")),
    Case("positions 2 to 6 % too large or too small", BASE, scaled, SCALE),
    Case("the same, one robot among anchors", RIG, scaled, SCALE, names("too few pairs")),
    Case("all ranges become 8 to 25 cm longer", BASE, warming, names("all delays change")),
    Case("poses 0.15 to 1.5 s off", BASE, late_poses, names("pose time offset")),
    Case("true distances 0.15 to 0.6 s off, without poses", BASE,
         lambda f, rng: late_truths(f, int(rng.choice([-1, 1]) * rng.uniform(0.15, 0.6) * 1e9)),
         names("time offset of true distances")),
    Case("vacuum's speed of light", BASE, lambda f, _: changed(f, range_m=f.exchanges.range_m * VACUUM),
         names("speed of light in vacuum")),
    Case("a delay steps by 0.3 to 1.2 ns", BASE, stepped, names("delay changed mid-flight")),
    Case("the same, reflections that last 5 s", Plan(share=0.1, lasts_s=5.0), stepped,
         names("delay changed mid-flight"), names(LASTING)),
    Case("a delay drifts by 1 ns", BASE, drifting, names("delay drifts", "delay changed mid-flight")),
    Case("a pair 12 to 30 cm long", BASE, longer_pair, names("pairs that do not close")),
    Case("a tag that hardly answers", BASE, dead, names("dead or deaf tag")),
    Case("nothing moves", BASE, still, names("static data")),
    Case("power that follows distance", Plan(turning_db=0.1), nothing, names("power confounded with distance")),
    Case("single-sided, skew left in", Plan(protocol="ss"), nothing, names("skew in single-sided ranges")),
    Case("the same, carriers not read", Plan(protocol="ss", carriers=False), nothing,
         names("skew in single-sided ranges"), names("single-sided without carrier readings")),
    Case("corrected with the carriers' wrong sign", Plan(protocol="ss-cfo"),
         lambda f, _: changed(f, skew1_ppm=-f.exchanges.skew1_ppm, skew2_ppm=-f.exchanges.skew2_ppm,
                              range_m=np.full(len(f.exchanges), np.nan)),
         names("carrier readings with the wrong sign")),
    Case("a third of the ranges reflected", Plan(share=0.34), nothing, names("reflections")),
    Case("reflections that last 3 s, a quarter", Plan(share=0.25, lasts_s=3.0), nothing, names(LASTING)),
    Case("simulator: single-sided, skew left in", SHORT, partial(simulated, settings=("ranging.protocol=ss",)),
         names("skew in single-sided ranges")),
    Case("simulator: half of the ranges reflected", SHORT,
         partial(simulated, settings=("radio.multipath.share=0.5",)), names("reflections")),
    Case("an anchor 20 to 60 cm elsewhere", ANCHORS, partial(moved_anchor, plan=ANCHORS, both=False),
         names("anchor stands elsewhere")),
    Case("six anchors that range with each other, all 10 cm off", replace(RIG, among_anchors=True), all_anchors_off,
         names("anchor stands elsewhere", "places that do not close")),
    Case("an anchor moved between two recordings", ANCHORS, partial(moved_anchor, plan=ANCHORS, both=True),
         names("anchor moved between recordings")),
    Case("a delay of 0.5 to 1.2 ns more in the second", ONE, partial(other_delay, plan=ONE),
         names("delay changed between recordings")),
    Case("an anchor's delay 1.5 ns off in the second of two", ANCHORS, partial(other_anchor, plan=ANCHORS, gap=False),
         names("delay changed between recordings")),
    Case("the same, a rig of two tags", SHORT, partial(other_anchor, plan=RIG, gap=False),
         names("delay changed between recordings"), names(FEW)),
    Case("the same, one recording with a day's gap", SHORT, partial(other_anchor, plan=RIG, gap=True),
         names("delay changed mid-flight"), names(FEW)),
    Case("poses in mm, cm, inches or feet", BASE, in_unit, names("unit of the poses")),
    Case("lever arms in mm", BASE, arms_in_mm, names("lever arm unit")),
    Case("ranges without stamps in mm", BASE, partial(without_stamps, many=1000.0), names("unit of the ranges")),
    Case("reported ranges in mm beside stamps", BASE, lambda f, _: changed(f, range_m=f.exchanges.range_m * 1000),
         names("unit of the reported ranges")),
    Case("powers as losses, or times 100 or 256", BASE, other_powers, names("unit of the powers")),
    Case("a third of the rows twice", BASE, doubled, names("doubled exchanges")),
    Case("two anchors exchanged in the poses", RIG, partial(exchanged_anchors, given=False),
         names("swapped tag ids"), names(FEW)),
    Case("two anchors exchanged in the true distances", RIG, partial(exchanged_anchors, given=True),
         names("swapped tag ids"), names(FEW)),
    Case("the same, 20 ranges a second for 60 s", replace(RIG, seconds=60, per_second=20),
         partial(exchanged_anchors, given=True), names("swapped tag ids"), names(FEW)),
    Case("four exchanged in a circle", RIG, partial(exchanged_anchors, given=False, count=4),
         names("swapped tag ids"), names(FEW)),
    Case("nothing moves, and a pair is 45 cm long", BASE, still_open, names("pairs that do not close"),
         names("static data")),
    Case("power that follows distance, and noise", BASE, noisy_powers, names("power confounded with distance")),
)  # fmt: skip


def findings_of(case: Case, seed: int) -> set[str]:
    """Return the findings of the doctor for a case."""
    rng = np.random.default_rng([seed, 33])
    return {finding.fault for finding in calib.examine(case.plant(fly(case.plan, seed), rng))}


def judged(case: Case, seeds: range) -> tuple[int, int, Counter[str]]:
    """Return the number of detections, the number of runs with a false alarm, and counts of the false findings."""
    found = [findings_of(case, seed) for seed in seeds]
    wrong = [one - case.expected - case.also for one in found]
    return sum(bool(one & case.expected) for one in found), sum(map(bool, wrong)), Counter(chain.from_iterable(wrong))


def table(first: int) -> str:
    """Return the lines of the page; cases run on all cores."""
    with ProcessPoolExecutor(2) as pool:
        count = len(CLEAN) + len(FAULTS)
        return lines_of(list(pool.map(_judged_by_number, range(count), [first] * count)))


def lines_of(found: list[tuple[int, int, Counter[str]]]) -> str:
    """Return a summary of all cases, and the table of faults with the findings that they should give."""
    cases = [*CLEAN, *FAULTS]
    clean, faulty = found[: len(CLEAN)], found[len(CLEAN) :]
    runs, planted = CLEAN_SEEDS * len(CLEAN), SEEDS * len(FAULTS)
    alarms, hits, beside = sum(one[1] for one in clean), sum(one[0] for one in faulty), sum(one[1] for one in faulty)
    misses = [(case.name, SEEDS - one[0]) for case, one in zip(FAULTS, faulty, strict=True) if one[0] < SEEDS]
    told = [f"{name} ({n} of {SEEDS} missed)" for name, n in misses]
    for case, (_, _, wrong) in zip(cases, found, strict=True):
        told += [f"{case.name} ({fault}, false, {n})" for fault, n in wrong.items()]
    named: dict[str, list[str]] = {}
    for case in FAULTS:
        named.setdefault(" or ".join(sorted(case.expected)), []).append(case.name)
    return "\n".join([
        f"Sound recordings: {alarms} of {runs} with a false alarm ({100 * alarms / runs:.1f} %). Planted faults: "
        f"{hits} of {planted} found ({100 * hits / planted:.1f} %), {beside} with an additional false finding. "
        f"Not as expected: {'; '.join(told) or 'none'}.",
        "", "| finding | planted |", "|---|---|",
        *(f"| {fault} | {'; '.join(names)} |" for fault, names in named.items()),
    ])  # fmt: skip


def _judged_by_number(number: int, first: int) -> tuple[int, int, Counter[str]]:
    if number < len(CLEAN):
        return judged(CLEAN[number], range(first, first + CLEAN_SEEDS))
    return judged(FAULTS[number - len(CLEAN)], range(first + OF_FAULTS, first + OF_FAULTS + SEEDS))


def main() -> None:
    """Print the table of the tuning seeds, or write that of the reported seeds into the page."""
    if "--tuning" in sys.argv:
        print(table(0))
        return
    write_section(PAGE, "table", table(FIRST_REPORTED))


if __name__ == "__main__":
    main()
