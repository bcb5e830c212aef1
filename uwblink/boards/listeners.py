"""Listeners: the one way out of a recorder. The file writer, the live table and the user's callback are all listeners.

```python
import uwblink

def print_range(heard: uwblink.Heard) -> None:
    print(heard.board, heard.message)

uwblink.record(["/dev/ttyACM0", "/dev/ttyACM1"], "flight.uwb", uwblink.RangingPlan(), listeners=[print_range])
```

A listener is a function of one `Heard`, or an object of a class derived from `Listener`. They are called in the
recorder's own loop, in their order, so they must be quick: 0.1 ms a message is plenty, and what takes longer belongs
into a thread of the listener's own, as the file writer's does. What one raises ends the recording, with everything
that came before in the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from uwblink.recording.schema import Fault
from uwblink.wire.codec import Event
from uwblink.wire.messages import RangeReport

Pair = tuple[int, int]
"""Initiator and target."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A message or a line of text that a board sent, the id of the board, and when it came (host time, Unix epoch).

    Every function among the listeners of `uwblink.record` is called with these:

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         '''
    ...         run = { duration_s = 10.0 }
    ...         ranging = { rate_hz = 50 }
    ...         bodies = [
    ...             { name = "near", motion = { model = "static", position_m = [0.0, 0.0, 1.0] } },
    ...             { name = "far", motion = { model = "static", position_m = [3.0, 0.0, 1.0] } },
    ...         ]
    ...         tags = [{ id = 10, body = "near" }, { id = 20, body = "far" }]
    ...         '''
    ...     )
    ... )
    >>> heard = []
    >>> plan = uwblink.RangingPlan(rate_hz=20.0)
    >>> _ = uwblink.record(
    ...     ports.names.values(), "heard.uwb", plan, duration_s=1.0, using=ports, listeners=[heard.append]
    ... )
    >>> {one.board for one in heard if type(one.message).__name__ == "RangeReport"}
    {10}
    """

    time_ns: int
    board: int
    message: Event


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn of the plan: who was to range with whom, the report (None: it failed), and when it ended."""

    time_ns: int
    pair: Pair
    report: RangeReport | None


class Listener:
    """What a recorder tells. Override what you want to know; as they are, the methods do nothing.

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         '''
    ...         run = { duration_s = 10.0 }
    ...         ranging = { rate_hz = 50 }
    ...         bodies = [
    ...             { name = "near", motion = { model = "static", position_m = [0.0, 0.0, 1.0] } },
    ...             { name = "far", motion = { model = "static", position_m = [3.0, 0.0, 1.0] } },
    ...         ]
    ...         tags = [{ id = 10, body = "near" }, { id = 20, body = "far" }]
    ...         '''
    ...     )
    ... )
    >>> class Farthest(uwblink.Listener):
    ...     range_m = 0.0
    ...
    ...     def on_turn(self, turn):
    ...         if turn.report:
    ...             self.range_m = max(self.range_m, turn.report.range_m)
    >>> farthest, plan = Farthest(), uwblink.RangingPlan(rate_hz=20.0)
    >>> _ = uwblink.record(
    ...     ports.names.values(), "far.uwb", plan, duration_s=1.0, using=ports, listeners=[farthest]
    ... )
    >>> abs(farthest.range_m - 3.0) < 0.5
    True
    """

    def on_start(self, pairs: Sequence[Pair]) -> None:
        """Note which pairs will range; what this raises refuses the recording before anything is written."""

    def on_bytes(self, time_ns: int, port: str, direction: str, data: bytes) -> None:
        """Note bytes that came "in" from a port or went "out" to it."""

    def on_message(self, heard: Heard) -> None:
        """Note a message or a line of text of a board."""

    def on_turn(self, turn: Turn) -> None:
        """Note that a turn of the plan has ended."""

    def on_fault(self, fault: Fault) -> None:
        """Note that something went wrong."""

    def check(self) -> None:
        """Raise if there is no point in going on; called often."""

    def close(self) -> None:
        """End: nothing more will come."""


class CallbackListener(Listener):
    """Calls a function with everything that boards say."""

    def __init__(self, callback: Callable[[Heard], object]) -> None:
        """Call `callback` with each `Heard`."""
        self._callback = callback

    def on_message(self, heard: Heard) -> None:
        """Call the function."""
        self._callback(heard)


def as_listeners(listeners: Iterable[Listener | Callable[[Heard], object]]) -> list[Listener]:
    """Return listeners, functions made into some; raises `TypeError` for what is neither."""
    found: list[Listener] = []
    for listener in listeners:
        if isinstance(listener, Listener):
            found.append(listener)
        elif callable(listener):
            found.append(CallbackListener(listener))
        else:
            raise TypeError(f"listeners: found {listener!r}, expected a Listener or a function of one Heard")
    return found
