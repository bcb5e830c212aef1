"""The order of files: the longest first, so that two cores end at the same time."""

from typing import Final

LONGEST: Final = (
    "tests/test_pages.py",
    "tests/uwbsim/sweep/test_sweep.py",
    "tests/test_readme.py",
    "tests/calib/report/test_report.py",
    "tests/calib/report/test_files.py",
    "tests/test_bad_input.py",
    "tests/test_full_disk.py",
    "tests/test_security.py",
    "tests/calib/checks/test_examine.py",
    "tests/uwblink/boards/test_recorder.py",
    "tests/loop/test_accuracy.py",
    "tests/loop/test_wire.py",
    "tests/calib/surveys/test_surveying.py",
    "tests/calib/estimation/test_doubts.py",
    "tests/calib/trajectories/test_real_flight.py",
    "tests/uwblink/importers/test_table_forms.py",
    "tests/uwblink/streaming/test_stream.py",
    "tests/calib/planning/test_flights.py",
    "tests/contract/test_firmware.py",
    "tests/contract/test_habits.py",
    "tests/calib/estimation/test_fitting.py",
    "tests/uwbsim/twins/test_real_flight.py",
    "tests/uwbsim/sweep/test_machine_faults.py",
    "tests/calib/trajectories/test_fitting.py",
)


def pytest_collection_modifyitems(items):
    """Put the files that take longest before all others."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
