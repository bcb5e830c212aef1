"""One run of a sweep, as a worker does it: from plain data to plain rows, the same on every worker."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import uwblink
from uwblink.errors import UwblinkError
from uwbsim.errors import UwbsimError
from uwbsim.sweep.extensions import Evaluate, Extensions

Rows = list[dict[str, Any]]
Result = tuple[int, Rows]
"""A run's number, and its rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What a worker needs to do one run: the scenario as JSON, or the error that it gave."""

    number: int
    seed: int
    values: Mapping[str, Any]
    kind: str
    protocols: tuple[str, ...]
    ranges: int
    name: str
    scenario: str = ""
    error: str = ""


def run_chunk(tasks: Sequence[Task], extensions: Extensions | None = None) -> tuple[list[Result], float]:
    """Do some runs; return their rows by number, and how long they took together. A failure is a row."""
    start = time.perf_counter()
    known = extensions or Extensions()
    known.install()
    return [(task.number, rows_of(task, known.evaluate)) for task in tasks], time.perf_counter() - start


def rows_of(task: Task, evaluate: Evaluate | None = None) -> Rows:
    """Return the rows of one run, one a protocol."""
    try:
        if task.error:
            raise UwbsimError(task.error)
        outcomes = _compare(task) if evaluate is None else _evaluate(task, evaluate)
    except (UwbsimError, UwblinkError, ArithmeticError, ValueError, MemoryError) as error:
        return [failure(task, str(error) or type(error).__name__)]
    return [_head(task) | {"status": "ok", "error": None} | outcome for outcome in outcomes]


def failure(task: Task, reason: str) -> dict[str, Any]:
    """Return the row of a run that failed."""
    return _head(task) | {"status": "failed", "error": reason.splitlines()[0][:300] if reason else "unknown"}


def _head(task: Task) -> dict[str, Any]:
    versions = {"uwbcal": uwblink.__version__, "numpy": np.__version__, "python": platform.python_version()}
    named = {"scenario": task.name, "number": task.number, "seed": task.seed}
    values = {k: v if isinstance(v, int | float | str | bool) else json.dumps(v) for k, v in task.values.items()}
    return named | versions | values


def _compare(task: Task) -> Rows:
    from uwbsim.protocols.comparison import compare
    from uwbsim.scenario.model import Scenario

    scenario = Scenario.model_validate_json(task.scenario)
    return [outcome.to_dict() for outcome in compare(scenario, task.protocols, task.ranges).outcomes]


def _evaluate(task: Task, evaluate: Evaluate) -> Rows:
    """Simulate a flight with each protocol, and have it evaluated."""
    from uwbsim.scenario.model import Scenario
    from uwbsim.simulation.run import simulate

    scenario = Scenario.model_validate_json(task.scenario)
    found = []
    for name in task.protocols:
        ranging = scenario.ranging.model_copy(update={"protocol": name})
        simulated = simulate(scenario.model_copy(update={"ranging": ranging}))
        try:
            figures = dict(evaluate(simulated))
        except Exception as error:
            # Somebody else's function: whatever it raises is the failure of this run, and of no other.
            raise UwbsimError(str(error) or type(error).__name__) from error
        found.append({"protocol": name} | figures | {"failed_exchanges": len(simulated.faults)})
    return found
