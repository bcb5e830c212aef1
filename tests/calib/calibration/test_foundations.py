"""What is said of a calibration that was fitted without known distances."""

from calib.calibration import rests_on

KNOWN = {"known_s": 9.9, "moving": ["a", "b", "c"], "anchors_given": ["m"], "anchors_sought": [], "attitudes": "imu"}


def test_what_it_rests_on_is_one_phrase():
    told = rests_on({"truth": "ranges", "rests_on": KNOWN, "distance_std_m": 0.0123})
    assert told == (
        "ranges alone, of 3 moving bodies, positions known for 9.9 s, 1 anchor at places that were given, "
        "attitudes from imu, distances found to 1.2 cm (standard error)"
    )


def test_nothing_is_said_where_distances_were_known_or_the_file_is_odd():
    assert rests_on({}) == ""
    assert rests_on({"truth": "ranges", "rests_on": "a lake"}) == ""
    assert rests_on({"truth": "recorded", "rests_on": KNOWN}) == ""
