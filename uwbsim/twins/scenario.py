"""The scenario of a twin: its tables, their text, and a list of properties that the recording does not determine."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc
from scipy.stats import circmean

from uwblink.arrays import Floats
from uwblink.recording.schema import Poses
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.loading import MOST_POSES
from uwbsim.scenario.radio import Radio, TwoStateMultipath
from uwbsim.twins.clocks import ClockFit
from uwbsim.twins.flight import SHORTEST_LIFE_S, ScheduleFit, TwinFlight, attitude, bulk_spread
from uwbsim.twins.powers import PowerFit
from uwbsim.twins.range_errors import FittedRangeErrors, KnownDevices
from uwbsim.world.clocks import NS_PER_S
from uwbsim.world.radio import lifted

SCENARIO_COLUMNS: Final = 120
"""Characters in a line of a scenario file."""

AFTER_S: Final = 0.2
"""Time from the start of the last exchange to the end of a scenario; exchanges take less."""


def scenario_text(tables: Mapping[str, Any], head: str) -> str:
    """Return the text of a scenario file: a comment, and tables; inner tables have dotted names."""
    parts = ["\n".join(f"# {line}" for line in textwrap.wrap(head, SCENARIO_COLUMNS - 2))]
    for name, table in tables.items():
        rows = table if isinstance(table, list) else [table]
        parts += [_text(f"[[{name}]]" if isinstance(table, list) else f"[{name}]", name, row) for row in rows]
    return "\n\n".join(parts) + "\n"


def _text(header: str, name: str, table: Mapping[str, Any]) -> str:
    inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    lines = [header, *(f"{key} = {_toml(value)}" for key, value in table.items() if key not in inner)]
    return "\n".join(lines) + "".join(f"\n\n{_text(f'[{name}.{k}]', f'{name}.{k}', v)}" for k, v in inner.items())


def _toml(value: Any) -> str:
    """Return a value as TOML; numbers have eight digits, each table of a list has its own line."""
    if isinstance(value, float):
        return repr(float(f"{value:.8g}"))
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + " }"
    if not isinstance(value, list | tuple):
        return json.dumps(value, ensure_ascii=False)
    items = [_toml(one) for one in value]
    if value and isinstance(value[0], Mapping):
        return "[\n  " + ",\n  ".join(items) + ",\n]"
    return textwrap.fill(f"[{', '.join(items)}]", SCENARIO_COLUMNS, subsequent_indent="  ", break_on_hyphens=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedFlight:
    """All values fitted to a flight.

    `noise_s` is the noise of receive stamps at the first-path powers `noise_dbm`: one value if it does not depend on
    power, none if it is unknown.
    """

    clocks: ClockFit
    noise_dbm: Floats
    noise_s: Floats
    errors: FittedRangeErrors
    powers: PowerFit
    schedule: ScheduleFit


def receive_noise(noise_s: Floats, power_dbm: Floats) -> tuple[Floats, Floats]:
    """Return powers in dBm, and the standard deviation of receive stamps at these powers, in seconds.

    `noise_s` (n,) are errors of receive stamps, NaN if unknown, and `power_dbm` (n,) the powers of these receptions.
    The result has the form of `FittedFlight`.
    """
    rows = np.flatnonzero(np.isfinite(noise_s))
    if not len(rows):
        return np.zeros(0), np.zeros(0)
    rows = rows[np.abs(noise_s[rows]) < 5 * bulk_spread(noise_s[rows])]
    rows = rows[np.argsort(power_dbm[rows], kind="stable")]
    # At most six bins with at least 200 values each, whose standard deviations are known to 5 %.
    parts = np.array_split(rows, int(np.clip(len(rows) // 200, 1, 6)))
    std, together = (np.array([np.sqrt(np.mean(noise_s[own] ** 2)) for own in some]) for some in (parts, [rows]))
    # Chi-square test of equal standard deviations: the logarithm of each has the standard error 1/sqrt(2n).
    chi_square = np.sum([2 * len(own) for own in parts] * np.log(std / together) ** 2)
    if chdtrc(len(parts) - 1, chi_square) > 0.01:
        parts, std = [rows], together
    middle, first = np.unique([np.round(np.median(power_dbm[own]), 3) for own in parts], return_index=True)
    return middle, std[first]


def tables(
    flight: TwinFlight, known: KnownDevices, poses: Poses, fitted: FittedFlight, name: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tables of the scenario, and by body the poses of its `recorded` motions."""
    schedule = fitted.schedule
    whole = (len(schedule.time_s) + 0.3) / schedule.rate_hz
    duration = whole if schedule.turns is not None else float(schedule.time_s[-1]) + AFTER_S
    bodies, paths = _bodies(flight, poses, duration)
    steps = [np.diff(poses.time_ns[poses.body == tag.body]) for tag in flight.tags]
    rates = [round(NS_PER_S / float(np.median(step)), 3) for step in steps if len(step) > 1]
    table = {
        "run": {"name": name, "seed": 1, "duration_s": duration},
        "ranging": _ranging(flight, schedule),
        "radio": _radio(flight, known, fitted),
        "mocap": {"rate_hz": rates[0] if rates else 100.0},
        "bodies": bodies,
        "tags": [_tag(flight, known, fitted, k) for k in range(len(flight.tags))],
    }
    return table, paths


