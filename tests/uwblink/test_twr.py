"""Formulas of the protocols against exact arithmetic and finite differences."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import METRES_PER_TICK, TICK_S, elapsed
from uwblink.twr import Exchanges, delay_weights, time_of_flight, truncate4


def initiator_stamps(protocol):
    """The stamps of the initiator's clock: it stamps what it sends and what it receives."""
    senders = [message.sender for message in PROTOCOLS[protocol].messages]
    return tuple(f"{'tx' if sender == 'initiator' else 'rx'}{k}" for k, sender in enumerate(senders, start=1))


def exchange(protocol, flight, reply, third, gamma_i, gamma_j, start=0, bits=32):
    """An exchange in exact rationals, rounded to whole ticks only at the end."""
    sender = PROTOCOLS[protocol].messages[-1].sender
    true = {"tx1": 0, "rx1": flight, "tx2": flight + reply, "rx2": 2 * flight + reply}
    if len(PROTOCOLS[protocol].messages) == 3:
        left = true["tx2" if sender == "target" else "rx2"] + third
        true |= {"tx3": left, "rx3": left + flight}
    own = initiator_stamps(protocol)
    stamps = {}
    for name in ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3"):
        if name not in true:
            stamps[name] = np.array([0])
            continue
        rate = 1 + Fraction(gamma_i if name in own else gamma_j) / 10**6
        offset = start if name in own else 7 * start + 12345
        stamps[name] = np.array([int(offset + rate * Fraction(true[name])) % 2**bits])
    one = np.array([1])
    none = np.array([np.nan])
    return Exchanges(
        time_ns=np.array([0]),
        initiator=one,
        target=one + 1,
        protocol=np.array([protocol]),
        reporter=one,
        range_m=none,
        fpp1_dbm=none,
        fpp2_dbm=none,
        skew1_ppm=none,
        skew2_ppm=np.array(
            [float((Fraction(1) + Fraction(gamma_i, 10**6)) / (1 + Fraction(gamma_j, 10**6)) - 1) * 1e6]
        ),
        truth_m=none,
        bits=bits,
        **stamps,
    )


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.sampled_from([32, 40]))
def test_elapsed_undoes_addition_whatever_the_wrap(start, duration, bits):
    assert elapsed((start + duration) % 2**bits, start, bits) == duration
    assert 0 <= elapsed(start, start + duration, bits) < 2**bits


@given(
    st.sampled_from(["ds", "ds-alt", "ds-sym"]),
    st.integers(100, 10_000),
    st.integers(15_000_000, 60_000_000),
    st.integers(20_000_000, 300_000_000),
    st.integers(-20, 20),
    st.integers(-20, 20),
    st.integers(0, 2**32 - 1),
)
def test_double_sided_finds_the_flight_time_whatever_the_skews(protocol, flight, reply, third, gi, gj, start):
    found = time_of_flight(exchange(protocol, flight, reply, third, gi, gj, start))[0] / TICK_S
    # Six stamps cut to whole ticks, weighted by up to 1 + r <= 4 (docs/theory.md), halved; and the skew's share.
    assert abs(found - flight) < 2 * (1 + reply / third) + flight * 2e-5


def test_single_sided_carries_half_the_relative_skew_times_the_reply():
    found = time_of_flight(exchange("ss", 1000, 98_320_384, 0, 5, -5))[0] / TICK_S
    assert found - 1000 == pytest.approx(0.5 * 10e-6 * 98_320_384, abs=1)


def test_the_carrier_takes_the_skew_out():
    found = time_of_flight(exchange("ss-cfo", 1000, 98_320_384, 0, 5, -5))[0] / TICK_S
    # The reply is half a tick wrong at each end, the flight by its own skew.
    assert found - 1000 == pytest.approx(0, abs=1)
    blind = replace(exchange("ss-cfo", 1000, 98_320_384, 0, 5, -5), skew2_ppm=np.array([0.0]))
    assert time_of_flight(blind)[0] == pytest.approx(time_of_flight(exchange("ss", 1000, 98_320_384, 0, 5, -5))[0])


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("side", ["initiator", "target"])
@pytest.mark.parametrize("kind", ["tx", "rx"])
def test_a_delay_on_one_side_only_is_taken_out_by_its_weight(protocol, side, kind):
    clean = exchange(protocol, 1000, 20_000_000, 98_320_384, 3, -2)
    d = 4000
    own = initiator_stamps(protocol)
    touched = {
        name: getattr(clean, name) + d
        for name in ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
        if name[:2] == kind and (name in own) == (side == "initiator")
    }
    delayed = replace(clean, **touched)
    aggregate = d if kind == "tx" else -d  # d = d_t - d_r
    weights = dict(zip(("initiator", "target"), delay_weights(delayed), strict=True))
    corrected = time_of_flight(delayed)[0] / TICK_S + weights[side][0] * aggregate
    assert corrected == pytest.approx(time_of_flight(clean)[0] / TICK_S, abs=1e-3)
    assert abs(time_of_flight(delayed)[0] - time_of_flight(clean)[0]) > 0.4 * d * TICK_S


def test_truncation_is_towards_zero_and_keeps_what_has_four_decimals():
    assert truncate4(np.array([1.23459, -1.23459, -87.6187, 0.0001])).tolist() == [1.2345, -1.2345, -87.6187, 0.0001]


def test_a_tick_is_4_69_mm():
    assert pytest.approx(4.690357e-3, rel=1e-6) == METRES_PER_TICK


def test_stamps_belong_to_the_clocks_of_the_paper():
    # ICRA 2023, fig. 2, and the course in which the initiator sends the third message.
    assert initiator_stamps("ss") == initiator_stamps("ss-cfo") == ("tx1", "rx2")
    assert initiator_stamps("ds") == ("tx1", "rx2", "rx3")
    assert initiator_stamps("ds-alt") == initiator_stamps("ds-sym") == ("tx1", "rx2", "tx3")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("protocol", ["ds", "ds-alt", "ds-sym"])
def test_degenerate_stamps_make_no_range_and_no_warning(protocol):
    # Neither reply nor third leg lasted by the target: K is infinite, and zero times K is nothing.
    none = Exchanges.from_arrays([1], [2], tx1=[0], rx1=[9], tx2=[9], rx2=[50], tx3=[9], rx3=[70], protocol=protocol)
    found = time_of_flight(none)
    assert protocol != "ds" or not np.isfinite(found[0])
