"""Contents of recordings: copies, parts, pieces, distances, and the summary."""

import io
from dataclasses import replace
from functools import partial, partialmethod
from typing import Any

import duckdb
import numpy as np
import pytest
from rich.console import Console

import calib
import uwblink
from tests.boards import bench_scenario, record_bench
from tests.uwblink.recording.test_file import random_exchanges
from uwblink import Arrangement, Contents, Exchanges, KnownDistance, Poses, Recording, Tag, errors, exporters, load
from uwblink.boards.listeners import ReportCheck
from uwblink.cli.commands import print_summary
from uwblink.recording.contents import exchanges_with_poses, pieces
from uwblink.recording.distances import distances_m, poses_around, tracks_of
from uwblink.recording.schema import TABLES, CirRow, Fault, FrameRow
from uwblink.recording.summary import (
    clock_skews,
    differences,
    failures_by_pair,
    single_reports,
    skew_summary,
    summarize,
)
from uwblink.twr import COLUMNS, STAMPS
from uwblink.wire.messages import RangeReport, TargetRangeReport
from uwbsim import VirtualPorts

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
        r.append("exchanges", random_exchanges())
        r.append("tags", [Tag(3, "b", (0.1, 0.2, 0.3)), Tag(1, "a", (0, 0, 0))])
        r.append("poses", Poses(np.array([6, 5]), np.array(["a", "b"]), np.ones((2, 3)), np.zeros((2, 4))))
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


def copy(source, path, instead=None):
    """Write a copy of a recording with other contents of some tables."""
    with source.copying(path, without=instead or ()) as written:
        for table, found in (instead or {}).items():
            written.append(table, found)


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
        copy(source, tmp_path / "copy.uwb")
    before, after = rows(full), rows(tmp_path / "copy.uwb")
    assert all(before.values()), "the test needs rows in every table"
    assert after == before


@pytest.mark.parametrize("first", range(4))
def test_only_replaced_tables_differ(full, tmp_path, first):
    """Every fourth table is replaced: each table is replaced once."""
    instead = {table: INSTEAD[table] for table in list(INSTEAD)[first::4]}
    with Recording.open(full) as source:
        copy(source, tmp_path / "copy.uwb", instead)
    expected, found = rows(full), rows(tmp_path / "copy.uwb")
    assert {table for table in TABLES if found[table] != expected[table]} == instead.keys()
    for table, given in instead.items():
        assert len(found[table]) == len(given["time_ns"] if isinstance(given, dict) else given), table


def test_entries_of_meta_are_added_or_replaced(full, tmp_path):
    with Recording.open(full) as source:
        with source.copying(tmp_path / "more.uwb", meta={"seed": 8, "calibration": {"x": 1}}):
            pass
        with source.copying(tmp_path / "other.uwb", without=["meta"], meta={"note": "bare"}):
            pass
        before = source.meta()
    more, other = (load(tmp_path / name).meta for name in ("more.uwb", "other.uwb"))
    assert more == before | {"seed": 8, "calibration": {"x": 1}}
    assert (other["note"], {"seed", "planted"} & set(other)) == ("bare", set())


def test_mistakes_are_one_line_and_leave_nothing(full, tmp_path):
    with Recording.open(full) as source:
        with pytest.raises(errors.RecordingError, match="no table 'ranges' in a recording; there are meta, tags"):
            copy(source, tmp_path / "copy.uwb", {"ranges": []})
        with pytest.raises(errors.RecordingExistsError):
            copy(source, full)
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


# The summary of a recording by `uwblink show`: what it counts and prints, clock skews, and the reports of both ends.


@pytest.fixture
def summary(tmp_path):
    with uwblink.Recording.create(tmp_path / "f.uwb", meta={"note": "[bold]x[/] \x1b[31m", "scenario": "long"}) as r:
        r.append("exchanges", random_exchanges(50))
        r.append("tags", [uwblink.Tag(3, "b", (0.1, 0.2, 0.3))])
        r.append("faults", [Fault(9, "1", "time-out", "no answer"), Fault(10, "1", "time-out", "")])
    with uwblink.Recording.open(tmp_path / "f.uwb") as r:
        return r.show()


def test_counts_add_up(summary):
    by_pair, by_protocol = sum(p.exchanges for p in summary.pairs), sum(summary.protocols.values())
    assert (summary.counts["exchanges"], by_pair, by_protocol, summary.faults) == (50, 50, 50, {"time-out": 2})
    assert summary.to_dict()["tags"] == [{"tag": 3, "body": "b", "lever_arm_m": [0.1, 0.2, 0.3]}]


def test_printed_text_from_a_file_cannot_format_or_steer_the_terminal(summary):
    out = io.StringIO()
    print_summary(summary, Console(file=out, width=100, force_terminal=True, color_system=None))
    assert ("[bold]x[/]" in out.getvalue(), "\x1b[31m" in out.getvalue()) == (True, False)


