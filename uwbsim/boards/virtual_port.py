"""Virtual boards as ports of the driver, in virtual time: without wall clock and pseudo-terminal, deterministic.

For tests of programs that use `uwblink.Board` or the ports of a recorder.

```python
ports = uwbsim.VirtualPorts(scenario)
print(uwblink.Board(ports.port(10)).range(20).range_m)
uwblink.record(ports.names.values(), "flight.uwb", uwblink.RangingPlan(), duration_s=60.0, using=ports)
```

The minute of the recording takes only the time of its computation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from uwblink.boards.ports import Transport
from uwblink.errors import PortLostError, PortMissingError
from uwbsim.boards.virtual_board import Bench
from uwbsim.errors import ParameterError
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario
from uwbsim.world.clocks import NS_PER_S


class VirtualPorts:
    """The ports of a scenario's boards. Time passes only while a caller reads or waits.

    `names` by tag are the arguments of `open`; `lost_share` of all frames are lost in addition to weak ones.

    >>> import uwblink, uwbsim
    >>> near, far = ({"model": "static", "position_m": [x, 0.0, 1.0]} for x in (0.0, 3.0))
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         {
    ...             "run": {"duration_s": 10.0},
    ...             "ranging": {"rate_hz": 50.0},
    ...             "bodies": [{"name": "near", "motion": near}, {"name": "far", "motion": far}],
    ...             "tags": [{"id": 10, "body": "near"}, {"id": 20, "body": "far"}],
    ...         }
    ...     )
    ... )
    >>> with uwblink.Board(ports.port(10)) as board:
    ...     report = board.range(20)
    >>> report.neighbour, abs(report.range_m - 3.0) < 0.2
    (20, True)
    """

    def __init__(self, scenario: Scenario | Source, lost_share: float = 0.0, *, epoch_ns: int = 0) -> None:
        """Power all boards at virtual time zero, which is `epoch_ns` in the host times of a recording.

        `scenario` is an argument or a result of `uwbsim.load`; of all frames `lost_share` (0 to 1) are lost in addition
        to weak ones. Raises `ScenarioError` and `ParameterError`.
        """
        if not 0 <= lost_share <= 1:
            raise ParameterError(f"found {lost_share}, expected a share from 0 to 1", parameter="lost_share")
        scenario = as_scenario(scenario)
        self.bench = Bench(scenario, self._arrived, lost_share)
        self._epoch_ns = epoch_ns
        self._ports: dict[int, VirtualPort] = {}
        self._opened: list[VirtualPort] = []
        self.names = {tag.id: f"virtual board {tag.id}" for tag in scenario.tags}
        self.transfers: deque[tuple[int, int, bytes]] = deque(maxlen=20_000)
        """The last 20,000 transfers of boards, some MB: time (ns), board, bytes of one USB transfer."""

    def port(self, tag: int) -> VirtualPort:
        """Return the port of a board; raises `PortMissingError` where the scenario has no such tag."""
        if tag not in self.names:
            raise PortMissingError(f"no virtual board {tag}; the tags are {', '.join(map(str, self.names))}")
        return self._ports.setdefault(tag, VirtualPort(self, tag))

    def open(self, name: str) -> VirtualPort:
        """Return the port with one of `names`, empty; raises `PortMissingError` for another or an unplugged one."""
        tag = next((tag for tag, known in self.names.items() if known == name), None)
        if tag is None or not self.bench.boards[tag].powered:
            raise PortMissingError(f"{name}: no such port; there are {', '.join(self.names.values())}")
        port = self.port(tag)
        port.waiting.clear()
        self._opened.append(port)
        return port

    def close(self, port: Transport) -> None:
        """Close a port."""
        port.close()
        self._opened = [p for p in self._opened if p is not port]

    def wait(self, timeout_s: float) -> Sequence[VirtualPort]:
        """Advance time until bytes wait at an open port, or to the timeout; return the ports to read from."""
        until_ns = self.now_ns() + math.ceil(timeout_s * NS_PER_S)
        while not (ready := [p for p in self._opened if p.waiting or not self.bench.boards[p.tag].powered]):
            if self.bench.next_ns() > until_ns:
                self.bench.advance(until_ns)
                break
            self.bench.advance(int(self.bench.next_ns()) + 1)
        return ready

    def now_ns(self) -> int:
        """Return the virtual time in nanoseconds."""
        return int(self.bench.env.now)

    def now_s(self) -> float:
        """Return the virtual time in seconds."""
        return self.now_ns() / NS_PER_S

    def host_ns(self) -> int:
        """Return the host time that belongs to the virtual time."""
        return self._epoch_ns + self.now_ns()

    def moved(self, name: str, number: str | None) -> str | None:
        """Return the name of a port that is plugged in, None for another one."""
        return name if any(known == name and self.bench.boards[t].powered for t, known in self.names.items()) else None

    def _arrived(self, time_ns: int, tag: int, data: bytes) -> None:
        self.transfers.append((time_ns, tag, data))
        self.port(tag).waiting += data


class VirtualPort:
    """One board's port, a `uwblink.boards.ports.Transport`."""

    def __init__(self, ports: VirtualPorts, tag: int) -> None:
        """Create the port of a board."""
        self._ports, self.tag = ports, tag
        self.name = ports.names[tag]
        self.waiting = bytearray()

    def read(self, timeout_s: float) -> bytes:
        """Advance time until bytes arrive, or to the timeout; raises `PortLostError` at an unplugged board."""
        bench = self._ports.bench
        until_ns = self._ports.now_ns() + math.ceil(timeout_s * NS_PER_S)
        while not self.waiting and bench.next_ns() <= until_ns:
            bench.advance(int(bench.next_ns()) + 1)
        if not self.waiting:
            self._check()
            bench.advance(until_ns)
        data = bytes(self.waiting)
        self.waiting.clear()
        return data

    def write(self, data: bytes) -> None:
        """Send bytes to the board; raises `PortLostError` at an unplugged one."""
        self._check()
        self._ports.bench.boards[self.tag].write(data)

    def now_s(self) -> float:
        """Return the virtual time in seconds."""
        return self._ports.now_s()

    def close(self) -> None:
        """Discard bytes that were not read."""
        self.waiting.clear()

    def _check(self) -> None:
        if not self._ports.bench.boards[self.tag].powered:
            raise PortLostError(f"{self.name}: the port is gone (unplugged); plug the board in again")
