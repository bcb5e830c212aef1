"""A corrected recording: the ranges that `evaluate` sees, and every other row of every table as it was."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.data.samples import sample_flight
from tests.processes import refuse, succeed
from uwblink.recording.file import Recording
from uwblink.recording.schema import TABLES, CirRow, Fault, FrameRow


def full_recording(path):
    """Write a recording with rows in every table, in which a board printed 0.0000 dBm now and then."""
    flight = sample_flight(600)
    power = flight.exchanges.fpp1_dbm.copy()
    power[::9] = 0.0
    both = flight.exchanges.fpp2_dbm.copy()
    both[::90] = 0.0
    exchanges = replace(flight.exchanges, fpp1_dbm=power, fpp2_dbm=both)
    with Recording.create(path, meta={"note": "kept"}) as recording:
        recording.append_tags(flight.tags)
        recording.append_poses(flight.poses)
        recording.append_exchanges(exchanges)
        recording.append("faults", [Fault(5, "1", "time-out", "no answer")])
        recording.append("frames", [FrameRow(7, "1", "in", b"\x00\xff raw"), FrameRow(8, "1", "out", b"C05")])
        recording.append("cirs", [CirRow(9, 1, 1, 2, 741.25, tuple(range(1016)))])
        recording.append("overheard", [{name: float(k) for k, name in enumerate(TABLES["overheard"])}])
        # And not "corrected", which is what is made.
        for table in ("imu", "height", "powers", "quality", "receptions", "temperature", "arrangements", "distances"):
            kinds = {"BIGINT": np.array([11]), "VARCHAR": np.array(["b1"]), "DOUBLE": np.array([0.5])}
            kinds |= {"USMALLINT": np.array([3])}
            recording.append(table, {name: kinds[kind] for name, kind in TABLES[table].items()})
    return exchanges


def rows(path, table):
    import duckdb

    with duckdb.connect(str(path), read_only=True) as db:
        found = db.execute(f"SELECT * FROM {table}").fetchall()
        names = [column[0] for column in db.description]
    return names, found


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corrected")
    exchanges = full_recording(folder / "f.uwb")
    known = calib.fit(folder / "f.uwb").calibration
    done = calib.apply(folder / "f.uwb", known, folder / "c.uwb")
    return folder, exchanges, known, done


@pytest.mark.parametrize("table", sorted(TABLES.keys() - {"corrected"}))
def test_every_table_is_there(corrected, table):
    folder, *_ = corrected
    names, before = rows(folder / "f.uwb", table)
    also, after = rows(folder / "c.uwb", table)
    assert names == also
    assert before, "a table without rows shows nothing"
    if table == "exchanges":
        place = names.index("range_m")
        before, after = ([row[:place] + row[place + 1 :] for row in part] for part in (before, after))
    if table == "meta":
        after = [row for row in after if row[0] != "calibration"]
        before, after = sorted(before), sorted(after)
    assert repr(after) == repr(before)


def test_apply_and_evaluate_correct_the_same_range_alike(corrected):
    folder, exchanges, known, done = corrected
    with Recording.open(folder / "c.uwb") as recording:
        written = recording.exchanges().range_m
    judged = calib.load_ranges(folder / "f.uwb")
    kept = (exchanges.fpp1_dbm < 0) | (exchanges.fpp2_dbm < 0)
    assert judged.excluded == {"no power": np.count_nonzero(~kept)}
    assert done.count == len(exchanges)
    np.testing.assert_array_equal(written[kept], known.apply(judged).corrected_m)
    # And neither takes the 0 for a power: that would be 8 orders of magnitude of lifted power too much.
    assert np.abs(written - exchanges.range_m)[kept].max() < 1


def test_a_corrected_recording_is_not_corrected_again(corrected):
    folder, _, known, _ = corrected
    with pytest.raises(calib.BadInputError, match="corrected already"):
        calib.apply(folder / "c.uwb", known, folder / "again.uwb")
    assert not (folder / "again.uwb").exists()


def test_a_recording_without_exchanges_is_corrected_to_one_without(tmp_path):
    flight = sample_flight(600)
    with Recording.create(tmp_path / "f.uwb") as recording:
        recording.append_tags(flight.tags)
    done = calib.apply(tmp_path / "f.uwb", calib.fit(flight).calibration, tmp_path / "c.uwb")
    assert (done.count, done.clamped) == (0, 0)


def test_ranges_without_power_are_counted_apart(corrected):
    folder, _, _, done = corrected
    names, table = rows(folder / "c.uwb", "corrected")
    beyond, unpowered = (np.array([row[names.index(n)] for row in table], float) for n in ("clamped", "sigma_m"))
    assert (done.count, done.unpowered) == (600, 7)
    assert done.unpowered == np.count_nonzero(np.isnan(unpowered))
    assert done.clamped == np.count_nonzero(beyond[np.isfinite(unpowered)])


@pytest.mark.parametrize("size", [37, 599])
def test_blocks_of_any_size_are_corrected_alike(corrected, tmp_path, monkeypatch, size):
    folder, _, known, done = corrected
    blocks = Recording.exchange_blocks
    monkeypatch.setattr(Recording, "exchange_blocks", lambda recording: blocks(recording, size))
    assert calib.apply(folder / "f.uwb", known, tmp_path / "c.uwb") == done
    for table in ("exchanges", "corrected", "poses", "cirs"):
        assert repr(rows(tmp_path / "c.uwb", table)) == repr(rows(folder / "c.uwb", table))


def test_of_pairs_that_are_not_determined_the_others_are_corrected_and_they_are_named(tmp_path):
    """Two tags and two anchors; in the second flight the tags range with each other, too."""
    flight = calib.sample_flight()
    e = flight.exchanges
    lower = np.sort(np.unique(np.append(e.initiator, e.target)))[0]
    across = (e.initiator == lower) ^ (e.target == lower)
    for name, exchanges in (("across.uwb", e[across]), ("all.uwb", e), ("within.uwb", e[~across])):
        with Recording.create(tmp_path / name) as recording:
            recording.append_tags(flight.tags)
            recording.append_poses(flight.poses)
            recording.append_exchanges(exchanges)
    succeed("calib", "fit", "across.uwb", "-o", "c.json", cwd=tmp_path)
    whole = succeed("calib", "apply", "across.uwb", "-c", "c.json", "-o", "one.uwb", cwd=tmp_path)
    part = succeed("calib", "apply", "all.uwb", "-c", "c.json", "-o", "two.uwb", cwd=tmp_path)
    named = [f"{a}-{b}" for a, b in np.unique(np.sort(np.column_stack([e.initiator, e.target])[~across]), axis=0)]
    assert "left out" not in whole.stderr
    assert [line for line in part.stderr.splitlines() if all(pair in line for pair in named)]
    assert f"{np.count_nonzero(~across)} ranges are left out" in part.stderr
    for name in ("two.uwb", "one.uwb"):
        assert rows(tmp_path / name, "corrected") == rows(tmp_path / "one.uwb", "corrected")
        assert rows(tmp_path / name, "exchanges") == rows(tmp_path / "one.uwb", "exchanges")
    # Evaluation and localization do the same.
    for command in ("evaluate", "localize"):
        said = [succeed("calib", command, name, "-c", "c.json", cwd=tmp_path) for name in ("across.uwb", "all.uwb")]
        assert said[0].stdout.replace("across.uwb", "all.uwb").split() == said[1].stdout.split()
        assert ["left out" in one.stderr for one in said] == [False, True]
    refuse("calib", "apply", "within.uwb", "-c", "c.json", "-o", "no.uwb", cwd=tmp_path, naming=[named[0], "determine"])
    assert not (tmp_path / "no.uwb").exists()