def _given(**table: Any) -> dict[str, Any]:
    """Return a table without the keys whose value is None; these have their defaults in the scenario."""
    return {key: value for key, value in table.items() if value is not None}


def _ranging(flight: TwinFlight, schedule: ScheduleFit) -> dict[str, Any]:
    ids, plan = np.array([tag.tag for tag in flight.tags]), None
    turns = np.unique(schedule.ends, axis=1) if schedule.turns is None else schedule.turns
    if schedule.turns is None:
        columns = zip(schedule.time_s.tolist(), *ids[schedule.ends].tolist(), strict=True)
        plan = {"file": "", "slots": [(round(time_s, 6), i, j) for time_s, i, j in columns]}
    replies = schedule.replies_us
    return _given(
        protocol=flight.row.name,
        rate_hz=schedule.rate_hz,
        pairs=ids[turns.T].tolist(),
        response_delay_uus=schedule.delay_uus,
        reply=None if replies is None else {"model": "quantiles", "delays_us": list(replies)},
        plan=plan,
    )


def _radio(flight: TwinFlight, known: KnownDevices, fitted: FittedFlight) -> dict[str, Any]:
    powers, clocks, schedule, noise_s = fitted.powers, fitted.clocks, fitted.schedule, fitted.noise_s
    sigma, fading, outages = None, None, None
    if len(noise_s) > 1:
        at = lifted(fitted.noise_dbm)
        # The key `sigma` is the standard deviation of a range without reply time, c s / sqrt(2).
        spread = SPEED_OF_LIGHT * noise_s / np.sqrt(2)
        sigma = {"knots": [at[0], *at.tolist(), at[-1]], "coefficients": spread.tolist(), "degree": 1}
    # Smaller fading has no significant effect on first paths and bias (a judgement).
    if powers.fading_db >= 0.1:
        life_s = None if powers.fading_life_s is None else max(powers.fading_life_s, SHORTEST_LIFE_S)
        fading = _given(levels_db=powers.fading_levels_db.tolist(), life_s=life_s)
    if schedule.lost_share > 0:
        outages = {"share": schedule.lost_share, "life_s": max(schedule.outage_life_s, SHORTEST_LIFE_S)}
    return _given(
        first_path_at_1m_dbm=powers.at_1m_dbm,
        path_loss_exponent=None if powers.exponent is None else max(powers.exponent, 0.0),
        antenna=powers.antenna,
        power_noise_db=powers.noise_db,
        saturation_dbm=powers.saturation_dbm,
        sensitivity_dbm=min(Radio().sensitivity_dbm, float(flight.power_dbm.min()) - 1),
        skew_noise_ppm=float(clocks.noise_ppm[1]),
        skew_bias_ppm=float(clocks.bias_ppm[1]),
        bias=known.bias.model_dump(mode="json"),
        rx_noise_ps=float(noise_s[0]) * 1e12 if len(noise_s) == 1 else 0.0,
        sigma=sigma,
        multipath=_multipath(flight, fitted),
        fading=fading,
        outages=outages,
    )


