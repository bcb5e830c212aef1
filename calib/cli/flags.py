"""The flags that stand for parameters of calib, where they are spelt otherwise."""

from __future__ import annotations

from typing import Final

from uwblink.cli import shared

FLAGS: Final = {
    "boards": "COUNT",
    "data": "RECORDINGS",
    "distances": "--distance",
    "robots": "COUNT",
    "noise_m": "--noise",
    "still_s": "--still",
    "speed_m_s": "--speed",
    "apart_m": "--apart",
    "fixed_ns": "--fix",
    "groups": "--group",
    "scale_ns": "--scale",
    "pair_error_m": "--pair-error",
    "tape_sigma_m": "--tape-sigma",
    "anchor_sigma_m": "--anchor-sigma",
    "size_m": "--size",
    "rate_hz": "--rate",
    "reference_power_dbm": "--reference-power",
    "poses_until_s": "--poses-until",
    "heading_std_deg": "--heading-std",
    "velocity_std_mps": "--process-noise",
}


def with_flags(text: str) -> str:
    """Return a text with flags for the parameters in backticks: `minimum_norm` becomes --minimum-norm."""
    return shared.with_flags(text, FLAGS)
