"""The runs of a sweep, and its workers: a thread of this process, processes, or a Dask cluster.

A run takes plain data and gives plain rows, the same with every worker. Workers may be other processes on other
machines, which import functions of plug-ins by module and name.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import uwblink
from uwblink.errors import UwblinkError, raising
from uwblink.output import interrupts_held
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwbsim.errors import ParameterError, UwbsimError
from uwbsim.protocols.comparison import compare
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.run import Simulated, simulate
from uwbsim.sweep.design import EVALUATORS, Run, evaluators
from uwbsim.world.channel import CHANNEL_EFFECTS, ChannelEffect

Evaluate = Callable[[Simulated], Mapping[str, Any]]
"""Returns the results of a flight as columns of one row: numbers, texts or None."""

Row = dict[str, Any]
Result = tuple[int, list[Row]]
"""A run's number, and its rows."""


Chunk = list[Run]
Done = tuple[Chunk, list[Result] | None, float]
"""A chunk, its results (None: its worker died), and the seconds that it took."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What all runs of a sweep have in common: name of the scenario, protocols, evaluation, and channel effects.

    The effects are those that programs and other distributions have added in the process that makes it.
    With `evaluate` each protocol's flight is simulated and evaluated; without, protocols are compared by `ranges`.
    """

    name: str
    protocols: tuple[RangingProtocol, ...]
    ranges: int
    evaluate: Evaluate | None = None
    effects: tuple[ChannelEffect, ...] = field(default_factory=lambda: tuple(CHANNEL_EFFECTS.added()))

    def check(self) -> None:
        """Raise `ParameterError` for a function that another process cannot import by its name."""
        parts = ("flight_ticks", "delay_weights")
        named: dict[str, object] = {
            **{f"channel effect {effect.name!r}": effect.apply for effect in self.effects},
            **{f"{part} of protocol {row.name!r}": getattr(row, part) for row in self.protocols for part in parts},
            **({} if self.evaluate is None else {"evaluate": self.evaluate}),
        }
        for what, function in named.items():
            module = sys.modules.get(getattr(function, "__module__", None) or "")
            if getattr(module, getattr(function, "__qualname__", ""), None) is not function:
                raise ParameterError(
                    f"found {function!r}, which other processes cannot import; use a function at the top level of a "
                    f"module, or one process (workers = 1)",
                    parameter=what,
                )

    def do(self, run: Run) -> Result:
        """Do a run: return its rows, one per protocol; a failure is a row."""
        try:
            if run.error:
                raise UwbsimError(run.error)
            scenario = Scenario.model_validate_json(run.scenario)
            rows = (
                [one.to_dict() for one in compare(scenario, self.protocols, self.ranges).outcomes]
                if self.evaluate is None
                else [self._evaluated(scenario, row.name, self.evaluate) for row in self.protocols]
            )
        except (UwbsimError, UwblinkError, ArithmeticError, ValueError, MemoryError) as error:
            return self.failed(run, str(error) or type(error).__name__)
        return run.number, [self._head(run) | {"status": "ok", "error": None} | row for row in rows]

    def failed(self, run: Run, reason: str) -> Result:
        """Return the row of a run that failed."""
        error = reason.splitlines()[0][:300] if reason else "unknown"
        return run.number, [self._head(run) | {"status": "failed", "error": error}]

    def _head(self, run: Run) -> Row:
        versions = {"uwbcal": uwblink.__version__, "numpy": np.__version__, "python": platform.python_version()}
        values = {k: v if isinstance(v, int | float | str | bool) else json.dumps(v) for k, v in run.values.items()}
        return {"scenario": self.name, "number": run.number, "seed": run.seed} | versions | values

    def _evaluated(self, scenario: Scenario, protocol: str, evaluate: Evaluate) -> Row:
        """Simulate a flight with a protocol, and have it evaluated."""
        simulated = simulate(scenario.changed("ranging", protocol=protocol))
        try:
            figures = dict(evaluate(simulated))
        except Exception as error:
            # A plug-in's function: whatever it raises is the failure of this run, and of no other.
            raise UwbsimError(str(error) or type(error).__name__) from error
        return {"protocol": protocol} | figures | {"failed_exchanges": len(simulated.faults)}


def run_chunk(runs: Sequence[Run], work: Work) -> tuple[list[Result], float]:
    """Do some runs; return their results, and the seconds that they took together."""
    start = time.perf_counter()
    PROTOCOLS.adopt(work.protocols)
    CHANNEL_EFFECTS.adopt(work.effects)
    # One thread of linear algebra for each worker, so that results do not depend on the number of cores.
    with threadpool_limits(limits=1, user_api="blas"):
        return [work.do(run) for run in runs], time.perf_counter() - start


def evaluator(kind: str) -> Evaluate:
    """Return the entry point of an installed distribution for a kind of sweep; raises `ParameterError`."""
    entry = evaluators().get(kind)
    if entry is None:
        raise ParameterError(
            f"a sweep of kind {kind!r} needs a function that evaluates a flight, and no installed distribution offers "
            f"one (entry point {kind!r} of the group {EVALUATORS})",
            parameter="evaluate",
        )
    what = f"{entry.value}, which {EVALUATORS} names, cannot be imported"
    with raising(partial(ParameterError, parameter="evaluate"), what, ImportError, AttributeError):
        found: Evaluate = entry.load()
    return found


class ClusterLostError(UwbsimError, ConnectionError):
    """The connection to the scheduler of a cluster was lost."""


class WorkersLostError(UwbsimError):
    """Worker processes end at their start."""


