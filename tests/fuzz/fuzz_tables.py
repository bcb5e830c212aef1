"""Coverage-guided fuzzing of what reads tables and trajectories, with atheris (see docs/testing.md).

Holds for arbitrary bytes as CSV, JSON lines, TUM or EuRoC: what is read is read again the same, what is not is refused
by an error of the package in one line, and nothing else is raised.
"""

import sys
import tempfile
import warnings
from pathlib import Path

import atheris
import numpy as np

with atheris.instrument_imports(include=["uwblink.importers"]):
    from uwblink.errors import UwblinkError
    from uwblink.importers import read_source
    from uwblink.importers.guess import guess_map
    from uwblink.importers.poses import read_poses

PLACE = Path(tempfile.mkdtemp())
READERS = (
    ("t.csv", read_source),
    ("t.jsonl", read_source),
    ("g.csv", guess_map),
    ("p.csv", read_poses),
    ("p.tum", read_poses),
)


def check(data: bytes) -> None:
    if not data:
        return
    name, read = READERS[data[0] % len(READERS)]
    path = PLACE / name
    path.write_bytes(data[1:])
    more = ("body",) if read is read_poses else ()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            found = read(path, *more)
    except UwblinkError as error:
        if len(str(error).splitlines()) > 1:
            raise
        return
    if read is read_poses:
        assert np.isfinite(found.position_m).all()
        assert np.allclose(np.linalg.norm(found.quaternion, axis=1), 1)


if __name__ == "__main__":
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()
