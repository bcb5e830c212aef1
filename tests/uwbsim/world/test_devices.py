"""Effects of boards as devices: temperature, supply voltage, group delay over direction, and carrier readings.

Expected values were computed by hand from the planted ones.
"""

from dataclasses import replace

import numpy as np
import pytest

import uwbsim
from tests.registered import registered
from uwblink import PROTOCOLS, SPEED_OF_LIGHT, Board, Recording, raw_range
from uwblink.ticks import METRES_PER_TICK
from uwblink.wire.codec import Decoder
from uwblink.wire.messages import REPORTS, Overheard
from uwbsim.protocols.conditions import conditions_of, range_errors_m
from uwbsim.protocols.prediction import predict
from uwbsim.world.channel import CHANNEL_EFFECTS, ChannelEffect
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, Clocks
from uwbsim.world.reception import AntennaDelays

TYPICAL = {"range_mm_per_k": 2.15, "range_cm_per_v": 5.35}


def scenario(tags=({}, {}), bodies=({}, {}), devices=None, places=((0.0, 0.0, 1.0), (4.0, 0.0, 1.0)), **more):
    """Return two tags 4 m apart; 20 ps of noise dither the ticks, equally in every scenario."""
    quiet = {"rx_noise_ps": 20.0, "skew_noise_ppm": 0.0, "skew_bias_ppm": 0.0}
    return uwbsim.load(
        {
            "run": {"duration_s": 10.0, "seed": 2},
            "ranging": {
                "rate_hz": 100.0,
                "pairs": [[1, 2]],
                "reply": {"model": "fixed", "delay_us": 305.0},
            }
            | more.pop("ranging", {}),
            "radio": quiet | more.pop("radio", {}),
            "devices": devices or {},
            "bodies": [
                {"name": n, "motion": {"model": "static", "position_m": p}} | b
                for n, p, b in zip("ab", places, bodies, strict=True)
            ],
            "tags": [{"id": k + 1, "body": n} | tag for k, (n, tag) in enumerate(zip("ab", tags, strict=True))],
        }
        | more
    )


def errors(world):
    flight = uwbsim.simulate(world)
    return raw_range(flight.exchanges) - flight.truth_m, flight.exchanges.time_ns * 1e-9


HOT = [{"temperature_c": 43.0}] * 2


@pytest.mark.parametrize(
    ("changed", "longer_m"),
    [
        ({"bodies": HOT}, 0.086),  # two tags times 2.15 mm/K times 20 K
        # A tag alone half of that, and a body only where its tag has none.
        ({"bodies": HOT, "tags": ({"temperature_c": 23.0}, {"range_mm_per_k": 3.0})}, 0.060),
        ({"bodies": [{"supply_v": 3.2}] * 2}, -0.0107),
    ],
)
def test_ranges_change_with_temperature_and_supply(changed, longer_m):
    plain = np.mean(errors(scenario(devices=TYPICAL))[0])
    found = np.mean(errors(scenario(devices=TYPICAL, **changed))[0])
    # The mean of 1000 ranges with 20 ps and whole ticks is known to 0.1 mm.
    assert found - plain == pytest.approx(longer_m, abs=0.0005)


def test_a_warm_up_has_the_time_course_of_the_heat():
    cold, _ = errors(scenario(devices=TYPICAL))
    warm_up = {"model": "warm-up", "start": 23.0, "end": 43.0, "time_constant_s": 5.0}
    error, time_s = errors(scenario(bodies=[{"temperature_c": warm_up}] * 2, devices=TYPICAL))
    moved = 0.086 * (1 - np.exp(-time_s / 5.0))
    assert np.mean(error - moved) == pytest.approx(np.mean(cold), abs=0.0005)
    assert np.polyfit(moved, error, 1)[0] == pytest.approx(1, abs=0.02)


def test_longer_antennas_send_later_than_stamped_and_stamp_later_than_heard():
    world = scenario(tags=({"delay_ns": -0.5}, {}), bodies=({"temperature_c": 33.0}, {}), devices=TYPICAL)
    delays, tags, now = AntennaDelays.of(world), np.array([0, 1]), np.array([5, 5])
    longer = 2 * 0.0215 / SPEED_OF_LIGHT
    np.testing.assert_allclose(delays.transmit_s(tags, now), [-0.22e-9 - 0.44 * longer, 0], atol=1e-18)
    np.testing.assert_allclose(delays.receive_s(tags, now), [0.28e-9 + 0.56 * longer, 0], atol=1e-18)


