"""Recording from boards into a file: who is there, what the file says of it, and the recorder that plays the plan."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from uwblink.boards.board import Board
from uwblink.boards.delay_check import DelayCheck, WrongDelayError
from uwblink.boards.listeners import Heard, Listener, Pair, as_listeners
from uwblink.boards.ports import Ports, SerialPorts
from uwblink.boards.progress import Progress
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.recorder import Recorder
from uwblink.boards.writer import RecordingWriter
from uwblink.errors import PlanError
from uwblink.output import check_output
from uwblink.recording.antenna_delays import meta_of_delays
from uwblink.recording.file import Recording
from uwblink.recording.schema import SHAPES, Arrangement, Tag

FILE_MB: Final = 64
"""Of the file so much is kept in memory; without a limit all of it would be, and a recording of hours is long."""


def record(  # noqa: PLR0913 - the settings of a recording, by keyword
    ports: Iterable[str],
    output: str | os.PathLike[str],
    plan: RangingPlan,
    *,
    duration_s: float = float("inf"),
    passive: bool = False,
    arrangement: str | None = None,
    known: str = "",
    order: Sequence[int] = (),
    force: bool = False,
    stop: Callable[[], bool] = lambda: False,
    watch: Callable[[Progress], None] | None = None,
    listeners: Iterable[Listener | Callable[[Heard], object]] = (),
    using: Ports | None = None,
) -> Progress:
    """Record from boards until `stop` says so or the time is over; returns what was done.

    `ports` are names or pyserial URLs, `watch` is called four times a second, `listeners` are told what the file gets
    (see `uwblink.boards.listeners`), and `using` are other ports than this computer's serial ones (`VirtualPorts`).
    `arrangement` names the places of boards that stand still meanwhile, `known` to be on a "line" or a "plane", and
    `order` says in which order their ids lie along a line; it is marked in the recording, for a survey.
    What is programmed into boards as antenna delays is what `plan` says of it, and goes into the recording.
    `KeyboardInterrupt` ends a recording like `stop`, with everything in the file. Raises the errors of `Board.open`,
    `PlanError` (a tag of plan or order is absent, two boards have one id, a duration that is none, stamps of other
    antenna delays than the plan's, whose recording is removed), and
    `RecordingError` (cannot be written, disk full); the file stays readable.

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         '''
    ...         run = { duration_s = 10.0 }
    ...         ranging = { rate_hz = 50 }
    ...         bodies = [
    ...             { name = "near", motion = { model = "static", position_m = [0.0, 0.0, 1.0] } },
    ...             { name = "far", motion = { model = "static", position_m = [3.0, 0.0, 1.0] } },
    ...         ]
    ...         tags = [{ id = 10, body = "near" }, { id = 20, body = "far" }]
    ...         '''
    ...     )
    ... )
    >>> plan = uwblink.RangingPlan(rate_hz=20.0)
    >>> done = uwblink.record(ports.names.values(), "flight.uwb", plan, duration_s=1.0, using=ports)
    >>> len(uwblink.load("flight.uwb").exchanges) == done.exchanges > 15
    True
    """
    if not duration_s > 0:
        raise PlanError(f"duration_s: found {duration_s!r}, expected more than 0 seconds")
    if known not in SHAPES or (known and not arrangement):
        raise PlanError(f"known: found {known!r:.40}, allowed: line, plane, of an arrangement that has a name")
    if order and known != "line":
        raise PlanError("order: is that of boards on a line; say that they are known to be on one")
    path, others, using = Path(output), as_listeners(listeners), using or SerialPorts()
    check_output(path, force=force, recording=True)
    found = identify(ports, using)
    turns = plan.turns(sorted(found))
    if order and sorted(order) != sorted(found):
        there = ", ".join(map(str, sorted(found)))
        text = f"found {', '.join(map(str, order))}, expected each of the boards at the ports, {there}"
        raise PlanError(text, parameter="order")
    if plan.tags and not any(tag.tag in found for tag in plan.tags):
        seated, there = (", ".join(map(str, sorted(ids))) for ids in ({tag.tag for tag in plan.tags}, found))
        raise PlanError(
            f"the plan says where {seated} sit, but the boards at the ports are {there}: is it that of others?"
        )
    for listener in others:
        listener.on_start(turns)
    delays = plan.programmed(found)
    meta = _meta(found, plan, turns, passive) | (meta_of_delays(delays) if plan.antenna_delays else {})
    with (
        _without_wrong_delays(path),
        Recording.create(path, meta=meta, force=force, live=True, memory_mb=FILE_MB) as recording,
    ):
        seats = {tag.tag: tag for tag in plan.tags}
        recording.append_tags(seats.get(b, Tag(b, f"tag{b}", (0.0, 0.0, 0.0))) for b in sorted(found))
        with RecordingWriter(recording) as writer:
            told = [writer, DelayCheck(delays), *others]
            recorder = Recorder(found, plan, turns, told, passive=passive, ports=using)

            def tell(progress: Progress) -> None:
                progress.waiting, progress.behind_s = writer.waiting, writer.behind_s
                if watch:
                    watch(progress)

            try:
                recorder.run(duration_s, stop, tell)
            finally:
                recorder.close()
        if arrangement:
            last_ns = max(using.host_ns(), recorder.progress.start_ns + 1)
            mark = Arrangement(arrangement, recorder.progress.start_ns, last_ns, known, tuple(order))
            recording.append_arrangements([mark])
    return recorder.progress


@contextmanager
def _without_wrong_delays(path: Path) -> Iterator[None]:
    """Remove a recording that was given up because its `meta` would say wrong antenna delays."""
    try:
        yield
    except WrongDelayError:
        path.unlink(missing_ok=True)
        raise


def _meta(found: dict[int, str], plan: RangingPlan, turns: Iterable[Pair], passive: bool) -> dict[str, Any]:
    return {
        "source": "boards",
        "ports": {str(board): name for board, name in sorted(found.items())},
        "plan": {
            "pairs": [list(pair) for pair in turns],
            "rate_hz": plan.rate_hz,
            "protocol": plan.protocol,
            "target_reports": plan.target_reports,
            "get_cir": plan.get_cir,
            "passive": passive,
        },
    }


def identify(names: Iterable[str], ports: Ports | None = None) -> dict[int, str]:
    """Return which board is at each port; raises `PlanError` when two have one id, and what `Board.open` raises."""
    using = ports or SerialPorts()
    found: dict[int, str] = {}
    for name in names:
        port = using.open(name)
        try:
            number = Board(port).id
        finally:
            using.close(port)
        if number in found:
            raise PlanError(f"{found[number]} and {name} both say they are board {number}; ids must differ")
        found[number] = name
    return found
