"""Coverage-guided fuzzing of what reads calibrations and values of `meta`, with atheris (see docs/testing.md).

Holds for arbitrary bytes: what is read as a calibration is written and read again the same, what is not is refused by
an error of the package in one line, and nothing else is raised.
"""

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["calib.calibration", "calib.data.sources", "uwblink.recording.intake"]):
    from calib.calibration.formats import read_miluv
    from calib.calibration.model import Calibration
    from calib.data.sources import check_planted
    from calib.errors import CalibError
    from uwblink.errors import UwblinkError
    from uwblink.recording.intake import decode_json

PLACE = Path(tempfile.mkdtemp())


def calibration(data: bytes) -> None:
    found = Calibration.from_json(data.decode("utf-8", "replace"))
    assert Calibration.from_json(found.to_json()) == found


def miluv(data: bytes) -> None:
    (PLACE / "m.json").write_bytes(data)
    read_miluv(PLACE / "m.json").to_json()


def meta(data: bytes) -> None:
    found = decode_json(data.decode("utf-8", "replace"), PLACE, "planted")
    if isinstance(found, dict):
        check_planted(found, "here")


READERS = (calibration, miluv, meta)


def check(data: bytes) -> None:
    if not data:
        return
    try:
        READERS[data[0] % len(READERS)](data[1:])
    except (UwblinkError, CalibError) as error:
        if len(str(error).splitlines()) > 1:
            raise


if __name__ == "__main__":
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()
