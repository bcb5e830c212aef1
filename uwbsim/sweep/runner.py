"""[sweep.runner] Runs a sweep: hands out chunks, stores what comes back, and goes on where a killed one ended.

A result depends on its run alone, so neither the number of workers nor their order changes a bit of it. At most a few
chunks are out at a time and every result goes to the store at once, so memory does not grow with the number of runs.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Final

import uwblink
from uwblink.output import check_folder
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.scenario.loading import load
from uwbsim.sweep.design import SweepDesign
from uwbsim.sweep.executors import Chunk, Evaluate, Result, Task, Work, Workers, evaluator, workers_for
from uwbsim.sweep.results import Store, export

STORE: Final = "results.duckdb"
"""Name of the file that keeps the results of a sweep, in its folder."""


@dataclass(frozen=True, slots=True)
class Summary:
    """How a sweep went: runs done now, of which failed, and runs whose results were there already."""

    done: int
    failed: int
    skipped: int


def run_sweep(
    plan: SweepDesign,
    folder: str | os.PathLike[str],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    evaluate: Evaluate | None = None,
    progress: Callable[[float], None] | None = None,
) -> Summary:
    """Run what is not done yet, and write results.csv and results.parquet in the order of the runs.

    Runs of kind `compare` compare protocols; those of kind `calibrate` simulate a flight and have `evaluate(flight)`
    return its figures, a mapping of column to number, text or None. Where that is not given it is what an installed
    distribution offers as entry point `calibrate` of the group `uwbcal.evaluators`. The work is done by
    `workers` processes (None: all cores), or by the Dask cluster whose `scheduler` has this address; both import
    `evaluate` by its name. `progress` is called with the done fraction, 0 to 1.

    Raises `ScenarioError` where the folder holds another sweep's results, or the same one's without `resume`, and
    `ParameterError` where the scheduler does not answer; nothing is written then.

    >>> from pathlib import Path
    >>> import uwbsim
    >>> _ = Path("two.toml").write_text(
    ...     "run = { duration_s = 2.0 }\\n"
    ...     "ranging = { rate_hz = 50.0 }\\n"
    ...     "tags = [{ id = 1, body = 'a' }, { id = 2, body = 'b' }]\\n"
    ...     "[[bodies]]\\nname = 'a'\\nmotion = { model = 'static', position_m = [0.0, 0.0, 2.0] }\\n"
    ...     "[[bodies]]\\nname = 'b'\\nmotion = { model = 'static', position_m = [5.0, 0.0, 2.0] }\\n"
    ... )
    >>> _ = Path("sweep.toml").write_text("sweep = { scenario = 'two.toml', kind = 'calibrate', seeds = 2 }\\n")
    >>> def farthest(flight):
    ...     return {"farthest_m": flight.truth_m.max().round(6).item()}
    >>> uwbsim.run_sweep(uwbsim.load_design("sweep.toml"), "results", workers=1, evaluate=farthest)
    Summary(done=2, failed=0, skipped=0)
    >>> Path("results/results.csv").read_text().splitlines()[1].endswith("ds,5.0,0")
    True
    """
    folder = Path(folder)
    check_folder(folder)
    _check(plan, folder, resume=resume)
    kind = plan.settings.kind
    if kind == "calibrate":
        evaluate = evaluate or evaluator(kind)
    elif evaluate is not None:
        raise ParameterError(f"goes with a sweep of kind 'calibrate', and this one's is {kind!r}", parameter="evaluate")
    if workers is not None and workers < 1:
        raise ParameterError(f"found {workers}, expected 1 or more", parameter="workers")
    work = Work.of_here(plan.scenario.stem, plan.protocols, plan.settings.ranges, evaluate)
    team = workers_for(workers, scheduler, work)
    try:
        folder.mkdir(exist_ok=True)
        path = folder / STORE
        with Store.open(path) if Store.begun(path) else Store.create(path, _identity(plan)) as store:
            known = store.done()
            done, failed = _do(plan, store, team, work, known, progress)
            export(store, folder / "results.csv", folder / "results.parquet")
    finally:
        team.close()
    return Summary(done, failed, len(known))


def _identity(plan: SweepDesign) -> dict[str, Any]:
    return {"name": plan.name, "plan": plan.path.name, "fingerprint": plan.fingerprint, "uwbcal": uwblink.__version__}


def _check(plan: SweepDesign, folder: Path, *, resume: bool) -> None:
    path = folder / STORE
    if not Store.begun(path):
        if resume and not path.exists():
            raise ParameterError(f"{folder} holds no sweep to go on with", parameter="resume")
        if folder.is_dir() and any(item.name != STORE for item in folder.iterdir()):
            raise ScenarioError(f"{folder}: holds other files; give an empty folder or a new one")
        return
    with Store.open(path) as store:
        known = store.identity()
    told = {
        "plan": f"holds the results of another sweep, {known.get('plan')}",
        "fingerprint": f"{plan.path.name} or its scenario has changed since its results were made",
        "uwbcal": f"its results are of uwbcal {known.get('uwbcal')}, this is {uwblink.__version__}",
    }
    for key, text in told.items():
        if known.get(key) != _identity(plan)[key]:
            raise ScenarioError(f"{folder}: {text}; give another folder")
    if not resume:
        raise ParameterError(
            f"{folder} holds results of this sweep; go on with it, or give another folder", parameter="resume"
        )


def _do(
    plan: SweepDesign,
    store: Store,
    team: Workers,
    work: Work,
    known: set[int],
    progress: Callable[[float], None] | None,
) -> tuple[int, int]:
    """Do the runs whose numbers are not `known`; return how many were done, and how many of them failed."""
    numbers = (number for number in range(plan.total) if number not in known)
    # Work that was lost with its worker is done first, one run at a time, so that only a run that kills is to blame.
    again: list[Chunk] = []
    attempts: Counter[int] = Counter()
    out, done, failed, size = 0, 0, 0, 1
    while True:
        while out < 2 * team.size:
            chunk = again.pop() if again else [_task(plan, number) for number in islice(numbers, size)]
            if not chunk:
                break
            team.submit(chunk)
            out += 1
        if not out:
            return done, failed
        for chunk, rows, seconds in team.finished():
            out -= 1
            if rows is None:
                rows = _lost(chunk, work, attempts, again)
            else:
                # A chunk should take a second: long beside handing it out, short beside a patience.
                size = min(max(int(len(chunk) / max(seconds, 1e-6)), 1), 512)
            store.append(rows)
            done += len(rows)
            failed += sum(some[0]["status"] == "failed" for _, some in rows)
            if progress:
                progress((len(known) + done) / max(plan.total, 1))


def _lost(chunk: Chunk, work: Work, attempts: Counter[int], again: list[Chunk]) -> list[Result]:
    """Queue the runs of a lost chunk one by one; return the rows of those that took their worker down three times."""
    rows = []
    for task in chunk:
        attempts[task.number] += 1
        if attempts[task.number] >= 3:
            rows.append(work.failed(task, "its worker died 3 times"))
        else:
            again.append([task])
    return rows


def _task(plan: SweepDesign, number: int) -> Task:
    """Return a run as plain data; a scenario that cannot be is an error that travels with it."""
    run = plan.run(number)
    task = Task(number=number, seed=run.seed, values=run.values)
    try:
        scenario = load(plan.scenario, run.values, run.seed, allow_files=plan.allow_files)
        return replace(task, scenario=scenario.model_dump_json())
    except ScenarioError as error:
        # Where the file lies is no part of a result.
        return replace(task, error=str(error).removeprefix(f"{plan.scenario}: "))
