"""What the live page shows, as HTML: counts, a row a pair with the last minute of its ranges, faults, the disk."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Final, NamedTuple

from uwblink.boards.listeners import Pair
from uwblink.boards.progress import PairState, Progress
from uwblink.pages.stylesheet import CSS
from uwblink.recording.schema import Fault

SHOWN_S: Final = 60.0
WIDTH, HEIGHT, MARGIN = 260, 44, 3
SILENT_HZ: Final = 1e-9
STYLE: Final = CSS + (files("uwblink.boards") / "live.css").read_text(encoding="utf-8")
SCRIPT: Final = """
setInterval(async()=>{const m=document.querySelector('main');try{const r=await fetch('/body');
if(r.ok){m.innerHTML=await r.text();document.title=m.querySelector('h1').textContent;}
}catch(e){document.title='recording ended';
m.querySelector('p').textContent='This recording has ended; below is the last that came.';
}},1000);
"""


class Point(NamedTuple):
    """A range of a pair: host time (ns), range and corrected range (m), the latter NaN without a calibration."""

    time_ns: int
    range_m: float
    corrected_m: float


def whole(body: str) -> str:
    """Return the page around what changes, which is HTML and begins with a heading."""
    title = body.removeprefix("<h1>").partition("</h1>")[0]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style>'
        '<noscript><meta http-equiv="refresh" content="2"></noscript></head>'
        f"<body><main>{body}</main><script>{SCRIPT}</script></body></html>"
    )


def counts(progress: Progress) -> str:
    """Return what was heard so far, as a sentence."""
    found = f"{progress.time_s:.0f} s, {progress.exchanges} of {progress.tried} exchanges"
    others = ((progress.overheard, "overheard"), (progress.cirs, "impulse responses"))
    return f"<p>{', '.join([found, *(f'{count} {name}' for count, name in others if count)])}</p>"


def table(progress: Progress, series: Mapping[Pair, Sequence[Point]], *, corrected: bool) -> str:
    """Return a row a pair; one that has not ranged for two seconds stands out."""
    names = ["pair", "rate (Hz)", "success", "range (m)", *(["corrected (m)"] if corrected else []), "FPP (dBm)"]
    head = "".join(f"<th>{name}</th>" for name in names)
    drawn = "<b class='range'>range</b>" + (", <b class='corrected'>corrected</b>" if corrected else "")
    rows = (
        _row(pair, state, series.get(pair, ()), progress.time_s, corrected=corrected)
        for pair, state in list(progress.pairs.items())
    )
    return (
        f"<div class='wide live'><table><thead><tr>{head}<th>last minute: {drawn}</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _row(pair: Pair, state: PairState, points: Sequence[Point], time_s: float, *, corrected: bool) -> str:
    rate_hz = state.rate_hz(time_s)
    cells = [
        f"{pair[0]}&nbsp;&rarr;&nbsp;{pair[1]}",
        f"{rate_hz:.1f}",
        f"{100 * state.good / state.tried:.0f} %" if state.tried else "",
        _metres(state.range_m),
        *([_metres(points[-1].corrected_m if points else math.nan)] if corrected else []),
        f"{state.fpp_dbm:.1f}" if state.good else "",
        picture(points),
    ]
    silent = " class='silent'" if state.tried and rate_hz < SILENT_HZ else ""
    return f"<tr{silent}>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else ""


def picture(points: Sequence[Point]) -> str:
    """Draw range and corrected range over the last minute as SVG; the scale is that of the ranges shown."""
    if len(points) < 2:
        return ""
    shown = [p for p in points if points[-1].time_ns - p.time_ns <= SHOWN_S * 1e9]
    values = [v for p in shown for v in (p.range_m, p.corrected_m) if math.isfinite(v)]
    low, high = min(values), max(values)
    label = f"range from {low:.3f} to {high:.3f} m"
    lines = (_line(kind, _places(shown, kind, low, high)) for kind in ("range", "corrected"))
    return (
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none">'
        f"<title>{label}</title>{''.join(lines)}</svg>"
    )


def _places(shown: Sequence[Point], kind: str, low: float, high: float) -> list[str]:
    """Return where the ranges of one kind lie in a picture."""
    began, spread_m = shown[0].time_ns, max(high - low, 1e-3)
    lasted_ns = max(shown[-1].time_ns - began, 1)
    found = ((p.time_ns, p.range_m if kind == "range" else p.corrected_m) for p in shown)
    return [
        f"{MARGIN + (WIDTH - 2 * MARGIN) * (time_ns - began) / lasted_ns:.1f},"
        f"{HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * (value - low) / spread_m:.1f}"
        for time_ns, value in found
        if math.isfinite(value)
    ]


def _line(kind: str, places: Sequence[str]) -> str:
    return f'<polyline class="{kind}" points="{" ".join(places)}"/>' if places else ""


def faults_list(progress: Progress, last: Iterable[Fault]) -> str:
    """Return the count of each kind of fault, and the last ones, the newest first."""
    kinds = ", ".join(f"{escape(kind)} {n}" for kind, n in sorted(dict(progress.faults).items())) or "none"
    items = "".join(f"<li>board {escape(f.board)}: {escape(f.kind)}: {escape(f.detail)}</li>" for f in last)
    return f"<p>faults: {kinds}</p>" + (f"<ul>{items}</ul>" if items else "")


def disk(progress: Progress, size: int, free: int) -> str:
    """Return how large the file is and how much room is left, both in bytes, and what waits to be written."""
    behind = ' class="bad"' if progress.behind_s > 1 else ""
    return (
        f"<p{behind}>file {size / 2**20:.1f} MB, disk {free / 2**30:.1f} GB free; "
        f"queue: {progress.waiting} pieces, last commit {progress.behind_s:.1f} s ago</p>"
    )
