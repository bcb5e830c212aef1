"""The scenario of a twin: its tables from fitted values, their text, and what the recording does not determine."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.special import chdtrc

from uwblink.arrays import Bools, Floats
from uwblink.recording.schema import Poses
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.loading import MOST_POSES
from uwbsim.scenario.radio import Radio, TwoStateMultipath
from uwbsim.twins.clocks import ClockFit
from uwbsim.twins.flight import SHORTEST_LIFE_S, Flight, ScheduleFit, attitude, bulk_spread
from uwbsim.twins.powers import PowerFit
from uwbsim.twins.range_errors import KnownDevices, RangeErrors
from uwbsim.world.clocks import NS_PER_S
from uwbsim.world.radio import lifted

WIDTH: Final = 120
"""Columns of a line of a scenario file."""

AFTER_S: Final = 0.2
"""Time that a scenario lasts beyond the start of its last exchange, which takes less."""


def scenario_text(table: Mapping[str, Any], head: str) -> str:
    """Return the text of a scenario file: a comment and its tables; long values have a table of their own."""
    parts = ["\n".join(f"# {line}" for line in textwrap.wrap(head, WIDTH - 2))]
    for name, section in table.items():
        if isinstance(section, list):
            parts += [f"[[{name}]]\n{_lines(one)}" for one in section]
            continue
        long = {k: v for k, v in section.items() if isinstance(v, Mapping) and len(_toml(v)) > WIDTH // 2}
        parts.append(f"[{name}]\n{_lines({k: v for k, v in section.items() if k not in long})}")
        parts += [f"[{name}.{key}]\n{_lines(value)}" for key, value in long.items()]
    return "\n\n".join(parts) + "\n"


def _lines(section: Mapping[str, Any]) -> str:
    return "\n".join(f"{key} = {_toml(value)}" for key, value in section.items())


def _toml(value: Any) -> str:
    """Return a value as TOML: numbers with eight digits, lists wrapped; what is long in a list has its own line."""
    if isinstance(value, float):
        text = f"{value:.8g}"
        return text if "." in text or "e" in text else f"{text}.0"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + " }"
    if not isinstance(value, list | tuple):
        return json.dumps(value)
    items = [_toml(one) for one in value]
    line = f"[{', '.join(items)}]"
    if len(line) <= WIDTH:
        return line
    lines = [""]
    for item in items:
        if len(lines[-1]) + len(item) + 2 > WIDTH - 2 and lines[-1]:
            lines.append("")
        lines[-1] += f"{item}, "
    return "[\n" + textwrap.indent("\n".join(one.rstrip() for one in lines), "  ") + "\n]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """All that was fitted to a flight."""

    clocks: ClockFit
    noise: ReceiveNoise
    errors: RangeErrors
    powers: PowerFit
    schedule: ScheduleFit


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiveNoise:
    """The noise of receive stamps in seconds over first-path power in dBm; one value where it does not depend on it."""

    power_dbm: Floats
    std_s: Floats

    def at(self, power_dbm: Floats) -> Floats:
        """Return the noise at powers, linear in lifted power between those that are known."""
        if not len(self.std_s):
            return np.zeros_like(power_dbm)
        return np.asarray(np.interp(lifted(power_dbm), lifted(self.power_dbm), self.std_s))


def receive_noise(flight: Flight, clocks: ClockFit) -> ReceiveNoise:
    """Return the noise of receive stamps from ratios, by the power at their receiver, the initiator."""
    noise, power = clocks.receive_noise_s(flight), flight.exchanges.fpp2_dbm
    good = np.isfinite(noise)
    if not good.any():
        return ReceiveNoise(power_dbm=np.zeros(0), std_s=np.zeros(0))
    noise, power = noise[good], power[good]
    keep = np.abs(noise) < 5 * bulk_spread(noise)
    noise, power = noise[keep], power[keep]
    # Six bins at most, of 200 values or more each: their spreads are known to 5 %.
    count = int(np.clip(len(noise) // 200, 1, 6))
    parts = np.array_split(np.argsort(power, kind="stable"), count)
    std = np.array([np.sqrt(np.mean(noise[rows] ** 2)) for rows in parts])
    size = np.array([len(rows) for rows in parts])
    together = float(np.sqrt(np.mean(noise**2)))
    # The logarithm of a spread has the standard error 1/sqrt(2n).
    misfit = float(np.sum(2 * size * np.log(std / together) ** 2))
    if count == 1 or chdtrc(count - 1, misfit) > 0.01:
        return ReceiveNoise(power_dbm=np.array([np.median(power)]), std_s=np.array([together]))
    middle = np.array([np.median(power[rows]) for rows in parts])
    distinct = np.append(True, np.diff(middle) > 1e-3)
    return ReceiveNoise(power_dbm=middle[distinct], std_s=std[distinct])


def tables(
    flight: Flight, known: KnownDevices, poses: Poses, fitted: Fitted, name: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the scenario's tables, and the poses by body that its `recorded` motions stand for."""
    duration = float(fitted.schedule.time_s[-1]) + AFTER_S
    if fitted.schedule.regular:
        duration = (len(fitted.schedule.time_s) + 0.3) / fitted.schedule.rate_hz
    bodies, paths = _bodies(flight, poses, duration)
    steps = [np.diff(poses.time_ns[poses.body == tag.body]) for tag in flight.tags]
    rates = [round(NS_PER_S / float(np.median(step)), 3) for step in steps if len(step) > 1]
    table = {
        "run": {"name": name, "seed": 1, "duration_s": duration},
        "ranging": _ranging(flight, fitted.schedule),
        "radio": _radio(flight, known, fitted),
        "mocap": {"rate_hz": rates[0] if rates else 100.0},
        "bodies": bodies,
        "tags": [_tag(flight, known, fitted, k) for k in range(len(flight.tags))],
    }
    return table, paths


