"""Boards for tests: a scenario of three on a bench, served in a thread, and real ones if there are any."""

import os
import threading
from contextlib import ExitStack, contextmanager

import pytest

from uwblink import Listener, RangingPlan, record
from uwblink.boards.ports import SerialPort, Terminal
from uwbsim import Scenario, VirtualPorts
from uwbsim.boards.server import FaultsFile, Server

PLACES = {1: (0.0, 0.0, 0.0), 2: (3.0, 0.0, 0.0), 3: (1.0, 2.0, 0.0)}


def bench_scenario(seed=1, places=PLACES, **radio):
    """The layout of the captured transcripts: boards 1, 2, 3, skews +1.5, -2.0, +0.5 ppm."""
    return Scenario.model_validate(
        {
            "run": {"seed": seed, "duration_s": 60.0},
            "ranging": {"rate_hz": 100.0},
            "radio": {"first_path_at_1m_dbm": -78.0, **radio},
            "bodies": [{"name": f"b{k}", "motion": {"model": "static", "position_m": p}} for k, p in places.items()],
            "tags": [
                {"id": k, "body": f"b{k}", "skew_ppm": skew, "delay_ns": 0.0}
                for k, skew in zip(places, (1.5, -2.0, 0.5, 0.0), strict=False)
            ],
        }
    )


def record_bench(path, plan=None, ports=None, **more):
    """Record the boards of the bench in virtual time, at 50 exchanges per second unless a plan states another rate."""
    ports = ports or VirtualPorts(bench_scenario())
    return record(ports.names.values(), path, plan or RangingPlan(rate_hz=50.0), using=ports, **more)


class After(Listener):
    """Runs functions after some numbers of turns of the plan."""

    def __init__(self, **what):
        self.turns, self._what = 0, {int(name[1:]): do for name, do in what.items()}

    def on_turn(self, turn):
        self.turns += 1
        self._what.get(self.turns, lambda: None)()


@contextmanager
def served(scenario=None, faults=None, link_dir=None, **more):
    """Serve a scenario in a thread; yield the server."""
    wrong = FaultsFile.model_validate({"faults": faults or []})
    server = Server(scenario or bench_scenario(), link_dir, wrong, **more)
    stop = threading.Event()
    thread = threading.Thread(target=server.run, args=(stop.is_set,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        stop.set()
        thread.join(60)  # under load, a step takes long, and its output must not be closed
        server.close()


@contextmanager
def device(step, link=None):
    """Serve a device in a thread: `step` acts on its end of the port again and again; yield that end."""
    terminal, over = Terminal(link), threading.Event()

    def serve():
        while not over.wait(0.001):
            step(terminal)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield terminal
    finally:
        over.set()
        thread.join(10)
        terminal.unplug()


@contextmanager
def two_ports(kind):
    """Yield the ports of two boards: "virtual" in process, "terminal" served, or "real", of which UWB_PORTS names two.

    Also yield the bench of the boards, None for real ones.
    """
    if kind == "virtual":
        ports = VirtualPorts(bench_scenario())
        yield [ports.port(1), ports.port(2)], ports.bench
        return
    with ExitStack() as stack:
        server = stack.enter_context(served()) if kind == "terminal" else None
        names = [server.names[1], server.names[2]] if server else os.environ.get("UWB_PORTS", "").split(",")
        if len(names) != 2:
            pytest.skip("no real boards: UWB_PORTS does not name two ports")
        found = [SerialPort(name) for name in names]
        for port in found:
            stack.callback(port.close)
        yield found, server and server.bench
