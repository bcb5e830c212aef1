"""One exchange between boards, with everything that any board in range prints of it.

The same clocks, radios and firmware arithmetic as in a batch simulation (`uwbsim.stamps`), for a single exchange
whose instant is known only when a command arrives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uwblink.messages import Overheard, OverheardNothing, Ranged, TargetRanged
from uwblink.ticks import REPORT_BITS, SPEED_OF_LIGHT
from uwblink.twr import PROTOCOLS, STAMPS, Exchanges, Protocol, board_range
from uwbsim.clock import SUBTICKS_PER_SECOND, Clocks
from uwbsim.radio import printed_power_dbm, printed_skew_ppm, reception_bias_s, reception_noise_s
from uwbsim.scenario import Scenario
from uwbsim.stamps import Draws, Stamped, draw_reply_s, reception, stamp
from uwbsim.streams import stream
from uwbsim.world import World

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MASK: Final = (1 << REPORT_BITS) - 1
SINGLE_SIDED_DELAY_UUS: Final = 1500
"""The reply of a single-sided exchange is not settable on the boards (firmware wire format, 0.5)."""


@dataclass(frozen=True, slots=True)
class Encounter:
    """An exchange as the boards report it, and when its messages leave, in true sub-ticks.

    `heard` says for each message whether its receiver gets it.
    """

    report: Ranged
    departures: tuple[int, ...]
    heard: tuple[bool, ...]
    stamped: Stamped
    protocol: Protocol


class Radios:
    """The radios of a scenario, one exchange at a time; `lost_share` of all frames are lost besides the weak ones."""

    def __init__(self, scenario: Scenario, lost_share: float = 0.0) -> None:
        """Set up world and clocks; chance comes from the scenario's seed."""
        self.scenario = scenario
        self.world = World.of(scenario)
        self.clocks = Clocks.of(scenario)
        self.lost_share = lost_share
        self._place = {tag.id: k for k, tag in enumerate(scenario.tags)}
        self._delays = np.array([t.delays_ns() for t in scenario.tags]) * 1e-9 * SUBTICKS_PER_SECOND
        self._chance = stream(scenario.scenario.seed, "boards")

    def meet(self, initiator: int, target: int, start: int, *, double_sided: bool, delay_uus: int) -> Encounter:
        """Let two boards range from true time `start` (sub-ticks) on; ids are those of the scenario's tags."""
        protocol = PROTOCOLS["ds" if double_sided else "ss"]
        count = len(protocol.messages)
        i, j = (np.array([self._place[tag]]) for tag in (initiator, target))
        draws = self._draws(count)
        delay = delay_uus if double_sided else SINGLE_SIDED_DELAY_UUS
        stamped = stamp(
            self.scenario, protocol, self.world, self.clocks, np.array([start]), i, j, draws, response_delay_uus=delay
        )
        report = self._report(protocol.name, initiator, target, i, j, stamped)
        fading = self._chance.normal(size=count) * self.scenario.radio.power_noise_db
        power = np.array([p[0] for p in stamped.power_dbm]) + fading
        heard = (power >= self.scenario.radio.sensitivity_dbm) & (self._chance.random(count) >= self.lost_share)
        departures = tuple(int(d[0]) for d in stamped.departure)
        return Encounter(report, departures, tuple(heard.tolist()), stamped, protocol)

    def hears(self, listener: int, tag: int, time: int) -> bool:
        """Whether a board is strong enough at another one's antenna."""
        sender, receiver = (np.array([self._place[t]]) for t in (tag, listener))
        _, power = self.world.link(sender, receiver, np.array([time]))
        return bool(power[0] >= self.scenario.radio.sensitivity_dbm)

    def overhear(
        self, listener: int, initiator: int, met: Encounter, *, target_reports: bool
    ) -> Overheard | OverheardNothing | None:
        """Return what a passive listener prints of an exchange, None for nothing.

        Values that no frame carried are zero, and a missed response of a double-sided exchange leaves a line of
        zeros (firmware wire format, 1.4).
        """
        me = np.array([self._place[listener]])
        readings = []
        for k, message in enumerate(met.protocol.messages):
            sender = initiator if message.sender == "initiator" else met.report.neighbour
            reading = self._reception(me, np.array([self._place[sender]]), met.stamped.departure[k])
            if reading is None:
                missed_response = k == 1 and met.protocol.name == "ds"
                return OverheardNothing(initiator, met.report.neighbour) if missed_response else None
            readings.append(reading)
        rx1, rx2, rx3 = ([r[0] for r in readings] + [0])[:3]
        power = [r[1] for r in readings]
        skew = [r[2] for r in readings]
        third = len(readings) == 3
        r = met.report
        return Overheard(
            initiator,
            r.neighbour,
            rx1,
            rx2,
            rx3,
            r.tx1 if target_reports else 0,
            r.rx1,
            r.tx2,
            r.rx2 if target_reports else 0,
            r.tx3,
            r.rx3 if target_reports else 0,
            power[0],
            power[1],
            power[2] if third else None,
            skew[0],
            skew[1],
            skew[2] if third else None,
            r.fpp1_dbm,
            r.fpp2_dbm if target_reports else 0.0,
            r.skew1_ppm,
            r.skew2_ppm if target_reports else 0.0,
        )

    def _draws(self, count: int) -> Draws:
        chance, multipath = self._chance, self.scenario.radio.multipath
        excess = 0.0
        if multipath and chance.random() < multipath.probability:
            excess = chance.exponential(multipath.mean_excess_m)
        return Draws(
            chance.normal(size=(count, 1)),
            chance.normal(size=(count, 1)),
            draw_reply_s(self.scenario, chance, 1),
            np.array([excess]),
        )

    def _report(self, name: str, initiator: int, target: int, i: Ints, j: Ints, stamped: Stamped) -> Ranged:
        power1, skew1 = self._readings(i, j, stamped.departure[0], stamped.power_dbm[0])
        power2, skew2 = self._readings(j, i, stamped.departure[1], stamped.power_dbm[1])
        none = np.zeros(1, dtype=np.int64)
        stamps = {n: stamped.stamps.get(n, none) & MASK for n in STAMPS}
        exchange = Exchanges(
            time_ns=none,
            initiator=i,
            target=j,
            protocol=np.array([name]),
            reporter=i,
            range_m=none.astype(np.float64),
            fpp1_dbm=power1,
            fpp2_dbm=power2,
            skew1_ppm=skew1,
            skew2_ppm=skew2,
            truth_m=none.astype(np.float64),
            bits=REPORT_BITS,
            **stamps,
        )
        numbers = [float(v[0]) for v in (power1, power2, skew1, skew2)]
        return Ranged(target, float(board_range(exchange)[0]), *(int(stamps[n][0]) for n in STAMPS), *numbers)

    def _readings(self, sender: Ints, receiver: Ints, time: Ints, power_dbm: Floats) -> tuple[Floats, Floats]:
        noise = self._chance.normal(size=(2, 1))
        skew = (self.clocks.rate(receiver, time) - self.clocks.rate(sender, time)) * 1e6
        radio = self.scenario.radio
        return printed_power_dbm(radio, power_dbm, noise[0]), printed_skew_ppm(radio, skew, noise[1])

    def _reception(self, me: Ints, sender: Ints, departure: Ints) -> tuple[int, float, float] | None:
        radio = self.scenario.radio
        distance, power = self.world.link(sender, me, departure)
        if power[0] < radio.sensitivity_dbm or self._chance.random() < self.lost_share:
            return None
        noise = self._chance.normal(size=1)
        late_s = reception_bias_s(radio, power) + noise * reception_noise_s(radio, power)
        flight = np.rint(distance / SPEED_OF_LIGHT * SUBTICKS_PER_SECOND).astype(np.int64)
        stamp_ = reception(self.clocks, me, departure + flight, late_s, self._delays[me, 1])
        printed = self._readings(sender, me, departure, power)
        return int(stamp_[0]) & MASK, float(printed[0][0]), float(printed[1][0])


def as_target(report: Ranged, initiator: int) -> TargetRanged:
    """Return the target's report of the same exchange."""
    values = [getattr(report, name) for name in Ranged.FIELDS]
    return TargetRanged(initiator, *values[1:])
