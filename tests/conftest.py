"""The order of test files, the longest first, so that two cores end at the same time; and settings of hypothesis."""

from typing import Final

from hypothesis import settings

settings.register_profile("no clock", deadline=None)  # under load, an example takes long
settings.load_profile("no clock")

LONGEST: Final = (
    "tests/test_bad_input.py",
    "tests/calib/surveys/test_surveying.py",
    "tests/calib/test_bare_differences.py",
    "tests/calib/evaluation/test_team.py",
    "tests/uwblink/importers/test_table_forms.py",
    "tests/calib/evaluation/test_onboard.py",
    "tests/uwblink/boards/test_dialects.py",
    "tests/uwblink/importers/test_bag_guess.py",
    "tests/calib/evaluation/test_localization.py",
    "tests/uwblink/importers/test_forms.py",
    "tests/calib/fitting/test_directions.py",
    "tests/calib/report/test_report.py",
    "tests/uwbsim/pages/test_pages.py",
    "tests/uwblink/boards/test_recorder.py",
    "tests/uwbsim/twins/test_twin.py",
    "tests/uwblink/boards/test_machine_faults.py",
    "tests/uwblink/exporters/test_exporters.py",
    "tests/calib/fitting/test_temperatures.py",
    "tests/uwblink/importers/test_guess.py",
    "tests/uwblink/streaming/test_stream.py",
    "tests/calib/cli/test_flags.py",
    "tests/uwblink/importers/test_hard_tables.py",
    "tests/calib/calibration/test_model.py",
    "tests/test_security.py",
    "tests/calib/checks/test_checks.py",
    "tests/uwblink/boards/test_live_page.py",
    "tests/calib/data/test_sources.py",
    "tests/calib/fitting/test_fitting.py",
    "tests/calib/fitting/test_sessions.py",
    "tests/calib/report/test_files.py",
    "tests/calib/evaluation/test_differences_of_arrival.py",
    "tests/test_doors.py",
    "tests/calib/planning/test_flights.py",
    "tests/loop/test_programmed_delays.py",
    "tests/test_scenarios.py",
    "tests/test_help.py",
    "tests/uwbsim/sweep/test_sweep.py",
    "tests/calib/trajectories/test_fitting.py",
    "tests/test_plugins.py",
    "tests/calib/estimator/test_intervals.py",
    "tests/calib/evaluation/test_online.py",
    "tests/uwblink/pages/test_figures.py",
    "tests/uwblink/recording/test_file.py",
    "tests/loop/test_scenarios_of_the_world.py",
)


def pytest_collection_modifyitems(items):
    """Put the files that take longest before all others."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))
