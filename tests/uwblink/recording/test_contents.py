"""A whole recording in memory: everything comes in, parts can be cut out, and everything goes out again."""

import numpy as np
import pytest

from tests.uwblink.recording.test_copy import full, rows  # noqa: F401 - a fixture
from uwblink.errors import ArgumentError, RecordingExistsError
from uwblink.recording.contents import Contents, load
from uwblink.recording.schema import TABLES, CirRow, Fault, FrameRow, Poses, Tag
from uwblink.twr import COLUMNS, Exchanges

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def made():
    """Ten seconds of exchanges between 1, 2 and 3, one a second in turn; a moving body and one that stands still."""
    pairs = [(1, 2), (2, 3), (3, 1)] * 4
    initiator, target = np.array(pairs[:10]).T
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


def test_what_is_loaded_and_saved_is_the_same(full, tmp_path):  # noqa: F811
    load(full).save(tmp_path / "again.uwb")
    before, after = rows(full), rows(tmp_path / "again.uwb")
    for table in set(TABLES) - {"exchanges"}:  # in which the fixture leaves values out
        assert sorted(after[table]) == sorted(before[table]), table
    assert {table: len(found) for table, found in after.items()} == {
        table: len(found) for table, found in before.items()
    }
    one, other = load(full), load(tmp_path / "again.uwb")
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one.exchanges, name), getattr(other.exchanges, name))
    for name in ("cirs", "frames", "faults", "tags"):  # as text, because NaN differs from itself
        assert repr(getattr(one, name)) == repr(getattr(other, name)), name
    assert one.meta == other.meta


def test_exchanges_alone_make_a_recording(tmp_path):
    x = Exchanges.from_arrays([1], [2], tx1=[2**39], rx1=[5], tx2=[1005], rx2=[2**39 + 3000], bits=40)
    Contents(exchanges=x).save(tmp_path / "x.uwb")
    again = load(tmp_path / "x.uwb")
    assert again.exchanges.bits == 40
    np.testing.assert_array_equal(again.exchanges.range_m, x.range_m)
    with pytest.raises(RecordingExistsError):
        again.save(tmp_path / "x.uwb")
    again.save(tmp_path / "x.uwb", force=True)


def test_a_span_of_time_is_cut_out_with_the_poses_that_it_needs():
    part = made().select(start_s=2.25, stop_s=5)
    assert ((part.exchanges.time_ns - START) / SECOND).tolist() == [3, 4]
    assert part.overheard["time_ns"].tolist() == part.exchanges.time_ns.tolist()
    assert [(row.time_ns - START) / SECOND for row in part.cirs] == [3, 4]
    assert [(row.time_ns - START) / SECOND for row in part.frames] == [3, 4]
    assert [(row.time_ns - START) / SECOND for row in part.faults] == [3, 4]
    # From the pose before the span to the one at its end; the mast's only pose says where it always is.
    drone = part.poses[part.poses.body == "drone"]
    assert ((drone.time_ns - START) / SECOND).tolist() == [2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0]
    assert np.count_nonzero(part.poses.body == "mast") == 1
    assert part.meta == {"place": "hall", "selected": {"start_s": 2.25, "stop_s": 5}}
    assert len(part.tags) == 3


def test_tags_and_pairs_are_cut_out():
    whole = made()
    two = whole.select(tags=[1, 2])
    assert set(zip(two.exchanges.initiator.tolist(), two.exchanges.target.tolist(), strict=True)) == {(1, 2)}
    assert len(two.cirs) == len(two.overheard["time_ns"]) == len(two.exchanges) == 4
    assert len(whole.select(pairs=[(1, 3)]).exchanges) == 0
    assert len(whole.select(pairs=[(3, 1), (2, 3)], stop_s=4).exchanges) == 2
    assert len(whole.select(pairs=[]).exchanges) == 0
    assert len(whole.select().exchanges) == 10


def test_a_part_of_a_part_can_be_written(tmp_path):
    made().select(start_s=1).select(tags=[2, 3]).save(tmp_path / "part.uwb")
    assert load(tmp_path / "part.uwb").meta["selected"] == {"tags": [2, 3]}


def test_it_prints_itself_on_a_screen():
    whole = made()
    assert repr(whole).splitlines()[0] == "3 tags on drone, mast; poses 21, overheard 10, cirs 10, frames 10, faults 10"
    assert len(repr(whole).splitlines()) <= 13
    assert "<table>" in whole._repr_html_()


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
def test_what_cannot_be_selected_says_so(wrong, expected):
    with pytest.raises(ArgumentError, match=expected):
        made().select(**wrong)
