"""Plans as a page, as PDF and as figures: steps, arrangements, intervals, and the gain of further measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from calib.planning.result import FlightPlan, Plan
from calib.report.campaign import write_checked
from calib.report.figures import arrangement, flight, next_measurements, planned_delays
from uwblink.pages.blocks import Block, Document, Heading, Listing, Picture, Table, Text


def write_plan(
    plan: Plan | FlightPlan,
    output: Path | None,
    figures: Path | None,
    *,
    commands: Sequence[str] = (),
    force: bool = False,
) -> None:
    """Write a plan as a page (.html or .pdf), and its figures into a folder, as PDF and SVG at two widths.

    `commands` are the command lines that carry out the plan. Raises the errors of `check_places`.
    """
    blocks = list(_of_flight(plan) if isinstance(plan, FlightPlan) else _of_boards(plan))
    if commands:
        blocks += [Heading("Commands"), Listing("\n".join(commands))]
    title = f"Plan of a flight: {len(plan.half_ns)} tags"
    if isinstance(plan, Plan):
        places = {"line": "on a line", "plane": "in a plane", "": "in space"}[plan.on]
        title = f"Plan: {len(plan.half_ns)} boards {places}, {len(plan.arrangements)} arrangements"
    write_checked(Document(title, blocks), output, figures, force=force)


def _of_boards(plan: Plan) -> Iterator[Block]:
    yield Text(
        f"{_known(plan)} if the constant error of a pair is {100 * plan.pair_error_m:.1f} cm. The positions are only "
        f"proposals; measure only the distances named below.",
        "lead",
    )
    for k, one in enumerate(plan.arrangements):
        yield Heading(f"Step {k + 1}: arrangement {one.name}")
        tapes = "".join(f" Measure the distance of {i} and {j} with a tape, antenna to antenna." for i, j in one.taped)
        places = f"Boards {one.where(plan.on)}".replace("Boards with", "Board")
        yield Text(f"{places}.{tapes} Record all pairs for {plan.seconds_each:.0f} s.")
        yield Picture(
            f"arrangement-{one.name}",
            partial(arrangement, plan=plan, number=k),
            f"Arrangement {one.name}, and the intervals of the delays when it has been made.",
        )
    yield Heading("Expected accuracy")
    yield from _accuracy(plan)


def _of_flight(plan: FlightPlan) -> Iterator[Block]:
    yield Text(
        f"{_known(plan)}, and their common part to ± {plan.common_ns:.3f} ns, if ranges have "
        f"{100 * plan.settings.noise_m:.1f} cm of noise and {100 * plan.reflected:.0f} % are reflected.",
        "lead",
    )
    yield Heading("What to do")
    yield Listing("\n".join(plan.steps))
    yield Picture(
        "flight",
        partial(flight, plan=plan),
        "The flight from above and its heights, as a proposal; thick lines where positions are known.",
    )
    yield Heading("Expected accuracy")
    yield Picture("delays", partial(planned_delays, plan=plan), "Half the interval (95 %) of each delay.")
    yield from _accuracy(plan)


def _accuracy(plan: Plan | FlightPlan) -> Iterator[Block]:
    halves = plan.half_ns.items()
    rows = [[str(tag), f"± {half:.3f} ns" if math.isfinite(half) else "undetermined"] for tag, half in halves]
    yield Table(["tag", "delay"], rows)
    if plan.undetermined:
        yield Text(f"Not determined: {'; '.join(plan.verdict.free)}.", "warning")
    if plan.next_best:
        yield Heading("Gain of one more measurement")
        yield Picture(
            "more",
            partial(next_measurements, next_best=plan.next_best),
            "The mean interval with each further measurement; an undetermined delay counts as known to 1.5 ns.",
        )


def _known(plan: Plan | FlightPlan) -> str:
    """Return the first clause of a sentence: the mean interval of the delays (root mean square)."""
    known = [half for half in plan.half_ns.values() if math.isfinite(half)]
    if not known:
        return "No delay will be determined"
    mean = f"known to ± {math.sqrt(sum(half**2 for half in known) / len(known)):.3f} ns on average (95 %)"
    if len(known) == len(plan.half_ns):
        return f"Delays will be {mean}"
    return f"{len(known)} of {len(plan.half_ns)} delays will be {mean}"