def _given(**table: Any) -> dict[str, Any]:
    """Return a table without the values that are None, which keep their defaults."""
    return {key: value for key, value in table.items() if value is not None}


def _ranging(flight: Flight, schedule: ScheduleFit) -> dict[str, Any]:
    ids, plan = [tag.tag for tag in flight.tags], None
    if not schedule.regular:
        columns = zip(schedule.time_s.tolist(), schedule.initiator.tolist(), schedule.target.tolist(), strict=True)
        plan = {"file": "", "slots": [(round(t, 6), ids[i], ids[j]) for t, i, j in columns]}
    replies = schedule.replies_us
    return _given(
        protocol=flight.row.name,
        rate_hz=schedule.rate_hz,
        pairs=[[ids[i], ids[j]] for i, j in schedule.turns],
        response_delay_uus=schedule.delay_uus,
        reply=None if replies is None else {"model": "quantiles", "delays_us": list(replies)},
        plan=plan,
    )


def _radio(flight: Flight, known: KnownDevices, fitted: Fitted) -> dict[str, Any]:
    powers, clocks, schedule, noise = fitted.powers, fitted.clocks, fitted.schedule, fitted.noise
    sigma, fading, outages = None, None, None
    if len(noise.std_s) > 1:
        at = lifted(noise.power_dbm)
        # A range whose reply takes no time has c s / sqrt(2).
        spread = SPEED_OF_LIGHT * noise.std_s / np.sqrt(2)
        sigma = {"knots": [at[0], *at.tolist(), at[-1]], "coefficients": spread.tolist(), "degree": 1}
    # Less fading moves no first path and hardly a bias.
    if powers.fading_db >= 0.1:
        life_s = None if powers.fading_life_s is None else max(powers.fading_life_s, SHORTEST_LIFE_S)
        fading = _given(levels_db=powers.fading_levels_db.tolist(), life_s=life_s)
    if schedule.lost_share > 0:
        outages = {"share": schedule.lost_share, "life_s": schedule.outage_life_s()}
    return _given(
        first_path_at_1m_dbm=powers.at_1m_dbm,
        path_loss_exponent=None if powers.exponent is None else max(powers.exponent, 0.0),
        antenna=powers.antenna,
        power_noise_db=powers.noise_db,
        saturation_dbm=powers.saturation_dbm,
        sensitivity_dbm=min(Radio().sensitivity_dbm, float(flight.power_dbm.min()) - 1),
        skew_noise_ppm=clocks.carrier_std_ppm,
        skew_bias_ppm=clocks.carrier_bias_ppm,
        bias=known.bias.model_dump(mode="json"),
        rx_noise_ps=float(noise.std_s[0]) * 1e12 if len(noise.std_s) == 1 else 0.0,
        sigma=sigma,
        multipath=_multipath(flight, fitted),
        fading=fading,
        outages=outages,
    )