def test_a_summary_fits_on_a_screen_and_cannot_steer_it(tmp_path):
    tags = [uwblink.Tag(k, "\x1b[31m" + "b" * 200, (0.0, 0.0, 0.0)) for k in range(40)]
    faults = [Fault(k, "1", f"kind {k}" * 10, "", 1, 2) for k in range(40)]
    uwblink.Contents(exchanges=random_exchanges(500), tags=tags, faults=faults).save(tmp_path / "\x1b[2J.uwb")
    with uwblink.Recording.open(tmp_path / "\x1b[2J.uwb") as r:
        summary = r.show()
    text, html = str(summary), summary._repr_html_()
    lines = text.splitlines()
    assert (len(lines) <= 24, max(map(len, lines)) <= 79, "500 exchanges in" in lines[0]) == (True, True, True), text
    assert ("\x1b" in text + html, repr(summary) == text, "<td>" in html) == (False, True, True)


def test_failures_are_counted_by_the_ends_of_the_exchange_whatever_the_text_says():
    faults = [
        Fault(1, "7", "time-out", "anything at all", 7, 8),
        Fault(2, "7", "failed exchange", "nothing of the kind", 7, 8),
        Fault(3, "8", "failed exchange", "", 8, 7),
        Fault(4, "9", "garbage", "9 ranged with 8: message 1 lost; ranging with 8 failed"),
    ]
    assert failures_by_pair(faults) == {(7, 8): 2, (8, 7): 1}


# Clock skews of planted clocks, by stamps and by carriers.


TICKS = 128 * 499.2e6
SKEW_PPM = {1: 0.0, 2: 6.0, 3: -2.5}


def ranged(protocol, sign=1.0, carriers=True, warmer_ppm=0.0):
    """Return ranges of 3 m in both directions in every pair; a stamp is its true time by its own clock."""
    pairs = np.array([(1, 2), (2, 1), (1, 3), (3, 1), (2, 3), (3, 2)] * 20)
    first, second = pairs.T
    begin = 1e-3 * np.arange(len(pairs))
    fast = np.array([0.0] + [SKEW_PPM[tag] + warmer_ppm * (tag == 3) for tag in (1, 2, 3)])

    def stamp(tag, after):
        return np.rint((begin + after) * (1 + fast[tag] * 1e-6) * TICKS).astype(np.int64)

    ends = [first, second, second, first, *((second, first) if protocol == "ds" else (first, second))]
    after_s = (0, 1e-8, 3e-4, 3e-4 + 1e-8, 2e-3, 2e-3 + 1e-8)
    columns = {name: stamp(tag, after) % 2**32 for name, tag, after in zip(STAMPS, ends, after_s, strict=True)}
    relative = fast[second] - fast[first]
    skews = {"skew1_ppm": sign * relative, "skew2_ppm": -sign * relative} if carriers else {}
    return uwblink.Exchanges.from_arrays(first, second, **columns, **skews, protocol=np.full(len(pairs), protocol))


@pytest.mark.parametrize(
    ("protocol", "sign", "said"),
    [
        ("ds", 1, "carriers over stamps 1.000, residual 0.00 ppm, same sign"),
        ("ds-alt", 1, "carriers over stamps 1.000, residual 0.00 ppm, same sign"),
        ("ds", -1, "OTHER SIGN in 3 of 3 pairs"),
    ],
)
def test_stamps_and_carriers_give_the_planted_skews(protocol, sign, said):
    found = {one.pair: one for one in clock_skews(ranged(protocol, sign))}
    assert sorted(found) == ["1-2", "1-3", "2-3"]
    for pair, planted in {"1-2": 6.0, "1-3": -2.5, "2-3": -8.5}.items():
        one = found[pair]
        # A tick in two milliseconds is 0.008 ppm.
        assert (one.stamps_ppm, one.slope) == pytest.approx((planted, sign), abs=0.01)
        assert (one.carrier_ppm, one.residual_ppm) == pytest.approx((sign * planted, 0), abs=1e-9)
        assert one.same_sign is (sign == 1)
    assert said in skew_summary(list(found.values()))


def test_carriers_without_readings_are_left_out():
    (first, *_) = clock_skews(ranged("ds", carriers=False))
    assert (first.carrier_ppm, first.slope, first.same_sign) == (None, None, None)
    assert str(first) == "pair 1-2: +6.00 ppm by the stamps, drift +0.00, carriers not read"


def test_drifting_clocks_appear_in_their_pairs():
    drifts = [one.drift_ppm for one in clock_skews([ranged("ds"), ranged("ds", warmer_ppm=1.5)])]
    assert drifts == pytest.approx([0.0, 1.5, 1.5], abs=0.01)


def test_single_sided_exchanges_have_no_skews():
    e = ranged("ds")
    columns = {name: getattr(e, name) for name in ("tx1", "rx1", "tx2", "rx2")}
    assert clock_skews(uwblink.Exchanges.from_arrays(e.initiator, e.target, **columns)) == []


