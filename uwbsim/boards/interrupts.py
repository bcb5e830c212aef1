"""What a board does with a frame for which it was not waiting: answer, overhear, complain, or print a broadcast.

Overhearing keeps the processor busy from frame to frame, and waits for ever for the initiator's final: a passive board
is deaf to USB meanwhile (firmware wire format, 3.3).
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, Any, Final

import simpy

from uwblink.wire.messages import BroadcastReceived, Overheard, OverheardNothing
from uwbsim.boards.board_air import PREAMBLE_TIMEOUT, US
from uwbsim.boards.frames import MASK, DataPayload, FinalPayload, Payload, PollPayload, Received, ResponsePayload
from uwbsim.boards.ranging import answer, is_expected, print_cir

if TYPE_CHECKING:
    from uwbsim.boards.virtual_board import VirtualBoard

TO_LINE: Final = 90 * US
"""From the end of a frame to a line that needs no arithmetic."""

TO_OVERHEARD: Final = 525 * US
WARNING_B: Final = b"WARNING 0xB: TWR message is firing an interrupt when it shouldn't be.\r\n"
WARNING_C: Final = b"WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.\r\n"

Steps = Generator[simpy.Event, Any, None]
Expected = tuple[type[Payload], int, int, int | None]
"""A frame that a listener waits for: its payload, its two boards, and for how long."""


def received_by(board: VirtualBoard, received: Received | None) -> Steps | None:
    """Deal with a frame at once, or return the steps that it takes."""
    if received is None:
        return _recover(board)
    payload = received.frame.payload
    if isinstance(payload, PollPayload):
        if received.frame.receiver == board.id:
            return answer(board, received)
        if board.passive:
            return overhear(board, received)
    elif isinstance(payload, DataPayload):
        board.say(BroadcastReceived(payload.data), TO_LINE)
    else:
        board.say(WARNING_B if isinstance(payload, ResponsePayload) else WARNING_C, TO_LINE)
    board.radio.listen()
    return None


def _recover(board: VirtualBoard) -> Steps:
    """After a damaged frame the receiver is off, until the USB task looks at it."""
    board.release()
    yield board.until_next_poll()


def overhear(board: VirtualBoard, poll: Received) -> Steps:
    """Follow the exchange that a poll begins, and print it; nothing, or zeros, where a frame does not come."""
    wish, initiator, target = poll.frame.payload, poll.frame.sender, poll.frame.receiver
    if not isinstance(wish, PollPayload) or target is None:
        raise TypeError("an exchange begins with a poll for somebody")
    heard = [poll]
    for payload, sender, receiver, patience in _sequence(wish, initiator, target):
        came = yield from board.radio.wait(patience)
        if came is None or not is_expected(came, payload, sender, receiver):
            if wish.double_sided and len(heard) == 1:
                board.say(OverheardNothing(initiator, target), TO_LINE)
            return
        heard.append(came)
    yield board.sleep(TO_OVERHEARD)
    if wish.get_cir:
        yield from print_cir(board, initiator, target, heard[-1])
    board.say(_overheard(initiator, target, wish, heard))


def _sequence(wish: PollPayload, initiator: int, target: int) -> list[Expected]:
    """Return the frames that follow a poll; the firmware sets no time-out for the last one."""
    frames: list[Expected] = [(FinalPayload, target, initiator, PREAMBLE_TIMEOUT)]
    if wish.double_sided:
        frames.insert(0, (ResponsePayload, target, initiator, PREAMBLE_TIMEOUT))
    if wish.target_reports:
        frames.append((FinalPayload, initiator, target, None))
    return frames


def _overheard(initiator: int, target: int, wish: PollPayload, heard: list[Received]) -> Overheard:
    """Return what a listener prints; the initiator's own readings travel only in its final."""
    signals = heard[:3] if wish.double_sided else heard[:2]
    rx = [*(r.stamp & MASK for r in signals), 0]
    power: list[float | None] = [*(r.power_dbm for r in signals), None]
    skew: list[float | None] = [*(r.skew_ppm for r in signals), None]
    theirs = _readings(signals[-1])
    mine = _readings(heard[-1]) if wish.target_reports else FinalPayload((0, 0, 0), 0.0, 0.0)
    (tx1, rx2, rx3), (rx1, tx2, tx3) = mine.stamps, theirs.stamps
    return Overheard(
        initiator,
        target,
        rx1=rx[0],
        rx2=rx[1],
        rx3=rx[2],
        tx1_n=tx1,
        rx1_n=rx1,
        tx2_n=tx2,
        rx2_n=rx2,
        tx3_n=tx3,
        rx3_n=rx3,
        fpp1_dbm=heard[0].power_dbm,
        fpp2_dbm=heard[1].power_dbm,
        fpp3_dbm=power[2],
        skew1_ppm=heard[0].skew_ppm,
        skew2_ppm=heard[1].skew_ppm,
        skew3_ppm=skew[2],
        fpp1_n_dbm=theirs.power_dbm,
        fpp2_n_dbm=mine.power_dbm,
        skew1_n_ppm=theirs.skew_ppm,
        skew2_n_ppm=mine.skew_ppm,
    )


def _readings(received: Received) -> FinalPayload:
    payload = received.frame.payload
    if not isinstance(payload, FinalPayload):
        raise TypeError("readings travel in finals")
    return payload
