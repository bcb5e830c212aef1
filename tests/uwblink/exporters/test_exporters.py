"""What leaves the project: every column of every table comes back, and other readers read it."""

import duckdb
import numpy as np
import pytest

from tests.uwblink.recording.test_copy import full, rows  # noqa: F401 - full is a fixture
from uwblink.errors import (
    ArgumentError,
    ImportTableError,
    RecordingError,
    RecordingExistsError,
    RecordingMissingError,
)
from uwblink.exporters import EXPORTERS, Exporter, export_recording, register_exporter
from uwblink.importers import import_recording
from uwblink.recording.contents import Contents
from uwblink.recording.file import Recording
from uwblink.recording.schema import TABLES, Fault, Poses, Tag
from uwblink.twr import Exchanges


@pytest.fixture
def whole(full):  # noqa: F811
    """A recording with rows in every table, and without what only a stranger's hand leaves missing."""
    with duckdb.connect(str(full)) as db:
        db.execute("DELETE FROM exchanges WHERE tx1 IS NULL")
        db.execute("DELETE FROM cirs WHERE magnitudes IS NULL")
        db.execute("DELETE FROM faults WHERE board IS NULL")
    with Recording.open(full, update=True) as recording:
        recording.append("faults", [Fault(3, "", 'odd, "quoted"', "two\nlines; nan")])
    return full


def in_order(path):
    # Contents are saved in order of time, the exchanges as they are.
    return {table: found if table == "exchanges" else sorted(found) for table, found in rows(path).items()}


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_every_column_of_every_table_comes_back(whole, tmp_path, form):
    counts = export_recording(whole, tmp_path / "out", to=form)
    expected = in_order(whole)
    assert all(expected.values()), "the test needs rows in every table"
    assert counts == {f"{table}.{form}": len(found) for table, found in expected.items()}
    import_recording(tmp_path / "out", tmp_path / "back.uwb", importer="exported")
    assert in_order(tmp_path / "back.uwb") == expected


def test_trajectories(tmp_path):
    """Also times of a clock that began elsewhere; the second one lies within a second of zero."""
    time = [1_706_822_508_042_560_815, -1_500_000_000, -250_000_000, 750_000_000]
    poses = Poses.from_arrays(time, ["a/b", "c", "c", "c"], [[1.5, -2.0, 0.1]] * 4, [[0.0, 0.0, 0.6, 0.8]] * 4)
    with Recording.create(tmp_path / "r.uwb") as recording:
        recording.append_poses(poses)
    assert export_recording(tmp_path / "r.uwb", tmp_path / "tum", to="tum") == {"a_b.tum": 1, "c.tum": 3}
    assert (tmp_path / "tum" / "a_b.tum").read_text() == "1706822508.042560815 1.5 -2.0 0.1 0.0 0.0 0.6 0.8\n"
    lines = (tmp_path / "tum" / "c.tum").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["-1.500000000", "-0.250000000", "0.750000000"]


def test_what_cannot_be_exported_leaves_nothing(whole, tmp_path):
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ArgumentError, match="`to`: found 'xls', allowed: csv, parquet, tum, mcap, rosbag2"):
        export_recording(whole, tmp_path / "out", to="xls")
    with pytest.raises(RecordingMissingError, match="no such recording"):
        export_recording(tmp_path / "no.uwb", tmp_path / "out", to="csv")
    with pytest.raises(RecordingError, match="does not exist"):
        export_recording(whole, tmp_path / "no" / "out", to="csv")
    assert sorted(tmp_path.iterdir()) == before
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("mine")
    with pytest.raises(RecordingExistsError, match="exists already"):
        export_recording(whole, tmp_path / "out", to="csv")
    with pytest.raises(RecordingError, match="holds mine"):
        export_recording(whole, tmp_path / "out", to="csv", force=True)
    assert (tmp_path / "out" / "mine").read_text() == "mine"
    (tmp_path / "out" / "mine").rename(tmp_path / "out" / "meta.csv")
    export_recording(whole, tmp_path / "out", to="csv", force=True)
    assert sorted(path.stem for path in (tmp_path / "out").iterdir()) == sorted(TABLES)


def test_a_path_with_quotes(whole, tmp_path):
    folder = tmp_path / "it's; DROP TABLE x"
    export_recording(whole, folder, to="csv")
    import_recording(folder, tmp_path / "back.uwb", importer="exported")
    assert in_order(tmp_path / "back.uwb") == in_order(whole)


