"""Ranging as in the firmware: the initiator runs in the USB task, target and listeners in the interrupt.

Each takes the first frame that arrives, and stops if it is not the expected one (firmware wire format, 3.1 and 3.2).
A passive board occupies its processor from frame to frame, and waits for the initiator's final without timeout: it
reads no USB commands meanwhile (firmware wire format, 3.3).
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import simpy

from uwblink.ticks import REPORT_BITS
from uwblink.twr import Exchanges, board_range
from uwblink.wire.codec import encode
from uwblink.wire.messages import BroadcastReceived, Cir, Overheard, OverheardNothing, RangeReport, TargetRangeReport
from uwbsim.boards.frames import (
    NS_PER_MS,
    NS_PER_US,
    DataPayload,
    FinalPayload,
    Frame,
    Payload,
    PollPayload,
    Received,
    ResponsePayload,
)
from uwbsim.scenario.ranging import PREAMBLE_TIMEOUT_S
from uwbsim.simulation.timestamps import MASK
from uwbsim.world.clocks import NS_PER_S
from uwbsim.world.impulse_response import impulse_response, in_transfers

if TYPE_CHECKING:
    from uwbsim.boards.virtual_board import VirtualBoard


TO_AIR: Final = 330 * NS_PER_US
"""From the read of the USB buffer with a command to the marker of its frame: set-up and half a preamble."""

Content = TypeVar("Content", PollPayload, FinalPayload)
Steps = Generator[simpy.Event, Any, None]
Attempt = Generator[simpy.Event, Any, bool]
Answers = Generator[simpy.Event, Any, "tuple[Received, Received] | None"]


def is_expected(received: Received | None, payload: type[Payload], sender: int, receiver: int) -> bool:
    """Return whether a frame is the expected one; boards compare type and both ids."""
    if received is None:
        return False
    frame = received.frame
    return isinstance(frame.payload, payload) and (frame.sender, frame.receiver) == (sender, receiver)


def payload_of(received: Received, kind: type[Content]) -> Content:
    """Return the payload of a frame; raises `TypeError` for one of another kind."""
    payload = received.frame.payload
    if not isinstance(payload, kind):
        raise TypeError(f"found {payload!r:.60}, expected a {kind.__name__}")
    return payload


def initiate(board: VirtualBoard, target: int, target_reports: bool, double_sided: bool, get_cir: bool) -> Attempt:
    """Range with a target: one attempt of C05."""
    if target == board.id:
        return (yield from board.answer(b"TWR FAIL: The target ID is the same as the initiator's ID.\r\n"))
    radio = board.radio
    radio.off()
    board.ranging = radio.masked = True
    yield board.sleep(TO_AIR - board.bench.air.before_marker)
    request = PollPayload(target_reports, double_sided, get_cir)
    poll = radio.send(target, request, radio.first_stamp(), board.bench.radios.excess_m())
    answers = yield from _answers(board, poll, double_sided)
    if answers is not None:
        yield from _report(board, poll, request, *answers)
    board.ranging = radio.masked = False
    radio.listen()
    return answers is not None


def _answers(board: VirtualBoard, poll: Frame, double_sided: bool) -> Answers:
    """Wait for the target's frames; return its first and its last one."""
    first = None
    if double_sided:
        first = yield from board.radio.wait()
        if first is None or not is_expected(first, ResponsePayload, poll.receiver or 0, board.id):
            return None
    last = yield from board.radio.wait()
    if last is None or not is_expected(last, FinalPayload, poll.receiver or 0, board.id):
        return None
    return first or last, last


def _report(board: VirtualBoard, poll: Frame, request: PollPayload, first: Received, last: Received) -> Steps:
    """Send the final if the target reports too, print the report, and the impulse response if requested."""
    theirs, target = payload_of(last, FinalPayload), poll.receiver or 0
    mine = poll.stamp & MASK, first.stamp & MASK, last.stamp & MASK if request.double_sided else 0
    to_final = 136 * NS_PER_US  # from the end of the target's last frame to the start of the final
    if request.target_reports:
        yield board.sleep(to_final)
        final = FinalPayload(mine, first.power_dbm, first.skew_ppm)
        board.radio.send(target, final, board.radio.first_stamp(), poll.excess_m)
    # From the end of the last frame to the report on the bus: read-out, arithmetic, printing.
    to_report = 474 * NS_PER_US
    yield board.sleep(to_report - (to_final if request.target_reports else 0))
    powers = theirs.power_dbm, first.power_dbm, theirs.skew_ppm, first.skew_ppm
    board.send(range_report(target, _in_order(mine, theirs.stamps), powers))
    if request.get_cir:
        yield from print_cir(board, board.id, target, last)


