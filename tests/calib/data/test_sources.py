"""Ranges from files, open recordings, objects in memory and arrays are equal, and errors name the fault."""

import math
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import calib
import uwblink
from calib.data.clocks import clocks_apart
from calib.data.samples import DELAYS_NS, sample_flight
from calib.data.sources import load_flight, load_ranges
from calib.evaluation import Settings
from uwblink.recording.contents import exchanges_with_poses
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S


def written(place, flight, planted):
    replace(flight, meta={"planted": planted}).save(place)
    return place


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    flight = sample_flight()
    return written(tmp_path_factory.mktemp("source") / "sample.uwb", flight, flight.meta["planted"])


def assert_same(one, other):
    for name, column in one.to_dict().items():
        np.testing.assert_array_equal(column, getattr(other, name), err_msg=name)


def test_a_file_an_open_recording_and_an_object_are_the_same(path):
    from_file, in_memory = load_ranges(path), load_ranges(sample_flight())
    assert (from_file.source, in_memory.source) == ("sample.uwb", "memory")
    assert from_file.planted == {"delays_ns": {str(tag): delay for tag, delay in DELAYS_NS.items()}}
    both = load_ranges([path, sample_flight(300, seed=2)])
    assert (len(both), both.source) == (1200, "sample.uwb, memory")
    with uwblink.Recording.open(path) as recording:
        for same in (load_ranges(str(path)), load_ranges(recording), in_memory, both[:900]):
            assert_same(same, from_file)
    assert load_ranges(from_file) is from_file
    assert load_flight(path).moving_bodies() == ["robot1", "robot2", "robot3"]


@pytest.mark.slow
def test_every_function_accepts_the_sources_of_a_fit(tmp_path):
    in_memory = sample_flight(300)
    path = written(tmp_path / "sample.uwb", in_memory, in_memory.meta["planted"])
    from_file, known = (calib.fit(data).calibration for data in ([path], in_memory))
    named = known.provenance | {"recordings": [path.name]}
    assert replace(known, provenance=named).to_json() == from_file.to_json()
    judged, again = (calib.evaluate(data, known).to_dict() for data in (in_memory, path))
    assert [one.pop("seen_by_fit") for one in (judged, again)] == [["memory"], [path.name]]
    assert (judged, calib.examine(in_memory)) == (again, calib.examine(path))
    ours, theirs = (calib.localize(data, known, Settings(seeds=1)) for data in (in_memory, path))
    assert [one.tracks["raw"].rmse_m for one in ours] == [one.tracks["raw"].rmse_m for one in theirs]
    # Delays differ from the planted ones by a common shift, which is a constant of the curve.
    away = np.array([known.delays_ns[tag] - DELAYS_NS[tag] for tag in DELAYS_NS])
    np.testing.assert_allclose(away - away.mean(), 0, atol=0.02)


def test_objects_with_the_attributes_of_a_source_are_read():
    """An object of another class, with only the attributes that a source needs."""
    flight = sample_flight()
    bare = SimpleNamespace(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags)
    assert load_ranges(bare).planted is None
    assert_same(load_ranges(bare), load_ranges(flight))
    assert calib.examine(bare) == []
    planted = {"delays_ns": {"1": 0.1}}
    for said in ({"planted": planted}, {"meta": {"planted": planted}}):
        assert load_ranges(SimpleNamespace(**vars(bare), **said)).planted == planted


def test_exchanges_with_their_distances_need_no_poses():
    ranges, exchanges = load_ranges(sample_flight()), sample_flight().exchanges
    assert_same(load_ranges(replace(exchanges, truth_m=ranges.truth_m)), ranges)
    assert_same(calib.Ranges.from_exchanges(exchanges, ranges.truth_m), ranges)
    with pytest.raises(calib.BadInputError, match=r"`truth_m`: has shape \(3,\)"):
        calib.Ranges.from_exchanges(exchanges, np.zeros(3))
    with pytest.raises(calib.UnanswerableError, match=r"add poses and lever arms \(`uwblink poses`\), or measured"):
        load_ranges(exchanges)


