"""Ranges from files, open recordings, objects in memory and arrays: all the same, and mistakes are named."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import duckdb
import numpy as np
import pytest

import calib
from calib.data.ranges import Ranges
from calib.data.samples import DELAYS_NS, sample_flight
from calib.data.sources import load_flight, load_ranges
from calib.errors import BadInputError, UnanswerableError
from uwblink import Contents
from uwblink.errors import RecordingError
from uwblink.recording.file import Recording


def written(place, flight, planted):
    Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags, meta={"planted": planted}).save(place)
    return place


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    flight = sample_flight()
    return written(tmp_path_factory.mktemp("source") / "sample.uwb", flight, flight.planted)


def assert_same(one, other):
    for name, column in one.to_dict().items():
        np.testing.assert_array_equal(column, getattr(other, name), err_msg=name)


def test_a_file_an_open_recording_and_an_object_are_the_same(path):
    from_file = load_ranges(path)
    assert from_file.source == "sample.uwb"
    assert from_file.planted == {"delays_ns": {str(tag): delay for tag, delay in DELAYS_NS.items()}}
    assert_same(load_ranges(str(path)), from_file)
    with Recording.open(path) as recording:
        assert_same(load_ranges(recording), from_file)
    in_memory = load_ranges(sample_flight())
    assert in_memory.source == "memory"
    assert_same(in_memory, from_file)
    assert load_ranges(from_file) is from_file
    both = load_ranges([path, sample_flight(300, seed=2)])
    assert len(both) == 1200
    assert both.source == "sample.uwb, memory"
    assert_same(both[:900], from_file)


def test_every_function_takes_what_a_fit_takes(path):
    in_memory, from_file = sample_flight(), calib.fit([path])
    result = calib.fit(in_memory)
    known = result.calibration
    named = {"recordings": [path.name]}
    assert replace(known, provenance=known.provenance | named).to_json() == from_file.calibration.to_json()
    judged = {name: calib.evaluate(data, known).to_dict() for name, data in (("memory", in_memory), (path.name, path))}
    assert [(name, found.pop("seen_by_fit")) for name, found in judged.items()] == [(name, [name]) for name in judged]
    assert judged["memory"] == judged[path.name]
    assert calib.examine(in_memory) == calib.examine(path)
    ours, theirs = calib.localize(in_memory, known), calib.localize(path, known)
    assert [one.tracks["raw"].rmse_m for one in ours] == [one.tracks["raw"].rmse_m for one in theirs]
    # Delays differ from the planted ones by a common shift, which is a constant of the curve.
    away = np.array([known.delays_ns[tag] - DELAYS_NS[tag] for tag in DELAYS_NS])
    np.testing.assert_allclose(away - away.mean(), 0, atol=0.02)


def test_a_strangers_object_will_do():
    """Somebody else's object, with nothing but the attributes that a source needs."""
    flight = sample_flight()
    bare = SimpleNamespace(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags)
    assert load_ranges(bare).planted is None
    assert_same(load_ranges(bare), load_ranges(flight))
    assert calib.examine(bare) == []
    planted = {"delays_ns": {"1": 0.1}}
    for said in ({"planted": planted}, {"meta": {"planted": planted}}):
        assert load_ranges(SimpleNamespace(**vars(bare), **said)).planted == planted


def test_exchanges_with_their_distances_need_no_poses():
    flight = sample_flight()
    truth = load_ranges(flight).truth_m
    carried = replace(flight.exchanges, truth_m=truth)
    assert_same(load_ranges(carried), load_ranges(flight))
    assert_same(Ranges.from_exchanges(flight.exchanges, truth), load_ranges(flight))
    with pytest.raises(BadInputError, match=r"`truth_m`: has shape \(3,\)"):
        Ranges.from_exchanges(flight.exchanges, np.zeros(3))
    with pytest.raises(UnanswerableError, match=r"it needs poses and lever arms \(`uwblink poses`\), or measured"):
        load_ranges(flight.exchanges)


@pytest.mark.parametrize("data", [None, 3, [], [None], {"a": 1}])
def test_what_is_no_recording_is_refused(data):
    with pytest.raises((BadInputError, FileNotFoundError)):
        load_ranges(data)


def test_ranges_are_not_enough_to_localize_or_examine():
    flight = load_ranges(sample_flight())
    known = calib.fit(flight).calibration
    for call in (lambda: calib.examine(flight), lambda: calib.localize(flight, known)):
        with pytest.raises(BadInputError) as raised:
            call()
        assert raised.value.parameter == "data"


