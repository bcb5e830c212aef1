"""Localizations as text, as JSON, and as trajectories in TUM files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibration.document import for_json
from calib.evaluation.localization import PAPER_RMSE_M, Localization, rmse_rows, summarize
from calib.evaluation.onboard import OnboardSettings, OnboardTrack
from calib.evaluation.tracking import Settings
from uwblink.arrays import Floats, Ints
from uwblink.display import printable
from uwblink.output import write_files


def localization_text(found: list[Localization], settings: Settings) -> str:
    """Return the table that `calib localize` prints, a row per body, with the settings below."""
    summary, fixed = summarize(found), found[0].fixed
    numbers = rmse_rows(found, summary, f"its spread over {settings.seeds} seeds")
    rows = [["RMSE of the position (m)", *summary.rmse_m], *numbers]
    first = max(30, *(len(row[0]) + 1 for row in rows))
    table = [f"{printable(name):{first}s}" + "".join(f"{cell:>12s}" for cell in cells) for name, *cells in rows]
    paper = ", ".join(f"{value:.3f}" for value in PAPER_RMSE_M.values())
    what = "simulated flights" if all(one.simulated for one in found) else "other flights"
    lines = [
        *table,
        f"process noise: velocity with {settings.velocity_std_mps:g} m/s an axis at {settings.velocity_rate_hz:g} Hz "
        "(a choice, that of a small drone's optical flow; gains depend on it)",
        f"fixed standard deviations, {fixed.source}: raw {fixed.std_m['raw']:.3f} m, calibrated "
        f"{fixed.std_m['calibrated']:.3f} m",
        f"ICRA 2023 has {paper} m for real flights of its own and another filter's noise; these are {what}: metres do "
        "not compare",
        f"with the calibrated variance: NIS {summary.nis:.2f} (1 expected, 95 % bounds {summary.nis_bounds[0]:.2f} to "
        f"{summary.nis_bounds[1]:.2f}), NEES {summary.nees:.2f} (3 expected, {summary.nees_bounds[0]:.2f} to "
        f"{summary.nees_bounds[1]:.2f}), {100 * summary.accepted:.1f} % of the ranges pass the gate",
    ]
    if arrivals := sum(one.arrivals for one in found):
        every = sum(len(one.tracks["raw"].time_ns) for one in found)
        lines.append(f"by {every - arrivals} ranges and {arrivals} differences of arrival")
    return "\n".join(lines)


def localization_json(found: list[Localization]) -> dict[str, Any]:
    """Return what `calib localize --json` prints: RMSE by body, filter and seed in metres, and the summary."""
    rows = [
        {
            "recording": one.source,
            "body": one.body,
            "rmse_m": {name: float(rmse.mean()) for name, rmse in one.rmse_m.items()},
            "rmse_by_seed_m": {name: rmse.tolist() for name, rmse in one.rmse_m.items()},
            "fixed_std_m": one.fixed.std_m,
            "fixed_std_source": one.fixed.source,
            "simulated": one.simulated,
            "arrivals": one.arrivals,
        }
        for one in found
    ]
    return {"scenarios": rows, "summary": for_json(asdict(summarize(found)))}


def write_tum(found: Sequence[Localization | OnboardTrack], folder: Path, *, force: bool = False) -> None:
    """Write the trajectories of each body, the true one among them, into a folder, which is made if it is missing."""
    files: dict[str, bytes] = {}
    for name, one in zip(_names(f"{one.source}-{one.label}" for one in found), found, strict=True):
        texts = {kind: _tum(*columns).encode() for kind, columns in one.trajectories().items()}
        files |= {f"{name}{'-' if kind else ''}{kind}.tum": text for kind, text in texts.items()}
    write_files(folder, files, force=force)


def _names(texts: Iterable[str]) -> list[str]:
    """Return file names; equal names of recordings in different folders are numbered."""
    found: list[str] = []
    for text in texts:
        plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in text)
        numbered = (f"{plain}_{k}" for k in count(2))
        found.append(plain if plain not in found else next(name for name in numbered if name not in found))
    return found


def onboard_text(found: list[OnboardTrack], settings: OnboardSettings) -> str:
    """Return a line per body: its RMSE where truth is known."""
    lines = [f"{'by ranges to fixed anchors':33s}{'RMSE (m)':>10s}{'median':>9s}{'95 %':>9s}{'own std':>9s}  restarts"]
    for one in found:
        off = np.linalg.norm(one.estimate_m - one.truth_m, axis=1)
        off = off[np.isfinite(off)]
        figures = (one.rmse_m, *np.quantile(off, (0.5, 0.95))) if len(off) else (np.nan,) * 3
        cells = "".join(f"{'-':>9s}" if value != value else f"{value:9.3f}" for value in figures)
        own = float(np.sqrt(np.mean(one.std_m**2)))
        lines.append(f"{one.source + ' ' + one.body:33s} {cells}{own:9.3f}  {len(one.restarts_s)}")
    noise = settings.noise
    moves = (
        f"accelerometer {noise.force:g} m/s^2 and gyro {noise.gyro:g} rad/s a root of Hz"
        if settings.model == "imu"
        else f"velocity wanders by {noise.acceleration:g} m/s^2 a root of Hz"
    )
    return "\n".join([*lines, f"used: {found[0].used}; process noise: {moves}, speed about {settings.speed_m_s:g} m/s"])


def onboard_json(found: list[OnboardTrack]) -> list[dict[str, Any]]:
    """Return a table per body for JSON; unknown values are None."""
    return [
        {
            "recording": one.source,
            "body": one.body,
            "model": one.model,
            "used": one.used,
            "rmse_m": for_json(one.rmse_m),
            "std_m": float(np.sqrt(np.mean(one.std_m**2))),
            "nis": float(np.mean(one.nis)),
            "believed": float(np.mean(one.believed)),
            "restarts_s": list(one.restarts_s),
        }
        for one in found
    ]


def _tum(time_ns: Ints, place_m: Floats, attitude: Floats) -> str:
    rows = [
        f"{time * 1e-9:.9f} {x:.6f} {y:.6f} {z:.6f} {qx:.6f} {qy:.6f} {qz:.6f} {qw:.6f}"
        for time, (x, y, z), (qx, qy, qz, qw) in zip(time_ns.tolist(), place_m.tolist(), attitude.tolist(), strict=True)
    ]
    return "# time x y z qx qy qz qw\n" + "\n".join(rows) + "\n"
