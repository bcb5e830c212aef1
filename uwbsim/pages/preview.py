"""What to expect of a scenario: rates, distances, powers and warnings, without running it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import UUS_S
from uwbsim.simulation.air import schedule
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.world import World


@dataclass(frozen=True, slots=True, kw_only=True)
class PairPreview:
    """What to expect of a pair: rate, distances and first-path powers over the run, and its bias by skew in SS-TWR."""

    initiator: int
    target: int
    exchanges: int
    rate_hz: float
    distance_m: tuple[float, float]
    power_dbm: tuple[float, float]
    audible: float
    ss_bias_m: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Preview:
    """What to expect of a run of `scenario`; `air_share` is the share of time in which some frame is on the air."""

    scenario: Scenario

    pairs: tuple[PairPreview, ...]
    exchanges: int
    rate_hz: float
    fastest_hz: float
    air_share: float
    duration_s: float

    def __repr__(self) -> str:
        """Return what to expect, a line each; warnings begin with "warning:"."""
        scenario, ranging = self.scenario, self.scenario.ranging
        plan = ranging.plan if isinstance(ranging.plan, str) else ranging.plan.file
        lines = [
            f"{scenario.run.name}: {PROTOCOLS[ranging.protocol].title}, plan {plan}, {self.duration_s:g} s",
            f"{self.exchanges} exchanges planned among {len(self.pairs)} pairs, {self.rate_hz:.3g} a second "
            f"(one after the other at most {self.fastest_hz:.0f}); "
            f"frames on the air {100 * self.air_share:.1f} % of the time",
            f"{'pair':>10s}{'exchanges':>11s}{'Hz':>7s}{'metres':>17s}{'dBm':>18s}  SS-TWR's bias (cm)",
        ]
        lines += [
            f"{pair.initiator:3d} -> {pair.target:3d}{pair.exchanges:11d}{pair.rate_hz:7.3g}"
            f"{pair.distance_m[0]:8.2f} to {pair.distance_m[1]:5.2f}{pair.power_dbm[0]:8.1f} to "
            f"{pair.power_dbm[1]:6.1f}{100 * pair.ss_bias_m:+20.1f}"
            for pair in self.pairs
        ]
        lines += [
            f"warning: {pair.initiator} and {pair.target} hear each other {100 * pair.audible:.0f} % of the time "
            f"(sensitivity {scenario.radio.sensitivity_dbm:g} dBm)"
            for pair in self.pairs
            if pair.audible < 0.9
        ]
        # A range has the sum of two tags' delays: these sums determine the delays if their matrix has full rank.
        ends = np.array([(pair.initiator, pair.target) for pair in self.pairs]).reshape(-1, 2)
        tags = np.unique(ends)
        if len(tags) and np.linalg.matrix_rank((ends[:, :, None] == tags).sum(axis=1)) < len(tags):
            lines.append(
                "warning: the pairs split the tags into two groups that range only with each other; their antenna "
                "delays will not be determined"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim validate --json` prints: the figures, without the scenario."""
        figures = ("exchanges", "rate_hz", "fastest_hz", "air_share", "duration_s")
        return {"pairs": [asdict(pair) for pair in self.pairs]} | {name: getattr(self, name) for name in figures}


def preview(scenario: Scenario | Source) -> Preview:
    """Predict what a scenario will do, without running it; raises `ScenarioError`.

    `scenario` is whatever `load` takes, or a `Scenario`.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> found = uwbsim.preview(
    ...     {
    ...         "run": {"name": "two", "duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> found.exchanges, found.pairs[0].distance_m
    (100, (5.0, 5.0))
    >>> print(str(found).splitlines()[0])
    two: DS-TWR, third message from the target, plan round-robin, 2 s
    """
    scenario = as_scenario(scenario)
    plan, world = schedule(scenario), World(scenario)
    duration, radio, samples = scenario.run.duration_s, scenario.radio, 200
    time = (np.linspace(0, duration, samples) * SUBTICKS_PER_SECOND).astype(np.int64)
    reply_s = scenario.ranging.response_delay_uus * UUS_S
    pairs = []
    for i, j in sorted(set(zip(plan.initiator.tolist(), plan.target.tolist(), strict=True))):
        count = int(np.count_nonzero((plan.initiator == i) & (plan.target == j)))
        link = world.link(np.full(samples, i), np.full(samples, j), time)
        one, two = scenario.tags[i], scenario.tags[j]
        pairs.append(
            PairPreview(
                initiator=one.id,
                target=two.id,
                exchanges=count,
                rate_hz=count / duration,
                distance_m=(float(link.distance_m.min()), float(link.distance_m.max())),
                power_dbm=(float(link.power_dbm.min()), float(link.power_dbm.max())),
                audible=float(np.mean(link.power_dbm >= radio.sensitivity_dbm)),
                ss_bias_m=SPEED_OF_LIGHT / 2 * (one.skew_ppm - two.skew_ppm) * 1e-6 * reply_s,
            )
        )
    return Preview(
        scenario=scenario,
        pairs=tuple(pairs),
        exchanges=len(plan.start),
        rate_hz=len(plan.start) / duration,
        fastest_hz=scenario.ranging.fastest_hz(radio.preamble_symbols),
        air_share=scenario.ranging.air_share(radio.preamble_symbols),
        duration_s=duration,
    )
