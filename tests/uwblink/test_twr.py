"""Formulas of the protocols compared with exact arithmetic and finite differences."""

from dataclasses import replace
from fractions import Fraction
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblink import twr
from uwblink.errors import ArgumentError
from uwblink.plugins import Registry
from uwblink.protocols.table import (
    PROTOCOLS,
    ProtocolMessage,
    RangingProtocol,
    check_protocol,
    half_delays,
    register_protocol,
)
from uwblink.ticks import METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S, elapsed
from uwblink.twr import (
    STAMPS,
    Exchanges,
    board_range,
    delay_weights,
    intervals,
    range_ns,
    raw_range,
    time_of_flight,
    truncate4,
    without_stamps,
)


def initiator_stamps(protocol):
    """Return the stamps of the initiator's clock: of its transmissions and receptions."""
    senders = [message.sender for message in PROTOCOLS[protocol].messages]
    return tuple(f"{'tx' if sender == 'initiator' else 'rx'}{k}" for k, sender in enumerate(senders, start=1))


def exchange(protocol, flight, reply, third, gamma_i, gamma_j, start=0, bits=32):
    """Return an exchange in exact rationals, rounded to whole ticks only at the end."""
    sender = PROTOCOLS[protocol].messages[-1].sender
    true = {"tx1": 0, "rx1": flight, "tx2": flight + reply, "rx2": 2 * flight + reply}
    if len(PROTOCOLS[protocol].messages) == 3:
        left = true["tx2" if sender == "target" else "rx2"] + third
        true |= {"tx3": left, "rx3": left + flight}
    own = initiator_stamps(protocol)
    rates = [1 + Fraction(gamma, 10**6) for gamma in (gamma_i, gamma_j)]
    stamps = dict.fromkeys(STAMPS, np.array([0]))
    for name, when in true.items():
        rate, offset = (rates[0], start) if name in own else (rates[1], 7 * start + 12345)
        stamps[name] = np.array([int(offset + rate * Fraction(when)) % 2**bits])
    skew2_ppm = [float(rates[0] / rates[1] - 1) * 1e6]
    return Exchanges.from_arrays([1], [2], **stamps, protocol=protocol, skew2_ppm=skew2_ppm, range_m=np.nan, bits=bits)


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
    # Six stamps rounded to whole ticks, with weights up to 1 + r <= 4 (docs/theory.md), halved; and the part of the
    # skew.
    assert abs(found - flight) < 2 * (1 + reply / third) + flight * 2e-5


def test_single_sided_carries_half_the_relative_skew_times_the_reply():
    found = time_of_flight(exchange("ss", 1000, 98_320_384, 0, 5, -5))[0] / TICK_S
    assert found - 1000 == pytest.approx(0.5 * 10e-6 * 98_320_384, abs=1)


def test_the_carrier_takes_the_skew_out():
    found = time_of_flight(exchange("ss-cfo", 1000, 98_320_384, 0, 5, -5))[0] / TICK_S
    # The reply has an error of half a tick at each end, the flight that of its own skew.
    assert found - 1000 == pytest.approx(0, abs=1)
    blind = replace(exchange("ss-cfo", 1000, 98_320_384, 0, 5, -5), skew2_ppm=np.array([0.0]))
    assert time_of_flight(blind)[0] == pytest.approx(time_of_flight(exchange("ss", 1000, 98_320_384, 0, 5, -5))[0])


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("side", ["initiator", "target"])
@pytest.mark.parametrize("kind", ["tx", "rx"])
def test_a_delay_on_one_side_only_is_taken_out_by_its_weight(protocol, side, kind):
    clean = exchange(protocol, 1000, 20_000_000, 98_320_384, 3, -2)
    d, own = 4000, initiator_stamps(protocol)
    touched = [name for name in STAMPS if name[:2] == kind and (name in own) == (side == "initiator")]
    delayed = replace(clean, **{name: getattr(clean, name) + d for name in touched})
    aggregate = d if kind == "tx" else -d  # d = d_t - d_r
    weights = dict(zip(("initiator", "target"), delay_weights(delayed), strict=True))
    corrected = time_of_flight(delayed)[0] / TICK_S + weights[side][0] * aggregate
    assert corrected == pytest.approx(time_of_flight(clean)[0] / TICK_S, abs=1e-3)
    assert abs(time_of_flight(delayed)[0] - time_of_flight(clean)[0]) > 0.4 * d * TICK_S