def test_a_folder_that_is_no_export(whole, tmp_path):
    with pytest.raises(ImportTableError, match=r"holds no exchanges\.csv"):
        import_recording(tmp_path, tmp_path / "o.uwb", importer="exported")
    export_recording(whole, tmp_path / "out", to="csv")
    path = tmp_path / "out" / "exchanges.csv"
    path.write_text(path.read_text().replace(",", ",x", 1).replace("\n", "\nx", 1))
    with pytest.raises(ImportTableError, match="not in the form of 'uwblink export'"):
        import_recording(tmp_path / "out", tmp_path / "o.uwb", importer="exported")
    assert not (tmp_path / "o.uwb").exists()


def test_a_form_of_ones_own(whole, tmp_path):
    def write(recording, folder):
        (folder / "name.txt").write_text(recording.name)
        return {"name.txt": 1}

    register_exporter(Exporter("names", write, "the name"))
    try:
        assert export_recording(whole, tmp_path / "out", to="names") == {"name.txt": 1}
    finally:
        EXPORTERS.remove("names")
    with pytest.raises(ArgumentError, match="the project's own"):
        register_exporter(Exporter("csv", write, "mine"))


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_a_link_to_a_recording_is_exported_like_the_recording(tmp_path, to):
    (tmp_path / "there").mkdir()
    exchanges = Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    Contents(exchanges=exchanges).save(tmp_path / "there" / "r.uwb")
    (tmp_path / "link.uwb").symlink_to(tmp_path / "there" / "r.uwb")
    written = export_recording(tmp_path / "link.uwb", tmp_path / "out", to=to)
    assert written[f"exchanges.{to}"] == 1


@pytest.fixture
def flown(tmp_path):
    """One tag on a body that flies along x, half a metre ahead of it; the second of three distances was measured."""
    exchanges = Exchanges.from_arrays(
        [1] * 3, [2] * 3, time_ns=[0, 10**9, 10**10], tx1=[0] * 3, rx1=[0] * 3, tx2=[10**8] * 3, rx2=[127_795_200] * 3,
        truth_m=[np.nan, 7.25, np.nan],
    )  # fmt: skip
    poses = Poses.from_arrays([0, 2 * 10**9], ["drone"] * 2, [[0.0, 3.0, 0.0], [4.0, 3.0, 0.0]])
    mast = Poses.from_arrays([0], ["mast"], [[0.0, 0.0, 0.0]])
    both = Poses(*(np.concatenate([getattr(p, n) for p in (mast, poses)]) for n in Poses.__slots__))
    tags = [Tag(1, "mast", (0.0, 0.0, 0.0)), Tag(2, "drone", (0.5, 0.0, 0.0))]
    Contents(exchanges=exchanges, tags=tags, poses=both).save(tmp_path / "flown.uwb")
    return tmp_path / "flown.uwb"


BY_HAND = [np.hypot(0.5 + 2 * 0.001, 3.0), 7.25]
"""By a range's middle, 1 ms after its time, the body is at 2 mm; the third exchange is after the last pose."""


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_true_distances_are_those_of_the_poses_where_none_was_measured(flown, tmp_path, to):
    export_recording(flown, tmp_path / "out", to=to)
    with duckdb.connect() as db:
        rows = db.execute(
            f"SELECT truth_m, truth_from FROM read_{to}(?)", [str(tmp_path / "out" / f"exchanges.{to}")]
        ).fetchall()
    assert [row[0] for row in rows[:2]] == pytest.approx(BY_HAND, abs=1e-9)
    assert rows[2] == (None, None)
    assert [row[1] for row in rows] == ["poses", "measured", None]
    import_recording(tmp_path / "out", tmp_path / "back.uwb", importer="exported")
    assert in_order(tmp_path / "back.uwb") == in_order(flown), "what the poses say is not taken for measured"


def test_messages_have_true_distances_by_the_poses(flown, tmp_path):
    export_recording(flown, tmp_path / "out", to="mcap")
    import_recording(tmp_path / "out" / "recording.mcap", tmp_path / "back.uwb")
    with Recording.open(tmp_path / "back.uwb") as recording:
        assert recording.exchanges().truth_m == pytest.approx([*BY_HAND, np.nan], abs=1e-9, nan_ok=True)
