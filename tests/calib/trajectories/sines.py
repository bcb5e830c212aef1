"""Flights for tests: bodies on sums of sines, ranges by geometry, without code that is tested."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink import Exchanges, Poses, Tag
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S

DELAYS_NS = {1: -0.36, 2: 0.05, 3: 0.24, 4: -0.11, 5: -0.2, 6: 0.1}
ARM = 0.24
MAST = np.array([0.3, -0.1, 0.2])
"""Lever arm of an anchor's antenna."""

CORNERS = [[3.5, 3.5, 0.3], [-3.5, 3.5, 2.6], [-3.5, -3.5, 0.5], [3.5, -3.5, 2.5]]
CEILING = [[3.5, 3.5, 2.6], [-3.5, 3.5, 2.6], [-3.5, -3.5, 2.6], [3.5, -3.5, 2.6]]
"""Places of antennas of anchors: low and high, and all in a plane."""

REPLY = 20_000_000
PAIRS = np.array([(1, 3), (2, 5), (4, 6), (1, 4), (2, 6), (3, 5), (1, 5), (2, 3), (4, 5), (1, 6), (2, 4), (3, 6)])


def place(body, t):
    """Return positions (n, 3) in metres of body 0, 1 or 2 at seconds (n,): two sines per axis about its own centre."""
    rng = np.random.default_rng(100 + body)
    period, phase = rng.uniform(4.0, 11.0, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))
    middle = [2.2 * np.cos(2.1 * body), 2.2 * np.sin(2.1 * body), 1.2 + 0.2 * body]
    size = np.array([0.8, 0.8, 0.5])
    return middle + 0.6 * size * np.sin(2 * np.pi * t[:, None, None] / period + phase).sum(axis=2)


def since_takeoff(t, standing_s):
    """Return seconds of flight (n,) at seconds (n,); bodies stand still at first and start gently."""
    flown = np.maximum(t - standing_s, 0.0)
    return flown - 0.8 * (1 - np.exp(-flown / 0.8)) if standing_s else t


def shake(body, t, size_m, rate_hz):
    """Return displacements (n, 3) in metres of a body that is shaken along all axes, at rates about the given one."""
    return size_m * np.sin(2 * np.pi * rate_hz * t[:, None] * np.array([1.0, 1.13, 0.91]) + body)


def heading(body, t):
    """Return headings (n,) in radians."""
    return body + 1.2 * np.sin(2 * np.pi * t / (13.0 + 2 * body))


def arm(tag, length_m=ARM):
    return np.array([1.0, -1.0, -0.2]) * length_m * (1 if tag % 2 else -1)


def distance_errors(result, flown):
    """Return errors of the estimated distances (n,) of a flight, in metres."""
    return result.ranges.truth_m - flown.distance_m[np.searchsorted(flown.exchanges.time_ns, result.ranges.time_ns)]


def scores(result):
    """Return errors of delays divided by the standard errors of their covariance, for tags on moving bodies."""
    found = result.calibration
    std = dict(zip(found.uncertainty.tags, np.sqrt(np.diag(found.uncertainty.delays_ns2)), strict=True))
    return np.array([(found.delays_ns[tag] - delay) / std[tag] for tag, delay in DELAYS_NS.items()])


@dataclass
class Flight:
    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    distance_m: np.ndarray
    planted: dict[str, Any] = field(default_factory=lambda: {"delays_ns": {str(t): d for t, d in DELAYS_NS.items()}})
    imu: dict[str, Any] = field(default_factory=dict)
    height: dict[str, Any] = field(default_factory=dict)
    antennas: Any = None


def bias(lifted):
    return 0.05 * np.sin(3 * lifted)