@pytest.mark.parametrize(
    ("call", "data", "said"),
    [
        (load_ranges, None, "found NoneType, expected a path"),
        (load_ranges, 3, "found int, expected a path"),
        (load_ranges, [], "no recording was given"),
        (load_ranges, [None], "found NoneType, expected a path"),
        (load_ranges, {"range_m": [3.1]}, "found dict, expected a path"),
        (calib.examine, load_ranges(sample_flight()), ""),
        (lambda ranges: calib.localize(ranges, calib.fit(ranges)), load_ranges(sample_flight()), ""),
    ],
)
def test_other_objects_than_recordings_are_refused(call, data, said):
    with pytest.raises(calib.BadInputError, match=f"`data`: {said}"):
        call(data)


def test_ranges_that_are_given_twice_are_refused_and_halves_are_not():
    whole = calib.load_ranges(calib.sample_flight(600))
    first, second = whole[:300], whole[300:]
    assert len(calib.load_ranges([first, second])) == 600
    for twice in ([whole, whole], [first, second, first]):
        with pytest.raises(calib.BadInputError, match="same exchanges"):
            calib.fit(twice)


def test_arrays_become_ranges():
    r = calib.Ranges.from_arrays([3, 4], initiator=1, target=[2, 3], fpp1_dbm=[-85.0, 0.0], truth_m=[2.9, 3.9])
    assert (r.tags(), repr(r)) == ([1, 2, 3], "<Ranges of memory: 2 of tags 1, 2, 3>")
    np.testing.assert_array_equal(r.fpp1_dbm, [-85.0, math.nan])
    assert repr(r.usable()) == "<Ranges of memory: 1 of tags 1, 2, 1 left out: no power>"
    assert load_ranges(r.usable()).excluded == {"no power": 1}


