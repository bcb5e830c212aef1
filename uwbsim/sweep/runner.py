"""Runs a sweep: submits chunks of runs to workers, stores their results, and resumes an interrupted sweep.

A result depends on its run alone, not on the number of workers or their order. Few chunks are submitted at a time and
results are stored at once, so memory does not grow with the number of runs.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, Self

import duckdb

import uwblink
from uwblink.database import connect, write_tables
from uwblink.errors import UwblinkError, first_line, raising
from uwblink.output import check_folder, check_utf8
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.store import check_tables
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.sweep.design import SweepDesign
from uwbsim.sweep.executors import Chunk, Evaluate, Result, Work, Workers, evaluator, workers_for

STORE: Final = "results.duckdb"
"""Name of the file that keeps the results of a sweep, in its folder."""


@dataclass(frozen=True, slots=True)
class SweepSummary:
    """Numbers of runs of a sweep: done now, failed among these, and skipped because their results were stored."""

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
) -> SweepSummary:
    """Do the runs that have no results yet, and write results.csv and results.parquet in the order of the runs.

    Runs of kind `compare` compare protocols; those of other kinds simulate a flight and have `evaluate(flight)` return
    its results, a mapping of column to number, text or None; by default the entry point of that name of the group
    `uwbcal.evaluators`, as `calibrate`. Runs are done by `workers` processes (None: all cores), or by the
    Dask cluster at the address `scheduler`; both import `evaluate` by its name. `progress` is called with the done
    fraction, 0 to 1.

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
    SweepSummary(done=2, failed=0, skipped=0)
    >>> Path("results/results.csv").read_text().splitlines()[1].endswith("ds,5.0,0")
    True
    """
    folder = Path(folder)
    check_folder(folder)
    _check(plan, folder, resume=resume)
    kind = plan.settings.kind
    if kind != "compare":
        evaluate = evaluate or evaluator(kind)
    elif evaluate is not None:
        raise ParameterError(
            "can only be used with sweeps of flights, but the kind of this one is 'compare'", parameter="evaluate"
        )
    if workers is not None and workers < 1:
        raise ParameterError(f"found {workers}, expected 1 or more", parameter="workers")
    rows = tuple(PROTOCOLS[name] for name in plan.protocols)
    work = Work(name=plan.scenario.stem, protocols=rows, ranges=plan.settings.ranges, evaluate=evaluate)
    with closing(workers_for(workers, scheduler, work)) as team:
        folder.mkdir(exist_ok=True)
        with ResultStore.open(folder / STORE, _identity(plan)) as store:
            known = store.done()
            done, failed = _do(plan, store, team, work, known, progress)
            write_tables(folder / "results.csv", folder / "results.parquet", store, force=True)
    return SweepSummary(done, failed, len(known))


def _identity(plan: SweepDesign) -> dict[str, Any]:
    return {"name": plan.name, "plan": plan.path.name, "fingerprint": plan.fingerprint, "uwbcal": uwblink.__version__}


def _check(plan: SweepDesign, folder: Path, *, resume: bool) -> None:
    path, own, known, begun = folder / STORE, _identity(plan), {}, False
    if path.exists():
        with ResultStore.open(path, own) as store:
            known, begun = store.identity(), bool(store.done())
    elif resume:
        raise ParameterError(f"{folder} contains no sweep to continue", parameter="resume")
    elif folder.is_dir() and any(folder.iterdir()):
        raise ScenarioError(f"{folder}: holds other files; give an empty folder or a new one")
    told = {
        "plan": f"holds the results of another sweep, {known.get('plan')}",
        "fingerprint": f"{plan.path.name} or its scenario has changed since its results were made",
        "uwbcal": f"its results were made with uwbcal {known.get('uwbcal')}, but this is {uwblink.__version__}",
    }
    for key, text in told.items():
        if known and known.get(key) != own[key]:
            raise ScenarioError(f"{folder}: {text}; give another folder")
    if begun and not resume:
        raise ParameterError(
            f"{folder} already contains results of this sweep; continue it, or give another folder", parameter="resume"
        )


def _do(
    plan: SweepDesign,
    store: ResultStore,
    team: Workers,
    work: Work,
    known: set[int],
    progress: Callable[[float], None] | None,
) -> tuple[int, int]:
    """Do the runs whose numbers are not `known`; return the numbers of done and of failed runs."""
    numbers = (number for number in range(plan.total) if number not in known)
    # Runs of a worker that died are done again first, one at a time, to find the run that kills its worker.
    again: list[Chunk] = []
    attempts: Counter[int] = Counter()
    out, done, failed, size = 0, 0, 0, 1
    while True:
        while out < 2 * team.size:
            chunk = again.pop() if again else [plan.loaded(number) for number in islice(numbers, size)]
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
                # A chunk takes about a second: long compared with its submission, short for a user who waits.
                size = min(max(int(len(chunk) / max(seconds, 1e-6)), 1), 512)
            store.append(rows)
            done += len(rows)
            failed += sum(some[0]["status"] == "failed" for _, some in rows)
            if progress:
                progress((len(known) + done) / max(plan.total, 1))


def _lost(chunk: Chunk, work: Work, attempts: Counter[int], again: list[Chunk]) -> list[Result]:
    """Queue the runs of a lost chunk one by one; return the rows of those whose worker died three times."""
    attempts.update(run.number for run in chunk)
    again += [[run] for run in chunk if attempts[run.number] < 3]
    return [work.failed(run, "its worker died 3 times") for run in chunk if attempts[run.number] >= 3]


class TableError(UwblinkError, ValueError):
    """A table or store that cannot be read or written: what, where, what to do."""


RESULT_TABLES: Final = {
    "identity": {"key": "VARCHAR", "value": "VARCHAR"},
    "results": {"number": "BIGINT", "part": "BIGINT", "document": "VARCHAR"},
}


@dataclass(frozen=True, slots=True)
class ResultStore:
    """Results by number of run, committed as they come: a killed sweep loses only results not yet committed."""

    _db: Any
    _path: Path

    @classmethod
    @contextmanager
    def open(cls, path: Path, identity: Mapping[str, Any] | None = None) -> Iterator[Self]:
        """Open a store, or make one for the sweep with this identity; raises `TableError` if it is no store."""
        check_utf8(path, TableError)
        if path.is_symlink():
            raise TableError(f"{path}: is a link; give the folder in which the sweep was started")
        try:
            db = connect(path)
        except duckdb.Error as error:
            locked = "lock" in first_line(error)
            reason = f"cannot be opened ({first_line(error)})"
            other = "another sweep writes its results there; give another folder"
            raise TableError(f"{path}: {other if locked else reason}") from error
        with db:
            with _reading(path):
                check_tables(lambda query: db.execute(query).fetchall(), path, path.stat().st_size, RESULT_TABLES)
                asked = "SELECT table_name, column_name FROM system.main.duckdb_columns() WHERE NOT internal"
                found = set(db.execute(asked).fetchall())
            # A sweep killed at its start leaves a file without tables.
            if identity is not None and not found:
                with _writing(path):
                    db.execute("BEGIN")
                    for table, columns in RESULT_TABLES.items():
                        db.execute(
                            f"CREATE TABLE {table} ({', '.join(f'{name} {kind}' for name, kind in columns.items())})"
                        )
                    db.executemany(
                        "INSERT INTO identity VALUES (?, ?)", [[k, json.dumps(v)] for k, v in identity.items()]
                    )
                    db.execute("COMMIT")
            elif not {(table, column) for table, columns in RESULT_TABLES.items() for column in columns} <= found:
                raise TableError(f"{path}: not a store of results")
            yield cls(db, path)

    def identity(self) -> dict[str, Any]:
        """Return the identity of the sweep whose results it holds."""
        with _reading(self._path):
            rows = self._db.execute("SELECT key, value FROM identity").fetchall()
            return {key: json.loads(value) for key, value in rows}

    def done(self) -> set[int]:
        """Return the numbers of the runs that have results."""
        with _reading(self._path):
            return {int(row[0]) for row in self._db.execute("SELECT DISTINCT number FROM results").fetchall()}

    def append(self, results: Sequence[tuple[int, Sequence[Mapping[str, Any]]]]) -> None:
        """Commit results, each a number and its rows, all or none; raises `TableError`."""
        rows = [(number, part, json.dumps(row)) for number, some in results for part, row in enumerate(some)]
        # One statement and one commit, however many rows: a statement a row took most of a sweep's own time.
        columns = [list(column) for column in zip(*rows, strict=True)] or [[], [], []]
        with _writing(self._path):
            self._db.execute("INSERT INTO results SELECT unnest(?), unnest(?), unnest(?)", columns)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield all rows in the order of their numbers; raises `TableError` where one is damaged."""
        with _reading(self._path):
            cursor = self._db.cursor()
            cursor.execute("SELECT number, document FROM results ORDER BY number, part")
            while batch := cursor.fetchmany(5000):
                for number, document in batch:
                    row = dict(json.loads(document))
                    if row.get("number") != number:
                        raise ValueError(f"the row of run {number} is not a result")
                    yield row


def _reading(path: Path) -> AbstractContextManager[None]:
    return _using(path, "its results are damaged", "; begin in another folder")


def _writing(path: Path) -> AbstractContextManager[None]:
    return _using(path, "cannot be written", "; is the disk full? Results so far are kept")


def _using(path: Path, wrong: str, remedy: str) -> AbstractContextManager[None]:
    """Raise `TableError` for the errors of a store whose file is damaged, or cannot be written."""
    unusable = (duckdb.Error, ValueError, TypeError, KeyError, RecursionError)
    return raising(TableError, f"{path}: {wrong}", *unusable, remedy=remedy)