def answer(board: VirtualBoard, received: Received) -> Steps:
    """Answer a poll: response and delayed final, or the final alone; report if the initiator's final arrives."""
    request, initiator, radio = payload_of(received, PollPayload), received.frame.sender, board.radio
    excess, radios = received.frame.excess_m, board.bench.radios
    if request.double_sided:
        first = radios.reply_stamp(board.id, received.stamp)
        yield radio.over(radio.send(initiator, ResponsePayload(), first, excess))
        # A transmission with a shorter delay would start in the past (firmware wire format, 3.6).
        if not 265 <= board.delay_uus <= 32_767:
            return
        last, printed = radios.scheduled_stamps(board.id, first, board.delay_uus)
        sent = first, printed
    else:
        # The delay of a single-sided exchange cannot be set on the boards (firmware wire format, 0.5).
        last, printed = radios.scheduled_stamps(board.id, received.stamp, 1500)
        first, sent = last, (printed, printed)
    payload = FinalPayload(_of_target(received.stamp, *sent, request), received.power_dbm, received.skew_ppm)
    radio.send(initiator, payload, last, excess)
    if not request.target_reports:
        return
    final = yield from radio.wait()
    if final is None or not is_expected(final, FinalPayload, initiator, board.id):
        return
    yield board.sleep(474 * NS_PER_US)
    if request.get_cir:
        yield from print_cir(board, initiator, board.id, final)
    # Its own report has the chip's stamps, not those that it sent.
    mine, theirs = _of_target(received.stamp, first, last, request), payload_of(final, FinalPayload)
    powers = received.power_dbm, theirs.power_dbm, received.skew_ppm, theirs.skew_ppm
    report = range_report(initiator, _in_order(theirs.stamps, mine), powers)
    board.send(TargetRangeReport(*(getattr(report, name) for name in RangeReport.FIELDS)))


def _of_target(received: int, first: int, last: int, request: PollPayload) -> tuple[int, int, int]:
    """Return the printed stamps of a target: rx1, tx2, tx3; the last is 0 in single-sided ranging."""
    return received & MASK, first & MASK, last & MASK if request.double_sided else 0


def _in_order(initiator: tuple[int, int, int], target: tuple[int, int, int]) -> dict[str, int]:
    """Return the stamps of an exchange by name from those of its two boards."""
    tx1, rx2, rx3 = initiator
    rx1, tx2, tx3 = target
    return {"tx1": tx1, "rx1": rx1, "tx2": tx2, "rx2": rx2, "tx3": tx3, "rx3": rx3}


def range_report(neighbour: int, stamps: dict[str, int], powers: tuple[float, float, float, float]) -> RangeReport:
    """Return the report of an exchange, with the range that the boards compute from its stamps."""
    fpp1, fpp2, skew1, skew2 = powers
    none = np.zeros(1, dtype=np.int64)
    exchange = Exchanges(
        time_ns=none,
        initiator=none,
        target=none,
        protocol=np.array(["ds" if stamps["rx3"] or stamps["tx3"] else "ss"]),
        reporter=none,
        range_m=none.astype(np.float64),
        fpp1_dbm=np.array([fpp1]),
        fpp2_dbm=np.array([fpp2]),
        skew1_ppm=np.array([skew1]),
        skew2_ppm=np.array([skew2]),
        truth_m=none.astype(np.float64),
        bits=REPORT_BITS,
        **{name: np.array([stamp], dtype=np.int64) for name, stamp in stamps.items()},
    )
    return RangeReport(
        neighbour,
        float(board_range(exchange)[0]),
        **stamps,
        fpp1_dbm=fpp1,
        fpp2_dbm=fpp2,
        skew1_ppm=skew1,
        skew2_ppm=skew2,
    )


def print_cir(board: VirtualBoard, initiator: int, target: int, last: Received) -> Steps:
    """Print the impulse response of the last frame received, one transfer a millisecond; other tasks run meanwhile."""
    # Read-out over SPI, and computation of 1016 magnitudes.
    yield board.sleep(int(board.rng.integers(3_800 * NS_PER_US, 6_000 * NS_PER_US)))
    board.release()
    frame = last.frame
    paths = board.bench.radios.paths(frame, board.id)
    index, taps = impulse_response(board.rng, last.stamp & MASK, paths)
    for piece in in_transfers(encode(Cir(initiator, target, index, taps))):
        board.send(piece)
        yield board.sleep(NS_PER_MS + int(board.rng.integers(0, 120 * NS_PER_US)))