class Workers:
    """Workers that do chunks of runs, `size` of them at once, in any order: threads of this process."""

    died: type[Exception] = BrokenProcessPool
    """Raised by the future of a chunk whose worker died."""

    patience_s: float | None = None
    """Seconds to wait for a chunk before `_replace` is asked; None where a future always tells that its worker died."""

    def __init__(self, size: int, work: Work) -> None:
        """`size` is how many chunks are worked on at once."""
        self.size, self._work = size, work
        self._running: dict[Future[tuple[list[Result], float]], Chunk] = {}
        self._lost: list[Done] = []
        self._pool = self._start_pool()

    def _start_pool(self) -> Any:  # an `Executor`, of whatever kind
        return ThreadPoolExecutor(self.size)

    def submit(self, chunk: Chunk) -> None:
        """Submit a chunk."""
        self._running[self._pool.submit(run_chunk, chunk, self._work)] = chunk

    def finished(self) -> Sequence[Done]:
        """Wait until a chunk is done, and return all chunks that are."""
        found, self._lost = self._lost, []
        while not found:
            for future in wait(self._running, self.patience_s, return_when=FIRST_COMPLETED).done:
                chunk = self._running.pop(future)
                try:
                    found.append((chunk, *future.result()))
                except self.died:
                    found.append((chunk, None, 0.0))
            found = found or self._replace()
        return found

    def _replace(self) -> list[Done]:
        """Replace workers whose death no future told, and return their chunks."""
        return []

    def close(self) -> None:
        """Release the workers, without waiting for running chunks."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class Processes(Workers):
    """Processes of this machine; if one dies, the pool is replaced, and its chunks are returned as lost.

    They end with this process, even if it is killed: each watches a pipe that this process holds open. Raises
    `ParameterError` for plug-ins that they could not import, and `WorkersLostError` where they end as they begin.
    """

    patience_s = 5.0  # chunks take about a second

    def _start_pool(self) -> Any:
        self._work.check()
        context = multiprocessing.get_context("spawn")
        held, self._held = context.Pipe(duplex=False)
        pool = ProcessPoolExecutor(self.size, context, initializer=_end_with, initargs=(held,))
        try:
            with interrupts_held():  # workers inherit this: a terminal sends Ctrl-C to all, and this process handles it
                list(pool.map(abs, range(self.size)))
        except BrokenProcessPool as error:
            self._held.close()
            # CPython 3.11 prints a traceback if this process ends while a thread of the pool closes its pipe.
            pool.shutdown()
            raise WorkersLostError(
                "`workers`: a process ended at its start; check that there is enough memory, and that the script "
                "starts its work below `if __name__ == '__main__':`; with 1 the work is done in this process"
            ) from error
        return pool

    def submit(self, chunk: Chunk) -> None:
        """Submit a chunk, to new processes if one has died."""
        try:
            super().submit(chunk)
        except BrokenProcessPool:
            self._lost += self._replace()
            super().submit(chunk)

    def _replace(self) -> list[Done]:
        """Start a new pool if a process has died, and return the chunks that the old pool did not report.

        CPython 3.11 never reports a chunk that is submitted while the pool handles the death of a process, because
        `terminate_broken` does not take the lock of `submit`.
        """
        try:
            self._pool.submit(abs, 0)
        except BrokenProcessPool:
            silent = [future for future in self._running if not future.done()]
            self._pool = self._start_pool()
            return [(self._running.pop(future), None, 0.0) for future in silent]
        return []

    def close(self) -> None:
        """End the processes, without waiting for running chunks."""
        if self._running:
            self._held.close()
        self._pool.shutdown(cancel_futures=True)
        self._held.close()


class Cluster(Workers):
    """A Dask cluster by the address of its scheduler; `distributed` moves the work of a dead worker to another."""

    connect_s = 10
    """Timeout of the connection in seconds: chosen, some round trips to a busy scheduler."""

    def __init__(self, address: str, work: Work) -> None:
        """Connect; raises `ParameterError` where no scheduler answers in time."""
        work.check()
        self._address = address
        refused = partial(ParameterError, parameter="scheduler")
        with raising(refused, "needs the extra 'cluster'", ImportError, remedy=": pip install 'uwbcal[cluster]'"):
            dask: Any = import_module("distributed")
        self.died = dask.KilledWorker
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        with raising(
            refused, f"{address} does not answer within {self.connect_s} s", OSError, TimeoutError, ValueError
        ):
            self._client = dask.Client(address, timeout=self.connect_s, set_as_default=False)
        super().__init__(max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1), work)

    def _start_pool(self) -> Any:
        return self._client.get_executor(pure=False)

    def finished(self) -> Sequence[Done]:
        """Wait for the first chunk that is done."""
        try:
            return super().finished()
        except (CancelledError, OSError, TimeoutError) as error:
            raise ClusterLostError(
                f"{self._address}: the connection to the scheduler is lost; results so far are kept, continue with "
                f"`resume`"
            ) from error

    def close(self) -> None:
        """Disconnect from the cluster."""
        self._client.close()


def workers_for(count: int | None, scheduler: str | None, work: Work) -> Workers:
    """Return the workers for a sweep: a cluster by its address, else processes, or this process for one worker."""
    if scheduler:
        return Cluster(scheduler, work)
    # Not every system says which cores this process may use.
    allowed = getattr(os, "sched_getaffinity", None)
    size = count or (len(allowed(0)) if allowed else os.cpu_count() or 1)
    return Workers(1, work) if size == 1 else Processes(size, work)


def _end_with(held: Connection) -> None:
    """End this process when the other end of a pipe is closed, by its holder or with it, or when it is told to."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})

    def wait_for_end() -> None:
        with suppress(EOFError, OSError):
            held.recv_bytes()
        os._exit(1)

    Thread(target=wait_for_end, daemon=True).start()
