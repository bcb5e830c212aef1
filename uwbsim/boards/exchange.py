"""One exchange between boards, with everything that any board in range prints of it.

The same clocks, radios and firmware arithmetic as in a batch simulation (`uwbsim.simulation.timestamps`), for a single
exchange whose instant is known only when a command arrives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import REPORT_BITS, SPEED_OF_LIGHT
from uwblink.twr import PROTOCOLS, STAMPS, Exchanges, RangingProtocol, board_range
from uwblink.wire.messages import Overheard, OverheardNothing, RangeReport, TargetRangeReport
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.timestamps import Draws, Stamped, draw_reply_s, reception, stamp
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, Clocks
from uwbsim.world.lookahead import SampledWorld
from uwbsim.world.radio import printed_power_dbm, printed_skew_ppm, reception_bias_s, reception_noise_s
from uwbsim.world.world import World

MASK: Final = (1 << REPORT_BITS) - 1
SINGLE_SIDED_DELAY_UUS: Final = 1500
"""The reply of a single-sided exchange is not settable on the boards (firmware wire format, 0.5)."""


@dataclass(frozen=True, slots=True)
class ExchangeResult:
    """An exchange as the boards report it, and when its messages leave, in true sub-ticks.

    `heard` says for each message whether its receiver gets it.
    """

    report: RangeReport
    departures: tuple[int, ...]
    heard: tuple[bool, ...]
    stamped: Stamped
    protocol: RangingProtocol


class Radios:
    """The radios of a scenario, one exchange at a time; `lost_share` of all frames are lost besides the weak ones."""

    def __init__(self, scenario: Scenario, lost_share: float = 0.0) -> None:
        """Set up world and clocks; chance comes from the scenario's seed."""
        self.scenario = scenario
        self.world = World.of(scenario)
        self.sampled_world = SampledWorld(self.world)
        self.clocks = Clocks.of(scenario)
        self.lost_share = lost_share
        self._place = {tag.id: k for k, tag in enumerate(scenario.tags)}
        self._delays = np.array([t.delays_ns() for t in scenario.tags]) * 1e-9 * SUBTICKS_PER_SECOND
        self._chance = stream(scenario.run.seed, "boards")

    def exchange(
        self, initiator: int, target: int, start: int, *, double_sided: bool, delay_uus: int
    ) -> ExchangeResult:
        """Let two boards range from true time `start` (sub-ticks) on; ids are those of the scenario's tags."""
        protocol = PROTOCOLS["ds" if double_sided else "ss"]
        count = len(protocol.messages)
        i, j = (np.array([self._place[tag]]) for tag in (initiator, target))
        draws = self._draws(count)
        delay = delay_uus if double_sided else SINGLE_SIDED_DELAY_UUS
        stamped = stamp(
            self.scenario,
            protocol,
            self.sampled_world,
            self.clocks,
            np.array([start]),
            i,
            j,
            draws,
            response_delay_uus=delay,
        )
        report = self._report(protocol.name, initiator, target, i, j, stamped)
        fading = self._chance.normal(size=count) * self.scenario.radio.power_noise_db
        power = np.array([p[0] for p in stamped.power_dbm]) + fading
        heard = (power >= self.scenario.radio.sensitivity_dbm) & (self._chance.random(count) >= self.lost_share)
        departures = tuple(int(d[0]) for d in stamped.departure)
        return ExchangeResult(report, departures, tuple(heard.tolist()), stamped, protocol)

    def hearers(self, sender: int, tags: list[int], time: int) -> list[int]:
        """Return those of the tags whose boards a board is strong enough for."""
        power = self.sampled_world.from_sender(self._place[sender], time).power_dbm
        return [tag for tag in tags if power[self._place[tag]] >= self.scenario.radio.sensitivity_dbm]

    def overhear(
        self, listeners: list[int], initiator: int, met: ExchangeResult, *, target_reports: bool
    ) -> dict[int, Overheard | OverheardNothing]:
        """Return what passive listeners print of an exchange; who prints nothing is not in it.

        Values that no frame carried are zero, and a missed response of a double-sided exchange leaves a line of
        zeros (firmware wire format, 1.4).
        """
        places = np.array([self._place[tag] for tag in listeners], dtype=np.int64)
        target = met.report.neighbour
        receptions = []
        for message, departure in zip(met.protocol.messages, met.departures, strict=True):
            sender = initiator if message.sender == "initiator" else target
            receptions.append(self._receptions(places, self._place[sender], departure))
        said: dict[int, Overheard | OverheardNothing] = {}
        for k, tag in enumerate(listeners):
            heard = [bool(r.heard[k]) for r in receptions]
            if all(heard):
                said[tag] = _overheard(k, initiator, met.report, receptions, target_reports=target_reports)
            elif heard[0] and not heard[1] and met.protocol.name == "ds":
                said[tag] = OverheardNothing(initiator, target)
        return said

    def echoes(self, sender: int, receiver: int, time: int) -> list[tuple[float, float]]:
        """Return the reflections at a board, as `World.echoes` does."""
        return self.world.echoes(self._place[sender], self._place[receiver], time)

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

    def _report(self, name: str, initiator: int, target: int, i: Ints, j: Ints, stamped: Stamped) -> RangeReport:
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
        return RangeReport(target, float(board_range(exchange)[0]), *(int(stamps[n][0]) for n in STAMPS), *numbers)

    def _readings(self, sender: Ints, receiver: Ints, time: Ints, power_dbm: Floats) -> tuple[Floats, Floats]:
        noise = self._chance.normal(size=(2, len(time)))
        skew = (self.clocks.rate(receiver, time) - self.clocks.rate(sender, time)) * 1e6
        radio = self.scenario.radio
        return printed_power_dbm(radio, power_dbm, noise[0]), printed_skew_ppm(radio, skew, noise[1])

    def _receptions(self, me: Ints, sender: int, departure: int) -> _Receptions:
        """Return how listeners (n,) receive one frame."""
        radio, count = self.scenario.radio, len(me)
        link = self.sampled_world.from_sender(sender, departure)[me]
        power = link.power_dbm
        heard = (power >= radio.sensitivity_dbm) & (self._chance.random(count) >= self.lost_share)
        late_s = reception_bias_s(radio, power, link.total_dbm)
        late_s = late_s + self._chance.normal(size=count) * reception_noise_s(radio, power)
        flight = np.rint((link.distance_m + link.excess_m) / SPEED_OF_LIGHT * SUBTICKS_PER_SECOND).astype(np.int64)
        stamps = reception(self.clocks, me, departure + flight, late_s, self._delays[me, 1]) & MASK
        time = np.full(count, departure)
        power, skew = self._readings(np.full(count, sender), me, time, power)
        return _Receptions(heard, stamps, power, skew)


