"""Smooth a flight with GTSAM: positions and drifting antenna delays, from odometry and ranges with reflections."""

import gtsam
import numpy as np

import calib
from calib.factors import Antenna, range_factor
from calib.online import DelayStates, RangeUpdate


def smooth(ranges, known, anchors_m, moves_m, std_m, robot=1):
    """Return positions (n, 3), changes of delays (n, tags) and their error; `moves_m` (n, 3) begin with the start."""
    states, updates = DelayStates.of(known, ranges.tags()), RangeUpdate.of(known, ranges)
    graph, guess, fixed = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.zeros(len(states.tags))
    moved = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-3, std_m], 3))  # rotation, translation
    x, d = ([gtsam.symbol(name, k) for k in range(len(ranges))] for name in "xd")
    for k, place_m in enumerate(np.cumsum(moves_m, axis=0)):
        ends = (Antenna(np.zeros(3), x[k]) if tag == robot else Antenna(anchors_m[tag]) for tag in updates.ends[k])
        graph.add(range_factor(updates.at([k]), states, d[k], *ends))
        guess.insert(x[k], gtsam.Pose3(gtsam.Rot3(), place_m))
        guess.insert(d[k], fixed)
    graph.add(gtsam.PriorFactorPose3(x[0], guess.atPose3(x[0]), moved))
    graph.add(gtsam.PriorFactorVector(d[0], fixed, gtsam.noiseModel.Gaussian.Covariance(states.covariance_m2)))
    for k, elapsed_ns in enumerate(np.diff(ranges.time_ns), 1):
        walk = gtsam.noiseModel.Isotropic.Sigma(len(fixed), states.walk_m * np.sqrt(1e-9 * elapsed_ns))
        graph.add(gtsam.BetweenFactorPose3(x[k - 1], x[k], gtsam.Pose3(gtsam.Rot3(), moves_m[k]), moved))
        graph.add(gtsam.BetweenFactorVector(d[k - 1], d[k], fixed, walk))
    best = gtsam.LevenbergMarquardtOptimizer(graph, guess).optimize()
    places_m = np.array([best.atPose3(key).translation() for key in x])
    return places_m, np.array([best.atVector(key) for key in d]), graph.error(best)


if __name__ == "__main__":
    known, flight = calib.fit(calib.sample_flight(anchors=True)).calibration, calib.sample_flight(seed=2, anchors=True)
    ranges = calib.load_ranges(flight)[flight.exchanges.initiator == 1]
    true_m = {tag: flight.poses.position_m[flight.poses.body == f"robot{tag}"] for tag in ranges.tags()}
    moving_m = true_m[1][ranges.time_ns // 10**7]  # poses come every 10 ms
    moves_m = np.diff(moving_m, axis=0, prepend=0.0) + np.random.default_rng(3).normal(0, 0.02, moving_m.shape)
    off_m = smooth(ranges, known, {tag: at[0] for tag, at in true_m.items()}, moves_m, 0.02)[0] - moving_m
    print(f"off by {100 * np.sqrt(np.mean(np.sum(off_m**2, axis=1))):.1f} cm rms")