def test_truncation_is_towards_zero_and_keeps_what_has_four_decimals():
    assert truncate4(np.array([1.23459, -1.23459, -94.9998, 0.0001])).tolist() == [1.2345, -1.2345, -94.9998, 0.0001]


def test_stamps_belong_to_the_clocks_of_the_paper():
    # ICRA 2023, fig. 2, and the variant in which the initiator sends the third message.
    assert initiator_stamps("ss") == initiator_stamps("ss-cfo") == ("tx1", "rx2")
    assert initiator_stamps("ds") == ("tx1", "rx2", "rx3")
    assert initiator_stamps("ds-alt") == initiator_stamps("ds-sym") == ("tx1", "rx2", "tx3")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("protocol", ["ds", "ds-alt", "ds-sym"])
def test_degenerate_stamps_make_no_range_and_no_warning(protocol):
    # Reply and third interval are zero by the target: K is infinite, and zero times K is NaN.
    none = Exchanges.from_arrays([1], [2], tx1=[0], rx1=[9], tx2=[9], rx2=[50], tx3=[9], rx3=[70], protocol=protocol)
    assert protocol != "ds" or not np.isfinite(time_of_flight(none)[0])


def test_boards_print_single_sided_ranges_of_whole_ticks_and_cut_all_of_them():
    def printed(rx2, protocol, **third):
        stamps: Any = {"tx1": [0], "rx1": [1000], "tx2": [101_000], "rx2": [rx2]}
        return board_range(Exchanges.from_arrays(1, 2, **stamps, **third, protocol=protocol))[0]

    # (102 001 - 100 000)/2 = 1000.5 ticks: 1000 of 4.690357 mm are 4.69035..., and ds keeps the half tick.
    assert (printed(102_001, "ss"), printed(102_000, "ss")) == (4.6903, 4.6903)
    assert printed(102_001, "ds", tx3=[201_000], rx3=[202_001]) == 4.6927
    # Towards zero also from below: -0.5 ticks become 0, -1.5 become -1.
    assert (printed(99_999, "ss"), printed(99_997, "ss")) == (0.0, -0.0046)


def test_a_row_without_any_stamp_has_the_range_that_was_reported():
    stamps: Any = {"tx1": [0, 0, 0, 0], "rx1": [0, 5, 0, 0], "tx2": [0, 1005, 0, 2000], "rx2": [0, 3000, 3000, 5000]}
    for name in stamps:  # any of the four will do
        alone: Any = {n: [int(n == name)] for n in stamps}
        assert not without_stamps(Exchanges.from_arrays(1, 2, **alone, range_m=[9.0]))[0]
    e = Exchanges.from_arrays(1, 2, **stamps, range_m=[7.5, 9.0, 9.0, 9.0])
    assert without_stamps(e).tolist() == [True, False, False, False]
    expected = [7.5, *(np.array([1000.0, 1500.0, 1500.0]) * METRES_PER_TICK)]
    np.testing.assert_allclose(raw_range(e), expected, rtol=1e-12)
    np.testing.assert_allclose(time_of_flight(e)[0], 7.5 / SPEED_OF_LIGHT, rtol=1e-12)


def test_the_error_for_a_wide_stamp_names_the_option_bits():
    stamps: Any = {"tx1": [2**32], "rx1": [5], "tx2": [1005], "rx2": [3000]}
    with pytest.raises(ArgumentError, match="stamps of 40 bits need bits=40"):
        Exchanges.from_arrays(1, 2, **stamps)
    assert Exchanges.from_arrays(1, 2, **stamps, bits=40).tx1[0] == 2**32
    with pytest.raises(ArgumentError) as caught:
        Exchanges.from_arrays(1, 2, **stamps | {"tx1": [2**40]}, bits=40)
    assert "need bits" not in str(caught.value)


