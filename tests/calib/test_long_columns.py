"""Columns in files: rows put into them are those that are read, whichever way they are written."""

import os

import numpy as np
import pytest

from calib import long_columns
from calib.long_columns import empty, let_go, put


@pytest.fixture(params=["in memory", "in a file", "a few bytes at a time"])
def few(request, monkeypatch):
    """Columns of ten rows lie where columns of millions do; a write may take less than all, as the system may."""
    if request.param != "in memory":
        monkeypatch.setattr(long_columns, "MANY", 1)
    if request.param == "a few bytes at a time":
        write = os.pwrite
        monkeypatch.setattr(os, "pwrite", lambda file, data, at: write(file, data[:5], at))


@pytest.mark.parametrize("kind", [np.float64, np.int32, np.bool_, "U3"])
def test_rows_are_put_where_they_belong(few, kind):
    column, expected = empty(10, kind), np.zeros(10, kind)
    put(column, slice(None), expected)
    for rows, values in ((slice(2, 5), [1, 0, 2]), (slice(9, 10), [3]), (slice(0, 0), [])):
        put(column, rows, np.array(values).astype(kind))
        expected[rows] = np.array(values).astype(kind)
        let_go(column)
        np.testing.assert_array_equal(column, expected)


def test_rows_of_one_of_several_columns(few):
    columns = empty(4, each=(3,))
    columns[:] = 0
    put(columns[1], slice(1, 3), np.array([5.0, 6.0]))
    put(columns[2], slice(0, 4), np.array(7.0))
    put(columns[:, 0], slice(1, 3), np.array([8.0, 9.0]))  # not one after the other
    np.testing.assert_array_equal(columns, [[0, 0, 0, 0], [8, 5, 6, 0], [9, 7, 7, 7]])


def test_what_does_not_fit_is_refused(few):
    with pytest.raises(ValueError, match="broadcast"):
        put(empty(4), slice(0, 3), np.zeros(2))
