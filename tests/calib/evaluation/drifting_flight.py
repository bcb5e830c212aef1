"""Flights of a robot among anchors with drifting delays, in plain NumPy; shares no code with filters and simulator."""

import numpy as np

from uwblink import Contents, Exchanges, Poses, Tag

LIGHT = 0.299702547  # metres per nanosecond, in air
PLACES = np.array([[0, 0, 2.6], [7, 0.4, 0.3], [6.6, 6, 2.4], [0.2, 5.7, 0.4], [3.5, -0.5, 1.8], [3.2, 6.4, 2.2]])
ARMS = np.array([[0.17, 0.12, 0.05], [-0.16, -0.13, -0.08]])
DELAYS_NS = {1: 0.31, 2: -0.22, 11: 0.05, 12: -0.3, 13: 0.14, 14: -0.07, 15: 0.22, 16: -0.12}
TAGS = np.array([*DELAYS_NS])
BODIES = ["robot", "robot", *(f"anchor{tag}" for tag in range(11, 17))]


def place(time_s, seed):
    """Return the positions (n, 3) of the robot, which does not turn."""
    phases = np.random.default_rng([seed, 7]).uniform(0, 6, 5)
    wave = np.sin(np.outer(time_s, [0.62, 0.53, 0.44, 1.4, 1.1]) + phases)
    return [3.4, 2.9, 1.3] + wave @ [[2.3, 0, 0], [0, 2.1, 0], [0, 0, 0.7], [0.3, 0, 0.1], [0, 0.3, 0]]


def flight(seed, last_s=120.0, rate_hz=100, drift_m=None, only=None, offset_m=0.0):
    """Return a recording, and the position (n, 3) of the initiator's antenna in each exchange: of the robot, or in one
    of five, of an anchor.

    Ranges have noise of 6 cm; a tenth is reflected, by 35 cm on average. Ranges of a tag drift linearly, by `drift_m`
    at the end. `only` is the tag of the robot that ranges, by default both and the anchors. Ranges of a pair have a
    constant error with the standard deviation `offset_m`.
    """
    rng, count = np.random.default_rng(seed), int(last_s * rate_hz)
    time_s, rows = 1 + np.arange(count) / rate_hz, np.arange(count)
    own, other = rng.integers(0, 2, count), rng.integers(2, 8, count)
    own = np.where(rng.random(count) < 0.2, 2 + (other - 2 + rng.integers(1, 6, count)) % 6, own)
    own = np.full(count, only - 1) if only else own
    points = np.tile(np.concatenate([ARMS, PLACES]), (count, 1, 1))
    points[:, :2] += place(time_s, seed)[:, None]
    longer = np.array([(drift_m or {}).get(tag, 0.0) for tag in TAGS]) * ((time_s - 1) / last_s)[:, None]
    longer -= np.array([*DELAYS_NS.values()]) * LIGHT / 2
    range_m = np.linalg.norm(points[rows, own] - points[rows, other], axis=1) + 0.06 * rng.normal(size=count)
    range_m += longer[rows, own] + longer[rows, other] + (rng.random(count) < 0.1) * rng.exponential(0.35, count)
    offsets_m = offset_m * np.triu(np.random.default_rng([seed, 11]).normal(size=(8, 8)))
    range_m += (offsets_m + offsets_m.T)[own, other]
    columns = dict.fromkeys(("tx1", "rx1", "tx2", "rx2"), np.zeros(count, dtype=int)) | {"range_m": range_m}
    pose_s = np.arange(0.5, last_s + 1.5, 0.01)
    return Contents(
        exchanges=Exchanges.from_arrays(
            TAGS[own], TAGS[other], fpp1_dbm=-85.0, fpp2_dbm=-85.0, time_ns=np.rint(time_s * 1e9).astype(int), **columns
        ),
        tags=[
            Tag(*one)
            for one in zip(TAGS.tolist(), BODIES, [*map(tuple, ARMS.tolist()), *[(0.0,) * 3] * 6], strict=True)
        ],
        poses=Poses.from_arrays(
            np.tile(np.rint(pose_s * 1e9).astype(int), 7),
            np.repeat(BODIES[1:], len(pose_s)),
            np.concatenate([place(pose_s, seed), np.repeat(PLACES, len(pose_s), axis=0)]),
        ),
    ), points[rows, own]
