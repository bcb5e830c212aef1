"""Inertial readings of bodies that move by formulas; they share no code with filters."""

import numpy as np


def readings(place, attitude, t):
    """Return angular velocity and specific force (n, 6) in the frame of a body, by differences of attitudes and
    places.
    """
    turning = (attitude(t - 5e-6).inv() * attitude(t + 5e-6)).as_rotvec() / 1e-5
    bend = (place(t + 1e-3) - 2 * place(t) + place(t - 1e-3)) / 1e-6
    return np.hstack([turning, attitude(t).inv().apply(bend + np.array([0.0, 0.0, 9.81]))])


def table(time_ns, bodies, read):
    """Return the table of readings (bodies * n, 6) of a recording, at the same times (n,) for all bodies."""
    columns = dict(zip(("wx", "wy", "wz", "ax", "ay", "az"), read.T, strict=True))
    return {"time_ns": np.tile(time_ns, len(bodies)), "body": np.repeat(bodies, len(time_ns)), **columns}