@pytest.mark.parametrize(("protocol", "after"), [("ss", 0.5), ("ds", 0.0), ("ds-alt", 1.0), ("ds-sym", 1.0)])
def test_the_time_of_a_range_is_that_of_the_distance_it_measures(protocol, after):
    """A distance grows at constant speed; flights of messages are solved one by one."""
    speed, start, reply, third = 50.0, 10.0, 0.02, 0.031

    def arrival(sent):
        return sent + (start + speed * sent) / (SPEED_OF_LIGHT - speed)

    times = [0.0, arrival(0.0), arrival(0.0) + reply, arrival(arrival(0.0) + reply)]
    sender = PROTOCOLS[protocol].third_sender
    if sender:
        sent = times[2 if sender == "target" else 3] + third
        times += [sent, arrival(sent)]
    ticks = [round(t / TICK_S) for t in times] + [0] * (6 - len(times))
    stamps = {name: [stamp] for name, stamp in zip(("tx1", "rx1", "tx2", "rx2", "tx3", "rx3"), ticks, strict=True)}
    x = Exchanges.from_arrays([1], [2], protocol=protocol, bits=40, **stamps)
    when_s = range_ns(x)[0] * 1e-9
    assert when_s == pytest.approx(after * times[3], abs=2e-9)
    # The distance changes by a metre between poll and response; rounded stamps are 4.7 mm, flights of 10 m last 33 ns.
    assert raw_range(x)[0] == pytest.approx(start + speed * when_s, abs=0.01)


# A protocol that is registered at run time: accepted ones, refused ones, and the reasons.


POLL = ProtocolMessage("initiator", "", "at once")
REPLY = ProtocolMessage("target", "rx1", "scheduled")


def mean_of_trips(t):
    """Return half of the mean rest of both round trips: exact if both replies are equal."""
    return (t.dt41 - t.dt32 + t.dt64 - t.dt53) / 4


SYMMETRIC = RangingProtocol(
    "mean-of-trips",
    "DS-TWR, mean of two single-sided trips",
    (POLL, REPLY, ProtocolMessage("initiator", "rx2", "scheduled")),
    mean_of_trips,
    half_delays,
)
TARGETS = RangingProtocol(
    "targets-clock",
    "DS-TWR in the target's clock",
    (POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("target", "tx2", "scheduled")),
    # ICRA 2023, eq. (2), with the round trip rescaled instead of the reply.
    lambda t: (t.dt41 * t.dt53 / t.dt64 - t.dt32) / 2,
    lambda t: (t.dt53 / t.dt64 / 2, np.full_like(t.dt41, 0.5)),
)


@pytest.fixture(params=[SYMMETRIC, TARGETS], ids=lambda row: row.name)
def registered(request):
    register_protocol(request.param)
    yield request.param
    PROTOCOLS.remove(request.param.name)


@pytest.mark.parametrize("name", list(PROTOCOLS))
def test_the_projects_own_rows_pass_their_own_check(name):
    check_protocol(PROTOCOLS[name])


@pytest.mark.parametrize("registered", [TARGETS], indirect=True)
def test_skew_and_delays_go_through_the_registered_formula(registered):
    e = exchange(registered.name, 1000, 20_000_000, 98_320_384, 7, -4)
    # Six stamps rounded to whole ticks, with weights up to 1.2, halved.
    assert time_of_flight(e)[0] / TICK_S == pytest.approx(1000, abs=2.5)
    moved = (time_of_flight(replace(e, rx1=e.rx1 + 4000)) - time_of_flight(e))[0] / TICK_S
    assert moved == pytest.approx(4000 * delay_weights(e)[1][0], abs=1e-3)


def test_a_mixture_of_protocols_keeps_each_to_its_own_formula(registered):
    names = [registered.name, "ds", "ss", registered.name]
    parts = [exchange(name, 1000 + k, 98_304_000, 98_304_000, 0, 0) for k, name in enumerate(names)]
    columns = {f: np.concatenate([getattr(p, f) for p in parts]) for f in parts[0].__slots__ if f != "bits"}
    np.testing.assert_allclose(time_of_flight(replace(parts[0], **columns)) / TICK_S, [1000, 1001, 1002, 1003])


