"""One run of a sweep as a worker does it, and the workers: this process, processes, or a Dask cluster.

A run goes from plain data to plain rows, the same on every worker. Workers are other processes, perhaps on other
machines: functions of plug-ins reach them by module and name.
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import numpy as np

import uwblink
from uwblink.errors import UwblinkError
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS, register_protocol
from uwbsim.errors import ParameterError, UwbsimError
from uwbsim.protocols.comparison import compare
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.run import simulate
from uwbsim.simulation.simulated import Simulated
from uwbsim.world.channel import CHANNEL_EFFECTS, OWN_EFFECTS, ChannelEffect

Evaluate = Callable[[Simulated], Mapping[str, Any]]
"""Returns the figures of a flight as columns of one row: numbers, texts or None."""

Row = dict[str, Any]
Result = tuple[int, list[Row]]
"""A run's number, and its rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One run: what varies, and the scenario as JSON, or the error that it gave."""

    number: int
    seed: int
    values: Mapping[str, Any]
    scenario: str = ""
    error: str = ""


Chunk = list[Task]
Done = tuple[Chunk, list[Result] | None, float]
"""A chunk, its rows by number (None: its worker died), and the seconds that it took."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What all runs of a sweep have in common: scenario's name, protocols, what is done, and plug-ins of this process.

    With `evaluate` each protocol's flight is simulated and evaluated; without, protocols are compared by `ranges`.
    """

    name: str
    protocols: tuple[RangingProtocol, ...]
    ranges: int
    evaluate: Evaluate | None = None
    effects: tuple[tuple[str, ChannelEffect], ...] = ()

    @classmethod
    def of_here(cls, name: str, protocols: Iterable[str], ranges: int, evaluate: Evaluate | None = None) -> Work:
        """Return the work of a sweep with the rows of protocols and the channel effects that this process has."""
        effects = tuple((name, effect) for name, effect in CHANNEL_EFFECTS.items() if name not in OWN_EFFECTS)
        rows = tuple(PROTOCOLS[name] for name in protocols)
        return cls(name=name, protocols=rows, ranges=ranges, evaluate=evaluate, effects=effects)

    def check(self) -> None:
        """Raise `ParameterError` where another process would not find a function by its name."""
        named: dict[str, object] = {f"channel effect {name!r}": effect for name, effect in self.effects}
        for row in self.protocols:
            named |= {
                f"{part} of protocol {row.name!r}": getattr(row, part) for part in ("flight_ticks", "delay_weights")
            }
        if self.evaluate is not None:
            named["evaluate"] = self.evaluate
        for what, function in named.items():
            module = sys.modules.get(getattr(function, "__module__", None) or "")
            if getattr(module, getattr(function, "__qualname__", ""), None) is not function:
                raise ParameterError(
                    f"found {function!r}, which other processes cannot import; "
                    "give a function at the top of a module, or work in this process (workers = 1)",
                    parameter=what,
                )

    def do(self, task: Task) -> Result:
        """Return the rows of a run, one a protocol; a failure is a row."""
        try:
            if task.error:
                raise UwbsimError(task.error)
            scenario = Scenario.model_validate_json(task.scenario)
            rows = self._compared(scenario) if self.evaluate is None else self._evaluated(scenario, self.evaluate)
        except (UwbsimError, UwblinkError, ArithmeticError, ValueError, MemoryError) as error:
            return self.failed(task, str(error) or type(error).__name__)
        return task.number, [self._head(task) | {"status": "ok", "error": None} | row for row in rows]

    def failed(self, task: Task, reason: str) -> Result:
        """Return the row of a run that failed."""
        error = reason.splitlines()[0][:300] if reason else "unknown"
        return task.number, [self._head(task) | {"status": "failed", "error": error}]

    def _head(self, task: Task) -> Row:
        versions = {"uwbcal": uwblink.__version__, "numpy": np.__version__, "python": platform.python_version()}
        values = {k: v if isinstance(v, int | float | str | bool) else json.dumps(v) for k, v in task.values.items()}
        return {"scenario": self.name, "number": task.number, "seed": task.seed} | versions | values

    def _compared(self, scenario: Scenario) -> list[Row]:
        return [outcome.to_dict() for outcome in compare(scenario, self.protocols, self.ranges).outcomes]

    def _evaluated(self, scenario: Scenario, evaluate: Evaluate) -> list[Row]:
        """Simulate a flight with each protocol, and have it evaluated."""
        found = []
        for row in self.protocols:
            ranging = scenario.ranging.model_copy(update={"protocol": row.name})
            simulated = simulate(scenario.model_copy(update={"ranging": ranging}))
            try:
                figures = dict(evaluate(simulated))
            except Exception as error:
                # A plug-in's function: whatever it raises is the failure of this run, and of no other.
                raise UwbsimError(str(error) or type(error).__name__) from error
            found.append({"protocol": row.name} | figures | {"failed_exchanges": len(simulated.faults)})
        return found


