"""One reception for all: what happens to waves shows in flights, served boards, listeners and the workbench alike."""

from dataclasses import replace

import numpy as np
import pytest

import uwbsim
from tests.uwbsim.world.helpers import served
from uwblink import PROTOCOLS, raw_range
from uwblink.ticks import METRES_PER_TICK
from uwbsim.protocols.conditions import conditions_of, range_errors_m
from uwbsim.protocols.prediction import predict
from uwbsim.world.channel import CHANNEL_EFFECTS

PLACES = {"a": (0.0, 0.0, 1.0), "b": (4.0, 0.5, 1.2), "c": (1.5, 3.0, 0.8), "post": (2.0, 0.25, 1.1)}
# Wide enough that the delayed transmissions of the firmware, 512 ticks apart, shift by whole steps.
TICKS, LOSS_DB = 512, 3.0
TAG_OF_LOSS = 2
GEOMETRIC = {
    "room.reflection_loss_db": None,
    "radio.multipath": {"model": "geometric", "scatterers": 32, "stamp_noise": False},
    "radio.rx_noise_ps": 0.0,
    "room.roughness_mm": 0.0,
}


def scenario(**more):
    """Two tags that range and one that listens, nothing moves; the power readings have no noise."""
    shadow = {"semi_axes_m": [0.3, 0.3, 1.0], "loss_db_per_m": 20.0}
    return uwbsim.load(
        {
            "run": {"duration_s": 1.0, "seed": 4},
            "ranging": {"rate_hz": 20.0, "pairs": [[1, 2]]},
            "radio": {"quantize": False, "first_path_at_1m_dbm": -75.0, "skew_noise_ppm": 0.0, "antenna": "dipole"},
            "room": {"min_m": [-2.0, -2.0, 0.0], "max_m": [6.0, 5.0, 3.0], "reflection_loss_db": 8.0},
            "obstacles": [{"min_m": [0.9, -1.0, 0.0], "max_m": [1.1, 4.0, 2.5], "material": "drywall"}],
            "bodies": [
                {"name": name, "motion": {"model": "static", "position_m": place}}
                | ({"shadow": shadow} if name == "post" else {})
                for name, place in PLACES.items()
            ],
            "tags": [{"id": k + 1, "body": name, "passive": k == 2} for k, name in enumerate("abc")],
        },
        more,
    )


def weaken_tag(link, ends):
    """A plug-in's effect: links of one tag are weaker, and longer by a whole step of the boards' grid."""
    hit = (np.array(ends.tags()) == TAG_OF_LOSS).any(axis=0)
    loss, way = LOSS_DB * hit, TICKS * METRES_PER_TICK * hit
    powers = {"power_dbm": link.power_dbm - loss, "total_dbm": link.total_dbm - loss}
    return replace(link, excess_m=link.excess_m + way, **powers)


@pytest.fixture(scope="module")
def both():
    """The same world without the effect and with it: a flight, served boards, and conditions of the workbench."""
    found = []
    for _ in range(2):
        found.append((uwbsim.simulate(scenario()), served(scenario()), conditions_of(scenario())))
        if not found[1:]:
            uwbsim.register_channel_effect("weaken", weaken_tag)
    del CHANNEL_EFFECTS["weaken"]
    return found


def test_a_plug_ins_effect_shows_in_flights_draw_for_draw(both):
    before, after = (found[0] for found in both)
    for name in ("fpp1_dbm", "fpp2_dbm"):
        drop = getattr(before.exchanges, name) - getattr(after.exchanges, name)
        np.testing.assert_allclose(drop, LOSS_DB, atol=1e-9)
    # Stamps are whole ticks, and the flight is rounded to sub-ticks: the same draws give the same range, but for one.
    longer = raw_range(after.exchanges) - raw_range(before.exchanges)
    np.testing.assert_allclose(longer, TICKS * METRES_PER_TICK, atol=1.01 * METRES_PER_TICK)
    assert after.meta["channel_effects"] == ["weaken"]
    assert "channel_effects" not in before.meta


def test_it_shows_in_what_listeners_overhear(both):
    before, after = (found[0].overheard for found in both)
    np.testing.assert_allclose(before["fpp1_dbm"], after["fpp1_dbm"], atol=1e-9)
    np.testing.assert_allclose(before["fpp2_dbm"] - after["fpp2_dbm"], LOSS_DB, atol=1e-9)
    # The response leaves later by the poll's way more, and is on its way longer by as much.
    shift = (after["rx2"] - after["rx1"]) - (before["rx2"] - before["rx1"])
    np.testing.assert_allclose(shift, 2 * TICKS, atol=1)


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
        longer = errors(after)[0] - errors(before)[0]
        assert longer == pytest.approx(TICKS * METRES_PER_TICK, abs=1e-6)


@pytest.mark.parametrize(
    "more",
    [{}, {"obstacles": []}, {"room.reflection_loss_db": None}, {"bodies.3.shadow": None}, GEOMETRIC],
    ids=str,
)
def test_flights_boards_listeners_and_workbench_agree_on_every_power(more):
    """Each part of the world is taken away in turn, so that none of the four can leave it out."""
    world = scenario(**more)
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
        whole = uwbsim.simulate(scenario()).exchanges.fpp1_dbm[0]
        assert power - whole > 0.5 or more == {"room.reflection_loss_db": None}


def test_a_body_in_the_way_weakens_served_boards_by_its_chord():
    powers = [
        served(scenario(**more))[0].fpp1_dbm for more in ({"room": None}, {"room": None, "bodies.3.shadow": None})
    ]
    # Through an ellipsoid whose height hardly matters: twice its half axis, 20 dB a metre.
    assert powers[1] - powers[0] == pytest.approx(20.0 * 0.6, abs=0.1)


@pytest.mark.parametrize(
    ("name", "effect", "fragment"),
    [
        ("shadows", lambda link, _: link, "`name`: found 'shadows', which is taken"),
        ("x", 3, "`effect`: found 3, expected"),
        ("", lambda link, _: link, "`name`: found '', expected a word"),
    ],
)
def test_effects_that_cannot_be_are_refused(name, effect, fragment):
    with pytest.raises(uwbsim.ParameterError, match=fragment):
        uwbsim.register_channel_effect(name, effect)
    assert "x" not in CHANNEL_EFFECTS


@pytest.mark.parametrize(
    ("effect", "fragment"),
    [
        (lambda link, _: None, "returned None, expected a Link"),
        (lambda link, _: replace(link, power_dbm=-80.0), "power_dbm"),
        (lambda link, _: replace(link, total_dbm=link.total_dbm * np.nan), "total_dbm"),
        (lambda link, _: replace(link, excess_m=link.excess_m[:0]), "excess_m"),
    ],
)
def test_an_effect_that_returns_no_links_is_named(effect, fragment):
    uwbsim.register_channel_effect("strange", effect)
    try:
        with pytest.raises(uwbsim.UwbsimError, match=f"channel effect 'strange'.*{fragment}"):
            uwbsim.simulate(scenario())
    finally:
        del CHANNEL_EFFECTS["strange"]
