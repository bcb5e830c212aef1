"""Exchanges and poses from arrays, and as columns; their text form."""

from typing import Any

import numpy as np
import pytest

from tests.uwblink.recording.test_file import random_exchanges
from uwblink.errors import ArgumentError, UwblinkError
from uwblink.importers import read_source
from uwblink.recording.schema import Poses
from uwblink.twr import COLUMNS, Exchanges

SS: dict[str, Any] = {"tx1": [0, 9], "rx1": [5, 3], "tx2": [1005, 1003], "rx2": [3000, 3009]}
DS: dict[str, Any] = SS | {"tx3": [99_005, 99_003], "rx3": [101_000, 101_009]}


def test_ranges_without_stamps_are_those_of_a_table_without_stamps(tmp_path):
    """A registered importer for a device that prints ranges needs no stamps."""
    (tmp_path / "t.csv").write_text("time_s,from_id,to_id,range_m,fpp2\n0.5,1,7,3.1,-82.5\n0.6,2,7,3.2,-83.0\n")
    table = read_source(tmp_path / "t.csv").exchanges
    mine = Exchanges.from_arrays(
        [1, 2], 7, range_m=[3.1, 3.2], fpp2_dbm=[-82.5, -83.0], time_ns=table.time_ns, reporter=table.reporter
    )
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(mine, name), getattr(table, name), err_msg=name)


def test_one_value_applies_to_all_rows_and_whole_floats_are_accepted():
    floats: Any = {k: np.array(v, dtype=float) for k, v in DS.items()}
    x = Exchanges.from_arrays(1, 2, **floats, protocol="ds-alt")
    assert (x.target.tolist(), x.protocol.tolist(), str(x.tx3.dtype)) == ([2, 2], ["ds-alt"] * 2, "int64")


def test_stamps_that_a_protocol_has_not_are_zero_and_mixed_protocols_keep_theirs():
    x = Exchanges.from_arrays(1, 2, **DS, protocol=["ss", "ds"])
    assert (x.tx3.tolist(), Exchanges.from_arrays(1, 2, **DS).protocol.tolist()) == ([0, 99_003], ["ds", "ds"])


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"target": 2, "tx1": [3], "range_m": [3.1]}, "rx1: is missing"),
        ({"target": 2, "rx1": [3], "range_m": [3.1]}, "tx1: is missing"),
        ({}, "tx1: is missing; give the stamps, or range_m"),
        *((SS | change, expected) for change, expected in (
        ({"rx2": [1, 2, 3]}, "rx2: found 3 rows, expected 2 as in the first column"),
        ({"tx1": [[1, 2]]}, r"tx1: found an array of shape \(1, 2\), expected one value a row"),
        ({"tx1": 5}, r"tx1: found an array of shape \(\), expected one value a row"),
        ({"rx1": [[1], [2, 3]]}, "rx1: expected one value a row"),
        ({"rx1": [5, 2**32]}, "rx1: row 1: found 4294967296, expected a whole number from 0 to 4294967295; stamps of"),
        ({"rx1": [5, -1]}, "rx1: row 1: found -1, expected a whole number from 0"),
        ({"rx1": [5.5, 1]}, "rx1: row 0: found 5.5, expected a whole number"),
        ({"rx1": [5, np.nan]}, "rx1: row 1: found nan, expected a whole number"),
        ({"rx1": ["5", "6"]}, "rx1: found '5' .*, expected whole numbers"),
        ({"rx1": [True, False]}, "rx1: found 'True' .*, expected whole numbers"),
        ({"protocol": "tdoa"}, "protocol: found 'tdoa', allowed: ss, ss-cfo, ds"),
        ({"protocol": ["ss", 3]}, "protocol: found .*, expected text|protocol: found '3', allowed"),
        ({"protocol": ["ss", "ds"]}, "tx3: is missing, but protocol 'ds' needs it"),
        ({"tx3": [1, 2]}, "rx3: is missing; a third message has both stamps"),
        ({"target": [3, 1]}, "target: row 1: found 1, expected another tag than the initiator"),
        ({"target": 70_000}, "target: row 0: found 70000, expected a whole number from 0 to 65535"),
        ({"bits": 33}, "bits: found 33, allowed: 32, 40"),
        ({"fpp1_dbm": [-80, np.inf]}, "fpp1_dbm: row 1: found inf, expected a finite number, or NaN"),
        ({"fpp1_dbm": ["a", "b"]}, "fpp1_dbm: found 'a' .*, expected numbers"),
        ({"time_ns": 2**63}, "time_ns: row 0: found 9223372036854775808, expected a whole number from"),
        )),
    ],
)  # fmt: skip
def test_mistakes_name_column_row_and_what_is_expected(columns, expected):
    assert issubclass(ArgumentError, ValueError)
    assert issubclass(ArgumentError, UwblinkError)
    with pytest.raises(ArgumentError, match=rf"\A.*({expected}).*\Z"):
        Exchanges.from_arrays(**({"initiator": 1, "target": [2, 3]} | columns))