def _multipath(flight: TwinFlight, fitted: FittedFlight) -> dict[str, Any] | None:
    found, loss = fitted.errors, fitted.powers.reflection_loss_db
    if found.share < 0.002 and found.direct_std_m == 0:
        return None
    default = TwoStateMultipath(model="two-state")
    # Without correlation of consecutive ranges, paths change faster than a pair ranges.
    life_s = min(default.life_s, flight.interval_s / 3) if found.life_s is None else found.life_s
    # Pairs with an undetermined duration have that of all pairs.
    lives = np.maximum(np.nan_to_num(found.pair_life_s, nan=life_s), SHORTEST_LIFE_S)
    columns = (np.clip(found.pair_share, 0, 1), found.pair_excess_m, lives)
    pairs = zip(flight.pairs, *(column.tolist() for column in columns), strict=True)
    return _given(
        model="two-state",
        share=found.share,
        mean_excess_m=found.mean_excess_m,
        excess_shape=found.excess_shape,
        direct_std_m=found.direct_std_m,
        life_s=max(life_s, SHORTEST_LIFE_S),
        first_path_loss_db=loss,
        loss_std_db=None if loss is None else fitted.powers.reflection_loss_std_db,
        total_loss_db=None if loss is None else min(default.total_loss_db, loss),
        pairs=[
            {"tags": list(p), "share": share, "mean_excess_m": mean, "life_s": own} for p, share, mean, own in pairs
        ],
    )


def _tag(flight: TwinFlight, known: KnownDevices, fitted: FittedFlight, k: int) -> dict[str, Any]:
    tag, clocks, powers = flight.tags[k], fitted.clocks, fitted.powers
    pattern = powers.pattern_db[k]
    return _given(
        id=tag.tag,
        body=tag.body,
        lever_arm_m=list(tag.lever_arm_m),
        delay_ns=known.calibration.delays_ns[tag.tag] + fitted.errors.delays_ns[tag.tag],
        skew_ppm=float(np.clip(clocks.skew_ppm[k], -100, 100)),
        drift_ppm_per_sqrt_s=float(clocks.walk_ppm_per_sqrt_s[k]),
        tx_power_db=float(powers.tx_db[k]),
        power_offset_db=float(powers.offset_db[k]),
        warm_up_ppm=None if clocks.warm_up_s is None else float(clocks.warm_up_ppm[k]),
        warm_up_s=clocks.warm_up_s,
        pattern_db=pattern.tolist() if np.any(pattern) else None,
    )