def run_chunk(tasks: Sequence[Task], work: Work) -> tuple[list[Result], float]:
    """Do some runs; return their rows by number, and how long they took together in seconds."""
    start = time.perf_counter()
    # What this process knows already stays.
    for row in work.protocols:
        if row.name not in PROTOCOLS:
            register_protocol(row)
    for name, effect in work.effects:
        CHANNEL_EFFECTS.setdefault(name, effect)
    return [work.do(task) for task in tasks], time.perf_counter() - start


def evaluator(kind: str) -> Evaluate:
    """Return the function that installed distributions offer for a kind of sweep; raises `ParameterError`."""
    group = "uwbcal.evaluators"
    for entry in entry_points(group=group, name=kind):
        try:
            found: Evaluate = entry.load()
        except (ImportError, AttributeError) as error:
            raise ParameterError(
                f"{entry.value}, which {group} names, cannot be imported: {error}", parameter="evaluate"
            ) from error
        return found
    raise ParameterError(
        f"a sweep of kind {kind!r} needs a function that evaluates a flight, and no installed distribution offers one "
        f"(entry point {kind!r} of the group {group})",
        parameter="evaluate",
    )


class ClusterLostError(UwbsimError, ConnectionError):
    """The scheduler of a cluster went away while it worked."""


class WorkersLostError(UwbsimError):
    """Processes that end as they begin."""


class Workers:
    """Does chunks of runs, in whatever order, `size` of them at once: in this process, one after the other."""

    died: type[Exception] = BrokenProcessPool
    """Raised by the future of a chunk whose worker died."""

    def __init__(self, size: int, work: Work) -> None:
        """`size` is how many chunks are worked on at once."""
        self.size, self._work = size, work
        self._running: dict[Any, Chunk] = {}

    def submit(self, chunk: Chunk) -> None:
        """Take on a chunk."""
        self._running[self._start(chunk)] = chunk

    def finished(self) -> Sequence[Done]:
        """Wait until something is done, and return all that is."""
        found: list[Done] = []
        for future in self._wait():
            chunk = self._running.pop(future)
            try:
                found.append((chunk, *future.result()))
            except self.died:
                found.append((chunk, None, 0.0))
        return found

    def _start(self, chunk: Chunk) -> Any:
        return Future()

    def _wait(self) -> Iterable[Any]:
        future, chunk = next(iter(self._running.items()))
        future.set_result(run_chunk(chunk, self._work))
        return [future]

    def close(self) -> None:
        """Release the workers, without waiting for what they do."""


