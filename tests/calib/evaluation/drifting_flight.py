"""Flights of a robot among anchors whose delays drift, in plain NumPy; shares no code with filters and simulator."""

from dataclasses import dataclass, field

import numpy as np

import uwblink

LIGHT = 0.299702547  # metres a nanosecond, in air
PLACES = np.array([[0, 0, 2.6], [7, 0.4, 0.3], [6.6, 6, 2.4], [0.2, 5.7, 0.4], [3.5, -0.5, 1.8], [3.2, 6.4, 2.2]])
ARMS = {1: (0.17, 0.12, 0.05), 2: (-0.16, -0.13, -0.08)}
DELAYS_NS = {1: 0.31, 2: -0.22, 11: 0.05, 12: -0.3, 13: 0.14, 14: -0.07, 15: 0.22, 16: -0.12}
NOISE_M, REFLECTED, DETOUR_M = 0.06, 0.1, 0.35


@dataclass
class DriftingFlight:
    """What `calib.fit` and `calib.localize` take, and the places (n, 3) of the antenna that begins each exchange."""

    exchanges: uwblink.Exchanges
    poses: uwblink.Poses
    tags: list
    antenna_m: np.ndarray
    meta: dict = field(default_factory=dict)

    def save(self, path):
        with uwblink.Recording.create(path) as recording:
            recording.append_tags(self.tags)
            recording.append_poses(self.poses)
            recording.append_exchanges(self.exchanges)
        return path


def place(time_s, seed):
    """Places (n, 3) and headings (n,) of the robot."""
    phases = np.random.default_rng([seed, 7]).uniform(0, 6, 6)
    wave = np.sin(np.outer(time_s, [0.62, 0.53, 0.44, 1.4, 1.1, 0.3]) + phases)
    xyz = (
        [3.4, 2.9, 1.3]
        + wave[:, :3] * [2.3, 2.1, 0.7]
        + wave[:, 3:4] * [0.3, 0.0, 0.1]
        + wave[:, 4:5] * [0.0, 0.3, 0.0]
    )
    return xyz, 2.5 * wave[:, 5] + 0.2 * time_s


def flight(seed, last_s=120.0, rate_hz=100, drift_m=None, only=()):
    """Ranges of both tags, or of `only` one, with anchors, and among these; linear in time, `drift_m` by tag at the end."""
    rng, count = np.random.default_rng(seed), int(last_s * rate_hz)
    time_s = 1 + np.arange(count) / rate_hz
    xyz, heading = place(time_s, seed)
    tags = np.array([*ARMS, *range(11, 17)])
    own, other = rng.integers(0, 2, count), rng.integers(2, 8, count)
    own = np.where(rng.random(count) < 0.2, 2 + (other - 2 + rng.integers(1, 6, count)) % 6, own)
    own = own * 0 + only[0] - 1 if only else own
    cos, sin = np.cos(heading), np.sin(heading)
    points = np.empty((count, 8, 3))
    for k, (x, y, z) in enumerate(ARMS.values()):
        points[:, k] = xyz + np.column_stack([cos * x - sin * y, sin * x + cos * y, np.full(count, z)])
    points[:, 2:] = PLACES
    rows, delay = np.arange(count), np.array([DELAYS_NS[tag] for tag in tags])
    distance = np.linalg.norm(points[rows, own] - points[rows, other], axis=1)
    change = np.array([(drift_m or {}).get(tag, 0.0) for tag in tags])
    share = (time_s - time_s[0]) / last_s
    range_m = distance - LIGHT * (delay[own] + delay[other]) / 2 + (change[own] + change[other]) * share
    range_m += NOISE_M * rng.normal(size=count) + (rng.random(count) < REFLECTED) * rng.exponential(DETOUR_M, count)
    stamps = dict.fromkeys(("tx1", "rx1", "tx2", "rx2"), np.zeros(count, dtype=int))
    ns = np.rint(time_s * 1e9).astype(np.int64)
    exchanges = uwblink.Exchanges.from_arrays(
        tags[own], tags[other], time_ns=ns, range_m=range_m, fpp1_dbm=-85.0, fpp2_dbm=-85.0, **stamps
    )
    pose_s = np.arange(0.5, last_s + 1.5, 0.01)
    xyz, heading = place(pose_s, seed)
    turned = np.column_stack([np.zeros((len(pose_s), 2)), np.sin(heading / 2), np.cos(heading / 2)])
    bodies = ["robot", *(f"anchor{tag}" for tag in range(11, 17))]
    poses = uwblink.Poses.from_arrays(
        np.tile(np.rint(pose_s * 1e9).astype(np.int64), 7),
        np.repeat(bodies, len(pose_s)),
        np.concatenate([xyz, np.repeat(PLACES, len(pose_s), axis=0)]),
        np.concatenate([turned, np.tile([0.0, 0, 0, 1], (6 * len(pose_s), 1))]),
    )
    known = [uwblink.Tag(tag, "robot", arm) for tag, arm in ARMS.items()]
    known += [uwblink.Tag(tag, f"anchor{tag}", (0.0, 0.0, 0.0)) for tag in range(11, 17)]
    return DriftingFlight(exchanges, poses, known, points[rows, own])
