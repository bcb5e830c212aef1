"""A live page of a recording: a listener of the recorder, and a server for this computer only.

Plain HTML with pictures in SVG, drawn here and fetched once a second: counts, a row a pair with the last minute of its
ranges, faults, the disk. Nothing is loaded from a network; without scripts the page reloads itself. The server listens
on the loopback interface only and refuses other host names.
"""

from __future__ import annotations

import base64
import hashlib
import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from html import escape
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler
from importlib.resources import files
from pathlib import Path
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Any, Final

import numpy as np

from uwblink.boards.listeners import Listener, Pair, Progress, check_pairs
from uwblink.boards.ports import Closing
from uwblink.corrections import Columns
from uwblink.database import log_of
from uwblink.errors import PortError, raising
from uwblink.pages.blocks import CSS
from uwblink.twr import Exchanges
from uwblink.wire.codec import exchanges_of

PICTURE_WIDTH, PICTURE_HEIGHT, PICTURE_MARGIN = 260, 44, 3
"""Size of a pair's picture, and of the margin around its lines, in pixels."""

SCRIPT: Final = """
setInterval(async()=>{const m=document.querySelector('main');try{const r=await fetch('/body');
if(r.ok){m.innerHTML=await r.text();document.title=m.querySelector('h1').textContent;}
}catch(e){document.title='recording ended';
m.querySelector('p').textContent='This recording has ended; below is the last that came.';
}},1000);
"""


