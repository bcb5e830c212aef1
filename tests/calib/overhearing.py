"""Tags that stand still, range in turn and overhear each other, by NumPy alone."""

import numpy as np

from uwblink import Contents, Exchanges, Poses, Tag

C, TICK = 299_702_547.0, 1 / (128 * 499.2e6)
REPLY_S, THIRD_S = 0.4e-3, 1.5e-3


def flight(seed, *, tags=6, count=1500, noise_ns=0.15, pairs=None, listeners=None, reflected=0.0, bias_m=0.0):
    """Return a recording and the planted delays in ns (tags,), which are delays of reception: stamps are earlier by
    them.

    Every reception has normal noise; a share is `reflected` by 0.03 m plus an exponential detour of 0.3 m; the bias
    changes from plus to minus `bias_m` with power.
    """
    g = np.random.default_rng(seed)
    place, delay_ns = g.uniform(0, 8, (tags, 3)), g.normal(0, 0.3, tags)
    rate, offset = 1 + g.normal(0, 5e-6, tags), g.uniform(0, 0.06, tags)
    pairs = pairs or [(i, j) for i in range(tags) for j in range(tags) if i != j]
    i, j = np.array([pairs[k % len(pairs)] for k in range(count)]).T
    flight_s = np.linalg.norm(place[:, None] - place[None], axis=2) / C

    def stamp(tag, t):
        return np.rint((offset[tag] + rate[tag] * t) / TICK).astype(np.int64) & (2**32 - 1)

    def receive(sender, tag, t):
        detour = np.where(g.random(len(t)) < reflected, 0.03 + g.exponential(0.3, len(t)), 0.0) / C
        power = -82 - 20 * np.log10(np.maximum(flight_s[sender, tag] * C, 1) / 4) + g.normal(0, 4, len(t))
        late = g.normal(0, noise_ns * 1e-9, len(t)) + detour - 1e-9 * delay_ns[tag]
        late -= bias_m * np.tanh((power + 84) / 4) / C
        return t + flight_s[sender, tag] + late, power

    poll = 1.0 + 0.01 * np.arange(count)
    at_target, fpp1 = receive(i, j, poll)
    response = at_target + REPLY_S
    at_initiator, fpp2 = receive(j, i, response)
    final = response + THIRD_S
    stamps = {"tx1": stamp(i, poll), "rx1": stamp(j, at_target), "tx2": stamp(j, response)}
    stamps |= {"rx2": stamp(i, at_initiator), "tx3": stamp(j, final), "rx3": stamp(i, receive(j, i, final)[0])}
    time_ns = np.rint(poll * 1e9).astype(np.int64)
    exchanges = Exchanges.from_arrays(i, j, **stamps, protocol="ds", time_ns=time_ns, fpp1_dbm=fpp1, fpp2_dbm=fpp2)
    parts = []
    for k in range(tags) if listeners is None else listeners:
        rows = np.flatnonzero((i != k) & (j != k))
        me = np.full(len(rows), k)
        columns = {"time_ns": time_ns[rows], "listener": me, "initiator": i[rows], "target": j[rows]}
        columns |= {f"{name}_n": column[rows] for name, column in stamps.items()}
        for n, (sender, sent) in enumerate(((i, poll), (j, response), (j, final)), 1):
            heard, power = receive(sender[rows], me, sent[rows])
            columns |= {f"rx{n}": stamp(me, heard), f"fpp{n}_dbm": power, f"skew{n}_ppm": np.full(len(rows), np.nan)}
        parts.append(columns)
    overheard = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}
    ends_ns = np.array([0, int(1e9 * poll[-1]) + 10**9])
    names = np.array([f"mast {k}" for k in range(tags)])
    poses = Poses.from_arrays(np.repeat(ends_ns, tags), np.tile(names, 2), np.tile(place, (2, 1)))
    mounted = [Tag(k, name, (0.0, 0.0, 0.0)) for k, name in enumerate(names.tolist())]
    return Contents(exchanges=exchanges, tags=mounted, poses=poses, overheard=overheard), delay_ns


def _rows(i, j, tags, *, listening=True):
    """Return errors of receptions (rows, 3 + 3 k) and delays (rows, tags) in a range and in what k others overhear of
    it.

    Errors of stamps are propagated to first order, with the rate of the target's clock from its two transmissions.
    """
    share, others = REPLY_S / THIRD_S, [k for k in range(tags) if k not in (i, j)] if listening else []
    errors, slopes = np.zeros((1 + len(others), 3 + 3 * len(others))), np.zeros((1 + len(others), tags))
    errors[0, :3] = 0.5, 0.5 * (1 + share), -0.5 * share
    slopes[0, [i, j]] = -0.5
    for row in range(1, 1 + len(others)):
        errors[row, 0] = 1
        errors[row, 3 * row : 3 * row + 3] = -1, 1 + share, -share
        slopes[row, j] = -1
    return errors, slopes


def bound_ns2(pairs, tags, *, count=1500, noise_ns=0.15, listening=True):
    """Return the Cramer-Rao bound (tags, tags) of delays in ns^2, from ranges and from what all others overhear."""
    known = np.zeros((tags, tags))
    for i, j in (pairs[k % len(pairs)] for k in range(count)):
        errors, slopes = _rows(i, j, tags, listening=listening)
        known += slopes.T @ np.linalg.solve(errors @ errors.T * noise_ns**2, slopes)
    return np.linalg.inv(known)


def least_squares_ns(data, tags=6):
    """Return the delays (tags,) in ns by generalised least squares from the stamps of a whole flight."""
    e, h = data.exchanges, data.overheard
    at = np.array([data.poses.position_m[data.poses.body == f"mast {k}"][0] for k in range(tags)])
    far_s = np.linalg.norm(at[:, None] - at[None], axis=2) / C

    def span(later, earlier):
        return ((later - earlier) & (2**32 - 1)) * TICK

    i, j, k, row = e.initiator, e.target, h["listener"], np.searchsorted(e.time_ns, h["time_ns"])
    ratio = span(e.rx3, e.rx2) / span(e.tx3, e.tx2)
    error = (span(e.rx2, e.tx1) - ratio * span(e.tx2, e.rx1)) / 2 - far_s[i, j]
    rate = span(h["tx3_n"], h["tx2_n"]) / span(h["rx3"], h["rx2"])
    late = rate * span(h["rx2"], h["rx1"]) - span(h["tx2_n"], h["rx1_n"])
    heard = np.zeros((len(e), tags))
    heard[row, k] = late - (far_s[i[row], j[row]] + far_s[j[row], k] - far_s[i[row], k])
    known, pulled = np.zeros((tags, tags)), np.zeros(tags)
    for one, (first, second) in enumerate(zip(i, j, strict=True)):
        errors, slopes = _rows(first, second, tags)
        weighed = np.linalg.solve(errors @ errors.T, slopes)
        known += weighed.T @ slopes
        pulled += weighed.T @ np.append(error[one], np.delete(heard[one], [first, second]))
    return 1e9 * np.linalg.solve(known, pulled)