def _multipath(flight: Flight, fitted: Fitted) -> dict[str, Any] | None:
    found, loss = fitted.errors, fitted.powers.reflection_loss_db
    if found.share < 0.002 and found.direct_std_m == 0:
        return None
    default = TwoStateMultipath(model="two-state")
    life_s, shortest = found.life_s, flight.interval_s
    if life_s is None:
        life_s = min(shortest / 3, default.life_s) if shortest < default.life_s else default.life_s
    pairs = [
        {"tags": list(pair)}
        | _given(
            share=float(np.clip(found.pair_share[k], 0, 1)) if found.share_std > 0 else None,
            life_s=max(float(found.pair_life_s[k]), SHORTEST_LIFE_S) if found.life_spread > 0.1 else None,
            mean_excess_m=float(found.pair_excess_m[k]) if np.ptp(found.pair_excess_m) > 0 else None,
        )
        for k, pair in enumerate(flight.pairs)
    ]
    return _given(
        model="two-state",
        share=found.share,
        share_std=min(found.share_std, 0.9 * float(np.sqrt(found.share * (1 - found.share)))),
        mean_excess_m=found.mean_excess_m,
        excess_shape=found.excess_shape,
        direct_std_m=found.direct_std_m,
        life_s=max(life_s, SHORTEST_LIFE_S),
        life_spread=min(found.life_spread, 2.0),
        first_path_loss_db=loss,
        loss_std_db=None if loss is None else fitted.powers.reflection_loss_std_db,
        total_loss_db=None if loss is None else min(default.total_loss_db, loss),
        pairs=[pair for pair in pairs if len(pair) > 1] or None,
    )


def _tag(flight: Flight, known: KnownDevices, fitted: Fitted, k: int) -> dict[str, Any]:
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


def _bodies(flight: Flight, poses: Poses, duration_s: float) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the bodies' tables, and the poses of those that move, from the origin to after the end."""
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
    """Return position and heading of a body that does not move and stands level; None for any other."""
    middle = np.median(mine.position_m, axis=0)
    if np.max(np.linalg.norm(mine.position_m - middle, axis=1)) > 0.01:
        return None
    turns = attitude(mine, str(mine.body[0]), mine.time_ns)
    yaw, pitch, roll = turns.as_euler("ZYX").T
    heading = float(np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean()))
    turning = np.abs(np.angle(np.exp(1j * (yaw - heading))))
    if max(np.abs(pitch).max(), np.abs(roll).max(), turning.max()) > 0.01:
        return None
    return {"position_m": [float(v) for v in middle], "yaw_deg": float(np.degrees(heading))}


def _cut(mine: Poses, origin_ns: int, duration_s: float) -> Poses:
    """Return poses from the origin on, as long as needed, with poses at both ends."""
    first, last = origin_ns, origin_ns + int((duration_s + AFTER_S) * NS_PER_S)
    times, rows = np.unique(mine.time_ns, return_index=True)
    mine = mine[rows]
    inside: Bools = (times > first) & (times < last)
    wanted = np.concatenate([[first], times[inside], [last]])
    wanted = wanted[:: max(len(wanted) // MOST_POSES + 1, 1)] if len(wanted) > MOST_POSES else wanted
    if wanted[-1] != last:
        wanted = np.append(wanted, last)
    at = np.clip(wanted, times[0], times[-1]).astype(np.float64)
    position = np.column_stack([np.interp(at, times.astype(np.float64), mine.position_m[:, k]) for k in range(3)])
    turns = attitude(mine, str(mine.body[0]), wanted)
    return Poses(wanted, np.full(len(wanted), str(mine.body[0])), position, turns.as_quat())


NOT_DETERMINED: Final = (
    "The common rate of all clocks: skew_ppm is relative to their mean at the start, on which no range depends.",
    "White and flicker noise of clocks (white_ppm_sqrt_s, flicker_ppm: none): in a flight they cannot be told from "
    "noise of stamps and from a random walk of the rate.",
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

NOT_DETERMINED_IF: Final[tuple[tuple[Callable[[Flight, Fitted], bool], str], ...]] = (
    (
        lambda flight, fitted: not len(fitted.noise.std_s),
        "Noise of stamps apart from that of ranges: only a third message from the target shows it. All noise of ranges "
        "is assigned to direct_std_m, which is constant between redraws of a path.",
    ),
    (
        lambda flight, fitted: abs(fitted.clocks.ratio_bias_ppm) > 0.02,
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


def unknowns(flight: Flight, fitted: Fitted) -> Iterator[str]:
    """Yield a sentence for each property that keeps its default, or was chosen without the recording."""
    interval = flight.interval_s
    for applies, text in NOT_DETERMINED_IF:
        if applies(flight, fitted):
            yield text.format(interval=interval, ratio_bias=fitted.clocks.ratio_bias_ppm)
    yield from NOT_DETERMINED
