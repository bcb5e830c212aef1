"""Looks whether boards' transmit stamps agree with the antenna delays that are said to be programmed into them."""

from __future__ import annotations

from typing import Final

from uwblink.boards.listeners import Listener, Turn
from uwblink.errors import PlanError
from uwblink.recording.antenna_delays import AntennaDelays
from uwblink.ticks import DELAYED_TX_GRID

HALF: Final = DELAYED_TX_GRID // 2
AGREEING: Final = 3
"""Reports that must contradict a delay alike: the wire has no checksum, and one stamp may be damaged."""


class WrongDelayError(PlanError):
    """Boards have other antenna delays than were said to be programmed into them."""


class DelayCheck(Listener):
    """Raises `WrongDelayError` where a board's first stamps are of another antenna delay than it is said to have.

    A frame leaves on a grid of 512 ticks, and its stamp is that time and the antenna delay: the stamp's rest is the
    delay's. What is in the register of the receiver shows in no stamp.
    """

    def __init__(self, delays: AntennaDelays) -> None:
        """Take what is programmed into each board."""
        self._expected = {
            (board, name): getattr(delay, name) for board, delay in delays.items() for name in ("tx", "reply")
        }
        self._rests: dict[tuple[int | None, str], list[int]] = {}

    def on_turn(self, turn: Turn) -> None:
        """Look at the stamps of a report; a delay that was found to be right is not looked at again."""
        report = turn.report
        if report is None or not self._expected:
            return
        initiator, target = turn.pair
        double_sided = bool(report.tx3 or report.rx3)
        sent = {(initiator, "tx"): report.tx1, (target, "tx" if double_sided else "reply"): report.tx2}
        if double_sided:
            sent[target, "reply"] = report.tx3
        for which, stamp in sent.items():
            if which in self._expected:
                self._look(which, stamp)

    def _look(self, which: tuple[int | None, str], stamp: int) -> None:
        delay = self._expected[which]
        rest = (stamp - delay + HALF) % DELAYED_TX_GRID - HALF
        rests = self._rests.setdefault(which, [])
        rests.append(rest)
        if not rest:
            del self._expected[which]
        elif len(rests) >= AGREEING and len(set(rests[-AGREEING:])) == 1:
            board, name = which
            raise WrongDelayError(
                f"board {board}: {name} = {delay} is taken to be programmed, but by its stamps it is {delay + rest}; "
                "say what is programmed into the boards",
                parameter="antenna_delays",
            )