# An exchange is counted once, whoever reported it.


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The same 2.5 seconds of three boards, with and without reports of targets."""
    folder = tmp_path_factory.mktemp("reports")
    for name, target_reports in (("both", True), ("one", False)):
        plan = uwblink.RangingPlan(rate_hz=60.0, target_reports=target_reports)
        lossy = VirtualPorts(bench_scenario(), lost_share=0.1)
        record_bench(folder / f"{name}.board.uwb", plan, lossy, duration_s=2.5)
        exchanges = uwblink.load(folder / f"{name}.board.uwb").exchanges
        assert len(exchanges) > 100
        measured = replace(exchanges, truth_m=np.full(len(exchanges), 3.0))
        rewritten(folder / f"{name}.board.uwb", folder / f"{name}.uwb", measured)
    return folder


def rewritten(source, output, exchanges):
    with uwblink.Recording.open(source) as recording:
        copy(recording, output, {"exchanges": exchanges})


@pytest.fixture(scope="module")
def exchanges(both):
    return uwblink.load(both / "both.uwb").exchanges


def test_show_calibration_and_doctor_count_each_exchange_once(both, exchanges):
    count = len(set(zip(exchanges.tx1.tolist(), exchanges.rx2.tolist(), strict=True)))
    with uwblink.Recording.open(both / "both.uwb") as recording:
        summary = summarize(recording)
        failed = sum("failed" in fault.kind for fault in recording.faults())
    assert summary.counts["exchanges"] == sum(p.exchanges for p in summary.pairs) == count
    assert sum(p.failed for p in summary.pairs) == failed > 0
    assert summary.reported_twice == len(exchanges) - count > 75
    assert summary.contradictory == 0
    assert len(calib.load_ranges(both / "both.uwb")) == count
    assert not any("contradicting" in finding.fault for finding in calib.examine(both / "both.uwb"))
    kept = single_reports(exchanges).exchanges
    assert np.all(kept.reporter == kept.initiator), "every target's report follows one of the initiator's"
    one = uwblink.load(both / "one.uwb").exchanges
    assert single_reports(one).exchanges is one


def test_target_reports_replace_missing_initiator_reports(exchanges):
    first = np.argmax(exchanges.reporter == exchanges.target)
    twin = (exchanges.tx1 == exchanges.tx1[first]) & (exchanges.reporter == exchanges.initiator)
    found = single_reports(exchanges[~twin])
    assert len(found.exchanges) == len(single_reports(exchanges).exchanges)
    assert np.count_nonzero(found.exchanges.reporter == found.exchanges.target) == 1


@pytest.mark.parametrize("name", ["range_m", "tx1", "tx2", "rx3", "skew2_ppm"])
def test_differences_of_reports_are_found_in_all_columns(exchanges, name):
    row = np.flatnonzero(exchanges.reporter == exchanges.target)[7]
    column = getattr(exchanges, name) + (np.arange(len(exchanges)) == row)
    changed = replace(exchanges, **{name: column})
    ((first, second),) = single_reports(changed).differing
    said = [f"{name} {column[first]} and {column[row]}"]
    assert (second, differences(changed, first, second)) == (row, said)


def test_equal_stamps_of_another_time_are_another_exchange(exchanges):
    once = single_reports(exchanges).exchanges
    later = replace(once, reporter=once.target, time_ns=once.time_ns + 70_000_000)
    columns: dict[str, Any] = {n: np.concatenate([getattr(once, n), getattr(later, n)]) for n in COLUMNS}
    assert single_reports(replace(once, **columns)).repeated == 0


def test_the_doctor_names_reports_that_contradict_each_other(both, exchanges, tmp_path):
    path = tmp_path / "f.uwb"
    wrong = (exchanges.reporter == exchanges.target) & (exchanges.initiator == 1)
    rewritten(both / "both.uwb", path, replace(exchanges, range_m=exchanges.range_m + wrong))
    with uwblink.Recording.open(path) as recording:
        assert recording.show().contradictory == np.count_nonzero(wrong)
    assert "the first: range_m" in next(f for f in calib.examine(path) if f.fault == "contradicting reports").evidence


REPORT = RangeReport(2, 3.0, 100, 200, 300, 400, 500, 600, -80.0, -81.0, 1.0, -1.0)


def as_target(report, **changes):
    return TargetRangeReport(**{n: getattr(report, n) for n in RangeReport.FIELDS} | {"neighbour": 1} | changes)


def test_a_recorder_compares_the_two_reports_as_they_come():
    check = ReportCheck()
    told = "boards 1 and 2 report one exchange of 1 with 2 differently: range_m 3.0 and 3.5, rx3 600 and 601"
    # The report of a lost exchange is not compared with that of the next one.
    later = RangeReport(2, 3.1, 107, 207, 307, 407, 507, 607, -80.0, -81.0, 1.0, -1.0)
    for board, report, expected in (
        (1, REPORT, None),
        (2, as_target(REPORT), None),
        (1, REPORT, None),
        (2, as_target(REPORT, range_m=3.5, rx3=601), told),
        (1, REPORT, None),
        (2, as_target(later), None),
        (1, later, None),
    ):
        assert check.add(board, report) == expected
