"""Ranging as in the firmware: the initiator runs in the USB task, target and listeners in the interrupt.

Each takes the first frame that arrives, and stops if it is not the expected one (firmware wire format, 3.1 and 3.2).
A passive board occupies its processor from frame to frame, and waits for the initiator's final without timeout: it
reads no USB commands meanwhile (firmware wire format, 3.3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

from uwblink.twr import Exchanges, board_range
from uwblink.wire.codec import encode
from uwblink.wire.messages import (
    Broadcast,
    BroadcastReceived,
    Cir,
    Overheard,
    OverheardNothing,
    RangeCommand,
    RangeReport,
    TargetRangeReport,
)
from uwbsim.boards.frames import (
    NS_PER_MS,
    NS_PER_US,
    Attempt,
    FinalPayload,
    Frame,
    Payload,
    Received,
    ResponsePayload,
    Steps,
    Wait,
)
from uwbsim.scenario.ranging import PREAMBLE_TIMEOUT_S
from uwbsim.simulation.timestamps import MASK
from uwbsim.world.clocks import NS_PER_S
from uwbsim.world.impulse_response import impulse_response, in_transfers

if TYPE_CHECKING:
    from uwbsim.boards.virtual_board import VirtualBoard


TO_AIR: Final = 330 * NS_PER_US
"""From the read of the USB buffer with a command to the marker of its frame: set-up and half a preamble."""

PREAMBLE_TIMEOUT: Final = round(PREAMBLE_TIMEOUT_S * NS_PER_S)
AT_HOST: Final = 474 * NS_PER_US
"""From the end of the last frame to the report on the bus: read-out, arithmetic, printing."""


def expected(
    board: VirtualBoard, payload: type[Payload], sender: int, receiver: int, timeout: int | None = PREAMBLE_TIMEOUT
) -> Wait:
    """Wait for a frame; None if another one arrives, or none. Boards compare type and both ids."""
    received = yield from board.radio.wait(timeout)
    if received is None or not isinstance(received.frame.payload, payload):
        return None
    return received if (received.frame.sender, received.frame.receiver) == (sender, receiver) else None


def final_of(received: Received) -> FinalPayload:
    """Return the payload of a final, for which `expected` was asked."""
    return cast("FinalPayload", received.frame.payload)


def initiate(board: VirtualBoard, request: RangeCommand) -> Attempt:
    """Range with a target: one attempt of C05."""
    radio, air, target = board.radio, board.bench.air, request.target
    if target == board.id:
        return (yield from board.answer(b"TWR FAIL: The target ID is the same as the initiator's ID.\r\n"))
    radio.off()
    board.ranging = radio.masked = True
    yield board.sleep(TO_AIR - air.before_marker)
    poll = radio.send(target, request, air.first_stamp(board.id), air.excess_m())
    first = last = None
    if request.double_sided:
        first = yield from expected(board, ResponsePayload, target, board.id)
    if first is not None or not request.double_sided:
        last = yield from expected(board, FinalPayload, target, board.id)
    if last is not None:
        yield from _report(board, poll, request, first or last, last)
    board.ranging = radio.masked = False
    radio.listen()
    return last is not None


def _report(board: VirtualBoard, poll: Frame, request: RangeCommand, first: Received, last: Received) -> Steps:
    """Send the final if the target reports too, print the report, and the impulse response if requested."""
    target = request.target
    final = _final(first, (poll.stamp, first.stamp, last.stamp), request)
    to_final = 136 * NS_PER_US if request.target_reports else 0  # from the end of the target's last frame
    if request.target_reports:
        yield board.sleep(to_final)
        board.radio.send(target, final, board.bench.air.first_stamp(board.id), poll.excess_m)
    yield board.sleep(AT_HOST - to_final)
    board.send(range_report(RangeReport, target, final, final_of(last)))
    if request.get_cir:
        yield from print_cir(board, board.id, target, last)


def answer(board: VirtualBoard, received: Received, request: RangeCommand) -> Steps:
    """Answer a poll: response and delayed final, or the final alone; report if the initiator's final arrives."""
    initiator, radio, air = received.frame.sender, board.radio, board.bench.air
    excess = received.frame.excess_m
    if request.double_sided:
        first = air.reply_stamp(board.id, received.stamp)
        yield air.over(radio.send(initiator, ResponsePayload(), first, excess))
        # A transmission with a shorter delay would start in the past (firmware wire format, 3.6).
        if not 265 <= board.delay_uus <= 32_767:
            return
        last, printed = air.scheduled_stamps(board.id, first, board.delay_uus)
        sent = first, printed
    else:
        # The delay of a single-sided exchange cannot be set on the boards (firmware wire format, 0.5).
        last, printed = air.scheduled_stamps(board.id, received.stamp, 1500)
        first, sent = last, (printed, printed)
    radio.send(initiator, _final(received, (received.stamp, *sent), request), last, excess)
    if not request.target_reports:
        return
    final = yield from expected(board, FinalPayload, initiator, board.id)
    if final is None:
        return
    yield board.sleep(AT_HOST)
    if request.get_cir:
        yield from print_cir(board, initiator, board.id, final)
    # Its own report has the chip's stamps, not those that it sent.
    mine = _final(received, (received.stamp, first, last), request)
    board.send(range_report(TargetRangeReport, initiator, final_of(final), mine))


