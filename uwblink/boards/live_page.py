"""A page that shows a recording while it is made: a listener of the recorder, and a server for this computer alone.

Plain HTML with pictures in SVG, drawn here and fetched once a second; nothing comes from a network, and without
scripts the page reloads itself. The server listens on the loopback interface only and answers no other host's name.
"""

from __future__ import annotations

import base64
import hashlib
import math
import shutil
import threading
from collections import deque
from dataclasses import dataclass, field
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from uwblink.boards.corrections import Correction
from uwblink.boards.listeners import Listener, Pair, Turn
from uwblink.boards.progress import PairState, Progress
from uwblink.errors import PortError
from uwblink.recording.schema import Fault

LOOPBACK: Final = "127.0.0.1"
SHOWN_S: Final = 60.0
MOST_POINTS: Final = 600
LAST_FAULTS: Final = 8
WIDTH, HEIGHT, MARGIN = 260, 44, 3
RANGE_COLOUR, CORRECTED_COLOUR = "#0072B2", "#D55E00"

STYLE: Final = """
body{font:15px system-ui,sans-serif;margin:1.5em;color:#222}table{border-collapse:collapse}
td,th{padding:.2em .7em;text-align:right;border-bottom:1px solid #ddd}caption{text-align:left;padding:.4em 0}
svg{background:#f7f7f7;display:block}.bad{color:#b00020;font-weight:600}ul{padding-left:1.2em}
"""
SCRIPT: Final = """
setInterval(async()=>{const m=document.querySelector('main');try{const r=await fetch('/body');
if(r.ok){m.innerHTML=await r.text();}}catch(e){document.title='recording ended';}},1000);
"""


@dataclass(slots=True)
class _Series:
    """The last ranges of a pair: time since the start (s), range and corrected range (m)."""

    points: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=MOST_POINTS))


class LivePage(Listener):
    """What is going on, as a page. A context manager: leaving it ends the server."""

    def __init__(self, path: Path, *, correct: Correction | None = None, port: int = 0) -> None:
        """Serve a page about the recording at `path`; port 0 takes any that is free. Raises `PortError`.

        With `correct` each range is shown corrected, too.
        """
        self._path, self._correct = path, correct
        self._lock = threading.Lock()
        self._series: dict[Pair, _Series] = {}
        self._faults: deque[Fault] = deque(maxlen=LAST_FAULTS)
        self._progress = Progress()
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), self._handler())
        except OSError as error:
            raise PortError(f"port {port}: the page cannot be served there ({error.strerror})") from error
        self._server.daemon_threads = True
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

    def on_turn(self, turn: Turn) -> None:
        """Keep the range of a turn."""
        if turn.report is None:
            return
        time_s = (turn.time_ns - self._progress.start_ns) * 1e-9 if self._progress.start_ns else turn.time_ns * 1e-9
        known = self._correct(turn.pair[0], turn.report) if self._correct else {}
        corrected = known.get("corrected_m", math.nan)
        with self._lock:
            self._series.setdefault(turn.pair, _Series()).points.append((time_s, turn.report.range_m, corrected))

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
        title = f"recording {escape(self._path.name)}"
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
            '<noscript><meta http-equiv="refresh" content="2"></noscript></head>'
            f"<body><h1>{title}</h1><main>{self.body()}</main><script>{SCRIPT}</script></body></html>"
        )

    def body(self) -> str:
        """Return what changes: counts, pairs, faults, disk."""
        progress = self._progress
        with self._lock:
            series = {pair: list(found.points) for pair, found in self._series.items()}
            faults = list(self._faults)
        rows = "".join(self._row(pair, state, series.get(pair, [])) for pair, state in list(progress.pairs.items()))
        head = "".join(f"<th>{name}</th>" for name in ("pair", "rate (Hz)", "success", "range (m)", "corrected (m)"))
        return (
            f"<p>{progress.time_s:.1f} s, {progress.exchanges} of {progress.tried} exchanges, {progress.overheard} "
            f"overheard, {progress.cirs} impulse responses</p>"
            f"<table><thead><tr>{head}<th>FPP (dBm)</th>"
            f'<th>last minute: <span style="color:{RANGE_COLOUR}">range</span>'
            f', <span style="color:{CORRECTED_COLOUR}">corrected</span></th></tr></thead><tbody>{rows}</tbody></table>'
            f"{_faults(progress, faults)}{self._disk(progress)}"
        )

    def _row(self, pair: Pair, state: PairState, points: list[tuple[float, float, float]]) -> str:
        corrected = points[-1][2] if points else math.nan
        cells = (
            f"{pair[0]} &rarr; {pair[1]}",
            f"{state.rate_hz(self._progress.time_s):.1f}",
            f"{100 * state.good / state.tried:.0f} %" if state.tried else "",
            _metres(state.range_m),
            _metres(corrected),
            f"{state.fpp_dbm:.1f}" if state.good else "",
            _picture(points),
        )
        return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"

    def _disk(self, progress: Progress) -> str:
        try:
            size = sum(p.stat().st_size for p in (self._path, Path(f"{self._path}.wal")) if p.exists())
            free = shutil.disk_usage(self._path.parent).free
        except OSError:
            return ""
        behind = ' class="bad"' if progress.behind_s > 1 else ""
        return (
            f"<p{behind}>file {size / 2**20:.1f} MB, disk {free / 2**30:.1f} GB free; "
            f"queue: {progress.waiting} pieces, last commit {progress.behind_s:.1f} s ago</p>"
        )

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        page = self

        class Handler(BaseHTTPRequestHandler):
            """Answers for one page."""

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


