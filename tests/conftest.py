"""The order of files: the longest first, so that two cores end at the same time. And what hypothesis may take."""

from typing import Final

from hypothesis import settings

settings.register_profile("no clock", deadline=None)  # on a busy machine an example takes long
settings.load_profile("no clock")

LONGEST: Final = (
    "tests/calib/report/test_report.py",
    "tests/test_pages.py",
    "tests/uwbsim/sweep/test_machine_faults.py",
    "tests/uwbsim/sweep/test_sweep.py",
    "tests/calib/checks/test_examine.py",
    "tests/calib/checks/test_surveys.py",
    "tests/calib/surveys/test_surveying.py",
    "tests/calib/trajectories/test_known.py",
    "tests/calib/report/test_files.py",
    "tests/test_bad_input.py",
    "tests/uwblink/exporters/test_exporters.py",
    "tests/uwbsim/twins/test_twin.py",
    "tests/uwbsim/protocols/test_monte_carlo.py",
    "tests/uwbsim/pages/test_pages.py",
    "tests/test_readme.py",
    "tests/test_full_disk.py",
    "tests/uwblink/boards/test_recorder.py",
    "tests/calib/evaluation/test_localization.py",
    "tests/calib/estimation/test_doubts.py",
    "tests/calib/test_front_door.py",
    "tests/uwblink/test_interrupts.py",
    "tests/calib/trajectories/test_fitting.py",
    "tests/test_security.py",
    "tests/loop/test_without_motion_capture.py",
    "tests/test_plugins.py",
    "tests/loop/test_scenarios_of_the_world.py",
    "tests/calib/evaluation/test_onboard.py",
)


def pytest_collection_modifyitems(items):
    """Put the files that take longest before all others."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