def _final(first: Received, stamps: tuple[int, int, int], request: RangeCommand) -> FinalPayload:
    """Return a board's printed stamps, the third 0 in single-sided ranging, and its readings of the first frame."""
    one, two, three = (stamp & MASK for stamp in stamps)
    return FinalPayload((one, two, three if request.double_sided else 0), first.power_dbm, first.skew_ppm)


def range_report(kind: type[RangeReport], neighbour: int, initiator: FinalPayload, target: FinalPayload) -> RangeReport:
    """Return the report of an exchange, with the range that the boards compute from its stamps."""
    (tx1, rx2, rx3), (rx1, tx2, tx3) = initiator.stamps, target.stamps
    stamps: dict[str, Any] = {"tx1": tx1, "rx1": rx1, "tx2": tx2, "rx2": rx2, "tx3": tx3, "rx3": rx3}
    exchange = Exchanges.from_arrays([0], [1], **stamps | {"tx1": [tx1]}, protocol="ds" if rx3 or tx3 else "ss")
    readings = (target.power_dbm, initiator.power_dbm, target.skew_ppm, initiator.skew_ppm)
    rest: list[Any] = [*stamps.values(), *readings]
    return kind(neighbour, float(board_range(exchange)[0]), *rest)


def print_cir(board: VirtualBoard, initiator: int, target: int, last: Received) -> Steps:
    """Print the impulse response of the last frame received, one transfer a millisecond; other tasks run meanwhile."""
    # Read-out over SPI, and computation of 1016 magnitudes.
    yield board.sleep(int(board.rng.integers(3_800 * NS_PER_US, 6_000 * NS_PER_US)))
    board.release()
    index, taps = impulse_response(board.rng, last.stamp & MASK, board.bench.air.paths(last, board.id))
    for piece in in_transfers(encode(Cir(initiator, target, index, taps))):
        board.send(piece)
        yield board.sleep(NS_PER_MS + int(board.rng.integers(0, 120 * NS_PER_US)))


def received_by(board: VirtualBoard, received: Received | None) -> Steps | None:
    """Handle a frame that no task waits for at once, or return the steps of its handling."""
    if received is None:
        return _recover(board)
    payload = received.frame.payload
    to_line = 90 * NS_PER_US  # from the end of a frame to a line without computation
    if isinstance(payload, RangeCommand):
        if received.frame.receiver == board.id:
            return answer(board, received, payload)
        if board.passive:
            return overhear(board, received, payload)
    elif isinstance(payload, Broadcast):
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


def overhear(board: VirtualBoard, poll: Received, request: RangeCommand) -> Steps:
    """Receive the exchange after a poll, and print it; without one of its frames print nothing, or zeros."""
    initiator, target = poll.frame.sender, request.target
    frames: list[tuple[type[Payload], int, int, int | None]] = [
        *[(ResponsePayload, target, initiator, PREAMBLE_TIMEOUT)] * request.double_sided,
        (FinalPayload, target, initiator, PREAMBLE_TIMEOUT),
        *[(FinalPayload, initiator, target, None)] * request.target_reports,  # the firmware sets no timeout
    ]
    heard = [poll]
    for frame in frames:
        received = yield from expected(board, *frame)
        if received is None:
            if request.double_sided and len(heard) == 1:
                board.send(OverheardNothing(initiator, target), 90 * NS_PER_US)
            return
        heard.append(received)
    yield board.sleep(525 * NS_PER_US)
    if request.get_cir:
        yield from print_cir(board, initiator, target, heard[-1])
    board.send(_overheard(initiator, target, request, heard))


def _overheard(initiator: int, target: int, request: RangeCommand, heard: list[Received]) -> Overheard:
    """Return the report of a listener; the initiator's own readings are sent only in its final."""
    signals = heard[: 2 + request.double_sided]
    third = signals[2] if request.double_sided else None
    theirs = final_of(signals[-1])
    mine = final_of(heard[-1]) if request.target_reports else FinalPayload((0, 0, 0), 0.0, 0.0)
    (tx1, rx2, rx3), (rx1, tx2, tx3) = mine.stamps, theirs.stamps
    shown = [*signals[:2], third]
    rest: list[Any] = [
        *(one.stamp & MASK if one else 0 for one in shown),
        *(tx1, rx1, tx2, rx2, tx3, rx3),
        *(one.power_dbm if one else None for one in shown),
        *(one.skew_ppm if one else None for one in shown),
        *(theirs.power_dbm, mine.power_dbm, theirs.skew_ppm, mine.skew_ppm),
    ]
    return Overheard(initiator, target, *rest)
