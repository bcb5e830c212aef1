"""When carried boards stand, and that a server says so."""

import math

import uwbsim
from uwbsim.boards.server import stays_s


def scenario(stays=((0.2, 0.1),), places=3):
    bodies = [
        {"name": f"b{k}", "motion": {"model": "carried", "stay_s": stay, "carry_s": carry, "places_m": [[k, p, 1.0]
         for p in range(places)]}}
        for k, (stay, carry) in enumerate(stays)
    ]  # fmt: skip
    bodies += [{"name": f"w{k}", "motion": {"model": "static", "position_m": [9.0, k, 1.0]}} for k in (0, 1)]
    tags = [{"id": k + 1, "body": body["name"]} for k, body in enumerate(bodies)]
    return uwbsim.load({"run": {"duration_s": 9.0}, "ranging": {"rate_hz": 20.0}, "bodies": bodies, "tags": tags})


def test_boards_stand_while_nobody_is_carried():
    found = stays_s(scenario(((10.0, 2.0), (5.0, 4.0)), places=2))
    assert found == [(0.0, 5.0), (9.0, 10.0), (12.0, math.inf)]
    assert stays_s(scenario(())) == []
    assert stays_s(scenario(((10.0, 2.0),), places=1)) == [(0.0, math.inf)]


def test_a_server_says_when_boards_stand():
    told: list[str] = []
    server = uwbsim.Server(scenario())
    try:
        server.announce(told.append)
        server.run(lambda: len(told) == 3, 20.0)
    finally:
        server.close()
    assert told == [
        "    0 s  place 1 of 3: boards stand until 0.2 s",
        "  0.3 s  place 2 of 3: boards stand until 0.5 s",
        "  0.6 s  place 3 of 3: boards stay there",
    ]