class BackgroundServer(ThreadingTCPServer):
    """A server of TCP connections in threads of this process, until `close`."""

    allow_reuse_address = True
    daemon_threads = True
    request_queue_size = 128

    def __init__(self, address: Any, handler: type[BaseRequestHandler]) -> None:
        """Serve at an address; raises `OSError`."""
        super().__init__(address, handler)
        threading.Thread(target=self.serve_forever, name="uwblink server", daemon=True).start()

    def close(self) -> None:
        """End the server; connections end with their handlers."""
        self.shutdown()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore lost connections; the recorder uses the terminal."""
        if not isinstance(sys.exception(), OSError | HTTPException):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class LivePage(Closing, Listener):
    """A page that shows the progress of a recording. A context manager: leaving it ends the server."""

    def __init__(self, path: Path, *, correct: Callable[[Exchanges], Columns] | None = None, port: int = 0) -> None:
        """Serve a page about the recording at `path`; port 0 selects a free one. Raises `PortError`.

        With `correct` the page also shows corrected ranges.
        """
        self._path, self._correct = path, correct
        self._progress = Progress()
        with raising(PortError, f"port {port}: the page cannot be served there"):
            self._server = BackgroundServer(("127.0.0.1", port), type("Handler", (_Handler,), {"page": self}))

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def on_start(self, pairs: Sequence[Pair]) -> None:
        """Raise the error of the correction if it cannot correct ranges of a pair."""
        check_pairs(self._correct, pairs)

    def watch(self, progress: Progress) -> None:
        """Show this progress."""
        self._progress = progress

    def close(self) -> None:
        """End the server."""
        self._server.close()

    def html(self) -> str:
        """Return the whole page."""
        body = self.body()
        title = body.removeprefix("<h1>").partition("</h1>")[0]
        style = CSS + (files("uwblink.boards") / "live.css").read_text(encoding="utf-8")
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style}</style>'
            '<noscript><meta http-equiv="refresh" content="2"></noscript></head>'
            f"<body><main>{body}</main><script>{SCRIPT}</script></body></html>"
        )

    def body(self) -> str:
        """Return the part that changes: name, counts, pairs, faults, disk. The next recorder may have the same port."""
        progress = self._progress
        faults = reversed([*progress.last_faults])
        lines = (f"{_clock(one.time_ns)} board {one.board}: {one.kind}: {one.detail}" for one in faults)
        items = "".join(f"<li>{escape(text)}</li>" for text in lines)
        listed = f"<ul>{items}</ul>" if items else ""
        since = f" since {_clock(progress.start_ns)}" if progress.start_ns else ""
        head = f"<h1>recording {escape(self._path.name)}{since}</h1><p>{escape(str(progress))}</p>"
        absent = "".join(
            f"<p class='bad'>board {escape(board)} is unplugged since {_clock(time_ns)}</p>"
            for board, time_ns in sorted(progress.absent.copy().items())
        )
        return f"{head}{absent}{self._table(progress)}{listed}{self._disk()}"

    def _table(self, progress: Progress) -> str:
        """Return a table with one row for each pair; pairs without ranges for two seconds are highlighted.

        The spread is computed from differences to neighbours in time: at ten ranges per second motion hardly changes
        it.
        """
        kinds = ("range", "corrected") if self._correct else ("range",)
        sigma = ("σ (cm)",) if self._correct else ()
        drawn = (f"<b class='{kind}'>{kind}</b> (m)" for kind in kinds)
        names = ("pair", "rate (Hz)", "success, 10 s", "FPP (dBm)", *drawn, "spread (cm)", *sigma, "last minute")
        rows = ""
        for pair, (rate, success, _, power) in progress.rows():
            shown = [*progress.pairs[pair].reports]
            shown = [one for one in shown if shown[-1][0] - one[0] <= 60e9]
            series = {"range": [report.range_m for *_, report in shown]}
            expected = [""] * len(sigma)
            if self._correct and shown:
                found = self._correct(exchanges_of(shown))
                series["corrected"] = found["corrected_m"].tolist()
                expected = [f"{100 * np.median(found['sigma_m']):.1f}" if "sigma_m" in found else ""]
            last = (f"{series[k][-1]:.3f}" if shown else "" for k in kinds)
            image = picture([time_ns for time_ns, *_ in shown], series)
            ends = f"{pair[0]}&nbsp;&rarr;&nbsp;{pair[1]}"
            cells = (ends, rate, success, power, *last, spread_cm(series[kinds[-1]] if shown else []), *expected, image)
            silent = " class='silent'" if (success or shown) and rate == "0.0" else ""
            rows += f"<tr{silent}>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
        head = "".join(f"<th>{name}</th>" for name in names)
        return f"<div class='wide live'><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"

    def _disk(self) -> str:
        """Return the size of the file, the free space, and the number of rows that wait to be written."""
        try:
            size = sum(p.stat().st_size for p in (self._path, log_of(self._path)) if p.exists())
            free = shutil.disk_usage(self._path.parent).free
        except OSError:
            return ""
        progress = self._progress
        behind = ' class="bad"' if progress.behind_s > 1 else ""
        return (
            f"<p{behind}>file {size / 2**20:.1f} MB, disk {free / 2**30:.1f} GB free; "
            f"queue: {progress.waiting} rows, last commit {progress.behind_s:.1f} s ago</p>"
        )


class _Handler(BaseHTTPRequestHandler):
    """HTTP answers for one page."""

    timeout = 10.0  # seconds; idle connections are closed, because each has a thread
    page: LivePage

    def do_GET(self) -> None:
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        found = {"/": self.page.html, "/body": self.page.body}.get(self.path)
        if host not in ("127.0.0.1", "localhost"):
            self.send_error(403)
        elif found is None:
            self.send_error(404)
        else:
            data = found().encode()
            script = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
            policy = (
                f"default-src 'none'; style-src 'unsafe-inline'; connect-src 'self'; script-src 'sha256-{script}'; "
                "frame-ancestors 'none'"
            )
            self.send_response(200)
            for name, value in (
                ("Content-Type", "text/html; charset=utf-8"),
                ("Content-Length", str(len(data))),
                ("Cache-Control", "no-store"),
                ("Content-Security-Policy", policy),
            ):
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
        """Print nothing: the recorder uses the terminal."""


def _clock(time_ns: int) -> str:
    """Return a host time as local time of day."""
    return time.strftime("%H:%M:%S", time.localtime(time_ns * 1e-9))


def spread_cm(values: Sequence[float]) -> str:
    """Return the standard deviation of values about their neighbours as text, "" for fewer than ten finite values.

    Second differences of white noise have six times its variance, and those of a smooth motion are small. Two thirds
    of normal errors lie within a standard deviation.
    """
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    if len(second) < 8:
        return ""
    low, high = np.quantile(second, (0.16, 0.84))
    return f"{100 * (high - low) / 2 / math.sqrt(6):.1f}"


def picture(time_ns: Sequence[int], series: Mapping[str, Sequence[float]]) -> str:
    """Draw series of ranges over time as SVG, with its scale below; lines are interrupted after 2 s without a range."""
    if len(time_ns) < 2:
        return ""
    known = [value for values in series.values() for value in values if math.isfinite(value)]
    low, high, first, last = min(known), max(known), time_ns[0], time_ns[-1]
    across, up = (
        (PICTURE_WIDTH - 2 * PICTURE_MARGIN) / max(last - first, 1),
        (PICTURE_HEIGHT - 2 * PICTURE_MARGIN) / max(high - low, 1e-3),
    )
    lines = ""
    # Two seconds: the time over which rates are counted.
    pieces = np.split(np.arange(len(time_ns)), np.flatnonzero(np.diff(time_ns) > 2_000_000_000) + 1)
    for kind, values in series.items():
        for piece in pieces:
            points = " ".join(
                f"{PICTURE_MARGIN + across * (time_ns[k] - first):.1f},"
                f"{PICTURE_HEIGHT - PICTURE_MARGIN - up * (values[k] - low):.1f}"
                for k in piece.tolist()
                if math.isfinite(values[k])
            )
            lines += f'<polyline class="{kind}" points="{points}"/>'
    label = f"range from {low:.3f} to {high:.3f} m"
    return (
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {PICTURE_WIDTH} {PICTURE_HEIGHT}" '
        f'preserveAspectRatio="none"><title>{label}</title>{lines}</svg>'
        f"<small>{low:.2f} to {high:.2f} m, {(last - first) * 1e-9:.0f} s</small>"
    )
