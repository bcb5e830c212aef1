"""Whoever judges a calibration on what it was fitted to is told so."""

import calib
from tests import processes
from uwblink import Contents


def saved(path, flight):
    Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(path)


def test_the_recording_is_known_by_what_it_holds_and_not_by_its_name(tmp_path):
    train, test = calib.sample_flight(), calib.sample_flight(seed=2)
    for folder, flight in (("a", train), ("b", test), ("c", train)):
        (tmp_path / folder).mkdir()
        saved(tmp_path / folder / "flight.uwb", flight)
    found = calib.fit(tmp_path / "a" / "flight.uwb")
    assert calib.evaluate(tmp_path / "c" / "flight.uwb", found.calibration).seen == ("flight.uwb",)
    assert calib.evaluate(tmp_path / "b" / "flight.uwb", found.calibration).seen == ()
    assert calib.evaluate([train, test], found.calibration).seen == ("memory",)

    found.save(tmp_path / "c.json")
    for folder, warned in (("c", "warning: the calibration was fitted to flight.uwb: "), ("b", "")):
        done = processes.run("calib", "evaluate", tmp_path / folder / "flight.uwb", "-c", tmp_path / "c.json")
        assert (done.returncode, done.stderr[: len(warned) or None]) == (0, warned)
