"""One run of a sweep as a worker does it, and the workers: this process, processes, or a Dask cluster.

A run goes from plain data to plain rows, the same on every worker. Workers are other processes, perhaps on other
machines: functions of plug-ins reach them by module and name.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Final, Protocol

import numpy as np

import uwblink
from uwblink.errors import UwblinkError
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS, register_protocol
from uwbsim.errors import ParameterError, UwbsimError
from uwbsim.simulation.simulated import Simulated
from uwbsim.world.channel import CHANNEL_EFFECTS, OWN_EFFECTS, ChannelEffect

Evaluate = Callable[[Simulated], Mapping[str, Any]]
"""Returns the figures of a flight as columns of one row: numbers, texts or None."""

GROUP: Final = "uwbcal.evaluators"
"""Entry points of this group offer functions of kind `Evaluate`, by the name of a sweep's kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Extensions:
    """What a worker needs besides its tasks: the function that evaluates flights, protocols, effects of the channel."""

    evaluate: Evaluate | None = None
    protocols: tuple[RangingProtocol, ...] = ()
    effects: tuple[tuple[str, ChannelEffect], ...] = ()

    @classmethod
    def of_here(cls, evaluate: Evaluate | None, protocols: Sequence[str]) -> Extensions:
        """Return what this process has, with the rows of some protocols."""
        added = {name: effect for name, effect in CHANNEL_EFFECTS.items() if name not in OWN_EFFECTS}
        rows = tuple(PROTOCOLS[name] for name in protocols)
        return cls(evaluate=evaluate, protocols=rows, effects=tuple(added.items()))

    def install(self) -> None:
        """Have a process know what is in here; what it knows already stays."""
        for row in self.protocols:
            if row.name not in PROTOCOLS:
                register_protocol(row)
        for name, effect in self.effects:
            CHANNEL_EFFECTS.setdefault(name, effect)

    def check(self) -> None:
        """Raise `ParameterError` where another process would not find a function by its name."""
        named: dict[str, object] = {f"channel effect {name!r}": effect for name, effect in self.effects}
        for row in self.protocols:
            formulas = {part: getattr(row, part) for part in ("flight_ticks", "delay_weights")}
            named |= {f"{part} of protocol {row.name!r}": formula for part, formula in formulas.items()}
        if self.evaluate is not None:
            named["evaluate"] = self.evaluate
        for what, function in named.items():
            if not _found_by_name(function):
                raise ParameterError(
                    f"found {function!r}, which other processes cannot import; "
                    "give a function at the top of a module, or work in this process (workers = 1)",
                    parameter=what,
                )


def _found_by_name(function: object) -> bool:
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    return getattr(module, getattr(function, "__qualname__", ""), None) is function


def evaluator(kind: str) -> Evaluate:
    """Return the function that installed distributions offer for a kind of sweep; raises `ParameterError`."""
    for entry in entry_points(group=GROUP, name=kind):
        try:
            found: Evaluate = entry.load()
        except (ImportError, AttributeError) as error:
            raise ParameterError(
                f"{entry.value}, which {GROUP} names, cannot be imported: {error}", parameter="evaluate"
            ) from error
        return found
    raise ParameterError(
        f"a sweep of kind {kind!r} needs a function that evaluates a flight, and no installed distribution offers one "
        f"(entry point {kind!r} of the group {GROUP})",
        parameter="evaluate",
    )


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


Chunk = list[Task]
Done = tuple[Chunk, list[Result] | None, float]
"""A chunk, its rows by number (None: its worker died), and the seconds that it took."""

CONNECT_S: Final = 10
THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class ClusterLostError(UwbsimError, ConnectionError):
    """The scheduler of a cluster went away while it worked."""


class WorkersLostError(UwbsimError):
    """Processes that end as they begin."""


class Workers(Protocol):
    """Does chunks of runs, in whatever order; `size` of them at once."""

    size: int

    def submit(self, chunk: Chunk) -> None:
        """Take on a chunk."""
        ...

    def finished(self) -> Sequence[Done]:
        """Wait until something is done, and return all that is."""
        ...

    def close(self) -> None:
        """Let the workers go, without waiting for what they do."""
        ...


class InProcess:
    """This process."""

    size = 1

    def __init__(self, extensions: Extensions) -> None:
        """Begin without chunks; each is worked on with `extensions`."""
        self._extensions = extensions
        self._waiting: list[Chunk] = []

    def submit(self, chunk: Chunk) -> None:
        """Take on a chunk."""
        self._waiting.append(chunk)

    def finished(self) -> Sequence[Done]:
        """Do one chunk."""
        chunk = self._waiting.pop(0)
        rows, seconds = run_chunk(chunk, self._extensions)
        return [(chunk, rows, seconds)]

    def close(self) -> None:
        """Return: nothing was started."""


