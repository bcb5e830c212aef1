"""Coverage-guided fuzzing with atheris of the decoder, of tables and of JSON (see docs/testing.md).

`python tests/fuzz/targets.py decoder|tables|json CORPUS` holds for arbitrary bytes: what is read is read again the
same, what is not is refused by an error of the package in one line, and nothing else is raised.
"""

import sys
import tempfile
import warnings
from pathlib import Path

import atheris
import numpy as np

with atheris.instrument_imports(include=["uwblink", "calib.calibration", "calib.data.sources"]):
    from calib.calibration.formats import read_miluv
    from calib.calibration.model import Calibration
    from calib.data.sources import check_planted
    from calib.errors import CalibError
    from uwblink.errors import UwblinkError
    from uwblink.importers import read_source
    from uwblink.importers.guess import guess_map
    from uwblink.importers.poses import read_poses
    from uwblink.recording.store import decode_json
    from uwblink.wire.codec import Decoder, encode
    from uwblink.wire.messages import REPORTS, Skipped, TextLine

PLACE = Path(tempfile.mkdtemp())
READERS = (
    ("t.csv", read_source),
    ("t.jsonl", read_source),
    ("g.csv", guess_map),
    ("p.csv", read_poses),
    ("p.tum", read_poses),
)


def as_bytes(event):
    if isinstance(event, Skipped):
        return event.data
    return event.text.encode() if isinstance(event, TextLine) else encode(event)


def decoder(size: int, stream: bytes) -> None:
    """Whole and in pieces agree, and every byte is in one event."""
    size = size % 40 + 1
    whole = Decoder(REPORTS)
    events = whole.feed(stream) + whole.finish()
    assert b"".join(map(as_bytes, events)) == stream
    pieces = Decoder(REPORTS)
    found = []
    for at in range(0, len(stream), size):
        found += pieces.feed(stream[at : at + size])
    found += pieces.finish()
    understood = [e for e in events if not isinstance(e, Skipped)]
    assert [e for e in found if not isinstance(e, Skipped)] == understood


def tables(kind: int, data: bytes) -> None:
    """CSV, JSON lines, TUM or EuRoC, without a warning of NumPy."""
    name, read = READERS[kind % len(READERS)]
    path = PLACE / name
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = read(path, *(("body",) if read is read_poses else ()))
    if read is read_poses:
        assert np.isfinite(found.position_m).all()
        assert np.allclose(np.linalg.norm(found.quaternion, axis=1), 1)


def json(kind: int, data: bytes) -> None:
    """Calibrations, ours and published ones, and values of `meta`."""
    text = data.decode("utf-8", "replace")
    if kind % 3 == 0:
        found = Calibration.from_json(text)
        assert Calibration.from_json(found.to_json()) == found
    elif kind % 3 == 1:
        (PLACE / "m.json").write_bytes(data)
        read_miluv(PLACE / "m.json").to_json()
    elif isinstance(planted := decode_json(text, PLACE, "planted"), dict):
        check_planted(planted, "here")


TARGETS = {"decoder": decoder, "tables": tables, "json": json}


def main() -> None:
    target = TARGETS[sys.argv.pop(1)]

    def check(data: bytes) -> None:
        try:
            target(*((data[0], data[1:]) if data else (0, b"")))
        except (UwblinkError, CalibError) as error:
            if len(str(error).splitlines()) > 1:
                raise

    atheris.Setup(sys.argv, check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
