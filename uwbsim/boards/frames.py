"""Frames between virtual boards: what they carry, when they leave, and what every other board makes of them.

The same clocks, radios and firmware arithmetic as in a batch simulation, for one frame at a time, whose instant is
known only when a command arrives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import ANTENNA_DELAY_TICKS, DELAYED_TX_GRID, REPORT_BITS, TICK_S, UUS_TICKS
from uwbsim.random_streams import stream
from uwbsim.scenario.airtime import FINAL_BYTES, POLL_BYTES, RESPONSE_BYTES
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.timestamps import draw_reply_s
from uwbsim.world.clocks import Clocks
from uwbsim.world.impulse_response import PathsHeard
from uwbsim.world.lookahead import SampledWorld
from uwbsim.world.reception import Frames, Medium
from uwbsim.world.true_time import SUBTICKS
from uwbsim.world.world import World

MASK: Final = (1 << REPORT_BITS) - 1
DATA_BYTES: Final = 8
"""A broadcast's frame besides its payload (firmware wire format, 2.1)."""


@dataclass(frozen=True, slots=True)
class PollPayload:
    """Signal 1: what the initiator wants."""

    target_reports: bool
    double_sided: bool
    get_cir: bool
    length = POLL_BYTES


@dataclass(frozen=True, slots=True)
class ResponsePayload:
    """Signal 2 of a double-sided exchange."""

    length = RESPONSE_BYTES


@dataclass(frozen=True, slots=True)
class FinalPayload:
    """The last signal of either side: stamps of its sender as printed, power and skew of the first it received."""

    stamps: tuple[int, int, int]
    power_dbm: float
    skew_ppm: float
    length = FINAL_BYTES


@dataclass(frozen=True, slots=True)
class DataPayload:
    """A broadcast."""

    data: bytes

    @property
    def length(self) -> int:
        """Return the length of the frame in bytes."""
        return DATA_BYTES + len(self.data)


Payload = PollPayload | ResponsePayload | FinalPayload | DataPayload


@dataclass(frozen=True, slots=True, kw_only=True)
class Receptions:
    """A frame at all boards, shape (tags,), whoever listens.

    Power at the antenna, whether it is strong enough and not lost, its stamp (ticks, not wrapped), and what is printed
    of it.
    """

    power_dbm: Floats
    heard: Bools
    stamp: Ints
    printed_dbm: Floats
    skew_ppm: Floats


@dataclass(slots=True, kw_only=True)
class Frame:
    """A frame on the air, or about to be.

    `stamp` is the sender's transmit stamp (ticks, not wrapped), `departure` the true time (sub-ticks) at which its
    marker leaves, `start` and `end` when it is on the air (ns). `receiver` is None for a broadcast. `excess_m` is the
    detour between the two boards of an exchange. A frame that was `cancelled` before its start is never sent.
    """

    sender: int
    receiver: int | None
    payload: Payload
    stamp: int
    departure: int
    receptions: Receptions
    excess_m: float
    start: int = 0
    end: int = 0
    cancelled: bool = False


@dataclass(frozen=True, slots=True)
class Received:
    """A frame as one board received it: its stamp (ticks, not wrapped), printed power and skew."""

    frame: Frame
    stamp: int
    power_dbm: float
    skew_ppm: float


