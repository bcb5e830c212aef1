"""Faults in flights that share nothing with the simulator: the right one is named, with its size, place and time."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks import doctor as planted
from benchmarks.flights import LIGHT, Plan, fly
from tests import processes
from uwblink.recording.file import Recording

SHORT = Plan(seconds=60, per_second=80)
ONE_EACH = replace(SHORT, tags_a_body=1, bodies=5)
ANCHORS = replace(SHORT, tags_a_body=1, anchors=4)
RNG = np.random.default_rng(0)


def faults(flight):
    return [finding.fault for finding in calib.examine(flight)]


def evidence(flight, fault):
    (found,) = [finding.evidence for finding in calib.examine(flight) if finding.fault == fault]
    return found


def numbers(text):
    return [float(number) for number in re.findall(r"[-+]?\d+(?:\.\d+)?", text)]


@pytest.mark.parametrize("plan", [replace(SHORT, protocol="ds-alt"), replace(SHORT, protocol="ss-cfo"), ANCHORS])
def test_nothing_is_found_where_nothing_was_planted(plan):
    assert faults(fly(plan, 41)) == []


@pytest.mark.parametrize(
    ("plan", "read_as", "remedy"),
    [
        (SHORT, {"protocol": "ds-alt"}, 'protocol = "ds"'),
        (replace(SHORT, protocol="ds-alt"), {"protocol": "ds"}, 'protocol = "ds-alt"'),
        (SHORT, {"bits": 40}, "bits = 32"),
        (replace(SHORT, bits=40), {"protocol": "ds-alt"}, 'protocol = "ds"'),
    ],
)
def test_the_right_protocol_and_width_are_named(plan, read_as, remedy):
    (finding,) = calib.examine(planted.as_read(fly(replace(plan, seconds=20), 42), RNG, **read_as))
    assert remedy in finding.remedy
    assert finding.fault in ("another protocol", "timestamp width")


def test_corrupt_rows_hide_nothing():
    found = faults(planted.few_pairs(fly(SHORT, 43), np.random.default_rng(1)))
    # Two bodies alone also keep few distances apart, so that power may pass for one of them.
    assert found[:2] == ["corrupted exchanges", "too few pairs"]
    assert set(found[2:]) <= {"power confounded with distance"}


def test_a_step_is_named_with_tag_size_and_time():
    flight = fly(SHORT, 44)
    late = planted.of_tag(flight, 21) & (planted.seconds(flight) > 37)
    stepped = planted.longer(flight, np.where(late, -0.09, 0.0))
    tag, size_cm, time_s, size_ns, *_ = numbers(evidence(stepped, "delay changed mid-flight"))
    assert tag == 21
    assert size_cm == pytest.approx(-9, abs=1.5)
    assert time_s == pytest.approx(37, abs=1.5)
    assert size_ns == pytest.approx(0.09 / LIGHT * 2e9, abs=0.1)


def test_what_only_one_pair_does_is_no_step_of_a_delay():
    flight = fly(SHORT, 45)
    pair = planted.of_tag(flight, 21) & planted.of_tag(flight, 10)
    late = planted.seconds(flight) > 30
    assert "delay changed mid-flight" not in faults(planted.longer(flight, np.where(pair & late, 0.3, 0.0)))


def test_what_comes_back_is_no_step_of_a_delay():
    flight = fly(SHORT, 45)
    some = (planted.seconds(flight) > 25) & (planted.seconds(flight) < 35)
    shadowed = planted.longer(flight, np.where(planted.of_tag(flight, 21) & some, 0.2, 0.0))
    assert "delay changed mid-flight" not in faults(shadowed)


def test_a_drift_is_none():
    flight = fly(SHORT, 46)
    drift = 0.15 * planted.seconds(flight) / 60
    assert "tag 30 drift" in evidence(
        planted.longer(flight, np.where(planted.of_tag(flight, 30), drift, 0.0)), "delay drifts"
    )


def test_a_pair_that_does_not_close_is_named_with_its_size():
    flight = fly(ONE_EACH, 47)
    pair = planted.of_tag(flight, 20) & planted.of_tag(flight, 50)
    found = evidence(planted.longer(flight, np.where(pair, 0.2, 0.0)), "pairs that do not close")
    assert "pair 20-50 are" in found
    assert "too long" in found
    # The median of a pair's errors lies above their core, so that the clipped mean beside it does not weigh the same.
    assert numbers(found.split("are")[1])[0] == pytest.approx(20, abs=3)
    assert "closed loops" in found


def test_an_anchor_elsewhere_is_named_with_its_place():
    away = np.array([0.3, -0.2, 0.1])
    found = evidence(fly(ANCHORS, 48, 1, (2, away)), "anchor stands elsewhere")
    assert "anchor2" in found
    # Each axis with its interval, then "95 %".
    assert numbers(found.split("(")[1].split(")")[0])[:-1:2] == pytest.approx(away.tolist(), abs=0.08)


def test_what_changed_between_recordings_is_named():
    first = planted.named(fly(ANCHORS, 49, 1), "first")
    second = planted.named(fly(ANCHORS, 50, 1, (1, np.array([0.0, 0.4, 0.0]))), "second")
    assert faults([first, planted.named(fly(ANCHORS, 51, 1), "again")]) == []
    (finding,) = calib.examine([first, second])
    assert finding.fault == "anchor moved between recordings"
    assert "anchor1 stands 0.4" in finding.evidence
    boards = [planted.named(fly(ONE_EACH, 52 + k, 3), str(k)) for k in range(2)]
    other = planted.longer(boards[1], np.where(planted.of_tag(boards[1], 40), 0.12, 0.0))
    (finding,) = calib.examine([boards[0], other])
    assert finding.fault == "delay changed between recordings"
    assert numbers(finding.evidence)[1] == pytest.approx(12, abs=2)


def test_skew_is_told_from_its_wrong_sign():
    assert faults(fly(replace(SHORT, protocol="ss"), 54)) == ["skew in single-sided ranges"]
    blind = fly(replace(SHORT, protocol="ss", carriers=False), 54)
    assert faults(blind) == ["skew in single-sided ranges", "single-sided without carrier readings"]
    flight = fly(replace(SHORT, protocol="ss-cfo"), 54)
    e = flight.exchanges
    wrong = planted.changed(flight, skew1_ppm=-e.skew1_ppm, skew2_ppm=-e.skew2_ppm, range_m=e.range_m * np.nan)
    assert faults(wrong) == ["carrier readings with the wrong sign"]


def test_reflections_that_last_are_named_with_their_life():
    plan = replace(SHORT, tags_a_body=1, seconds=150, share=0.2, lasts_s=4.0)
    found = evidence(fly(plan, 55), "reflections that last")
    lives = [float(life) for life in re.findall(r"for ([\d.]+) s at a time", found)]
    # A few dozen spells a pair, of which the short detours are not seen.
    assert 1.5 < np.median(lives) < 9


def test_a_third_of_reflected_ranges_is_told():
    assert faults(fly(replace(SHORT, share=0.35), 56)) == ["reflections"]


def test_the_command_prints_clocks_and_takes_several(tmp_path):
    for k in range(2):
        flight = fly(replace(ONE_EACH, seconds=20), 57 + k, 5)
        with Recording.create(tmp_path / f"{k}.uwb") as recording:
            recording.append_tags(flight.tags)
            recording.append_poses(flight.poses)
            recording.append_exchanges(flight.exchanges)
    words = ["calib", "doctor", tmp_path / "0.uwb", tmp_path / "1.uwb"]
    shown = processes.run(*words).stdout
    assert "nothing found" in shown
    assert shown.count("pair 10-20: ") == 2
    assert "same sign" in shown
    found = json.loads(processes.run(*words, "--json").stdout)
    assert found["findings"] == []
    (pairs, _) = found["clock_skews"].values()
    assert len(pairs) == 10
    assert all(abs(one["stamps_ppm"] - one["carrier_ppm"]) < 0.1 for one in pairs)
