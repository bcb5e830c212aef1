"""Exchanges that both devices log, so that a table has them twice."""

import numpy as np
import pytest

from tests.uwblink.importers.test_table_forms import (
    AIR,
    HEADER,
    TICKS,
    flights,
    mapped,
    read_rows,
    read_table,
    wrapped,
    write,
)
from uwblink.errors import ImportTableError
from uwblink.importers.guess import guess_map


def test_the_same_stamps_of_the_same_devices_are_one_exchange(tmp_path):
    """The second log has the clock of another host, and its own power; the first row is used."""
    rows = wrapped(flights(317))
    again = [row | {"time_s": row["time_s"] + 0.003, "fpp1": -99.0} for row in rows[:246:2]]
    found = read_rows(tmp_path, sorted([*rows, *again], key=lambda row: row["time_s"]))
    assert "123 of 440 rows" in found.meta["notes"][0]
    columns = found.exchanges.tx1.tolist(), found.exchanges.fpp1_dbm.tolist()
    assert columns == tuple([row[name] for row in rows] for name in ("tx1", "fpp1"))


def test_unusable_rows_and_rows_without_stamps_are_no_repetition(tmp_path):
    rows = wrapped(flights(60))
    found = read_rows(tmp_path, [row if k % 7 else row | {"tx2": ""} for k, row in enumerate(rows)])
    assert len(found.exchanges) == 60 - 9
    assert not any("repeat" in note for note in found.meta["notes"])
    zeros = [row | dict.fromkeys(HEADER[3:9], 0) | {"range_m": 3.25} for row in rows]
    assert len(read_rows(tmp_path, zeros).exchanges) == 60


def plain(count, every_s, jitter_s, share, seed, quantum=0.01, noise=0.03):
    """Return ranges of three pairs, a share of which is also logged by the other device, with its own clock."""
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


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_ranges_without_stamps_that_both_devices_logged_are_merged(tmp_path, seed):
    rows = plain(317, 0.05, 0.004, 0.39, seed)
    found = read_rows(tmp_path, rows)
    first = [
        row["range_m"]
        for k, row in enumerate(rows)
        if not k or row["from_id"] != rows[k - 1]["to_id"] or row["to_id"] != rows[k - 1]["from_id"]
    ]
    assert found.exchanges.range_m.tolist() == first
    (note,) = found.meta["notes"]
    assert note.startswith(f"{len(rows) - 317} of {len(rows)} ranges repeat")


def test_repeated_ranges_of_one_end_are_noted_and_kept(tmp_path):
    rows = plain(317, 0.05, 0.004, 0.39, 0)
    rows = [
        row | {"from_id": min(row["from_id"], row["to_id"]), "to_id": max(row["from_id"], row["to_id"])} for row in rows
    ]
    found = read_rows(tmp_path, rows)
    assert len(found.exchanges) == len(rows)
    assert any("may be logged twice" in note for note in found.meta["notes"])


@pytest.mark.parametrize(("quantum", "noise"), [(0.1, 0.03), (0.01, 0.0)])
def test_ranges_that_are_equal_by_chance_are_not_noted(tmp_path, quantum, noise):
    assert not read_rows(tmp_path, plain(600, 0.05, 0, 0, 1, quantum, noise)).meta["notes"]


# Stamps of devices with and without programmed antenna delays, and of protocols that need more than stamps.


PROGRAMMED = 16_436
"""Ticks of each direction, as on the boards; a device without them stamps its transmissions earlier by this."""


def undelayed(rows, tags=(1, 2, 3), delay=PROGRAMMED):
    """Return the same exchanges as stamped by devices without programmed delays: sent early, received late."""
    found = []
    for row in rows:
        ends = {"i": row["from_id"] in tags, "t": row["to_id"] in tags}
        late = {"tx1": -ends["i"], "rx2": ends["i"], "rx3": ends["i"], "rx1": ends["t"], "tx2": -ends["t"]}
        late["tx3"] = -ends["t"]
        found.append(row | {name: row[name] + sign * delay for name, sign in late.items()})
    return found


def with_truth(rows):
    return [short | {"gt_range_m": row["truth"]} for short, row in zip(wrapped(rows), rows, strict=True)]


ZEROS = "[antenna_delays]\ntx = 0\nrx = 0\n"


@pytest.mark.parametrize(
    ("tags", "text", "ticks"),
    [
        ((1, 2, 3), "", 0),
        ((1, 2, 3), "protocol = 'ds'\nbits = 32\n" + ZEROS, 0),
        ((1, 2, 3), None, 0),
        ((), None, PROGRAMMED),
    ],
    ids=["no map", "a map", "the guess", "the guess of devices that have them"],
)
def test_devices_without_antenna_delays_are_read_beside_true_distances(tmp_path, tags, text, ticks):
    path = write(tmp_path / "t.csv", with_truth(undelayed(flights(), tags)))
    found = read_table(path, mapped(tmp_path, guess_map(path).text if text is None else text))
    assert set(found.exchanges.protocol) == {"ds"}
    assert found.meta["configured_antenna_delay_ticks"] == {"tx": ticks, "rx": ticks}
    longer = found.exchanges.range_m - found.exchanges.truth_m
    assert longer == pytest.approx(2 * (PROGRAMMED - ticks) * AIR / TICKS, abs=1e-6)
    assert len(found.meta["notes"]) == (text == "")


def test_one_device_without_antenna_delays(tmp_path):
    """Ranges to it are 77 m longer, which the map explains."""
    said = f"[antenna_delays]\ntx = {PROGRAMMED}\nrx = {PROGRAMMED}\n[antenna_delays.tags.2]\ntx = 0\nrx = 0\n"
    found = read_rows(tmp_path, with_truth(undelayed(flights(), tags=(2,))), said)
    assert (set(found.exchanges.protocol), found.meta["notes"]) == ({"ds"}, [])
    assert found.meta["configured_antenna_delay_ticks_by_tag"] == {"2": {"tx": 0, "rx": 0}}


def test_antenna_delays_of_a_map_have_priority(tmp_path):
    rows = with_truth(undelayed(flights()))
    with pytest.raises(ImportTableError, match="antenna_delays"):
        read_rows(tmp_path, rows, f"[antenna_delays]\ntx = {PROGRAMMED}\nrx = {PROGRAMMED}\n")
