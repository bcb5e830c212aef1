"""Exchanges that both devices log, so that they are in a table twice."""

import numpy as np
import pytest

from tests.uwblink.importers.test_table_forms import HEADER, flights, read_table, wrapped, write


def test_the_same_stamps_of_the_same_devices_are_one_exchange(tmp_path):
    """The second log has another host's clock, and its own power; the first row counts."""
    rows = wrapped(flights(317))
    again = [row | {"time_s": row["time_s"] + 0.003, "fpp1": -99.0} for row in rows[:246:2]]
    mixed = sorted([*rows, *again], key=lambda row: row["time_s"])
    path = write(tmp_path / "t.csv", mixed)
    whole = read_table(path)
    assert "123 of 440 rows" in whole.meta["notes"][0]
    found = whole.exchanges
    assert found.tx1.tolist() == [row["tx1"] for row in rows]
    assert found.fpp1_dbm.tolist() == [row["fpp1"] for row in rows]


def test_logs_in_files_of_their_own(tmp_path):
    rows = wrapped(flights(90))
    one, other = write(tmp_path / "a.csv", rows[:60]), write(tmp_path / "b.csv", rows[30:])
    found = read_table([one, other])
    assert found.exchanges.tx1.tolist() == [row["tx1"] for row in rows]
    assert found.exchanges.time_ns.tolist() == sorted(found.exchanges.time_ns.tolist())
    assert any("30 of 120 rows" in note for note in found.meta["notes"])


def test_unusable_rows_and_rows_without_stamps_are_no_repetition(tmp_path):
    rows = wrapped(flights(60))
    broken = [dict(row) for row in rows]
    for row in broken[::7]:
        row["tx2"] = ""
    found = read_table(write(tmp_path / "t.csv", broken))
    assert len(found.exchanges) == 60 - len(broken[::7])
    assert not any("repeat" in note for note in found.meta["notes"])
    zeros = [row | dict.fromkeys(HEADER[3:9], 0) | {"range_m": 3.25} for row in rows]
    assert len(read_table(write(tmp_path / "z.csv", zeros)).exchanges) == 60


def plain(count, every_s, jitter_s, share, seed, quantum=0.01, noise=0.03):
    """Ranges of three pairs, of which a share is logged a second time by the other device, by its own clock."""
    random, rows = np.random.default_rng(seed), []
    for k in range(count):
        one, other = [(1, 2), (2, 3), (3, 1)][k % 3]
        true = 4 + 2 * np.sin(k * every_s / 5 + one)
        row = {"time_s": k * every_s, "from_id": one, "to_id": other}
        row["range_m"] = round(round((true + random.normal(0, noise)) / quantum) * quantum, 6)
        rows.append(row)
        if random.random() < share:
            rows.append(
                row | {"time_s": row["time_s"] + abs(random.normal(0, jitter_s)), "from_id": other, "to_id": one}
            )
    return rows


@pytest.mark.parametrize("seed", [0, 2])
def test_ranges_without_stamps_that_both_devices_logged_are_merged(tmp_path, seed):
    rows = plain(317, 0.05, 0.004, 0.39, seed)
    found = read_table(write(tmp_path / "t.csv", rows))
    first = [
        row["range_m"]
        for k, row in enumerate(rows)
        if not k or row["from_id"] != rows[k - 1]["to_id"] or row["to_id"] != rows[k - 1]["from_id"]
    ]
    assert found.exchanges.range_m.tolist() == first
    (note,) = found.meta["notes"]
    assert note.startswith(f"{len(rows) - 317} of {len(rows)} ranges repeat")


def test_ranges_that_are_repeated_from_the_same_end_are_told_and_kept(tmp_path):
    rows = plain(317, 0.05, 0.004, 0.39, 0)
    rows = [
        row | {"from_id": min(row["from_id"], row["to_id"]), "to_id": max(row["from_id"], row["to_id"])} for row in rows
    ]
    found = read_table(write(tmp_path / "t.csv", rows))
    assert len(found.exchanges) == len(rows)
    assert any("exchanges there twice" in note for note in found.meta["notes"])


@pytest.mark.parametrize(("quantum", "noise"), [(0.1, 0.03), (0.01, 0.0)])
def test_ranges_that_are_equal_by_chance_are_not_told(tmp_path, quantum, noise):
    found = read_table(write(tmp_path / "t.csv", plain(600, 0.05, 0, 0, 1, quantum, noise)))
    assert not found.meta["notes"]
