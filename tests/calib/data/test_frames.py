"""Data frames in and out: of pandas, of Arrow, and of anything with Arrow's interface in C, as Polars has it."""

import builtins

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import calib
import uwblink
from uwblink.errors import ArgumentError

N = 600
TAGS = {"AN0": -0.3, "AN1": 0.2, "drone": 0.1}
C = 0.299792458  # m/ns, written out


def frame(**changes):
    """Return ranges of three tags with planted delays, in words and units of their owner."""
    rng = np.random.default_rng(4)
    pair = np.array([("drone", "AN0"), ("drone", "AN1"), ("AN0", "AN1")])[np.arange(N) % 3]
    truth = rng.uniform(1, 6, N)
    delay = np.array([[TAGS[name] for name in ends] for ends in pair]).sum(axis=1)
    columns = {
        "stamp": pd.date_range("2026-03-01", periods=N, freq="50ms"),
        "from_id": pair[:, 0],
        "to_id": pair[:, 1],
        "distance_mm": 1000 * (truth - C * delay / 2 + rng.normal(0, 0.02, N)),
        "gt_range_m": truth,
        "fpp_dbm": rng.uniform(-95, -80, N),
    }
    return pd.DataFrame(columns | changes)


MAP = {"columns": {"range_m": "distance_mm", "fpp2": "fpp_dbm", "time_s": "stamp"}, "units": {"distance": "mm"}}


class OfAnotherLibrary:
    """A table whose library is known by Arrow's interface only."""

    def __init__(self, table):
        self.table = table

    def __arrow_c_stream__(self, requested_schema=None):
        return self.table.__arrow_c_stream__(requested_schema)


def planted_difference(result, loaded):
    """Return the error of the difference of two delays, in ns; names of tags come from the import."""
    tag = {body: number for number, body in loaded.bodies}
    delays = result.calibration.delays_ns
    return delays[tag["AN1"]] - delays[tag["AN0"]] - (TAGS["AN1"] - TAGS["AN0"])


@pytest.mark.parametrize("form", [lambda f: f, pa.table, lambda f: OfAnotherLibrary(pa.table(f))])
@pytest.mark.filterwarnings("ignore:.*ids are words")
def test_a_frame_is_fitted_with_its_columns_in_words_of_their_owner(form):
    whole = frame(gt_range_m=1000 * frame().gt_range_m)
    loaded = calib.Ranges.from_dataframe(form(whole), MAP)
    assert len(loaded) == N
    assert loaded.truth_m == pytest.approx(whole.gt_range_m / 1000)
    assert loaded.raw_m == pytest.approx(whole.distance_mm / 1000)
    assert loaded.fpp2_dbm == pytest.approx(whole.fpp_dbm)
    assert np.diff(loaded.time_ns) == pytest.approx(50_000_000)
    result = calib.fit(loaded, delays_only=True)
    # 200 ranges a pair of 2 cm: 1.4 mm, or 9 ps of a sum of delays.
    assert abs(planted_difference(result, loaded)) < 0.04


def test_a_frame_with_plain_names_needs_no_map_and_says_what_it_assumed():
    plain = frame().rename(columns={"distance_mm": "range_m"})
    plain["range_m"] /= 1000
    with pytest.warns(UserWarning, match="3 ids are words"):
        result = calib.fit(plain)
    assert len(result.ranges) == N
    with pytest.warns(UserWarning, match="3 ids are words"):
        assert calib.fit(plain.set_index("stamp")).calibration.delays_ns == result.calibration.delays_ns


def test_a_frame_that_does_not_tell_everything_is_refused_with_what_is_missing(tmp_path):
    with pytest.raises(calib.BadInputError, match=r"data frame: state to_id in `map`.*\n(.*\n)*.*\[columns\]"):
        calib.Ranges.from_dataframe(frame().drop(columns="to_id"))
    with pytest.raises(calib.BadInputError, match="no column whose name is known"):
        calib.fit(pd.DataFrame({"a": [1.0], "b": [2.0]}))
    with pytest.raises(calib.BadInputError, match=r"columns\.nonsense"):
        calib.Ranges.from_dataframe(frame(), {"columns": {"nonsense": "a"}})
    with pytest.raises(ArgumentError, match="map_file"):
        uwblink.import_recording(tmp_path / "t.csv", tmp_path / "t.uwb", map_file=MAP)
    assert list(tmp_path.iterdir()) == []


def test_results_become_frames():
    flight = calib.sample_flight()
    ranges = calib.load_ranges(flight)
    result = calib.fit(ranges)
    table = ranges.to_pandas()
    assert table.raw_m.to_numpy() == pytest.approx(ranges.raw_m)
    corrected = result.calibration.apply(ranges)
    assert corrected.to_pandas().corrected_m.to_numpy() == pytest.approx(corrected.corrected_m)
    assert "corrected_m" in corrected._repr_html_()
    judged = calib.evaluate(flight, result)
    rows = judged.to_pandas().set_index("pair")
    assert rows.loc["1-2", "full_median_m"] == judged.pairs["1-2"].full.median_m
    assert rows.loc["all", "raw_n"] == len(ranges)
    assert flight.exchanges.to_pandas().range_m.to_numpy() == pytest.approx(flight.exchanges.range_m)


def test_without_pandas_one_line_says_what_to_do(monkeypatch):
    real = builtins.__import__

    def missing(name, *args, **kwargs):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ArgumentError, match="pip install pandas"):
        calib.load_ranges(calib.sample_flight()).to_pandas()
