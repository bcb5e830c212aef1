"""Who does the work of a sweep: this process, all cores, or a Dask cluster that runs already."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Final, Protocol

from uwbsim.errors import ParameterError, UwbsimError
from uwbsim.sweep.extensions import Extensions
from uwbsim.sweep.task import Result, Task, run_chunk

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
