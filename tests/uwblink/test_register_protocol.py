"""A protocol that is registered at run time: accepted ones, refused ones, and the reasons."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwblink.test_twr import exchange
from uwblink import errors, twr
from uwblink.plugins import Registry
from uwblink.protocols.table import (
    PROTOCOLS,
    ProtocolMessage,
    RangingProtocol,
    check_protocol,
    half_delays,
    register_protocol,
)
from uwblink.ticks import TICK_S

POLL = ProtocolMessage("initiator", "", "at once")
REPLY = ProtocolMessage("target", "rx1", "scheduled")


def mean_of_trips(t):
    """Return half of the mean rest of both round trips: exact if both replies are equal."""
    return (t.dt41 - t.dt32 + t.dt64 - t.dt53) / 4


def in_targets_clock(t):
    """ICRA 2023, eq. (2), with the round trip rescaled instead of the reply."""
    return (t.dt41 * t.dt53 / t.dt64 - t.dt32) / 2


def in_targets_clock_delays(t):
    return t.dt53 / t.dt64 / 2, np.full_like(t.dt41, 0.5)


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
    in_targets_clock,
    in_targets_clock_delays,
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
    assert twr.time_of_flight(e)[0] / TICK_S == pytest.approx(1000, abs=2.5)
    moved = (twr.time_of_flight(replace(e, rx1=e.rx1 + 4000)) - twr.time_of_flight(e))[0] / TICK_S
    assert moved == pytest.approx(4000 * twr.delay_weights(e)[1][0], abs=1e-3)


def test_a_mixture_of_protocols_keeps_each_to_its_own_formula(registered):
    names = [registered.name, "ds", "ss", registered.name]
    parts = [exchange(name, 1000 + k, 98_304_000, 98_304_000, 0, 0) for k, name in enumerate(names)]
    columns = {f: np.concatenate([getattr(p, f) for p in parts]) for f in parts[0].__slots__ if f != "bits"}
    np.testing.assert_allclose(twr.time_of_flight(replace(parts[0], **columns)) / TICK_S, [1000, 1001, 1002, 1003])


def test_exchanges_of_an_unknown_protocol_are_refused_by_name():
    unknown = replace(exchange("ds", 1000, 20_000_000, 98_320_384, 0, 0), protocol=np.array(["tdoa"]))
    for function in (twr.raw_range, twr.delay_weights, twr.intervals):
        with pytest.raises(errors.ArgumentError, match=r"protocol: found 'tdoa', allowed: ss, "):
            function(unknown)


def test_names_of_protocols_are_unique(registered):
    with pytest.raises(errors.ArgumentError, match=r"already registered; choose another name, or use replace=True"):
        register_protocol(registered)
    register_protocol(replace(registered, title="better"), replace=True)
    assert PROTOCOLS[registered.name].title == "better"
    with pytest.raises(errors.ArgumentError, match="'ds': this name is reserved"):
        register_protocol(replace(registered, name="ds"), replace=True)
    with pytest.raises(errors.ArgumentError, match="'ss': was not registered"):
        PROTOCOLS.remove("ss")


SOON = ProtocolMessage("target", "rx1", "soon")  # type: ignore[arg-type]
FOURTH = ProtocolMessage("target", "rx3", "at once")


def doubled(t):
    return 2 * mean_of_trips(t)


def collapsed(t):
    return float(np.mean(mean_of_trips(t)))


def failing(_t):
    raise KeyError("dt99")


def backwards(t):
    weights = half_delays(t)
    return -weights[0], weights[1]


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
        ({"flight_ticks": doubled}, r"flight_ticks finds 2000 ticks for an exchange without noise of 1000 ticks$"),
        ({"flight_ticks": collapsed}, r"return shapes \(\) and \(\(2,\), \(2,\)\) for two exchanges"),
        ({"flight_ticks": failing}, r"fail on an exchange without noise: KeyError\('dt99'\)"),
        ({"delay_weights": backwards}, "delay_weights leave 936 ticks .* antenna delays of 64 and 0"),
        )),
    ],
)  # fmt: skip
def test_wrong_protocols_are_refused_in_one_line(protocol, expected):
    with pytest.raises(errors.ArgumentError, match=rf"\A.*({expected}).*\Z"):
        register_protocol(protocol)
    assert SYMMETRIC.name not in PROTOCOLS


def test_ranges_of_known_protocols_look_for_no_plug_ins(monkeypatch):
    registry: Registry[RangingProtocol] = Registry("protocol", "nobody", PROTOCOLS.known(), check_protocol)

    def forbidden(**_group):
        raise AssertionError("entry points were asked for")

    monkeypatch.setattr("importlib.metadata.entry_points", forbidden)
    monkeypatch.setattr(twr, "PROTOCOLS", registry)
    for name in ("ss", "ds-sym"):
        assert twr.time_of_flight(exchange(name, 1000, 98_304_000, 98_304_000, 0, 0))[0] / TICK_S == pytest.approx(1000)
    assert len(twr.time_of_flight(exchange("ss", 1000, 98_304_000, 0, 0, 0)[:0])) == 0