class Radios:
    """The radios of a scenario's tags; `lost_share` of all receptions fail besides the weak ones."""

    def __init__(self, scenario: Scenario, lost_share: float = 0.0) -> None:
        """Set up world and clocks; chance comes from the scenario's seed."""
        self.scenario = scenario
        self.world = World.of(scenario)
        self.sampled_world = SampledWorld(self.world)
        self.medium = Medium(scenario, self.sampled_world, Clocks.of(scenario))
        self.lost_share = lost_share
        self.place = {tag.id: k for k, tag in enumerate(scenario.tags)}
        self._all = np.arange(len(scenario.tags))
        self._chance = stream(scenario.run.seed, "boards")

    def next_stamp(self, board: int, time: int) -> int:
        """Return the first transmit stamp that a board's clock allows at or after a true time (sub-ticks)."""
        me = self._one(board)
        ready = -(-int(self.medium.clocks.read(me, np.array([time]))[0]) // SUBTICKS)
        return _on_grid(ready) + self.tx_register(board)

    def reply_stamp(self, board: int, received: int) -> int:
        """Return the transmit stamp of a reply sent at once to what was received at a stamp; its latency is drawn."""
        latency = round(float(draw_reply_s(self.scenario, self._chance, 1)[0]) / TICK_S)
        return _on_grid(received + latency - ANTENNA_DELAY_TICKS) + self.tx_register(board)

    def scheduled_stamps(self, board: int, reference: int, delay_uus: int) -> tuple[int, int]:
        """Return the transmit stamps of a frame that is to leave a while after the stamp `reference`.

        The chip's, which ignores the low nine bits of the time at which it is told to send; and the one that the
        firmware works out and sends, with a constant of its build.
        """
        due = (reference + delay_uus * UUS_TICKS) // DELAYED_TX_GRID * DELAYED_TX_GRID
        return due + self.tx_register(board), due + int(self.medium.reply_constant[self.place[board]])

    def tx_register(self, board: int) -> int:
        """Return what is programmed into a board's register of the transmitter, in ticks."""
        return int(self.medium.tx_register[self.place[board]])

    def excess_m(self) -> float:
        """Draw the detour of an exchange's signals."""
        share, mean_m = self.scenario.radio.independent_multipath
        return float(self._chance.exponential(mean_m)) if share and self._chance.random() < share else 0.0

    def frame(self, sender: int, receiver: int | None, payload: Payload, stamp: int, excess_m: float = 0.0) -> Frame:
        """Return a frame that leaves at a transmit stamp of its sender's clock, and how every board receives it."""
        place = self.place[sender]
        departure = int(self.medium.leave(self._one(sender), np.array([stamp]), self._chance.normal(size=1))[0])
        excess = np.zeros(len(self._all))
        if receiver in self.place:
            excess[self.place[receiver]] = excess_m
        return Frame(
            sender=sender,
            receiver=receiver,
            payload=payload,
            stamp=stamp,
            departure=departure,
            receptions=self._receptions(place, departure, excess),
            excess_m=excess_m,
        )

    def received(self, frame: Frame, board: int) -> Received:
        """Return what one board has of a frame."""
        at, k = frame.receptions, self.place[board]
        return Received(frame, int(at.stamp[k]), float(at.printed_dbm[k]), float(at.skew_ppm[k]))

    def paths(self, frame: Frame, receiver: int) -> PathsHeard:
        """Return the paths that a frame took to a board, as `World.paths` does."""
        detour = frame.excess_m if frame.receiver == receiver else 0.0
        return self.world.paths(self.place[frame.sender], self.place[receiver], frame.departure, detour)

    def _receptions(self, sender: int, departure: int, excess_m: Floats) -> Receptions:
        chance, count = self._chance, len(self._all)
        frames = Frames(sender=np.full(count, sender), receiver=self._all, departure=np.full(count, departure))
        noise = chance.normal(size=(4, count))
        arrives = chance.random(count) >= self.lost_share
        received = self.medium.receive(frames, noise[1], excess_m)
        power_dbm = received.link.power_dbm
        printed_dbm, skew_ppm = self.medium.readings(frames, power_dbm, noise[2], noise[3])
        heard = self.medium.heard(power_dbm, noise[0]) & arrives
        return Receptions(
            power_dbm=power_dbm, heard=heard, stamp=received.stamp, printed_dbm=printed_dbm, skew_ppm=skew_ppm
        )

    def _one(self, board: int) -> Ints:
        return np.array([self.place[board]])


def _on_grid(ticks: int) -> int:
    return -(-ticks // DELAYED_TX_GRID) * DELAYED_TX_GRID
