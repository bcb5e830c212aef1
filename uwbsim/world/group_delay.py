"""Group delay of antennas over direction: how much longer ways seem for where they leave and where they come from."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.scenario.devices import GroupDelay, GroupDelayHarmonics, GroupDelayTable
from uwbsim.scenario.model import Scenario

if TYPE_CHECKING:
    from scipy.interpolate import RegularGridInterpolator


def has_group_delays(scenario: Scenario) -> bool:
    """Say whether any tag has one."""
    return scenario.radio.group_delay is not None or any(tag.group_delay is not None for tag in scenario.tags)


def group_delay_m(scenario: Scenario, tags: Ints, direction: Floats) -> Floats:
    """Return the group delays of tags (n,), by their places, towards unit vectors (n, 3) in the frames of their bodies.

    In metres of way, (n,).
    """
    delay = np.zeros(len(tags))
    for place in np.unique(tags).tolist():
        model = scenario.tags[place].group_delay or scenario.radio.group_delay
        if model is not None:
            rows = np.flatnonzero(tags == place)
            delay[rows] = _delay_cm(model, direction[rows]) * 1e-2
    return delay


def _delay_cm(model: GroupDelay, direction: Floats) -> Floats:
    azimuth = np.arctan2(direction[:, 1], direction[:, 0]) - np.radians(model.turned_deg)
    sine = np.clip(direction[:, 2], -1, 1)
    if isinstance(model, GroupDelayTable):
        # Turned boards look beyond the table's ends, which are the same direction.
        around = (np.degrees(azimuth) + 180) % 360 - 180
        return np.asarray(_interpolator(model)(np.column_stack([around, np.degrees(np.arcsin(sine))])))
    return _harmonics_cm(model, azimuth, sine)


def _harmonics_cm(model: GroupDelayHarmonics, azimuth: Floats, sine: Floats) -> Floats:
    around = np.zeros(len(azimuth))
    for wave, heights in ((np.cos, model.cosine_cm), (np.sin, model.sine_cm)):
        for order, height in enumerate(heights, start=1):
            around += height * wave(order * azimuth)
    return model.mean_cm + around * np.sqrt(1 - sine**2) + model.elevation_cm * sine


@lru_cache(maxsize=16)
def _interpolator(table: GroupDelayTable) -> RegularGridInterpolator:
    from scipy.interpolate import RegularGridInterpolator

    return RegularGridInterpolator((table.azimuth_deg, table.elevation_deg), np.array(table.delay_cm))
