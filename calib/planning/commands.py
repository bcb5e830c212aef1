"""The commands that carry a plan out: recording, truth where there is some, and the fit."""

from __future__ import annotations

from collections.abc import Iterator

from calib.planning.flight_result import FlightPlan
from calib.planning.result import Plan


def survey_commands(plan: Plan, ports: str) -> Iterator[str]:
    """Yield the commands of a plan of arrangements, one after the other; `ports` names the boards' serial ports."""
    for one in plan.arrangements:
        shape = f" --known {plan.on}" if plan.on else ""
        shape += f" --order {','.join(map(str, one.order()))}" if plan.on == "line" else ""
        words = f"--pairs all --rate {plan.rate_hz:g} --duration {plan.seconds_each:.0f} -o {one.name}.uwb"
        yield f"uwblink record {ports} --arrangement {one.name}{shape} {words}"
    beside = " --known known.toml" if plan.known_beside else ""
    yield f"calib survey {' '.join(f'{one.name}.uwb' for one in plan.arrangements)}{beside} -o calibration.json"


def flight_commands(plan: FlightPlan, ports: str, recording: str) -> Iterator[str]:
    """Yield the commands of a plan of a flight; one that was planned from a `recording` is not recorded again."""
    name = recording if plan.flown is None else "flight.uwb"
    if plan.flown is not None:
        yield f"uwblink record {ports} --pairs all --duration {plan.seconds:.0f} -o {name}"
        yield f"uwblink poses {name} --from poses.csv --tags robots.toml"
    usable = plan.usable
    words = [f"--poses-until {usable.poses_until_s:g}"]
    words += [f"--attitudes {usable.attitudes}"] if usable.attitudes != "poses" else []
    words += [f"--heading-std {usable.heading_std_deg:g}"] if usable.heading_std_deg != 3 else []
    words += [f"--anchors {usable.anchors}"] if plan.stands else []
    when = f"@0..{plan.still_s:g}" if plan.still_s else ""
    words += [f"--distance {first}-{second}=METRES{when}" for first, second in plan.taped]
    yield f"calib fit {name} --truth ranges {' '.join(words)} -o calibration.json"