def flight(  # noqa: PLR0913 - what a flight may differ in
    seconds=24.0,
    rate=80,
    noise_m=0.04,
    reflected=0.08,
    seed=1,
    wander_deg=0.0,
    anchors=None,
    curve=bias,
    tilt_deg=0.0,
    place_noise_m=0.0,
    standing_s=0.0,
    height_off_m=None,
    arm_m=ARM,
    shaken=(0.0, 1.0),
    late_m=None,
    blocked=None,
):
    """Return a flight whose poses have noise in positions, and headings and tilts with errors that are sines of some
    degrees.

    `anchors` (k, 3) are the antennas of standing bodies, tags 11 and on, with their own delays; they range with each
    tag in turn. With `height_off_m`, bodies read their heights with this error and 3 cm of noise; during `standing_s`
    all stand still. `shaken` bodies also oscillate by some metres, some times a second; ranges of pairs in `late_m` are
    too long. If `blocked` is "bodies", most ranges between two bodies are half a metre too long in spells of two
    seconds; if it is "pairs", each pair has its own spells. `antennas(tags, seconds)` of the flight returns positions
    of antennas.
    """
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    t = 0.5 + np.arange(n) / rate
    pair = PAIRS[np.arange(n) % len(PAIRS)].copy()
    stand = {} if anchors is None else {11 + k: np.array(p, float) for k, p in enumerate(anchors)}
    if stand:
        rows = np.arange(n) % 3 > 0
        pair[rows, 0] = 11 + np.arange(rows.sum()) % len(stand)
        pair[rows, 1] = 1 + (np.arange(rows.sum()) * 5 // 3) % 6
    planted = DELAYS_NS | {tag: 0.1 * (-1) ** k for k, tag in enumerate(stand)}
    delay = np.array([planted.get(tag, 0.0) for tag in range(12 + len(stand))])

    def antenna(ids, seconds):
        found = np.zeros((len(ids), 3))
        for tag in np.unique(ids):
            rows = ids == tag
            body, when = (tag - 1) // 2, since_takeoff(seconds[rows], standing_s)
            found[rows] = (
                stand[tag]
                if tag in stand
                else place(body, when)
                + Rotation.from_euler("z", heading(body, when)[:, None]).apply(arm(tag, arm_m))
                + shake(body, when, *shaken)
            )
        return found

    distance = np.linalg.norm(antenna(pair[:, 0], t) - antenna(pair[:, 1], t), axis=1)
    fpp = -79 - 20 * np.log10(distance / 2) + rng.normal(0, 3, (2, n))
    error = curve(np.mean(10 ** ((fpp + 82) / 10), axis=0)) - curve(1.0) + noise_m * rng.normal(size=n)
    error += np.where(rng.random(n) < reflected, rng.exponential(0.3, n), 0)
    if blocked:
        both = np.sort((pair - 1) // 2 if blocked == "bodies" else pair, axis=1)
        spell = [hash((seed, *ends)) % 7 == 0 for ends in np.column_stack([both, t // 2]).astype(int).tolist()]
        error += np.where(np.array(spell) & (rng.random(n) < 0.8), rng.exponential(0.5, n), 0)
    for ends, late in (late_m or {}).items():
        error += late * (np.sort(pair, axis=1) == ends).all(axis=1)
    measured = distance + error - 0.5e-9 * SPEED_OF_LIGHT * (delay[pair[:, 0]] + delay[pair[:, 1]])
    there_and_back = np.rint(2 * measured / SPEED_OF_LIGHT / TICK_S).astype(np.int64)
    zero = np.zeros(n, np.int64)
    stamps = {"tx1": zero, "rx1": zero, "tx2": zero + REPLY, "rx2": there_and_back + REPLY}
    stamps |= {"tx3": zero + 2 * REPLY, "rx3": there_and_back + 2 * REPLY}
    exchanges = Exchanges.from_arrays(
        pair[:, 0],
        pair[:, 1],
        **stamps,
        time_ns=np.rint(t * 1e9).astype(np.int64),
        fpp1_dbm=fpp[0],
        fpp2_dbm=fpp[1],
    )
    half = REPLY * TICK_S / 2
    tags = [Tag(tag, f"robot{(tag - 1) // 2}", tuple(arm(tag, arm_m))) for tag in DELAYS_NS]
    tags += [Tag(tag, f"anchor{tag}", tuple(MAST)) for tag in stand]
    # Ranges belong to the middle of their first two messages, `half` later than their time.
    when = np.arange(0.0, seconds + 1.0, 0.02)
    poses_of: list[Any] = []
    for body in range(3):
        flown_s = since_takeoff(when - half, standing_s)
        yaw = heading(body, flown_s) + np.radians(wander_deg) * np.sin(2 * np.pi * when / 17.0 + body)
        tilt = np.radians(tilt_deg) * np.sin(2 * np.pi * when / (11.0 + body) + body)
        # Tilted about the x axis of the world.
        turned = Rotation.from_euler("x", tilt[:, None]) * Rotation.from_euler("z", yaw[:, None])
        seen = place(body, flown_s) + shake(body, flown_s, *shaken) + place_noise_m * rng.normal(size=(len(when), 3))
        poses_of.append((when, np.full(len(when), f"robot{body}"), seen, turned.as_quat()))
    for tag, here in stand.items():
        # Anchors are rotated about all axes, differently for each.
        turned = Rotation.from_euler("ZYX", [1.1 * tag, 0.4, -0.3])
        two = (np.tile(each, (2, 1)) for each in (here - turned.apply(MAST), turned.as_quat()))
        poses_of.append((np.array([0.0, seconds]), np.full(2, f"anchor{tag}"), *two))
    times, names, places, attitudes = map(np.concatenate, zip(*poses_of, strict=True))
    poses_time_ns = np.rint(times * 1e9).astype(np.int64)
    poses = Poses.from_arrays(poses_time_ns, names, places, attitudes)
    of_tags = {"delays_ns": {str(tag): value for tag, value in planted.items()}}
    flown = Flight(exchanges, poses, tags, distance, of_tags, antennas=antenna)
    if height_off_m is not None:
        # 50 readings per second of each body.
        robots = slice(0, 3 * len(when))
        up = [place(body, since_takeoff(when - half, standing_s))[:, 2] for body in range(3)]
        read_m = np.concatenate(up) + height_off_m + 0.03 * rng.normal(size=3 * len(when))
        flown.height = {"time_ns": poses_time_ns[robots], "body": names[robots], "height_m": read_m}
    return flown
