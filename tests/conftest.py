"""The order of files: the longest first, so that two cores end at the same time. And what hypothesis may take."""

from typing import Final

from hypothesis import settings

settings.register_profile("no clock", deadline=None)  # on a busy machine an example takes long
settings.load_profile("no clock")

LONGEST: Final = (
    "tests/calib/report/test_report.py",
    "tests/calib/test_bare_differences.py",
    "tests/uwblink/importers/test_bag_guess.py",
    "tests/uwblink/importers/test_guess.py",
    "tests/calib/cli/test_flags.py",
    "tests/loop/test_programmed_delays.py",
    "tests/calib/surveys/test_surveying.py",
    "tests/uwblink/importers/test_table_forms.py",
    "tests/uwblink/importers/test_forms.py",
    "tests/test_bad_input.py",
    "tests/calib/evaluation/test_team.py",
    "tests/uwblink/streaming/test_stream.py",
    "tests/calib/evaluation/test_online.py",
    "tests/calib/estimation/test_directions.py",
    "tests/calib/evaluation/test_differences_of_arrival.py",
    "tests/uwblink/importers/test_broadcasts.py",
    "tests/calib/report/test_numbers.py",
    "tests/uwblink/importers/test_hard_tables.py",
    "tests/calib/report/test_files.py",
    "tests/test_security.py",
    "tests/calib/evaluation/test_onboard.py",
    "tests/uwblink/exporters/test_exporters.py",
    "tests/calib/calibration/test_model.py",
    "tests/uwbsim/twins/test_twin.py",
    "tests/uwblink/boards/test_dialects.py",
    "tests/calib/evaluation/test_localization.py",
    "tests/loop/test_scenarios_of_the_world.py",
    "tests/calib/planning/test_flights.py",
    "tests/calib/estimation/test_temperatures.py",
    "tests/uwblink/boards/test_recorder.py",
    "tests/uwbsim/pages/test_pages.py",
    "tests/calib/estimation/test_fitting.py",
    "tests/test_help.py",
    "tests/uwblink/recording/test_contents.py",
    "tests/test_scenarios.py",
    "tests/uwblink/boards/test_live_page.py",
    "tests/uwblink/boards/test_machine_faults.py",
    "tests/calib/estimation/test_sessions.py",
    "tests/uwblink/recording/test_intake.py",
    "tests/test_doors.py",
    "tests/calib/estimation/test_error_model.py",
    "tests/test_large_ids.py",
    "tests/calib/data/test_sources.py",
    "tests/test_plugins.py",
    "tests/calib/estimation/test_solver.py",
)


def pytest_collection_modifyitems(items):
    """Put the files that take longest before all others."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