Expected = tuple[type[Payload], int, int, int | None]
"""A frame that a listener waits for: payload, sender, receiver, and timeout in ns."""


def received_by(board: VirtualBoard, received: Received | None) -> Steps | None:
    """Handle a frame that no task waits for at once, or return the steps of its handling."""
    if received is None:
        return _recover(board)
    payload = received.frame.payload
    to_line = 90 * NS_PER_US  # from the end of a frame to a line without computation
    if isinstance(payload, PollPayload):
        if received.frame.receiver == board.id:
            return answer(board, received)
        if board.passive:
            return overhear(board, received)
    elif isinstance(payload, DataPayload):
        board.send(BroadcastReceived(payload.data), to_line)
    else:
        number = b"B" if isinstance(payload, ResponsePayload) else b"C"
        board.send(b"WARNING 0x" + number + b": TWR message is firing an interrupt when it shouldn't be.\r\n", to_line)
    board.radio.listen()
    return None


def _recover(board: VirtualBoard) -> Steps:
    """Wait with the receiver off after a damaged frame, until the USB task switches it on."""
    board.release()
    yield board.until_next_poll()


def overhear(board: VirtualBoard, poll: Received) -> Steps:
    """Receive the exchange after a poll, and print it; without one of its frames print nothing, or zeros."""
    request, initiator, target = payload_of(poll, PollPayload), poll.frame.sender, poll.frame.receiver or 0
    heard = [poll]
    for payload, sender, receiver, timeout in _sequence(request, initiator, target):
        frame = yield from board.radio.wait(timeout)
        if frame is None or not is_expected(frame, payload, sender, receiver):
            if request.double_sided and len(heard) == 1:
                board.send(OverheardNothing(initiator, target), 90 * NS_PER_US)
            return
        heard.append(frame)
    yield board.sleep(525 * NS_PER_US)
    if request.get_cir:
        yield from print_cir(board, initiator, target, heard[-1])
    board.send(_overheard(initiator, target, request, heard))


def _sequence(request: PollPayload, initiator: int, target: int) -> list[Expected]:
    """Return the frames after a poll; the firmware sets no timeout for the last one."""
    timeout = round(PREAMBLE_TIMEOUT_S * NS_PER_S)
    response: list[Expected] = [(ResponsePayload, target, initiator, timeout)] * request.double_sided
    report: list[Expected] = [(FinalPayload, initiator, target, None)] * request.target_reports
    return [*response, (FinalPayload, target, initiator, timeout), *report]


def _overheard(initiator: int, target: int, request: PollPayload, heard: list[Received]) -> Overheard:
    """Return the report of a listener; the initiator's own readings are sent only in its final."""
    signals = heard[:3] if request.double_sided else heard[:2]
    third = signals[2] if request.double_sided else None
    theirs = payload_of(signals[-1], FinalPayload)
    mine = payload_of(heard[-1], FinalPayload) if request.target_reports else FinalPayload((0, 0, 0), 0.0, 0.0)
    (tx1, rx2, rx3), (rx1, tx2, tx3) = mine.stamps, theirs.stamps
    return Overheard(
        initiator,
        target,
        rx1=heard[0].stamp & MASK,
        rx2=heard[1].stamp & MASK,
        rx3=third.stamp & MASK if third else 0,
        tx1_n=tx1,
        rx1_n=rx1,
        tx2_n=tx2,
        rx2_n=rx2,
        tx3_n=tx3,
        rx3_n=rx3,
        fpp1_dbm=heard[0].power_dbm,
        fpp2_dbm=heard[1].power_dbm,
        fpp3_dbm=third.power_dbm if third else None,
        skew1_ppm=heard[0].skew_ppm,
        skew2_ppm=heard[1].skew_ppm,
        skew3_ppm=third.skew_ppm if third else None,
        fpp1_n_dbm=theirs.power_dbm,
        fpp2_n_dbm=mine.power_dbm,
        skew1_n_ppm=theirs.skew_ppm,
        skew2_n_ppm=mine.skew_ppm,
    )
