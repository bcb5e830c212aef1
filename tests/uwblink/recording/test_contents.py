"""Contents of recordings: a copy has every row of every table, except those that were replaced; parts and pieces."""

from dataclasses import replace
from functools import partial, partialmethod

import duckdb
import numpy as np
import pytest

from tests.uwblink.recording.test_file import random_exchanges
from uwblink import Arrangement, Contents, Exchanges, KnownDistance, Poses, Recording, Tag, errors, exporters, load
from uwblink.recording.contents import exchanges_with_poses, pieces
from uwblink.recording.distances import distances_m, poses_around, tracks_of
from uwblink.recording.schema import TABLES, CirRow, Fault, FrameRow

HEARD = {name: 7.5 if kind == "DOUBLE" else 3 for name, kind in TABLES["overheard"].items()}
CIRS = [
    CirRow(5, 1, 1, 2, 3.25, (0, 65535, 7)),
    CirRow(4, 1, 1, 2, 3.5, (1, 2, 3)),
    CirRow(6, 2, 2, 1, 0.0, ()),
]
INSTEAD = {
    "tags": [Tag(9, "z", (0.0, 0.0, 1.0))],
    "poses": Poses(np.array([1]), np.array(["z"]), np.zeros((1, 3)), np.ones((1, 4))),
    "exchanges": random_exchanges(3, seed=2),
    "overheard": {name: np.array([value, value]) for name, value in HEARD.items()},
    "cirs": CIRS[:1],
    "frames": [FrameRow(1, "1", "in", b"R01|1\r\n")],
    "faults": [],
    "imu": {
        "time_ns": np.array([3]),
        "body": np.array(["z"]),
        **{n: np.ones(1) for n in TABLES["imu"] if n[0] in "wa"},
    },
    "powers": {name: np.array([1.0]) for name in TABLES["powers"]},
    "quality": {name: np.array([1.0]) for name in TABLES["quality"]},
    "temperature": {name: np.array([2.0]) for name in TABLES["temperature"]},
    "receptions": {name: np.array([3.0]) for name in TABLES["receptions"]},
    "differences": {name: np.array([3.0]) for name in TABLES["differences"]},
    "corrected": {name: np.array([1.0]) for name in TABLES["corrected"]},
    "height": {"time_ns": np.array([3]), "body": np.array(["z"]), "height_m": np.array([np.nan])},
    "arrangements": [Arrangement("Z", 1, 2, "plane")],
    "distances": [],
}


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A recording with rows in every table, not in order of time, and with missing values as in edited files."""
    path = tmp_path_factory.mktemp("full") / "full.uwb"
    with Recording.create(path, meta={"seed": 7, "planted": {"a": [1.5]}}) as r:
        r.append_exchanges(random_exchanges())
        r.append_tags([Tag(3, "b", (0.1, 0.2, 0.3)), Tag(1, "a", (0, 0, 0))])
        r.append_poses(Poses(np.array([6, 5]), np.array(["a", "b"]), np.ones((2, 3)), np.zeros((2, 4))))
        r.append("overheard", [HEARD, HEARD | {"time_ns": 1, "fpp3_dbm": np.nan, "skew3_ppm": np.nan}])
        r.append("cirs", CIRS)
        r.append("frames", [FrameRow(9, "1", "in", bytes(range(256))), FrameRow(8, "2", "out", b"C01\r")])
        readings = {"time_ns": np.array([7, 6]), "body": np.array(["a", "b"])}
        r.append("imu", {name: np.array([1.5, 2.5]) for name in TABLES["imu"]} | readings)
        for table in ("powers", "quality", "receptions", "differences"):
            r.append(table, {name: np.array([2, 1]) for name in TABLES[table]})
        celsius = {"temperature_c": np.array([25.5, 26.0]), "supply_v": np.array([3.3, np.nan])}
        r.append("temperature", {"time_ns": np.array([4, 3]), "tag": np.array([1, 3])} | celsius)
        r.append("corrected", {name: np.array([1, 0]) for name in TABLES["corrected"] if name != "sigma_m"})
        r.append("height", {"height_m": np.array([0.5, 0.25])} | readings)
        r.append("arrangements", [Arrangement("B", 5, 9, "line"), Arrangement("A", 1, 4)])
        r.append("distances", [KnownDistance(1, 2, 3.06, 0.005, "A"), KnownDistance(1, 3, 2.5, 0.01)])
        r.append("faults", [Fault(9, "1", "time-out", "no answer"), Fault(2, "2", "failed exchange", "é", 2, 1)])
    with duckdb.connect(str(path)) as db:
        db.execute("INSERT INTO exchanges (time_ns, initiator, target, protocol) VALUES (1, 2, 3, 'ds')")
        db.execute("DELETE FROM exchanges WHERE rowid = 5")
    return path


def test_arrangements_and_distances_come_back_in_order(full):
    with Recording.open(full) as source:
        assert source.arrangements() == [Arrangement("A", 1, 4), Arrangement("B", 5, 9, "line")]
        assert source.known_distances() == [KnownDistance(1, 2, 3.06, 0.005, "A"), KnownDistance(1, 3, 2.5, 0.01)]


def rows(path):
    with duckdb.connect(str(path), read_only=True) as db:
        # As text, so that NaN is equal to itself.
        return {
            table: [str(row) for row in db.execute(f"SELECT {', '.join(columns)} FROM {table} {order}").fetchall()]
            for table, columns in TABLES.items()
            for order in ["ORDER BY key" if table == "meta" else ""]
        }


@pytest.mark.parametrize("at_a_time", [1_000_000, 7])
def test_a_copy_has_every_row_of_every_table(full, tmp_path, monkeypatch, at_a_time):
    blocks = Recording._blocks
    monkeypatch.setattr(Recording, "_blocks", lambda self, table, _: blocks(self, table, at_a_time))
    with Recording.open(full) as source:
        source.copy(tmp_path / "copy.uwb")
    before, after = rows(full), rows(tmp_path / "copy.uwb")
    assert all(before.values()), "the test needs rows in every table"
    assert after == before


@pytest.mark.parametrize("first", range(4))
def test_only_replaced_tables_differ(full, tmp_path, first):
    """Every fourth table is replaced: each table is replaced once."""
    instead = {table: INSTEAD[table] for table in list(INSTEAD)[first::4]}
    with Recording.open(full) as source:
        source.copy(tmp_path / "copy.uwb", replacing=instead)
    expected, found = rows(full), rows(tmp_path / "copy.uwb")
    assert {table for table in TABLES if found[table] != expected[table]} == instead.keys()
    for table, given in instead.items():
        assert len(found[table]) == len(given["time_ns"] if isinstance(given, dict) else given), table


def test_entries_of_meta_are_added_or_replaced(full, tmp_path):
    with Recording.open(full) as source:
        source.copy(tmp_path / "more.uwb", meta={"seed": 8, "calibration": {"x": 1}})
        source.copy(tmp_path / "other.uwb", replacing={"meta": {"note": "bare"}})
        before = source.meta()
    more, other = (load(tmp_path / name).meta for name in ("more.uwb", "other.uwb"))
    assert more == before | {"seed": 8, "calibration": {"x": 1}}
    assert (other["note"], {"seed", "planted"} & set(other)) == ("bare", set())


def test_mistakes_are_one_line_and_leave_nothing(full, tmp_path):
    with Recording.open(full) as source:
        with pytest.raises(errors.RecordingError, match="no table 'ranges' in a recording; there are meta, tags"):
            source.copy(tmp_path / "copy.uwb", replacing={"ranges": []})
        with pytest.raises(errors.RecordingExistsError):
            source.copy(full)
    assert not list(tmp_path.iterdir())


# A whole recording in memory: it is read, parts are selected, and it is written again.


SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def made():
    """Ten seconds of exchanges between 1, 2 and 3, one a second in turn; a moving body and one that stands still."""
    initiator, target = np.array([(1, 2), (2, 3), (3, 1)] * 3 + [(1, 2)]).T
    time_ns = START + SECOND * np.arange(10)
    x = Exchanges.from_arrays(initiator, target, tx1=np.zeros(10), rx1=5, tx2=1005, rx2=3000, time_ns=time_ns)
    moving = Poses.from_arrays(START + SECOND // 2 * np.arange(20), "drone", (0.0, 0.0, 1.0))
    heard = {
        n: np.zeros(10) if kind == "DOUBLE" else np.zeros(10, dtype=int) for n, kind in TABLES["overheard"].items()
    }
    return Contents(
        exchanges=x,
        tags=[Tag(k, "drone" if k < 3 else "mast", (0.0, 0.0, 0.1 * k)) for k in (1, 2, 3)],
        poses=Poses.from_arrays(
            [*moving.time_ns, START - 5 * SECOND], [*moving.body, "mast"], [*moving.position_m, (5.0, 0.0, 0.0)]
        ),
        overheard=heard | {"time_ns": time_ns, "initiator": initiator, "target": target},
        cirs=[
            CirRow(int(t), 1, int(i), int(j), 750.0, (1, 2)) for t, i, j in zip(time_ns, initiator, target, strict=True)
        ],
        frames=[FrameRow(int(t), "1", "in", b"x") for t in time_ns],
        faults=[Fault(int(t), "1", "power", "") for t in time_ns],
        meta={"place": "hall"},
    )


def test_a_span_of_time_is_cut_out_with_the_poses_that_it_needs():
    part = made().select(start_s=2.25, stop_s=5)
    assert ((part.exchanges.time_ns - START) / SECOND).tolist() == [3, 4]
    assert part.overheard["time_ns"].tolist() == part.exchanges.time_ns.tolist()
    for rows_of in (part.cirs, part.frames, part.faults):
        assert [(row.time_ns - START) / SECOND for row in rows_of] == [3, 4]
    # From two poses before the span to two after it; the only pose of the mast is always included.
    drone = part.poses[part.poses.body == "drone"]
    assert ((drone.time_ns - START) / SECOND).tolist() == [1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5]
    assert (part.poses.body.tolist().count("mast"), len(part.tags)) == (1, 3)
    assert part.meta == {"place": "hall", "selected": {"start_s": 2.25, "stop_s": 5}}


def test_tags_and_pairs_are_cut_out():
    whole = made()
    two = whole.select(tags=[1, 2])
    assert set(zip(two.exchanges.initiator.tolist(), two.exchanges.target.tolist(), strict=True)) == {(1, 2)}
    assert len(two.cirs) == len(two.overheard["time_ns"]) == len(two.exchanges) == 4
    for chosen, count in (
        ({"pairs": [(1, 3)]}, 0),
        ({"pairs": [(3, 1), (2, 3)], "stop_s": 4}, 2),
        ({"pairs": []}, 0),
        ({}, 10),
    ):
        assert len(whole.select(**chosen).exchanges) == count


def test_a_part_of_a_part_can_be_written(tmp_path):
    made().select(start_s=1).select(tags=[2, 3]).save(tmp_path / "part.uwb")
    assert load(tmp_path / "part.uwb").meta["selected"] == {"tags": [2, 3]}


def test_it_prints_itself_on_a_screen():
    lines = repr(made()).splitlines()
    assert lines[0] == "3 tags on drone, mast; poses 21, overheard 10, cirs 10, frames 10, faults 10"
    assert (len(lines) <= 13, "<table>" in made()._repr_html_()) == (True, True)


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"start_s": 5, "stop_s": 2}, "stop_s: found 2, expected no less than start_s, 5"),
        ({"start_s": float("nan")}, "start_s: found nan, expected seconds"),
        ({"stop_s": 1e30}, r"stop_s: found 1e\+30, expected seconds"),
        ({"tags": ["a"]}, "tags: found 'a' .*, expected whole numbers"),
        ({"tags": "12"}, "tags: found '1' .*, expected whole numbers"),
        ({"pairs": [(1, 2, 3)]}, "pairs: found .*, expected pairs of initiator and target"),
        ({"pairs": [1, 2]}, "pairs: found .*, expected pairs of initiator and target"),
    ],
)
def test_wrong_selections_are_refused(wrong, expected):
    with pytest.raises(errors.ArgumentError, match=expected):
        made().select(**wrong)


# A recording in pieces: each row once, in order of time over all tables, for any size of the pieces.


COUNT = 400
SPAN_NS = 40_000_000_000
TAGS = [Tag(1, "drone", (0.1, 0.0, 0.0)), Tag(2, "mast", (0.0, 0.0, 2.0)), Tag(3, "car two", (0.0, 0.2, 0.0))]


def contents():
    """Rows of all tables with a time, not in order of time unless that is required."""
    rng = np.random.default_rng(1)
    pairs, time = np.array([(1, 2), (2, 3), (3, 1)])[rng.integers(0, 3, COUNT)], rng.integers(0, SPAN_NS, COUNT)
    stamps = dict(zip(("tx1", "rx1", "tx2", "rx2"), rng.integers(0, 2**32, (4, COUNT)), strict=True))
    x = Exchanges.from_arrays(*pairs.T, time_ns=time, range_m=rng.normal(3, 1, COUNT), **stamps)
    quaternion = rng.normal(size=(900, 4))
    poses = Poses.from_arrays(
        np.append(rng.integers(0, SPAN_NS, 899), 5),
        np.append(np.array(["drone", "car two"])[rng.integers(0, 2, 899)], "mast"),
        rng.normal(size=(900, 3)),
        quaternion / np.linalg.norm(quaternion, axis=1)[:, None],
    )
    some, bodies = np.sort(rng.integers(0, SPAN_NS, 300)), np.full(300, "drone")
    ends = {"time_ns": x.time_ns, "initiator": x.initiator, "target": x.target}
    values = ("sigma_m", "sigma_total_m", "mean_error_m", "tail_share", "tail_probability")
    others = dict.fromkeys(values, x.range_m * 0) | dict.fromkeys(("clamped", "outlier"), np.zeros(COUNT, dtype=bool))
    return Contents(
        exchanges=x,
        tags=TAGS,
        poses=poses,
        imu={
            "time_ns": some,
            "body": bodies,
            **{n: rng.normal(size=300) for n in ("wx", "wy", "wz", "ax", "ay", "az")},
        },
        height={"time_ns": some, "body": bodies, "height_m": rng.normal(size=300)},
        temperature={"time_ns": some, "tag": np.full(300, 1), "temperature_c": some * 1e-9, "supply_v": some * 0.0},
        corrected=ends | {"raw_m": x.range_m, "corrected_m": x.range_m - 0.1} | others,
        faults=[Fault(int(t), "1", "time-out", f"at {t}") for t in rng.integers(0, SPAN_NS, 50)],
    )


@pytest.fixture
def timed(tmp_path):
    contents().save(tmp_path / "r.uwb")
    return tmp_path / "r.uwb"


def test_corrections_of_other_exchanges_are_left_out(tmp_path):
    held = contents()
    target = np.where(np.arange(COUNT) == 7, 9, held.exchanges.target)
    replace(held, corrected={**held.corrected, "target": target}).save(tmp_path / "r.uwb")
    with Recording.open(tmp_path / "r.uwb") as recording:
        assert all(not held.corrected for held in pieces(recording, 50))


@pytest.mark.parametrize(
    ("to", "module"),
    [("mcap", exporters.mcap), ("tum", exporters), pytest.param("rosbag2", exporters.mcap, marks=pytest.mark.slow)],
)
def test_an_export_does_not_depend_on_the_pieces(timed, tmp_path, monkeypatch, to, module):
    as_one = exporters.export_recording(timed, tmp_path / "one", to=to)
    monkeypatch.setattr(module, "pieces", partial(pieces, rows=120))
    assert exporters.export_recording(timed, tmp_path / "many", to=to) == as_one
    files = [sorted(p for p in (tmp_path / name).rglob("*") if p.is_file()) for name in ("one", "many")]
    assert len(files[0]) == len(files[1]) > 0
    for one, other in zip(*files, strict=True):
        assert one.name == other.name
        if one.suffix != ".yaml":
            assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("count", [23, 399])
def test_exchanges_come_with_the_poses_that_they_need(timed, monkeypatch, count):
    monkeypatch.setattr(Recording, "exchange_blocks", partialmethod(Recording.exchange_blocks, count))
    with Recording.open(timed) as recording:
        x, poses = recording.exchanges(), recording.poses()
        parts = [
            distances_m(around, TAGS, part.initiator, part.target, part.time_ns)
            for part, around in exchanges_with_poses(recording)
        ]
    assert len(parts) >= COUNT // count
    np.testing.assert_array_equal(np.concatenate(parts), distances_m(poses, TAGS, x.initiator, x.target, x.time_ns))


def test_a_recording_without_exchanges_has_no_stretches(tmp_path):
    with Recording.create(tmp_path / "empty.uwb") as recording:
        assert recording.dividing_times("exchanges", 50) == []
    with Recording.open(tmp_path / "empty.uwb") as recording:
        assert recording.show().span_s == 0.0


# True distances from poses and lever arms.


LEVEL = (0, 0, 0, 1)
YAW_90 = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
NEGATED = tuple(-q for q in YAW_90)


@pytest.mark.parametrize(
    ("begin", "end", "stands", "time_ns", "expected"),
    [
        # At half of the time, body a is at (1, 0, 0), and its arm, rotated by 90 degrees, points along y.
        (((0, 0, 0), YAW_90), ((2, 0, 0), YAW_90), (1, 4, 0), 50, 3.0),
        (((0, 0, 0), YAW_90), ((0, 0, 0), NEGATED), (0, 4, 0), 50, 3.0),
        (((0, 0, 0), LEVEL), ((0, 0, 0), LEVEL), (0, 4, 0), -1, np.nan),
        (((0, 0, 0), LEVEL), ((0, 0, 0), LEVEL), (0, 4, 0), 101, np.nan),
    ],
    ids=["between poses", "both signs of a quaternion", "before the poses", "after the poses"],
)
def test_distances_are_those_of_antennas_on_their_way(begin, end, stands, time_ns, expected):
    position, quaternion = zip(begin, end, (stands, LEVEL), strict=True)
    poses = Poses.from_arrays([0, 100, 0], ["a", "a", "b"], position, quaternion)
    tags = [Tag(1, "a", (1.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))]
    (found,) = distances_m(poses, tags, np.array([1]), np.array([2]), np.array([time_ns]))
    assert found == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("step_m", "stands"), [(0.1, False), (0.0, True)])
def test_positions_in_gaps_of_poses_are_unknown(step_m, stands):
    seconds = np.r_[0:2:0.1, 5:7:0.1]
    poses = Poses.from_arrays(
        [*(seconds * 1e9).astype(int), 0],
        ["a"] * len(seconds) + ["b"],
        [*((step_m * k, 0, 0) for k in range(len(seconds))), (0, 4, 0)],
    )
    tags, ones = [Tag(1, "a", (0.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))], np.ones(4, np.int64)
    at_ns = np.array([1_500_000_000, 1_950_000_000, 3_000_000_000, 6_000_000_000])
    for some in (poses, poses_around(tracks_of(poses), 2_500_000_000, 3_500_000_000)):
        lost = ~np.isfinite(distances_m(some, tags, ones, 2 * ones, at_ns))
        assert lost[1:3].tolist() == [not stands] * 2
    assert np.isfinite(distances_m(poses, tags, ones, 2 * ones, at_ns))[[0, 3]].all()