def test_served_boards_are_as_warm():
    worlds = [scenario(bodies=[{"temperature_c": celsius}] * 2, devices=TYPICAL) for celsius in (23.0, 223.0)]
    boards = [Board(uwbsim.VirtualPorts(world).port(1)) for world in worlds]
    # 200 K, so that 20 ranges with whole ticks of 4.7 mm determine it: to 2 mm.
    longer_m = [boards[1].range(2).range_m - boards[0].range(2).range_m for _ in range(20)]
    assert np.mean(longer_m) == pytest.approx(0.86, abs=0.004)


def test_clocks_run_off_by_the_integral_of_warm_up_and_temperature():
    ramp = {"model": "ramp", "start": 23.0, "end": 33.0, "duration_s": 5.0, "begin_s": 2.0}
    tags = ({"skew_ppm": 3.0, "warm_up_ppm": 2.0, "warm_up_s": 4.0}, {"temperature_c": ramp, "skew_ppm_per_k": 0.5})
    clocks, which = Clocks.of(scenario(tags=tags)), np.array([0, 1])
    begin, end = (clocks.read(which, np.full(2, t * SUBTICKS_PER_SECOND)) for t in (0, 10))
    gained = (end - begin) / SUBTICKS_PER_SECOND - 10
    # Rates are constant over tenths of a second, evaluated in their middles.
    np.testing.assert_allclose(gained, [30e-6 + 8e-6 * (1 - np.exp(-2.5)), 0.5e-6 * (25 + 30)], atol=2e-9)


def test_a_profile_from_a_file_and_what_the_recording_tells(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "heat.csv").write_text("time_s,temperature_c\n0,20\n10,40\n")
    heat = {"temperature_c": {"model": "table", "file": "heat.csv"}}
    world = scenario(tags=(heat, {}), bodies=({"supply_v": 3.1}, {}), devices={"readings_hz": 2.0})
    uwbsim.simulate(world).save(tmp_path / "f.uwb")
    with Recording.open(tmp_path / "f.uwb") as recording:
        told = recording.columns("temperature")
        assert "temperature 21" in str(recording.show())
    assert set(told["tag"].tolist()) == {1}
    np.testing.assert_allclose(told["temperature_c"], 20 + 2 * told["time_ns"] * 1e-9, atol=1e-9)
    np.testing.assert_array_equal(told["supply_v"], 3.1)
    warm = scenario(bodies=({"temperature_c": 25.0}, {}), devices={"reading_noise_k": 0.1, "readings_hz": 20.0})
    noisy = uwbsim.simulate(warm).temperature
    assert np.isnan(noisy["supply_v"]).all()
    # 200 readings determine a deviation to 5 %.
    assert np.std(noisy["temperature_c"]) == pytest.approx(0.1, rel=0.15)
    assert uwbsim.simulate(scenario()).temperature == {}


WAVES = {"model": "harmonics", "mean_cm": 1.0, "cosine_cm": [2.0, 0.5], "sine_cm": [0.0, 3.0], "elevation_cm": 4.0}


@pytest.mark.parametrize("turned", [0.0, 30.0])
def test_group_delay_lengthens_ranges_by_both_directions(turned):
    """From a, b is at azimuth 30 degrees and elevation 0; from b, a is at -150 degrees."""
    places = ((0.0, 0.0, 1.0), (4 * np.cos(np.pi / 6), 2.0, 1.0))
    free, late = (errors(scenario(places=places, tags=tags))[0] for tags in (({}, {}), ({"group_delay": WAVES},) * 2))
    flat = 1 + 2 * np.cos(np.pi / 6) + 0.5 * 0.5 + 3 * np.sin(np.pi / 3)
    back = 1 - 2 * np.cos(np.pi / 6) + 0.5 * 0.5 + 3 * np.sin(np.pi / 3)
    assert np.mean(late) - np.mean(free) == pytest.approx((flat + back) / 100, abs=0.0005)
    one = scenario(places=places, tags=({"group_delay": WAVES | {"turned_deg": turned}}, {}))
    seen = np.radians(30 - turned)
    expected = 1 + 2 * np.cos(seen) + 0.5 * np.cos(2 * seen) + 3 * np.sin(2 * seen)
    assert np.mean(errors(one)[0]) - np.mean(free) == pytest.approx(expected / 100, abs=0.0005)


