"""The order of files: the longest first, so that two cores end at the same time."""

from typing import Final

LONGEST: Final = (
    "tests/test_readme.py",
    "tests/test_pages.py",
    "tests/loop/test_wire.py",
    "tests/calib/report/test_report.py",
    "tests/uwbsim/sweep/test_sweep.py",
    "tests/calib/report/test_files.py",
    "tests/loop/test_accuracy.py",
    "tests/uwblink/boards/test_recorder.py",
    "tests/contract/test_habits.py",
    "tests/test_full_disk.py",
    "tests/test_bad_input.py",
    "tests/loop/test_icra2023.py",
)


def pytest_collection_modifyitems(items):
    """Put the files that take longest before all others."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
