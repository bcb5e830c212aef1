"""Sensitivity of results to constants: each is halved and doubled in a copy of the packages, which fits again.

`python -m benchmarks.constants [NAME ...]` fits some of the golden cases (`benchmarks.golden`). It prints, by constant
and factor, the largest change of a delay in standard errors, and the smallest and largest ratio of standard errors.
Comments beside constants cite it. Integers remain integers; in a tuple or a table, all numbers are changed.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from benchmarks.golden import compared

ROOT: Final = Path(__file__).parents[1]
FACTORS: Final = (0.5, 2.0)
CASES: Final = {
    "estimator": ("world share by pair", "world persistent 5 s, 4 cm over 10 s, 90 s", "scenario room/room"),
    "surveys": ("survey line, 5 % reflected", "survey plane, bias over power"),
    "trajectories": ("from ranges, known for 8 of 24 s", "from ranges, four anchors given"),
}
STUDIED: Final = {
    ("estimator", "covariance.py"): ("CURVE_SERIES",),
    ("estimator", "grouped_errors.py"): ("NOISE_WORTH", "DETOUR_WORTH", "LEAST_DETOUR_M", "SCATTER"),
    ("estimator", "inverse.py"): ("PROBES",),
    ("estimator", "known_distances.py"): ("PILOT", "FIRST_SAMPLE", "SAMPLE_GROWTH"),
    ("estimator", "optimize.py"): ("EVIDENCE_STEPS", "LONGER"),
    ("estimator", "range_model.py"): ("CURVE_M", "TYPICAL_OFFSET_M"),
    ("surveys", "network.py"): ("DETOUR_MEAN_M", "DETOUR_STD_M"),
    ("surveys", "recordings.py"): ("PARTS",),
    ("surveys", "reflections.py"): ("PRIOR_REFLECTED", "PRIOR_DIRECT", "SHORTER_SHARE", "MAX_FIRST_CHANGES"),
    ("surveys", "solution.py"): ("PAIR_STD_M", "PAIR_PRIOR_FREEDOM", "CURVE_STD_M", "MAX_WORSE_ALONE", "RANDOM_STARTS"),
    ("trajectories", "motion.py"): ("TURN_S", "FAR_M", "CALM_M_S2", "SLOW_M_S"),
    ("trajectories", "scene.py"): ("POSE_STD_M", "TILT_STD_DEG"),
    ("trajectories", "search.py"): ("JERK_M_S3", "FIRST_SCALE_M", "LITTLE_LEVERAGE", "MIN_RANGES_PER_PAIR"),
    ("trajectories", "start.py"): ("RANGES_A_BODY", "WINDOW_JERK_M_S3", "START_COUNT", "SAMPLED_RANGES"),
}


def times(value: Any, factor: float) -> Any:
    """Return a number, or all numbers of a tuple or table, times a factor."""
    if isinstance(value, dict):
        return {key: times(one, factor) for key, one in value.items()}
    if isinstance(value, tuple):
        return tuple(times(one, factor) for one in value)
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


def changed(source: str, name: str, factor: float) -> str:
    """Return the source of a module with a constant times a factor."""
    lines = source.splitlines(keepends=True)
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            inside = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            pairs = zip(target.elts, value.elts, strict=True) if inside else [(target, value)]  # type: ignore[attr-defined]
            for one, old in pairs:
                if isinstance(one, ast.Name) and one.id == name:
                    head = "".join(lines[: old.lineno - 1]) + lines[old.lineno - 1][: old.col_offset]
                    tail = lines[(old.end_lineno or 0) - 1][old.end_col_offset :] + "".join(lines[old.end_lineno :])
                    return f"{head}{times(ast.literal_eval(old), factor)!r}{tail}"
    raise SystemExit(f"no constant {name}")


def outcomes(room: str, module: str = "", name: str = "", factor: float = 1.0) -> dict[str, Any]:
    """Return the outcomes of the golden cases of a package, by name, with a constant of one of its modules times a
    factor.
    """
    with tempfile.TemporaryDirectory() as folder:
        for part in ("calib", "uwbsim", "uwblink", "benchmarks", "tests", "scenarios"):
            shutil.copytree(ROOT / part, Path(folder, part), ignore=shutil.ignore_patterns("__pycache__", "golden"))
        if name:
            file = Path(folder, "calib", room, module)
            file.write_text(changed(file.read_text(encoding="utf-8"), name, factor), encoding="utf-8")
        code = "import json; from benchmarks.golden import outcome; print(json.dumps([outcome(n) for n in {!r}]))"
        given = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        ran = subprocess.run(
            [sys.executable, "-c", code.format(CASES[room])],
            cwd=folder,
            env=given,
            capture_output=True,
            text=True,
            check=True,
        )
    return dict(zip(CASES[room], json.loads(ran.stdout), strict=True))


def main(wanted: list[str]) -> None:
    """Print a line per constant, factor and case."""
    tried = [
        (room, module, name, factor)
        for (room, module), names in STUDIED.items()
        for name in names
        for factor in FACTORS
        if not wanted or name in wanted
    ]
    with ThreadPoolExecutor(2) as pool:
        rooms = sorted({room for room, *_ in tried})
        before = dict(zip(rooms, pool.map(outcomes, rooms), strict=True))
        for (room, _, name, factor), found in zip(tried, pool.map(lambda one: outcomes(*one), tried), strict=True):
            for case, new in found.items():
                print(f"{name} x {factor:g}, {case}: {compared(before[room][case], new)}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
