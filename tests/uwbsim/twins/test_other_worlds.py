"""Twins of worlds with anchors, antennas of tags, fading, losses in bursts, plans of other kinds and two messages."""

import numpy as np
import pytest

import uwbsim
from tests.uwbsim.twins.worlds import box, known, world


def antennas():
    """Two robots and an anchor; along x one tag has more gain, another sends weak, and a third reads strong."""
    bodies = [
        {"name": "a", "motion": box(-2.0, -2.0)},
        {"name": "b", "motion": box(2.0, 1.5)},
        {"name": "mast", "motion": {"model": "static", "position_m": [-1.5, 3.0, 2.5], "yaw_deg": 40.0}},
    ]
    tags = [
        {"id": 1, "body": "a", "lever_arm_m": [0.2, 0.0, 0.0], "pattern_db": [0.0, 0.0, 0.0, 2.0]},
        {"id": 2, "body": "a", "lever_arm_m": [-0.2, 0.0, 0.0], "tx_power_db": -4.0},
        {"id": 3, "body": "b", "lever_arm_m": [0.2, 0.0, 0.0], "power_offset_db": 3.0},
        {"id": 4, "body": "b", "lever_arm_m": [-0.2, 0.0, 0.0]},
        {"id": 5, "body": "mast"},
    ]
    radio = {
        "multipath": None,
        "power_noise_db": 0.5,
        "fading": {"std_db": 1.5, "life_s": 0.1},
        "outages": {"share": 0.1, "life_s": 0.2},
    }
    tables = world(40.0, seed=8, rate_hz=240.0, radio=radio, bodies=bodies, tags=tags)
    return tables | {"radio": {key: value for key, value in tables["radio"].items() if value is not None}}


@pytest.fixture(scope="module")
def found():
    flight = uwbsim.simulate(antennas(), contention=False)
    return uwbsim.twin(flight, known(antennas()))


def test_antennas_and_offsets_are_told_apart(found):
    """Differences of directions are told by every exchange; of an antenna, fading leaves half a decibel open."""
    tags = {tag.id: tag for tag in found.scenario.tags}
    own = np.array(tags[1].pattern_db[1:])
    assert own[2] == pytest.approx(2.0, abs=0.6)
    assert np.argmax(np.abs(own)) == 2
    assert [tags[k].tx_power_db for k in (1, 2, 3, 4)] == pytest.approx([0.0, -4.0, 0.0, 0.0], abs=0.05)
    assert [tags[k].power_offset_db for k in (1, 2, 3, 4)] == pytest.approx([0.0, 0.0, 3.0, 0.0], abs=0.05)


def test_fading_is_no_noise_of_readings(found):
    assert found.found["fading_db"] == pytest.approx(1.5, rel=0.1)
    assert found.found["fading_life_s"] == pytest.approx(0.1, rel=0.25)
    assert found.found["power_noise_db"] == pytest.approx(0.5, rel=0.05)
    assert found.found["path_loss_exponent"] == pytest.approx(2.4, abs=0.1)


def test_losses_come_in_bursts(found):
    outages = found.scenario.radio.outages
    assert outages.share == pytest.approx(0.1, abs=0.02)
    assert outages.life_s == pytest.approx(0.2, rel=0.3)
    assert found.found["reflected_share"] == 0.0


def test_readings_that_saturate_are_told_from_powers_that_end():
    tables = antennas()
    tables["radio"] |= {"saturation_dbm": -82.0}
    saturated = uwbsim.twin(uwbsim.simulate(tables, contention=False), known(tables))
    assert saturated.found["saturation_dbm"] == pytest.approx(-82.0, abs=0.3)
    assert saturated.found["path_loss_exponent"] == pytest.approx(2.4, abs=0.2)


def test_powers_without_saturation_have_none(found):
    assert found.found["saturation_dbm"] is None


def test_a_mast_stands_and_robots_fly_as_recorded(found):
    motions = {body.name: body.motion for body in found.scenario.bodies}
    assert [motion.model for motion in motions.values()] == ["recorded", "recorded", "static"]
    assert motions["mast"].position_m == pytest.approx((-1.5, 3.0, 2.5))
    assert motions["mast"].yaw_deg == pytest.approx(40.0)


def test_two_messages_at_random_times_have_a_plan_and_no_noise_of_stamps(tmp_path):
    tables = world(20.0, rate_hz=100.0)
    tables["ranging"] |= {"protocol": "ss", "plan": "aloha"}
    tables["radio"] = {"rx_noise_ps": 150.0, "first_path_at_1m_dbm": -72.0}
    flight = uwbsim.simulate(tables, contention=False)
    twin = uwbsim.twin(flight, known(tables))
    assert twin.found["receive_noise_ps"] is None
    assert any("Noise of stamps apart from that of ranges" in text for text in twin.unknown)
    assert twin.scenario.ranging.response_delay_uus == 1500
    twin.save(tmp_path / "t.toml")
    again = uwbsim.simulate(tmp_path / "t.toml", contention=False).exchanges
    assert len(again) == len(flight.exchanges)
    assert np.array_equal(again.target, flight.exchanges.target)
    # Slots begin where messages left: a preamble later.
    assert np.max(np.abs(np.diff(again.time_ns) - np.diff(flight.exchanges.time_ns))) < 2_000