def test_arrays_become_ranges():
    r = Ranges.from_arrays([3, 4], initiator=1, target=[2, 3], fpp1_dbm=[-85.0, 0.0], truth_m=[2.9, 3.9])
    assert r.tags() == [1, 2, 3]
    assert repr(r) == "<Ranges of memory: 2 of tags 1, 2, 3>"
    np.testing.assert_array_equal(r.fpp1_dbm, [-85.0, math.nan])
    assert repr(r.usable()) == "<Ranges of memory: 1 of tags 1, 2, 1 left out: no power>"
    assert load_ranges(r.usable()).excluded == {"no power": 1}


@pytest.mark.parametrize(
    ("parameter", "wrong"),
    [
        (None, {"range_m": [1.0, 2.0, 3.0]}),
        ("range_m", {"range_m": [[1.0, 2.0]]}),
        (None, {"initiator": [1.5, 2.5]}),
        (None, {"target": ["a", "b"]}),
        (None, {"fpp1_dbm": ["loud", "low"]}),
        ("protocol", {"protocol": "zz"}),
        ("target", {"target": [2, 1]}),
        ("weights", {"weights": (0.5,)}),
    ],
)
def test_arrays_that_do_not_fit_are_refused(parameter, wrong):
    columns: dict[str, Any] = {"range_m": [1.0, 2.0], "initiator": 1, "target": [2, 3], "fpp1_dbm": -85.0} | wrong
    with pytest.raises(BadInputError) as caught:
        Ranges.from_arrays(columns.pop("range_m"), **columns)
    assert caught.value.parameter == parameter


def test_a_flight_has_its_poses(path):
    found = load_flight(path)
    assert found.moving_bodies() == ["robot1", "robot2", "robot3"]
    assert found.tags == load_flight(sample_flight()).tags


def test_poses_without_tags_are_said_to_lack_them():
    flight = sample_flight()
    bare = replace(flight, tags=[], exchanges=replace(flight.exchanges, truth_m=flight.exchanges.truth_m * np.nan))
    with pytest.raises(UnanswerableError, match=r"does not say which tag sits on which body; .*--tags"):
        calib.fit(bare)


SPLINE = {"knots": [0, 0, 1, 1], "degree": 1, "coefficients": [0.0, 0.1]}


def test_planted_values_have_their_form(tmp_path):
    flight = sample_flight(10)
    assert load_ranges(replace(flight, planted={"bias_curve": SPLINE, "sigma_curve": None})).planted
    wrong: list[dict[str, Any]] = [
        {"delays_ns": "abc"},
        {"delays_ns": []},
        {"delays_ns": {"x": 1.0}},
        {"delays_ns": {"1": "x"}},
        {"delays_ns": {"1": 1e300}},
        {"bias_curve": "abc"},
        {"bias_curve": {"knots": [1, 2]}},
        {"bias_curve": SPLINE | {"degree": 7}},
        {"bias_curve": SPLINE | {"degree": "1"}},
        {"bias_curve": SPLINE | {"coefficients": [0.0, None]}},
        {"bias_curve": SPLINE | {"coefficients": [0.0, 1e308]}},
        {"bias_curve": SPLINE | {"knots": [0, 1, 1, 0]}},
        {"bias_curve": SPLINE | {"knots": [1, 1, 1, 1]}},
        {"sigma_curve": SPLINE | {"knots": [0, 0, 1]}},
    ]
    for planted in wrong:
        with pytest.raises(BadInputError, match=rf"^memory: planted: {next(iter(planted))}: "):
            load_ranges(replace(flight, planted=planted))
    with pytest.raises(BadInputError, match=r"^f\.uwb: planted: delays_ns: "):
        load_ranges(written(tmp_path / "f.uwb", flight, wrong[0]))


def test_poses_without_time_or_body_are_refused(tmp_path):
    flight = sample_flight(10)
    for column in ("time_ns", "body"):
        place = written(tmp_path / f"{column}.uwb", flight, {})
        with duckdb.connect(str(place)) as db:
            db.execute(f"UPDATE poses SET {column} = NULL WHERE body = ?", [flight.tags[0].body])
        with pytest.raises(RecordingError, match="table poses"):
            load_ranges(place)