class Processes(Workers):
    """Processes of this machine; when one dies the pool is made anew, and its chunks come back as lost.

    They end with this process, however that ends: each waits for the end of a pipe that this process holds.
    """

    def __init__(self, size: int, work: Work) -> None:
        """Start `size` processes; raises `ParameterError` for plug-ins that they could not import."""
        work.check()
        super().__init__(size, work)
        self._start_pool()

    def _start_pool(self) -> None:
        context = multiprocessing.get_context("spawn")
        held, self._held = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(self.size, context, initializer=_end_with, initargs=(held,))
        try:
            with _inherited():
                list(self._pool.map(abs, range(self.size)))
        except BrokenProcessPool as error:
            self.close()
            raise WorkersLostError(
                "`workers`: a process ended as it began: is there memory for so many, and does the script begin its "
                "work below `if __name__ == '__main__':`? With 1 the work is done in this process"
            ) from error

    def _start(self, chunk: Chunk) -> Any:
        with _inherited():  # a process may be started for it
            try:
                return self._pool.submit(run_chunk, chunk, self._work)
            except BrokenProcessPool:
                self._start_pool()
                return self._pool.submit(run_chunk, chunk, self._work)

    def _wait(self) -> Iterable[Any]:
        return wait(self._running, return_when=FIRST_COMPLETED).done

    def close(self) -> None:
        """End the processes, those that still have a chunk at once."""
        if self._running:
            self._held.close()
        self._pool.shutdown(cancel_futures=True)
        self._held.close()


class Cluster(Workers):
    """A Dask cluster by the address of its scheduler; `distributed` moves the work of a dead worker to another."""

    connect_s = 10
    """How long a cluster may take to answer: chosen, some round trips to a busy scheduler."""

    def __init__(self, address: str, work: Work) -> None:
        """Connect; raises `ParameterError` where no scheduler answers in time."""
        work.check()
        self._address = address
        try:
            self._dask: Any = import_module("distributed")
        except ImportError as error:
            raise ParameterError(
                "needs the extra 'cluster': pip install 'uwbcal[cluster]'", parameter="scheduler"
            ) from error
        self.died = self._dask.KilledWorker
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            self._client = self._dask.Client(address, timeout=self.connect_s, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ParameterError(
                f"{address} does not answer within {self.connect_s} s", parameter="scheduler"
            ) from error
        super().__init__(max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1), work)

    def finished(self) -> Sequence[Done]:
        """Wait for the first chunk that is done."""
        try:
            return super().finished()
        except (CancelledError, OSError, TimeoutError) as error:
            raise ClusterLostError(
                f"{self._address}: the scheduler is gone; results so far are kept, go on with `resume`"
            ) from error

    def _start(self, chunk: Chunk) -> Any:
        return self._client.submit(run_chunk, chunk, self._work, pure=False)

    def _wait(self) -> Iterable[Any]:
        with self._client.as_current():
            done: Iterable[Any] = self._dask.wait(list(self._running), return_when="FIRST_COMPLETED").done
        return done

    def close(self) -> None:
        """Leave the cluster as it was."""
        self._client.close()


def workers_for(count: int | None, scheduler: str | None, work: Work) -> Workers:
    """Return the workers that were asked for: a cluster by address, or processes, or this one if one is enough."""
    if scheduler:
        return Cluster(scheduler, work)
    # Not every system says which cores this process may use.
    allowed = getattr(os, "sched_getaffinity", None)
    size = count or (len(allowed(0)) if allowed else os.cpu_count() or 1)
    return Workers(1, work) if size == 1 else Processes(size, work)


def _end_with(held: Connection) -> None:
    """Have this process end when the other end of a pipe is closed: by its holder, or by that one's end."""

    def wait_for_end() -> None:
        with suppress(EOFError, OSError):
            held.recv_bytes()
        os._exit(1)

    Thread(target=wait_for_end, daemon=True).start()


@contextmanager
def _inherited() -> Iterator[None]:
    """Start processes with one thread each in linear algebra, and with Ctrl-C blocked.

    A terminal sends that to all of them, and it is this process that answers.
    """
    threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ[name] for name in threads if name in os.environ}
    os.environ.update(dict.fromkeys(threads, "1"))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name in threads:
            del os.environ[name]
        os.environ.update(before)
