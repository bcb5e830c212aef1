"""Clock ratios by third messages against carriers' readings: what is planted is named, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.data.clocks import clocks_apart
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S

PPM = np.array([0.0, 4.0, -3.0, 1.5])
"""By how much the clock of a tag is fast."""


def exchanges(stamps_ppm=None, sign=1.0, noise_ppm=0.3):
    """Return a sample flight whose third messages and carriers tell of the clocks; `stamps_ppm` is of tags 1 to 3."""
    flight = calib.sample_flight(900).exchanges
    rng = np.random.default_rng(4)
    fast = PPM if stamps_ppm is None else np.array([0.0, *stamps_ppm])
    # The third message leaves the target 15 ms after its second, in its own ticks; the initiator counts in others.
    span = 0.015 / TICK_S
    target, initiator = (span * (1 + 1e-6 * fast[ids]) for ids in (flight.target, flight.initiator))
    carrier = sign * (PPM[flight.target] - PPM[flight.initiator])
    return replace(
        flight,
        tx3=(flight.tx2 + np.rint(target).astype(np.int64)) % 2**32,
        rx3=(flight.rx2 + np.rint(initiator).astype(np.int64)) % 2**32,
        skew1_ppm=carrier + noise_ppm * rng.normal(size=900),
        skew2_ppm=-carrier + noise_ppm * rng.normal(size=900),
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_clocks_that_agree_are_left_alone_whichever_sign_readings_have(sign):
    assert clocks_apart(exchanges(sign=sign)) is None


def test_a_clock_that_only_the_stamps_find_fast_is_named_with_what_it_does():
    # Tag 3 is 3 ppm slow; its stamps say 2 ppm fast.
    some = exchanges(stamps_ppm=(4.0, -3.0, 6.5))
    found = clocks_apart(some)
    assert found is not None
    assert 3 in found.pair
    assert abs(found.stamps_ppm - found.carrier_ppm) == pytest.approx(5.0, abs=0.2)
    reply_s = float(np.median((some.tx2 - some.rx1) % 2**32)) * TICK_S
    assert found.moves_m == pytest.approx(0.5 * SPEED_OF_LIGHT * 5e-6 * reply_s, rel=0.05)
    result = calib.fit(replace(calib.sample_flight(900), exchanges=some))
    assert str(found) in result.warnings


def test_readings_of_zero_are_none():
    some = exchanges(stamps_ppm=(9.0, -9.0, 0.0))
    nothing = np.zeros(900)
    assert clocks_apart(replace(some, skew1_ppm=nothing, skew2_ppm=nothing)) is None


def test_readings_that_scatter_widely_prove_nothing():
    assert clocks_apart(exchanges(stamps_ppm=(4.0, -3.0, 3.0), noise_ppm=30.0)) is None
