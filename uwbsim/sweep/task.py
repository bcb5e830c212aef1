"""One run of a sweep, as a worker does it: from plain data to plain rows, the same on every worker."""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

import uwblink
from uwblink.errors import UwblinkError
from uwblink.twr import PROTOCOLS
from uwbsim.errors import UwbsimError

Task = dict[str, Any]
"""What a worker needs: number, seed, values, kind, protocols, ranges, and the scenario as JSON or the error it gave."""

FIT_TIMEOUT_S: Final = 600


def run_chunk(tasks: Sequence[Task]) -> tuple[list[tuple[int, list[dict[str, Any]]]], float]:
    """Do some runs; return their rows by number, and how long they took together. A failure is a row."""
    start = time.perf_counter()
    return [(task["number"], rows_of(task)) for task in tasks], time.perf_counter() - start


def rows_of(task: Task) -> list[dict[str, Any]]:
    """Return the rows of one run."""
    try:
        if task["error"]:
            raise UwbsimError(task["error"])
        outcomes = WORK[task["kind"]](task)
    except (UwbsimError, UwblinkError, ArithmeticError, ValueError, MemoryError) as error:
        return [failure(task, str(error) or type(error).__name__)]
    return [_head(task) | {"status": "ok", "error": None} | outcome for outcome in outcomes]


def failure(task: Task, reason: str) -> dict[str, Any]:
    """Return the row of a run that failed."""
    return _head(task) | {"status": "failed", "error": reason.splitlines()[0][:300] if reason else "unknown"}


def _head(task: Task) -> dict[str, Any]:
    versions = {"uwbcal": uwblink.__version__, "numpy": np.__version__, "python": platform.python_version()}
    named = {"scenario": task["name"], "number": task["number"], "seed": task["seed"]}
    values = {k: v if isinstance(v, int | float | str | bool) else json.dumps(v) for k, v in task["values"].items()}
    return named | versions | values


def _compare(task: Task) -> list[dict[str, Any]]:
    from uwbsim.protocols.comparison import compare
    from uwbsim.scenario.model import Scenario

    scenario = Scenario.model_validate_json(task["scenario"])
    outcomes, _ = compare(scenario, [PROTOCOLS[name] for name in task["protocols"]], task["ranges"])
    return [outcome.to_dict() for outcome in outcomes]


def _calibrate(task: Task) -> list[dict[str, Any]]:
    """Simulate, fit and evaluate: a fit is another package's, so its command is called."""
    from uwbsim.scenario.model import Scenario
    from uwbsim.simulation.run import simulate, write

    scenario = Scenario.model_validate_json(task["scenario"])
    found = []
    for name in task["protocols"]:
        ranging = scenario.ranging.model_copy(update={"protocol": name})
        simulated = simulate(scenario.model_copy(update={"ranging": ranging}))
        with tempfile.TemporaryDirectory() as folder:
            flight, calibration = Path(folder) / "flight.uwb", Path(folder) / "calibration.json"
            write(simulated, flight)
            _calib("fit", flight, "-o", calibration)
            judged = json.loads(_calib("evaluate", flight, "-c", calibration, "--json"))
        found.append(_figures(name, judged) | {"failed_exchanges": len(simulated.faults)})
    return found


def _figures(protocol: str, judged: dict[str, Any]) -> dict[str, Any]:
    overall, planted = judged["overall"], judged.get("planted") or {}
    row = {"protocol": protocol, "exchanges": overall["raw"]["n"]}
    for stage in ("raw", "delays", "full"):
        row |= {f"{stage}_{what}": overall[stage][what] for what in ("mean_m", "std_m", "robust_std_m")}
    row["rejected"] = overall["rejected"]
    delays = list((planted.get("delay_error_ns") or {}).values())
    row["delays_rms_ns"] = float(np.sqrt(np.mean(np.square(delays)))) if delays else None
    return row | {name: planted.get(name) for name in ("curve_rms_m", "correction_rms_m")}


def _calib(*arguments: object) -> str:
    """Run a `calib` command; raises `UwbsimError` with what it says."""
    command = shutil.which("calib", path=str(Path(sys.executable).parent)) or shutil.which("calib")
    if not command:
        raise UwbsimError("the command 'calib' is not installed beside this Python")
    words = [command, *map(str, arguments)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=FIT_TIMEOUT_S, check=False)  # noqa: S603
    except subprocess.TimeoutExpired as error:
        raise UwbsimError(f"calib {arguments[0]}: no answer in {FIT_TIMEOUT_S} s") from error
    if done.returncode:
        raise UwbsimError(f"calib {arguments[0]}: {done.stderr.strip().removeprefix('error: ')}")
    return done.stdout


WORK: Final = {"compare": _compare, "calibrate": _calibrate}
