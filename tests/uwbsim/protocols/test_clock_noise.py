"""What white noise of clocks' rates costs protocols: flights, Monte Carlo and prediction against closed forms."""

import numpy as np
import pytest

import uwbsim
from uwblink import PROTOCOLS, Board, raw_range
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.protocols.conditions import conditions_of, range_errors_m
from uwbsim.protocols.prediction import predict

WHITE = 0.01e-6
REPLY_S, UUS_S, COUNT = 305e-6, 512 / 499.2e6, 3000


def scenario(protocol="ds", white_ppm=WHITE * 1e6, uus=1500, **tag):
    quiet = {"rx_noise_ps": 0.0, "skew_noise_ppm": 0.0, "skew_bias_ppm": 0.0, "quantize": False}
    places = {"a": (0.0, 0.0, 1.0), "b": (3.0, 0.0, 1.0)}
    return uwbsim.load(
        {
            "run": {"duration_s": COUNT / 100, "seed": 3},
            "ranging": {
                "protocol": protocol,
                "rate_hz": 100.0,
                "response_delay_uus": uus,
                "reply": {"model": "fixed", "delay_us": REPLY_S * 1e6},
            },
            "radio": quiet,
            "bodies": [{"name": n, "motion": {"model": "static", "position_m": p}} for n, p in places.items()],
            "tags": [{"id": k + 1, "body": n, "white_ppm_sqrt_s": white_ppm} | tag for k, n in enumerate(places)],
        }
    )


def errors_m(world):
    flight = uwbsim.simulate(world, contention=False)
    return raw_range(flight.exchanges) - flight.truth_m


def closed_form_m(protocol, uus=1500):
    """From phases that wander independently over the spans of the formulas, whose flights are negligible."""
    wait = uus * UUS_S
    if protocol == "ss":
        # Half of the difference of what two clocks gather over the reply.
        return SPEED_OF_LIGHT * WHITE * np.sqrt(2 * wait) / 2
    # dt41 - K dt32: both clocks over the reply, and both over the wait, by which K = dt64/dt53 is known.
    return SPEED_OF_LIGHT * WHITE * np.sqrt(2 * REPLY_S * (1 + REPLY_S / wait)) / 2


@pytest.mark.parametrize("protocol", ["ds", "ss", "ss-cfo", "ds-alt", "ds-sym"])
def test_prediction_monte_carlo_and_flight_agree(protocol):
    world = scenario(protocol)
    conditions = conditions_of(world)
    predicted = np.sqrt(predict(PROTOCOLS[protocol], conditions).pooled()[1])
    drawn = np.std(range_errors_m(PROTOCOLS[protocol], conditions, 1, 20_000))
    assert drawn == pytest.approx(predicted, rel=0.03)
    assert np.std(errors_m(world)) == pytest.approx(predicted, rel=0.06)


@pytest.mark.parametrize("protocol", ["ds", "ss"])
def test_prediction_has_the_closed_form(protocol):
    found = predict(PROTOCOLS[protocol], conditions_of(scenario(protocol)))
    np.testing.assert_allclose(np.sqrt(found.parts_m2["clocks"]), closed_form_m(protocol), rtol=2e-3)


def test_served_boards_lose_as_much():
    world = scenario()

    ports = uwbsim.VirtualPorts(world)
    first = Board(ports.port(1))
    ranges = [first.range(2).range_m for _ in range(400)]
    # 400 exchanges know a deviation to 3.5 %; whole ticks and the grid are in it, too.
    assert np.std(ranges) == pytest.approx(closed_form_m("ds"), rel=0.15)
