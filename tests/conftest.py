"""The order of files: the longest first, so that two cores end at the same time. And what hypothesis may take."""

from typing import Final

from hypothesis import settings

settings.register_profile("no clock", deadline=None)  # on a busy machine an example takes long
settings.load_profile("no clock")

LONGEST: Final = (
    "tests/calib/evaluation/test_differences_of_arrival.py",
    "tests/calib/evaluation/test_team.py",
    "tests/calib/evaluation/test_online.py",
    "tests/calib/test_bare_differences.py",
    "tests/calib/report/test_report.py",
    "tests/test_pages.py",
    "tests/calib/estimator/test_receptions.py",
    "tests/calib/report/test_numbers.py",
    "tests/uwbsim/sweep/test_machine_faults.py",
    "tests/uwbsim/sweep/test_sweep.py",
    "tests/calib/planning/test_flights.py",
    "tests/uwblink/importers/test_bag_guess.py",
    "tests/loop/test_programmed_delays.py",
    "tests/uwblink/importers/test_broadcasts.py",
    "tests/uwblink/streaming/test_stream.py",
    "tests/calib/checks/test_examine.py",
    "tests/calib/checks/test_surveys.py",
    "tests/calib/surveys/test_surveying.py",
    "tests/calib/trajectories/test_known.py",
    "tests/calib/estimation/test_sessions.py",
    "tests/contract/test_firmware.py",
    "tests/calib/report/test_files.py",
    "tests/test_bad_input.py",
    "tests/test_large_ids.py",
    "tests/uwblink/boards/test_dialects.py",
    "tests/uwblink/importers/test_table_forms.py",
    "tests/uwblink/importers/test_forms.py",
    "tests/uwblink/importers/test_mutated_forms.py",
    "tests/test_new_protocol.py",
    "tests/calib/evaluation/test_onboard.py",
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
)


def pytest_collection_modifyitems(items):
    """Put the files that take longest before all others."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
