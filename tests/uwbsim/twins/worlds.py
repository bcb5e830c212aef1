"""Flights for twins, and calibrations with the planted values of their devices."""

from typing import Any

import uwbsim

LINE = {"knots": [0.0, 0.0, 2.0, 2.0], "coefficients": [0.0, 0.0], "degree": 1}
TWO_STATE = {
    "model": "two-state",
    "share": 0.2,
    "life_s": 0.25,
    "mean_excess_m": 0.45,
    "first_path_loss_db": 6.0,
    "total_loss_db": 1.0,
}

RADIO = {"first_path_at_1m_dbm": -72.0, "rx_noise_ps": 95.0, "path_loss_exponent": 2.4, "multipath": TWO_STATE}


def box(x, y):
    low, high = [x - 1.4, y - 1.4, 0.3], [x + 1.4, y + 1.4, 2.7]
    return {"model": "random-flight", "box_min_m": low, "box_max_m": high, "speed_mps": 1.5}


def world(duration_s=60.0, seed=5, rate_hz=150.0, radio=None, **more):
    places = [(-3.0, 0.0), (2.5, 2.2), (1.5, -3.0)]
    skews = [2.4, -3.1, 0.7]
    return {
        "run": {"name": "planted", "duration_s": duration_s, "seed": seed},
        "ranging": {"rate_hz": rate_hz},
        "radio": RADIO | (radio or {}),
        "bodies": [{"name": f"robot{k}", "motion": box(*place)} for k, place in enumerate(places)],
        "tags": [
            {"id": 11 + k, "body": f"robot{k}", "skew_ppm": skew, "drift_ppm_per_sqrt_s": 0.003, "delay_ns": 0.1 * k}
            for k, skew in enumerate(skews)
        ],
    } | more


def known(scenario):
    """Return a calibration with the planted values, as JSON."""
    planted = uwbsim.load(scenario).planted()
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