@pytest.mark.parametrize(
    ("wrong", "parameter", "said"),
    [
        ({"range_m": [1.0, 2.0, 3.0]}, None, "different lengths"),
        ({"target": [2, 2, 2]}, None, "different lengths"),
        ({"range_m": [[1.0, 2.0]]}, "range_m", "`range_m`: has shape"),
        ({"range_m": ["far", "near"]}, None, "range_m: expected numbers"),
        ({"initiator": [1.5, 2.5]}, None, "initiator: expected whole numbers"),
        ({"initiator": ["a", "b"]}, None, "initiator: expected whole numbers"),
        ({"target": ["a", "b"]}, None, "target: expected whole numbers"),
        ({"time_ns": [0.5, 1.5]}, None, "time_ns: expected whole numbers"),
        ({"fpp1_dbm": ["loud", "low"]}, None, "fpp1_dbm: expected numbers"),
        ({"protocol": "zz"}, "protocol", "`protocol`: found 'zz'"),
        ({"target": [2, 1]}, "target", "`target`: row 1 has tag 1 at both ends"),
        ({"weights": (0.5,)}, "weights", "`weights`: found 1"),
        ({"features": {"colour": 1.0}}, "features", "`features`: found 'colour'"),
        # A lost sign would leave the range without a power, and so without its bias and sigma.
        ({"fpp1_dbm": [-85.0, 85.0]}, "fpp1_dbm", "`fpp1_dbm`: found 85"),
        ({"fpp2_dbm": 84}, "fpp2_dbm", "`fpp2_dbm`: found 84"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_column(wrong, parameter, said):
    columns: dict[str, Any] = {"range_m": [1.0, 2.0], "initiator": 1, "target": [2, 3], "fpp1_dbm": -85.0} | wrong
    with pytest.raises(calib.BadInputError, match=said) as caught:
        calib.Ranges.from_arrays(columns.pop("range_m"), **columns)
    assert caught.value.parameter == parameter


SPLINE = {"knots": [0, 0, 1, 1], "degree": 1, "coefficients": [0.0, 0.1]}


@pytest.mark.parametrize(
    "planted",
    [
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
    ],
)
def test_planted_values_of_wrong_form_are_refused(tmp_path, planted):
    flight = sample_flight(10)
    assert load_ranges(replace(flight, meta={"planted": {"bias_curve": SPLINE, "sigma_curve": None}})).planted
    for source in (replace(flight, meta={"planted": planted}), written(tmp_path / "memory", flight, planted)):
        with pytest.raises(calib.BadInputError, match=rf"^memory: planted: {next(iter(planted))}: "):
            load_ranges(source)


@pytest.mark.parametrize("column", ["time_ns", "body"])
def test_poses_without_time_or_body_are_refused(tmp_path, column):
    flight = sample_flight(10)
    place = written(tmp_path / "f.uwb", flight, {})
    with duckdb.connect(str(place)) as db:
        db.execute(f"UPDATE poses SET {column} = NULL WHERE body = ?", [flight.tags[0].body])
    with pytest.raises(uwblink.errors.RecordingError, match="table poses"):
        load_ranges(place)


def test_bodies_with_one_pose_do_not_split_reading(tmp_path):
    """A hundred anchors have one pose each: thousands of exchanges are read in one part, not one by one."""
    flight = sample_flight(3000)
    names, places = [f"anchor{k}" for k in range(100)], np.ones((100, 3))
    anchors = uwblink.Poses.from_arrays(np.full(100, flight.poses.time_ns[0]), np.array(names), places)
    with uwblink.Recording.open(written(tmp_path / "it.uwb", flight, {}), update=True) as recording:
        recording.append("poses", anchors)
        assert [len(part) for part, _ in exchanges_with_poses(recording)] == [3000]


# Data frames in and out: of pandas, Arrow, and others with Arrow's C interface, such as Polars.


N = 600
TAGS = {"AN0": -0.3, "AN1": 0.2, "drone": 0.1}
C = 0.299792458  # m/ns, written as a number


def frame(**changes):
    """Return ranges of three tags with planted delays, with column names and units of another program."""
    rng = np.random.default_rng(4)
    pair = np.array([("drone", "AN0"), ("drone", "AN1"), ("AN0", "AN1")])[np.arange(N) % 3]
    truth, noise, power = rng.uniform(1, 6, N), rng.normal(0, 0.02, N), rng.uniform(-95, -80, N)
    delay = np.sum([[TAGS[name] for name in ends] for ends in pair], axis=1)
    columns = {
        "stamp": pd.date_range("2026-03-01", periods=N, freq="50ms"),
        "from_id": pair[:, 0],
        "to_id": pair[:, 1],
        "distance_mm": 1000 * (truth - C * delay / 2 + noise),
        "gt_range_m": truth,
        "fpp_dbm": power,
    }
    return pd.DataFrame(columns | changes)


MAP = {"columns": {"range_m": "distance_mm", "fpp2": "fpp_dbm", "time_s": "stamp"}, "units": {"distance": "mm"}}


@pytest.mark.parametrize(
    "form",
    [
        lambda f: f,
        pa.table,
        # A table of a library that only has Arrow's interface.
        lambda f: SimpleNamespace(__arrow_c_stream__=pa.table(f).__arrow_c_stream__),
    ],
)
@pytest.mark.filterwarnings("ignore:.*ids are words")
def test_frames_are_read_by_a_map(form):
    whole = frame(gt_range_m=1000 * frame().gt_range_m)
    loaded = calib.Ranges.from_dataframe(form(whole), MAP)
    found = loaded.truth_m, loaded.raw_m, loaded.fpp2_dbm
    np.testing.assert_allclose(found, [whole.gt_range_m / 1000, whole.distance_mm / 1000, whole.fpp_dbm])
    assert np.diff(loaded.time_ns) == pytest.approx(50_000_000)


def test_frames_with_plain_names_need_no_map_and_note_assumptions():
    plain = frame().rename(columns={"distance_mm": "range_m"})
    plain["range_m"] /= 1000
    with pytest.warns(UserWarning, match="3 ids are words"):
        result, again = calib.fit(plain), calib.fit(plain.set_index("stamp"))
    assert len(result.ranges) == N
    delays = result.calibration.delays_ns
    assert again.calibration.delays_ns == delays
    tag = {body: number for number, body in result.ranges.bodies}  # numbers are from the import
    # 200 ranges per pair with 2 cm of noise: 1.4 mm, or 9 ps of a sum of delays.
    assert delays[tag["AN1"]] - delays[tag["AN0"]] == pytest.approx(TAGS["AN1"] - TAGS["AN0"], abs=0.04)


def test_one_word_in_a_long_column_of_objects_is_one_unusable_row():
    # DuckDB looks at a sample of a thousand rows, which does not contain this one.
    range_m = np.linspace(1, 5, 2400).astype(object)
    several = pd.DataFrame({"time_s": np.arange(2400) * 0.05, "from_id": 1, "to_id": 2, "range_m": range_m})
    several.loc[3, "range_m"] = "none"
    with pytest.warns(UserWarning, match="1 of 2400 rows are unusable.*row 4.*'range_m': found 'none'"):
        loaded = calib.Ranges.from_dataframe(several)
    assert loaded.raw_m == pytest.approx(several.range_m.drop(3).astype(float))


def test_frames_of_boards_that_stand_still_are_arrangements_with_numbers():
    r = calib.sample_arrangements(2)
    columns = {"time_s": r.time_ns * 1e-9, "from_id": r.initiator, "to_id": r.target, "range_m": r.raw_m}
    frames = [half for _, half in pd.DataFrame(columns).groupby(r.time_ns // 40_000_000_000)]
    found = calib.survey(frames, known="line")
    assert [one.name for one in found.arrangements] == ["data frame 1", "data frame 2"]
    # Edges of the two arrangements differ by a second.
    whole = calib.survey(r, known="line").calibration
    assert found.calibration.delays_ns == pytest.approx(whole.delays_ns, abs=0.02)


@pytest.mark.parametrize(
    ("call", "error", "said"),
    [
        (
            lambda _: calib.Ranges.from_dataframe(frame().drop(columns="to_id")),
            calib.BadInputError,
            r"data frame: state to_id in `map`.*\n(.*\n)*.*\[columns\]",
        ),
        (
            lambda _: calib.fit(pd.DataFrame({"a": [1.0], "b": [2.0]})),
            calib.BadInputError,
            "^data frame: no column whose name",
        ),
        (
            lambda _: calib.Ranges.from_dataframe(frame(), {"columns": {"nonsense": "a"}}),
            calib.BadInputError,
            r"^data frame: columns\.nonsense",
        ),
        (
            lambda folder: uwblink.import_recording(frame(), folder / "t.uwb", map_file={"columns": {"nonsense": "a"}}),
            uwblink.errors.ImportTableError,
            r"^data frame: columns\.nonsense",
        ),
        (
            lambda folder: uwblink.import_recording(folder / "t.csv", folder / "t.uwb", map_file=MAP),
            uwblink.errors.ArgumentError,
            "map_file",
        ),
    ],
)
def test_incomplete_frames_are_refused_with_the_missing_data(tmp_path, call, error, said):
    with pytest.raises(error, match=said):
        call(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_ranges_and_true_distances_in_millimetres_are_refused():
    ranges = load_ranges(sample_flight())
    with pytest.raises(calib.UnanswerableError, match="check the units of the true distances and of the ranges"):
        calib.fit(replace(ranges, raw_m=1000 * ranges.raw_m, truth_m=1000 * ranges.truth_m))


def test_results_become_frames():
    ranges, exchanges = load_ranges(sample_flight()), sample_flight().exchanges
    result = calib.fit(ranges)
    corrected, judged = result.calibration.apply(ranges), calib.evaluate(ranges, result)
    for some, name in ((ranges, "raw_m"), (corrected, "corrected_m"), (exchanges, "range_m")):
        assert some.to_pandas()[name].to_numpy() == pytest.approx(getattr(some, name))
    assert "corrected_m" in corrected._repr_html_()
    assert ranges._repr_html_().count("data:image/png") == ranges[:0]._repr_html_().count("data:image/png") == 1
    rows = judged.to_pandas().set_index("pair")
    told = rows.loc["1-2", "full_median_m"], rows.loc["all", "raw_n"]
    assert told == (judged.pairs["1-2"].full.median_m, len(ranges))


def test_without_pandas_the_error_names_the_package_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(uwblink.errors.ArgumentError, match="pip install pandas"):
        calib.load_ranges(calib.sample_flight()).to_pandas()


# Clock rates by third messages against readings of the carriers: a planted fault is named, and nothing else.


PPM = np.array([0.0, 4.0, -3.0, 1.5])
"""Rate of each tag's clock in ppm."""


def exchanges(stamps_ppm=None, sign=1.0, noise_ppm=0.3):
    """Return a sample flight whose third messages and carriers contain clock rates; `stamps_ppm` are those of tags 1 to
    3.
    """
    flight, rng = calib.sample_flight(900).exchanges, np.random.default_rng(4)
    fast = PPM if stamps_ppm is None else np.array([0.0, *stamps_ppm])
    # The third message leaves the target 15 ms after its second, in ticks of its clock; the initiator counts other
    # ticks.
    target, initiator = (0.015 / TICK_S * (1 + 1e-6 * fast[ids]) for ids in (flight.target, flight.initiator))
    carrier = sign * (PPM[flight.target] - PPM[flight.initiator])
    return replace(
        flight,
        tx3=(flight.tx2 + np.rint(target).astype(np.int64)) % 2**32,
        rx3=(flight.rx2 + np.rint(initiator).astype(np.int64)) % 2**32,
        skew1_ppm=carrier + noise_ppm * rng.normal(size=900),
        skew2_ppm=-carrier + noise_ppm * rng.normal(size=900),
    )


@pytest.mark.parametrize(
    "some",
    [
        exchanges(),
        exchanges(sign=-1.0),
        replace(exchanges(stamps_ppm=(9.0, -9.0, 0.0)), skew1_ppm=np.zeros(900), skew2_ppm=np.zeros(900)),
        exchanges(stamps_ppm=(4.0, -3.0, 3.0), noise_ppm=30.0),
    ],
    ids=["they agree", "they agree by the other sign", "readings of zero are none", "readings scatter widely"],
)
def test_clocks_that_agree_have_no_finding(some):
    assert clocks_apart(some) is None


def test_a_clock_that_is_fast_by_stamps_only_is_named_with_its_effect():
    # Tag 3 is 3 ppm slow; by its stamps it is 2 ppm fast.
    some = exchanges(stamps_ppm=(4.0, -3.0, 6.5))
    found: Any = clocks_apart(some)
    assert (3 in found.pair, found.p_value < 1e-6) == (True, True)
    assert abs(found.stamps_ppm - found.carrier_ppm) == pytest.approx(5.0, abs=0.2)
    reply_s = float(np.median((some.tx2 - some.rx1) % 2**32)) * TICK_S
    assert found.moves_m == pytest.approx(0.5 * SPEED_OF_LIGHT * 5e-6 * reply_s, rel=0.05)
    findings = calib.fit(replace(calib.sample_flight(900), exchanges=some)).findings
    stated = "clocks contradict the carriers", str(found), found.p_value
    assert stated in [(one.fault, one.evidence, one.p_value) for one in findings]