class Processes:
    """Processes of this machine; when one dies the pool is made anew, and its chunks come back as lost.

    They end with this process, however that ends: each waits for the end of a pipe that this process holds.
    """

    def __init__(self, size: int, extensions: Extensions) -> None:
        """Start `size` processes; raises `ParameterError` for extensions that they could not import."""
        extensions.check()
        self.size, self._extensions = size, extensions
        self._running: dict[Any, Chunk] = {}
        self._start()

    def _start(self) -> None:
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor
        from concurrent.futures.process import BrokenProcessPool

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

    def submit(self, chunk: Chunk) -> None:
        """Take on a chunk; raises `WorkersLostError` where processes cannot be started."""
        from concurrent.futures.process import BrokenProcessPool

        with _inherited():  # a process may be started for it
            try:
                future = self._pool.submit(run_chunk, chunk, self._extensions)
            except BrokenProcessPool:
                self._start()
                future = self._pool.submit(run_chunk, chunk, self._extensions)
        self._running[future] = chunk

    def finished(self) -> Sequence[Done]:
        """Wait for the first chunk that is done."""
        from concurrent.futures import FIRST_COMPLETED, wait
        from concurrent.futures.process import BrokenProcessPool

        found: list[Done] = []
        for future in wait(self._running, return_when=FIRST_COMPLETED).done:
            chunk = self._running.pop(future)
            try:
                rows, seconds = future.result()
                found.append((chunk, rows, seconds))
            except BrokenProcessPool:
                found.append((chunk, None, 0.0))
        return found

    def close(self) -> None:
        """End the processes, those that still have a chunk at once."""
        if self._running:
            self._held.close()
        self._pool.shutdown(cancel_futures=True)
        self._held.close()


class Cluster:
    """A Dask cluster by the address of its scheduler; `distributed` moves the work of a dead worker to another."""

    def __init__(self, address: str, extensions: Extensions) -> None:
        """Connect; raises `ParameterError` where nobody answers within ten seconds."""
        extensions.check()
        self._extensions, self._address = extensions, address
        try:
            self._dask: Any = import_module("distributed")
        except ImportError as error:
            raise ParameterError(
                "needs the extra 'cluster': pip install 'uwbcal[cluster]'", parameter="scheduler"
            ) from error
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            self._client = self._dask.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ParameterError(f"{address} does not answer within {CONNECT_S} s", parameter="scheduler") from error
        self.size = max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1)
        self._running: dict[Any, Chunk] = {}

    def submit(self, chunk: Chunk) -> None:
        """Take on a chunk."""
        self._running[self._client.submit(run_chunk, chunk, self._extensions, pure=False)] = chunk

    def finished(self) -> Sequence[Done]:
        """Wait for the first chunk that is done."""
        found: list[Done] = []
        try:
            with self._client.as_current():
                ready = self._dask.wait(list(self._running), return_when="FIRST_COMPLETED").done
            for future in ready:
                chunk = self._running.pop(future)
                try:
                    rows, seconds = future.result()
                    found.append((chunk, rows, seconds))
                except self._dask.KilledWorker:
                    found.append((chunk, None, 0.0))
                future.release()
        except (CancelledError, OSError, TimeoutError) as error:
            raise ClusterLostError(
                f"{self._address}: the scheduler is gone; results so far are kept, go on with `resume`"
            ) from error
        return found

    def close(self) -> None:
        """Leave the cluster as it was."""
        self._client.close()


def workers_for(count: int | None, scheduler: str | None, extensions: Extensions) -> Workers:
    """Return the workers that were asked for: a cluster by address, or processes, or this one if one is enough."""
    if scheduler:
        return Cluster(scheduler, extensions)
    size = count or _cores()
    return InProcess(extensions) if size == 1 else Processes(size, extensions)


def _cores() -> int:
    """Return the cores that this process may use; not every system says, then all that there are."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def _end_with(held: Connection) -> None:
    """Have this process end when the other end of a pipe is closed: by its holder, or by that one's end."""

    def wait_for_end() -> None:
        with suppress(EOFError, OSError):
            held.recv_bytes()
        os._exit(1)

    Thread(target=wait_for_end, daemon=True).start()


@contextmanager
def _inherited() -> Iterator[None]:
    """Have processes that are started begin with one thread each in linear algebra, and without Ctrl-C.

    A terminal sends that to all of them, and it is this process that answers.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if hasattr(signal, "pthread_sigmask") else set()
    try:
        yield
    finally:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