def test_exchanges_of_an_unknown_protocol_are_refused_by_name():
    unknown = replace(exchange("ds", 1000, 20_000_000, 98_320_384, 0, 0), protocol=np.array(["tdoa"]))
    for function in (raw_range, delay_weights, intervals):
        with pytest.raises(ArgumentError, match=r"protocol: found 'tdoa', allowed: ss, "):
            function(unknown)


def test_names_of_protocols_are_unique(registered):
    with pytest.raises(ArgumentError, match=r"already registered; choose another name, or use replace=True"):
        register_protocol(registered)
    register_protocol(replace(registered, title="better"), replace=True)
    assert PROTOCOLS[registered.name].title == "better"
    with pytest.raises(ArgumentError, match="'ds': this name is reserved"):
        register_protocol(replace(registered, name="ds"), replace=True)
    with pytest.raises(ArgumentError, match="'ss': was not registered"):
        PROTOCOLS.remove("ss")


SOON = ProtocolMessage("target", "rx1", "soon")  # type: ignore[arg-type]
FOURTH = ProtocolMessage("target", "rx3", "at once")


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [
        ("ds", "found 'ds', expected a RangingProtocol"),
        *((replace(SYMMETRIC, **change), expected) for change, expected in (
        ({"name": "two words"}, r"name: found 'two words', expected a word such as 'ds-alt'"),
        ({"name": ""}, "name: found ''"),
        ({"title": ""}, "title: found ''"),
        ({"messages": [POLL, REPLY]}, "expected a tuple of ProtocolMessage"),
        ({"messages": (POLL,)}, "found 1, expected 2 or 3: a recording has six stamps"),
        ({"messages": (*SYMMETRIC.messages, FOURTH)}, "found 4, expected 2 or 3: a recording has six stamps"),
        ({"messages": (REPLY, POLL)}, "1: found .*after='rx1'.*from the initiator after nothing"),
        ({"messages": (POLL, ProtocolMessage("initiator", "tx1", "at once"))}, "2: found .*after='tx1'"),
        (
            {"messages": (POLL, REPLY, ProtocolMessage("target", "rx1", "at once"))},
            "3: found .*after='rx1'.*expected from the target after tx2 or from the initiator after rx2",
        ),
        ({"messages": (POLL, SOON)}, "2: found .*timing='soon'.*at once or scheduled"),
        ({"flight_ticks": "(dt41 - dt32) / 2"}, "flight_ticks: found '.*', expected a function"),
        ({"delay_weights": None}, "delay_weights: found None, expected a function"),
        (
            {"flight_ticks": lambda t: 2 * mean_of_trips(t)},
            r"flight_ticks finds 2000 ticks for an exchange without noise of 1000 ticks$",
        ),
        (
            {"flight_ticks": lambda t: float(np.mean(mean_of_trips(t)))},
            r"return shapes \(\) and \(\(2,\), \(2,\)\) for two exchanges",
        ),
        (
            {"flight_ticks": mock.Mock(side_effect=KeyError("dt99"))},
            r"fail on an exchange without noise: KeyError\('dt99'\)",
        ),
        (
            {"delay_weights": lambda t: (-half_delays(t)[0], half_delays(t)[1])},
            "delay_weights leave 936 ticks .* antenna delays of 64 and 0",
        ),
        )),
    ],
)  # fmt: skip
def test_wrong_protocols_are_refused_in_one_line(protocol, expected):
    with pytest.raises(ArgumentError, match=rf"\A.*({expected}).*\Z"):
        register_protocol(protocol)
    assert SYMMETRIC.name not in PROTOCOLS


def test_ranges_of_known_protocols_look_for_no_plug_ins(monkeypatch):
    registry: Registry[RangingProtocol] = Registry("protocol", "nobody", PROTOCOLS.known(), check_protocol)

    monkeypatch.setattr("importlib.metadata.entry_points", asked := mock.Mock())
    monkeypatch.setattr(twr, "PROTOCOLS", registry)
    for name in ("ss", "ds-sym"):
        assert time_of_flight(exchange(name, 1000, 98_304_000, 98_304_000, 0, 0))[0] / TICK_S == pytest.approx(1000)
    assert len(time_of_flight(exchange("ss", 1000, 98_304_000, 0, 0, 0)[:0])) == 0
    assert not asked.called
