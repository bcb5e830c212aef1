"""A page that shows a recording while it is made: a listener of the recorder, and a server for this computer alone.

Plain HTML with pictures in SVG, drawn here and fetched once a second; nothing comes from a network, and without
scripts the page reloads itself. The server listens on the loopback interface only and answers no other host's name.
"""

from __future__ import annotations

import base64
import hashlib
import math
import shutil
import sys
import threading
from collections import deque
from collections.abc import Sequence
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from uwblink.boards.corrections import Correction, check_pairs
from uwblink.boards.listeners import Listener, Pair, Turn
from uwblink.boards.live_view import SCRIPT, Point, counts, disk, faults_list, table, whole
from uwblink.boards.progress import Progress
from uwblink.errors import PortError
from uwblink.recording.schema import Fault
from uwblink.wire.bulk import exchanges_of

LOOPBACK: Final = "127.0.0.1"
MOST_POINTS: Final = 600
LAST_FAULTS: Final = 8
IDLE_S: Final = 10.0
"""A connection that sends no request for so long is closed: each has a thread."""


class LivePage(Listener):
    """What is going on, as a page. A context manager: leaving it ends the server."""

    def __init__(self, path: Path, *, correct: Correction | None = None, port: int = 0) -> None:
        """Serve a page about the recording at `path`; port 0 takes any that is free. Raises `PortError`.

        With `correct` each range is shown corrected, too.
        """
        self._path, self._correct = path, correct
        self._lock = threading.Lock()
        self._series: dict[Pair, deque[Point]] = {}
        self._faults: deque[Fault] = deque(maxlen=LAST_FAULTS)
        self._progress = Progress()
        try:
            self._server = _Server((LOOPBACK, port), self._handler())
        except OSError as error:
            raise PortError(f"port {port}: the page cannot be served there ({error.strerror})") from error
        self._thread = threading.Thread(target=self._server.serve_forever, name="uwblink page", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        """Return the page."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the server."""
        self.close()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self._server.server_address[1]}/"

    def on_start(self, pairs: Sequence[Pair]) -> None:
        """Raise what the correction raises where it cannot correct ranges of a pair."""
        check_pairs(self._correct, pairs)

    def on_turn(self, turn: Turn) -> None:
        """Keep the range of a turn."""
        if turn.report is None:
            return
        corrected_m = math.nan
        if self._correct:
            known = self._correct(exchanges_of([(turn.time_ns, turn.pair[0], turn.report)]))
            corrected_m = float(known["corrected_m"][0])
        point = Point(turn.time_ns, turn.report.range_m, corrected_m)
        with self._lock:
            self._series.setdefault(turn.pair, deque(maxlen=MOST_POINTS)).append(point)

    def on_fault(self, fault: Fault) -> None:
        """Keep a fault."""
        with self._lock:
            self._faults.append(fault)

    def watch(self, progress: Progress) -> None:
        """Take over the counts of a recorder."""
        self._progress = progress

    def close(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._server.server_close()

    def html(self) -> str:
        """Return the whole page."""
        return whole(self.body())

    def body(self) -> str:
        """Return what changes: counts, pairs, faults, disk; and the name, as the next recorder may have this port."""
        with self._lock:
            series = {pair: list(points) for pair, points in self._series.items()}
            faults = list(reversed(self._faults))
        parts = (
            f"<h1>recording {escape(self._path.name)}</h1>",
            counts(self._progress),
            table(self._progress, series, corrected=self._correct is not None),
            faults_list(self._progress, faults),
            self._disk(),
        )
        return "".join(parts)

    def _disk(self) -> str:
        try:
            size = sum(p.stat().st_size for p in (self._path, Path(f"{self._path}.wal")) if p.exists())
            return disk(self._progress, size, shutil.disk_usage(self._path.parent).free)
        except OSError:
            return ""

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        page = self

        class Handler(BaseHTTPRequestHandler):
            """Answers for one page."""

            timeout = IDLE_S

            def do_GET(self) -> None:
                host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
                found = {"/": page.html, "/body": page.body}.get(self.path)
                if host not in (LOOPBACK, "localhost"):
                    self.send_error(403)
                elif found is None:
                    self.send_error(404)
                else:
                    _send(self, found())

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
                """Say nothing: the terminal belongs to the recorder."""

        return Handler


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that goes away, which is no error; the terminal belongs to the recorder."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


def _send(handler: BaseHTTPRequestHandler, text: str) -> None:
    data = text.encode()
    script = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
    handler.send_response(200)
    handler.send_header("Content-Type", "text/html; charset=utf-8")
    handler.send_header("Content-Length", str(len(data)))
    handler.send_header("Cache-Control", "no-store")
    handler.send_header(
        "Content-Security-Policy",
        f"default-src 'none'; style-src 'unsafe-inline'; connect-src 'self'; script-src 'sha256-{script}'; "
        "frame-ancestors 'none'",
    )
    handler.end_headers()
    handler.wfile.write(data)