@dataclass(frozen=True, slots=True)
class _Receptions:
    """One frame at several listeners, shape (n,): whether it came, its stamp, and what is printed of it."""

    heard: Bools
    stamps: Ints
    power_dbm: Floats
    skew_ppm: Floats


def _overheard(
    k: int, initiator: int, report: RangeReport, receptions: list[_Receptions], *, target_reports: bool
) -> Overheard:
    """Return what listener number `k` prints; the initiator's own readings travel only in its final."""
    third = len(receptions) == 3
    rx1, rx2, rx3 = ([int(r.stamps[k]) for r in receptions] + [0])[:3]
    power = [float(r.power_dbm[k]) for r in receptions]
    skew = [float(r.skew_ppm[k]) for r in receptions]
    return Overheard(
        initiator,
        report.neighbour,
        rx1,
        rx2,
        rx3,
        report.tx1 if target_reports else 0,
        report.rx1,
        report.tx2,
        report.rx2 if target_reports else 0,
        report.tx3,
        report.rx3 if target_reports else 0,
        power[0],
        power[1],
        power[2] if third else None,
        skew[0],
        skew[1],
        skew[2] if third else None,
        report.fpp1_dbm,
        report.fpp2_dbm if target_reports else 0.0,
        report.skew1_ppm,
        report.skew2_ppm if target_reports else 0.0,
    )


def as_target(report: RangeReport, initiator: int) -> TargetRangeReport:
    """Return the target's report of the same exchange."""
    values = [getattr(report, name) for name in RangeReport.FIELDS]
    return TargetRangeReport(initiator, *values[1:])