def test_exchanges_are_made_by_name_only():
    with pytest.raises(TypeError):
        Exchanges(*([np.zeros(1)] * 17))  # type: ignore[call-arg]


def test_rows_are_chosen_by_number_slice_and_mask():
    x = random_exchanges()
    assert len(x[3]) == 1
    assert x[3].tx1[0] == x[-47].tx1[0] == x[3:5].tx1[0] == x.tx1[3]
    assert len(x[x.protocol == "ss"]) == np.count_nonzero(x.protocol == "ss")


@pytest.mark.parametrize("count", [0, 1, 6, 7, 10_000])
def test_printed_tables_fit_on_a_screen(count):
    stamps: Any = {name: np.arange(count) + 2**31 for name in SS}
    x = Exchanges.from_arrays(1, 2, **stamps, time_ns=2**60)
    poses = Poses.from_arrays(np.arange(count) + 2**60, "\x1b[31m" + "long" * 30, (1 / 3, -2 / 3, 1e-9))
    for thing in (x, poses):
        lines = repr(thing).splitlines()
        assert (len(lines) <= 12, max(map(len, lines)) <= 79, str(count) in lines[0]) == (True, True, True), lines
        assert "\x1b" not in repr(thing) + thing._repr_html_()
    assert ("..." in repr(x)) == (count > 6)
    assert len(x._repr_html_()) < 6000


def test_poses_are_put_in_order_and_turned_to_length_one():
    poses = Poses.from_arrays([2, 1], ["b", "a"], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0, 1.05], [0, 0, -0.95, 0]])
    assert (poses.body.tolist(), poses.position_m.tolist()) == (["a", "b"], [[4, 5, 6], [1, 2, 3]])
    assert poses.quaternion.tolist() == [[0, 0, -1, 0], [0, 0, 0, 1]]
    columns = poses.to_dict()
    assert (columns["x"].tolist(), columns["qz"].tolist()) == ([4, 1], [-1, 0])
    assert {np.shape(column) for column in columns.values()} == {(2,)}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"position_m": [1, 2]}, r"position_m: found an array of shape \(2,\), expected \(2, 3\) or \(3,\)"),
        ({"position_m": [[1, 2, 3], [1, np.nan, 3]]}, "position_m: row 1: found .*, expected finite numbers"),
        ({"position_m": "here"}, r"position_m: expected numbers of shape \(2, 3\)"),
        ({"quaternion": [1, 1, 0, 0]}, "quaternion: row 0: found .*, expected x y z w of length 1"),
        ({"body": [1, 2]}, "body: found '1' .*, expected text"),
        ({"time_ns": [0.5, 1]}, "time_ns: row 0: found 0.5, expected a whole number"),
    ],
)
def test_wrong_poses_name_column_and_row(change, expected):
    with pytest.raises(ArgumentError, match=expected):
        Poses.from_arrays(**({"time_ns": [1, 2], "body": "a", "position_m": [1.0, 2.0, 3.0]} | change))