def _send(handler: BaseHTTPRequestHandler, text: str) -> None:
    data = text.encode()
    script = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
    handler.send_response(200)
    handler.send_header("Content-Type", "text/html; charset=utf-8")
    handler.send_header("Content-Length", str(len(data)))
    handler.send_header("Cache-Control", "no-store")
    handler.send_header(
        "Content-Security-Policy",
        f"default-src 'none'; style-src 'unsafe-inline'; connect-src 'self'; script-src 'sha256-{script}'",
    )
    handler.end_headers()
    handler.wfile.write(data)


def _faults(progress: Progress, last: list[Fault]) -> str:
    counts = ", ".join(f"{escape(kind)} {n}" for kind, n in sorted(dict(progress.faults).items())) or "none"
    items = "".join(f"<li>board {escape(f.board)}: {escape(f.kind)}: {escape(f.detail)}</li>" for f in reversed(last))
    return f"<p>faults: {counts}</p>" + (f"<ul>{items}</ul>" if items else "")


def _metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else ""


def _picture(points: list[tuple[float, float, float]]) -> str:
    """Draw range and corrected range over the last minute; the scale is that of the ranges shown."""
    if len(points) < 2:
        return ""
    end = points[-1][0]
    shown = [p for p in points if p[0] > end - SHOWN_S]
    values = [v for _, *pair in shown for v in pair if math.isfinite(v)]
    low, high = min(values), max(values)
    spread, began = max(high - low, 1e-3), shown[0][0]
    lines = []
    for column, colour in ((1, RANGE_COLOUR), (2, CORRECTED_COLOUR)):
        at = " ".join(
            f"{MARGIN + (WIDTH - 2 * MARGIN) * (p[0] - began) / max(end - began, 1e-9):.1f},"
            f"{HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * (p[column] - low) / spread:.1f}"
            for p in shown
            if math.isfinite(p[column])
        )
        if at:
            lines.append(f'<polyline fill="none" stroke="{colour}" stroke-width="1.2" points="{at}"/>')
    label = f"range from {low:.3f} to {high:.3f} m"
    return (
        f'<svg role="img" aria-label="{label}" width="{WIDTH}" height="{HEIGHT}"><title>{label}</title>'
        + "".join(lines)
        + "</svg>"
    )
