"""Errors of twins of simulated recordings against planted values (`make twins`): a table of docs/accuracy.md.

The world is used only here: nothing in `uwbsim.twins` was chosen with it, except the separation of offsets of tags from
their antennas. It has two robots and three anchors, pairs whose reflections differ in share and duration, fading,
outages, tags with low transmit power or high readings, and dipoles.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

import uwbsim
from uwbsim.random_streams import stream
from uwbsim.scenario.loading import load
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import TwoStateMultipath
from uwbsim.twins.fitting import Twin
from uwbsim.world.world import pair_reflections

ROBOTS = {
    "hare": [[-3.0, -3.5, 0.3], [3.0, -0.3, 2.4]],
    "tortoise": [[-3.0, 0.3, 0.3], [3.0, 3.5, 2.4]],
}
ANCHORS = {"north": [0.0, 4.2, 2.8], "east": [4.2, -3.0, 0.4], "west": [-4.3, -1.0, 2.2]}
RADIO = {
    "first_path_at_1m_dbm": -76.0,
    "path_loss_exponent": 1.7,
    "antenna": "dipole",
    "power_noise_db": 0.4,
    "rx_noise_ps": 130.0,
    "skew_noise_ppm": 0.17,
    "bias": "icra2023",
    "fading": {"std_db": 1.2, "life_s": 0.6},
    "outages": {"share": 0.03, "life_s": 0.4},
    "multipath": {
        "model": "two-state",
        "share": 0.14,
        "share_std": 0.08,
        "life_s": 0.6,
        "mean_excess_m": 0.5,
        "first_path_loss_db": 5.0,
        "total_loss_db": 1.5,
    },
}


def world(seed: int, duration_s: float) -> dict[str, Any]:
    """Return the tables of the world, with skews and offsets of tags that depend on the seed."""
    rng = np.random.default_rng(seed)
    bodies: list[dict[str, Any]] = [
        {
            "name": name,
            "motion": {"model": "random-flight", "box_min_m": low, "box_max_m": high, "speed_mps": 1.2},
        }
        for name, (low, high) in ROBOTS.items()
    ]
    bodies += [{"name": n, "motion": {"model": "static", "position_m": spot}} for n, spot in ANCHORS.items()]
    seats = [("hare", 0.2), ("hare", -0.2), ("tortoise", 0.2), ("tortoise", -0.2), *((name, 0.0) for name in ANCHORS)]
    tags = [
        {
            "id": 20 + k,
            "body": body,
            "lever_arm_m": [arm, -arm, 0.03 if arm else 0.0],
            "delay_ns": float(rng.normal(-0.2, 0.2)),
            "skew_ppm": float(rng.normal(0, 3)),
            "drift_ppm_per_sqrt_s": 0.004,
            "tx_power_db": -4.0 if k == 1 else 0.0,
            "power_offset_db": 2.0 if k == 4 else 0.0,
        }
        for k, (body, arm) in enumerate(seats)
    ]
    return {
        "run": {"name": "two robots, three anchors", "seed": seed, "duration_s": duration_s},
        "ranging": {"rate_hz": 200.0},
        "radio": RADIO,
        "bodies": bodies,
        "tags": tags,
    }


LINE = {"knots": [0.0, 0.0, 2.0, 2.0], "coefficients": [0.0, 0.0], "degree": 1}
"""A curve that is zero at every lifted power."""


def known(scenario: Scenario) -> dict[str, Any]:
    """Return a calibration with the planted values; its curve is zero if the scenario has none."""
    planted = scenario.planted()
    curve: dict[str, Any] = planted["bias_curve"] or LINE
    shape = curve | {"range": [curve["knots"][0], curve["knots"][-1]]}
    return {
        "schema_version": 3,
        "delays_ns": planted["delays_ns"],
        "delays_std_ns": dict.fromkeys(planted["delays_ns"], 0.0),
        "loss": "cauchy",
        "scale_ns": 0.1,
        "lift": "mean-of-lifted",
        "power_at": "reception",
        "alpha_dbm": -82.0,
        "speed_of_light": 299_702_547.0,
        "bias_curve": shape,
        "sigma_curve": shape | {"coefficients": [0.05] * len(curve["coefficients"])},
        "provenance": {},
    }


def shares(scenario: Scenario) -> dict[str, float]:
    """Return the share of reflections that was drawn for each pair."""
    model = scenario.radio.multipath
    if not isinstance(model, TwoStateMultipath):
        raise TypeError("the world has two states")
    pairs = {tuple(sorted(pair)) for pair in scenario.pairs()}
    draws = {pair: stream(scenario.run.seed, "reflected states", *pair, "pair") for pair in pairs}
    return {f"{a}-{b}": pair_reflections(model, [a, b], rng)[0] for (a, b), rng in draws.items()}


Row = tuple[str, Callable[[Scenario, Twin], float], Callable[[Scenario, Twin], float]]


def _found(name: str) -> Callable[[Scenario, Twin], float]:
    return lambda _, twin: float(twin.found[name] if twin.found[name] is not None else np.nan)


def _skew(scenario: Scenario, twin: Twin) -> float:
    """Return the rms error of skews relative to the mean of all."""
    errors = [b.skew_ppm - a.skew_ppm for a, b in zip(scenario.tags, twin.scenario.tags, strict=True)]
    return float(np.std(errors))


def _share_of_pairs(scenario: Scenario, twin: Twin) -> float:
    drawn = shares(scenario)
    errors = [row["reflected_share"] - drawn[name] for name, row in twin.found["pairs"].items()]
    return float(np.sqrt(np.mean(np.square(errors))))


def _weak(_: Scenario, twin: Twin) -> float:
    return twin.scenario.tags[1].tx_power_db


def _strong(_: Scenario, twin: Twin) -> float:
    return twin.scenario.tags[4].power_offset_db


ROWS: tuple[Row, ...] = (
    ("rms error of a skew (ppm)", lambda s, t: 0.0, _skew),
    ("walk of rates (ppm/sqrt s)", lambda s, t: 0.004, lambda s, t: t.scenario.tags[0].drift_ppm_per_sqrt_s),
    ("noise of receive stamps (ps)", lambda s, t: 130.1, _found("receive_noise_ps")),
    ("noise of carrier readings (ppm)", lambda s, t: 0.17, _found("carrier_noise_ppm")),
    ("path-loss exponent", lambda s, t: 1.7, _found("path_loss_exponent")),
    ("noise of power readings (dB)", lambda s, t: 0.4, _found("power_noise_db")),
    ("fading (dB)", lambda s, t: 1.2, _found("fading_db")),
    ("life of fading (s)", lambda s, t: 0.6, _found("fading_life_s")),
    ("share of reflections", lambda s, t: float(np.mean(list(shares(s).values()))), _found("reflected_share")),
    ("rms error of pairs' shares", lambda s, t: 0.0, _share_of_pairs),
    ("mean detour (m)", lambda s, t: 0.5, _found("mean_excess_m")),
    ("life of reflections (s)", lambda s, t: 0.6, _found("reflection_life_s")),
    ("loss of reflections (dB)", lambda s, t: 5.0, _found("reflection_loss_db")),
    ("tag that sends weak (dB)", lambda s, t: -4.0, _weak),
    ("tag that reads strong (dB)", lambda s, t: 2.0, _strong),
    ("exchanges lost", lambda s, t: 0.03, _found("lost_share")),
    ("life of outages (s)", lambda s, t: 0.4, lambda s, t: t.scenario.radio.outages.life_s),  # type: ignore[union-attr]
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--duration-s", type=float, default=180.0)
    asked = parser.parse_args()
    planted, found = [], []
    for seed in range(101, 101 + asked.seeds):
        scenario = load(world(seed, asked.duration_s))
        twin = uwbsim.twin(uwbsim.simulate(scenario, contention=False), known(scenario))
        planted.append([row[1](scenario, twin) for row in ROWS])
        found.append([row[2](scenario, twin) for row in ROWS])
    print(f"{asked.seeds} flights of {asked.duration_s:g} s\n\n| what | planted | rms error |")
    print("|---|---|---|")
    for (name, _, _), was, got in zip(ROWS, np.array(planted).T, np.array(found).T, strict=True):
        rms = np.sqrt(np.mean((got - was) ** 2))
        print(f"| {name} | {np.mean(was):.3g} | {rms:.2g} |")


if __name__ == "__main__":
    main()