def _bodies(flight: TwinFlight, poses: Poses, duration_s: float) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the tables of the bodies, and the poses of moving bodies from the origin to `AFTER_S` after the end."""
    found, paths = [], {}
    for body in dict.fromkeys(tag.body for tag in flight.tags):
        mine = poses[np.flatnonzero(poses.body == body)]
        still = _still(mine)
        if still is not None:
            found.append({"name": body, "motion": {"model": "static"} | still})
            continue
        cut = _cut(mine, flight.origin_ns, duration_s)
        paths[body] = cut
        motion = {
            "model": "recorded",
            "file": "",
            "body": body,
            "times_s": ((cut.time_ns - cut.time_ns[0]) * 1e-9).tolist(),
            "positions_m": cut.position_m.tolist(),
            "quaternions": cut.quaternion.tolist(),
        }
        found.append({"name": body, "motion": motion})
    return found, paths


def _still(mine: Poses) -> dict[str, Any] | None:
    """Return position and heading of a body that stands still and level (within 1 cm and 0.01 rad), else None."""
    middle = np.median(mine.position_m, axis=0)
    turns = attitude(mine, str(mine.body[0]), mine.time_ns)
    heading = circmean(turns.as_euler("ZYX")[:, 0], high=np.pi, low=-np.pi)
    off = (Rotation.from_euler("Z", heading).inv() * turns).magnitude()
    if np.max(np.linalg.norm(mine.position_m - middle, axis=1)) > 0.01 or off.max() > 0.01:
        return None
    return {"position_m": [float(v) for v in middle], "yaw_deg": float(np.degrees(heading))}


def _cut(mine: Poses, origin_ns: int, duration_s: float) -> Poses:
    """Return as many poses as recorded in the flight, at equal intervals, constant beyond the recorded ones."""
    times, rows = np.unique(mine.time_ns, return_index=True)
    last = origin_ns + int((duration_s + AFTER_S) * NS_PER_S)
    count = int(np.clip(np.count_nonzero((times > origin_ns) & (times < last)) + 2, 2, MOST_POSES))
    wanted = np.linspace(origin_ns, last, count).astype(np.int64)
    position = np.column_stack([np.interp(wanted, times, column) for column in mine.position_m[rows].T])
    body = str(mine.body[0])
    return Poses(wanted, np.full(count, body), position, attitude(mine, body, wanted).as_quat())


NOT_DETERMINED: Final = (
    "The common rate of all clocks: skew_ppm is relative to their mean at the start, on which no range depends.",
    "White and flicker noise of clocks (white_ppm_sqrt_s, flicker_ppm: none): in a flight they cannot be separated "
    "from noise of stamps and a random walk of the rate.",
    "Noise of transmit stamps (tx_noise_ps: none): it is included in that of receive stamps.",
    "The split of a delay into transmission and reception: 0.44 to 0.56.",
    "Effects of reflections on total power and on impulse responses (total_loss_db, rise_ns).",
    "The split of a tag's power offsets between antenna, transmitter and receiver: a difference between the two "
    "directions is assigned to transmitter or receiver (none for the median tag), the rest to the antenna.",
    "Limits of reception: sensitivity_dbm is the default or just below the weakest reading; capture_db and "
    "dynamic_range_db have their defaults.",
    "Errors of poses: recorded poses are taken as true, so their errors are included in direct_std_m.",
    "Walls, obstacles and shadows of bodies: their effects are included in antennas, fading and reflections of pairs, "
    "and do not change with other trajectories.",
)

NOT_DETERMINED_IF: Final[tuple[tuple[Callable[[TwinFlight, FittedFlight], bool], str], ...]] = (
    (
        lambda flight, fitted: not len(fitted.noise_s),
        "Noise of stamps apart from that of ranges: only a third message from the target shows it. All noise of ranges "
        "is assigned to direct_std_m, which is constant between redraws of a path.",
    ),
    (
        lambda flight, fitted: abs(fitted.clocks.bias_ppm[0]) > 0.02,
        "The difference of {ratio_bias:+.2g} ppm between dt64/dt53 and the carrier readings: a scenario has no key "
        "for it.",
    ),
    (
        lambda flight, fitted: fitted.errors.life_s is None and fitted.errors.share > 0,
        "The duration of reflections (life_s): a pair ranges every {interval:.2g} s, and consecutive ranges show no "
        "correlation.",
    ),
    (
        lambda flight, fitted: fitted.powers.exponent is None,
        "The path-loss exponent: distances differ too little.",
    ),
    (
        lambda flight, fitted: fitted.powers.fading_db >= 0.1 and fitted.powers.fading_life_s is None,
        "The duration of fading (radio.fading.life_s): a pair ranges every {interval:.2g} s.",
    ),
    (
        lambda flight, fitted: fitted.powers.reflection_loss_db is None,
        "The loss of reflections: there are too few.",
    ),
    (
        lambda flight, fitted: fitted.powers.pattern_db.shape[1] == 1,
        "Antenna patterns of tags: each has too few readings.",
    ),
    (
        lambda flight, fitted: fitted.schedule.lost_share == 0,
        "The share of failed exchanges: the recording has none, and no gaps in a round robin.",
    ),
)


def unknowns(flight: TwinFlight, fitted: FittedFlight) -> Iterator[str]:
    """Yield a sentence for each property that the recording does not determine."""
    interval = flight.interval_s
    for applies, text in NOT_DETERMINED_IF:
        if applies(flight, fitted):
            yield text.format(interval=interval, ratio_bias=fitted.clocks.bias_ppm[0])
    yield from NOT_DETERMINED
