"""Virtual boards as ports of the driver, in virtual time: no wall clock, no pseudo-terminal, the same every run.

```python
ports = VirtualPorts(scenario)
board = uwblink.boards.board.Board(ports.port(10))
print(board.range(20).range_m)
```
"""

from __future__ import annotations

import math

from uwbsim.boards.virtual_board import NS_PER_S, Bench
from uwbsim.scenario.model import Scenario


class VirtualPorts:
    """The ports of a scenario's boards. Time passes only while somebody reads."""

    def __init__(self, scenario: Scenario, lost_share: float = 0.0) -> None:
        """Power all boards at time zero."""
        self.bench = Bench(scenario, self._arrived, lost_share)
        self._ports: dict[int, VirtualPort] = {}
        self.transfers: list[tuple[int, int, bytes]] = []
        """Everything that boards sent: time (ns), board, bytes of one USB transfer."""

    def port(self, tag: int) -> VirtualPort:
        """Return the port of a board, a `uwblink.boards.ports.Transport`."""
        return self._ports.setdefault(tag, VirtualPort(self, tag))

    def _arrived(self, time_ns: int, tag: int, data: bytes) -> None:
        self.transfers.append((time_ns, tag, data))
        self.port(tag).waiting += data


class VirtualPort:
    """One board's port."""

    def __init__(self, ports: VirtualPorts, tag: int) -> None:
        """Belong to a set of ports."""
        self._bench, self._tag = ports.bench, tag
        self.name = f"virtual board {tag}"
        self.waiting = b""

    def read(self, timeout_s: float) -> bytes:
        """Let time pass until something comes, or the time is over."""
        until_ns = int(self._bench.env.now) + math.ceil(timeout_s * NS_PER_S)
        while not self.waiting and self._bench.next_ns() <= until_ns:
            self._bench.advance(int(self._bench.next_ns()) + 1)
        if not self.waiting:
            self._bench.advance(until_ns)
        data, self.waiting = self.waiting, b""
        return data

    def write(self, data: bytes) -> None:
        """Send bytes to the board."""
        self._bench.boards[self._tag].write(data)

    def now_s(self) -> float:
        """Return the virtual time in seconds."""
        return int(self._bench.env.now) / NS_PER_S

    def close(self) -> None:
        """Forget what was not read."""
        self.waiting = b""