def test_group_delay_from_a_table_file_for_all(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = [f"{a},{e},{a / 60}" for a in (-180, -60, 60, 180) for e in (-90, 90)]
    (tmp_path / "delay.csv").write_text("azimuth_deg,elevation_deg,delay_cm\n" + "\n".join(lines) + "\n")
    tables = [{"model": "table", "file": "delay.csv", "turned_deg": turned} for turned in (0, 30)]
    places = ((0.0, 0.0, 1.0), (0.0, 4.0, 1.0))
    found = [np.mean(errors(scenario(places=places, radio={"group_delay": table}))[0]) for table in tables]
    # At 90 and -90 degrees 1.5 and -1.5 cm; rotated by 30, at 60 and -120 degrees, 1 and -2 cm.
    assert found[0] - found[1] == pytest.approx(0.01, abs=0.001)


def test_carrier_readings_have_a_sign_and_a_bias_by_power():
    told = []
    for radio in ({}, {"carrier_sign": -1}, {"skew_bias_ppm": 0.1, "skew_bias_ppm_per_db": 0.02}):
        exact = {"quantize": False, "first_path_at_1m_dbm": -80.0}
        x = uwbsim.simulate(scenario(({"skew_ppm": 5.0}, {"skew_ppm": 2.0}), radio=exact | radio)).exchanges
        told.append([np.mean(x.skew1_ppm), np.mean(x.skew2_ppm)])
    # 4 m are 12.04 dB below a metre: -92.04 dBm, 2.04 dB below the power to which the stated bias applies.
    bias = 0.1 - 0.02 * (20 * np.log10(4) - 10)
    np.testing.assert_allclose(told, [[-3, 3], [3, -3], [-3 + bias, 3 + bias]], atol=1e-6)


@pytest.mark.parametrize("protocol", ["ss-cfo", "ds", "ds-alt"])
def test_event_loop_and_monte_carlo_agree_on_all_of_it(protocol):
    """One flight with all effects: means of 1000 ranges each, known to 1 mm."""
    tags = (
        {"skew_ppm": 2.0, "temperature_c": 60.0, "group_delay": WAVES, "tx_power_db": 4.0, "skew_ppm_per_k": 0.01},
        {"supply_v": 3.0, "range_cm_per_v": 20.0},
    )
    radio = {"rx_noise_ps": 50.0, "carrier_sign": -1, "skew_bias_ppm": 0.4, "skew_bias_ppm_per_db": 0.05}
    world = scenario(tags=tags, devices=TYPICAL, radio=radio, ranging={"protocol": protocol})
    flight = errors(world)[0]
    columns = range_errors_m(PROTOCOLS[protocol], conditions_of(world), 3, 20_000)
    assert np.mean(flight) == pytest.approx(np.mean(columns), abs=0.003)
    assert abs(np.mean(columns)) > 0.01, "there is something to agree on"


def test_readings_of_power_saturate():
    """Inverses of lifted powers, to the power of 1.5, add to that of the limit: only strong powers saturate."""
    radio = {"quantize": False, "sensitivity_dbm": -120.0, "saturation_dbm": -80.0}
    worlds = (scenario(radio=radio | {"first_path_at_1m_dbm": at_1m_dbm}) for at_1m_dbm in (-100.0, -68.0, -40.0))
    found = [uwbsim.simulate(world).exchanges.fpp1_dbm[0] for world in worlds]
    middle = -80 - 10 / 1.5 * np.log10(1 + 10 ** (-0.15 * ((-68 - 20 * np.log10(4)) + 80)))
    np.testing.assert_allclose(found, [-100 - 20 * np.log10(4), middle, -80.0], atol=2e-3)
    assert middle == pytest.approx(-82.0, abs=0.05), "as strong as the highest: 2 dB below it"


# One model of reception: effects on radio waves are equal in flights, served boards, listeners and comparisons.


PLACES = {"a": (0.0, 0.0, 1.0), "b": (4.0, 0.5, 1.2), "c": (1.5, 3.0, 0.8), "post": (2.0, 0.25, 1.1)}
# Wide enough that the delayed transmissions of the firmware, 512 ticks apart, shift by whole steps.
TICKS, LOSS_DB = 512, 3.0
GEOMETRIC = {
    "room.reflection_loss_db": None,
    "radio.multipath": {"model": "geometric", "scatterers": 32, "stamp_noise": False},
    "radio.rx_noise_ps": 0.0,
    "room.roughness_mm": 0.0,
}


def reception(**more):
    """Two tags that range and one that listens, without motion; power readings have no noise."""
    return uwbsim.load(
        {
            "run": {"duration_s": 1.0, "seed": 4},
            "ranging": {"rate_hz": 20.0, "pairs": [[1, 2]]},
            "radio": {"quantize": False, "first_path_at_1m_dbm": -75.0, "skew_noise_ppm": 0.0, "antenna": "dipole"},
            "room": {"min_m": [-2.0, -2.0, 0.0], "max_m": [6.0, 5.0, 3.0], "reflection_loss_db": 8.0},
            "obstacles": [{"min_m": [0.9, -1.0, 0.0], "max_m": [1.1, 4.0, 2.5], "material": "drywall"}],
            "bodies": [{"name": n, "motion": {"model": "static", "position_m": p}} for n, p in PLACES.items()],
            "tags": [{"id": k + 1, "body": name, "passive": k == 2} for k, name in enumerate("abc")],
        },
        {"bodies.3.shadow": {"semi_axes_m": [0.3, 0.3, 1.0], "loss_db_per_m": 20.0}} | more,
    )


def served(world):
    """Range once from tag 1 to tag 2; return the output of the initiator and of the listener, tag 3."""
    ports = uwbsim.VirtualPorts(world)
    Board(ports.port(3)).set_passive(True)
    report = Board(ports.port(1)).range(2)
    ports.bench.advance(int(ports.bench.env.now) + 50_000_000)
    heard = b"".join(data for _, tag, data in ports.transfers if tag == 3)
    (overheard,) = (event for event in Decoder(REPORTS).feed(heard) if isinstance(event, Overheard))
    return report, overheard


def weaken_tag(link, ends):
    """An effect of a plug-in: links of tag 2 are weaker, and longer by a whole step of the boards' grid."""
    hit = (np.array(ends.tags()) == 2).any(axis=0)
    loss, way = LOSS_DB * hit, TICKS * METRES_PER_TICK * hit
    powers = {"power_dbm": link.power_dbm - loss, "total_dbm": link.total_dbm - loss}
    return replace(link, excess_m=link.excess_m + way, **powers)


@pytest.fixture(scope="module")
def both():
    """The same world without and with the effect: a flight, served boards, and conditions of comparisons."""

    def received():
        return uwbsim.simulate(reception()), served(reception()), conditions_of(reception())

    before = received()
    with registered(CHANNEL_EFFECTS, ChannelEffect("weaken", weaken_tag)):
        return before, received()


def test_a_plug_ins_effect_shows_in_flights_draw_for_draw(both):
    before, after = (found[0] for found in both)
    for name in ("fpp1_dbm", "fpp2_dbm"):
        np.testing.assert_allclose(getattr(before.exchanges, name) - getattr(after.exchanges, name), LOSS_DB, atol=1e-9)
    # Stamps are whole ticks, and the flight is rounded to sub-ticks: the same draws give the same range within a
    # sub-tick.
    longer = raw_range(after.exchanges) - raw_range(before.exchanges)
    np.testing.assert_allclose(longer, TICKS * METRES_PER_TICK, atol=1.01 * METRES_PER_TICK)
    assert after.meta["channel_effects"] == ["weaken"]
    assert "channel_effects" not in before.meta


def test_it_shows_in_what_listeners_overhear(both):
    before, after = (found[0].overheard for found in both)
    np.testing.assert_allclose(before["fpp1_dbm"], after["fpp1_dbm"], atol=1e-9)
    np.testing.assert_allclose(before["fpp2_dbm"] - after["fpp2_dbm"], LOSS_DB, atol=1e-9)
    # The response is sent later by the longer path of the poll, and its own path is longer by as much.
    np.testing.assert_allclose((after["rx2"] - after["rx1"]) - (before["rx2"] - before["rx1"]), 2 * TICKS, atol=1)


def test_it_shows_in_served_boards_and_their_listeners(both):
    (before, heard_before), (after, heard_after) = (found[1] for found in both)
    for name in ("fpp1_dbm", "fpp2_dbm"):
        assert getattr(before, name) - getattr(after, name) == pytest.approx(LOSS_DB, abs=2e-4), "four decimals"
    assert after.range_m - before.range_m == pytest.approx(TICKS * METRES_PER_TICK, abs=2 * METRES_PER_TICK)
    assert heard_before.fpp1_dbm == heard_after.fpp1_dbm
    assert heard_before.fpp2_dbm - heard_after.fpp2_dbm == pytest.approx(LOSS_DB, abs=2e-4)


def test_it_shows_in_the_workbench_draw_for_draw(both):
    before, after = (found[2] for found in both)
    np.testing.assert_allclose(before.power_dbm - after.power_dbm, LOSS_DB, atol=1e-9)
    for errors in (lambda c: range_errors_m(PROTOCOLS["ds"], c, 1, 500), lambda c: predict(PROTOCOLS["ds"], c).mean_m):
        assert errors(after)[0] - errors(before)[0] == pytest.approx(TICKS * METRES_PER_TICK, abs=1e-6)


@pytest.mark.parametrize(
    "more",
    [{}, {"obstacles": []}, {"room.reflection_loss_db": None}, {"bodies.3.shadow": None}, GEOMETRIC],
    ids=str,
)
def test_flights_boards_listeners_and_workbench_agree_on_every_power(more):
    """Each part of the world is removed in turn, so that none of the four can omit it."""
    world = reception(**more)
    flight, (report, overheard), conditions = uwbsim.simulate(world), served(world), conditions_of(world)
    power = flight.exchanges.fpp1_dbm[0]
    np.testing.assert_allclose(flight.exchanges.fpp1_dbm, power, atol=1e-9)
    np.testing.assert_allclose(conditions.power_dbm, power, atol=1e-9)
    assert report.fpp1_dbm == pytest.approx(power, abs=2e-4)
    assert overheard.fpp1_dbm == pytest.approx(flight.overheard["fpp1_dbm"][0], abs=2e-4)
    if more is GEOMETRIC:
        excess = np.mean(raw_range(flight.exchanges) - flight.truth_m)
        assert abs(excess) > 0.005
        assert np.mean(range_errors_m(PROTOCOLS["ds"], conditions, 1, 500)) == pytest.approx(excess, abs=0.003)
        assert report.range_m == pytest.approx(flight.truth_m[0] + excess, abs=0.012)
    elif more:
        whole = uwbsim.simulate(reception()).exchanges.fpp1_dbm[0]
        assert power - whole > 0.5 or more == {"room.reflection_loss_db": None}


def test_a_body_in_the_way_weakens_served_boards_by_its_chord():
    powers = [
        served(reception(**more))[0].fpp1_dbm for more in ({"room": None}, {"room": None, "bodies.3.shadow": None})
    ]
    # Through an ellipsoid whose height hardly matters: twice its half axis, 20 dB per metre.
    assert powers[1] - powers[0] == pytest.approx(20.0 * 0.6, abs=0.1)


@pytest.mark.parametrize(
    ("name", "effect", "fragment"),
    [
        ("reflections", lambda link, _: link, "channel effect 'reflections': this name is reserved"),
        ("x", 3, "channel effect 'x': apply: found 3, expected a function"),
        ("", lambda link, _: link, "channel effect '': name: found '', expected a word"),
    ],
)
def test_wrong_effects_are_refused(name, effect, fragment):
    with pytest.raises(uwbsim.ParameterError, match=fragment):
        uwbsim.register_channel_effect(name, effect)
    assert "x" not in CHANNEL_EFFECTS


@pytest.mark.parametrize(
    ("effect", "fragment"),
    [
        (lambda link, _: None, "returned None, expected a Link"),
        (lambda link, _: 1 / 0, "failed with ZeroDivisionError"),
        (lambda link, _: replace(link, power_dbm=-80.0), "power_dbm"),
        (lambda link, _: replace(link, total_dbm=link.total_dbm * np.nan), "total_dbm"),
        (lambda link, _: replace(link, excess_m=link.excess_m[:0]), "excess_m"),
    ],
)
def test_an_effect_that_returns_no_links_is_named(effect, fragment):
    said = pytest.raises(uwbsim.UwbsimError, match=f"channel effect 'strange'.*{fragment}")
    with registered(CHANNEL_EFFECTS, ChannelEffect("strange", effect)), said:
        uwbsim.simulate(reception())
