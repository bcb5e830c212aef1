"""Ports of virtual boards hold no more after many exchanges than after some."""

import gc
import sys
from collections import deque

import uwblink
import uwbsim
from uwblink.boards.listeners import PairState
from uwblink.boards.record import identify
from uwblink.boards.recorder import Recorder

WARM, LATER = 200, 700


def two_boards():
    near, far = ({"model": "static", "position_m": [x, 0.0, 1.0]} for x in (0.0, 3.0))
    bodies = [{"name": "near", "motion": near}, {"name": "far", "motion": far}]
    tags = [{"id": 10, "body": "near"}, {"id": 20, "body": "far"}]
    scenario = {"run": {"duration_s": 10.0}, "ranging": {"rate_hz": 50.0}, "bodies": bodies, "tags": tags}
    return uwbsim.VirtualPorts(uwbsim.load(scenario))


def test_nothing_grows_with_what_boards_sent():
    held: list[tuple[int, int]] = []
    ports = two_boards()
    assert ports.transfers.maxlen
    ports.transfers = deque(maxlen=50)
    found = identify(ports.names.values(), ports)
    plan = uwblink.RangingPlan(rate_hz=100.0)
    turns = plan.turns(sorted(found))
    recorder = Recorder(found, plan, turns, [], ports=ports)
    assert PairState().reports.maxlen
    recorder.progress.pairs = {pair: PairState(reports=deque(maxlen=50)) for pair in turns}
    for _ in recorder.steps(stop=lambda: len(held) == 2):
        if recorder.progress.exchanges == (WARM, LATER)[len(held)]:
            gc.collect()
            held.append((len(gc.get_objects()), sys.getallocatedblocks()))
    recorder.finish()
    recorder.close()
    assert len(ports.transfers) == 50
    time_ns, _, data = ports.transfers[-1]
    assert data
    assert time_ns <= ports.now_ns()
    (objects, blocks), (objects_later, blocks_later) = held
    # What boards sent of an exchange would be some of either, and there were 500 in between, of four blocks.
    assert objects_later - objects < 100
    assert blocks_later - blocks < 1_000
