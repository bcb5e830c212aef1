"""Bags with topics of ranges: guessed and imported without other files, and notes on their poses."""

import json
import sqlite3
from contextlib import closing, suppress

import numpy as np
import pytest

from tests import processes
from tests.errors import one_line
from tests.uwblink.importers.test_exchange_bags import TICK_M, header, ros1, ros2, store_of
from tests.uwblink.importers.test_forms import PLANT, ROUNDS
from uwblink.errors import ImportTableError
from uwblink.exporters import export_recording
from uwblink.importers import read_source
from uwblink.importers.guess import guess_map
from uwblink.recording.contents import Contents, load
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import Exchanges

pytest.importorskip("rosbags", reason="the extra uwbcal[bags] is not installed")
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg

START = 1_706_822_508_000_000_000
RANGE, NUMBER, TEXT = "sensor_msgs/msg/Range", "std_msgs/msg/Float32", "std_msgs/msg/String"
MINE, POSE = "uwb_msgs/msg/Mine", "geometry_msgs/msg/PoseStamped"
HEADER, STAMPED = "std_msgs/Header header\n", "uwb_msgs/msg/Stamped"


@pytest.fixture(autouse=True)
def own_types(monkeypatch):
    """Two more message types, in addition to those of bags with exchanges."""

    def with_more(kind):
        store = store_of(kind)
        store.register(
            get_types_from_msg("std_msgs/Header header\nstring dest\nfloat32 range_mm\nfloat32 rssi\n", MINE)
        )
        ids, stamps = "uint16 src\nuint16 dst\n", "".join(f"uint64 {n}\n" for n in ("tx1", "rx1", "tx2", "rx2"))
        store.register(get_types_from_msg(f"{HEADER}{ids}{stamps}", STAMPED))
        return store

    monkeypatch.setattr("tests.uwblink.importers.test_exchange_bags.store_of", with_more)


def by_map(tmp_path, bag, text):
    """Return the result of an import with a map of this text."""
    (tmp_path / "map.toml").write_text(text)
    return read_source(bag, importer="bag", map_file=tmp_path / "map.toml")


def by_guess(tmp_path, bag, asked=()):
    """Return the result of an import by the guess, with 7 as the answer to its questions."""
    guess = guess_map(bag)
    assert (guess.complete, guess.asked) == (True, asked), guess.text
    return by_map(tmp_path, bag, guess.text.replace('= "?"', "= 7"))


def ends(found):
    """Return initiator and target of each exchange, by their names if they have any."""
    named = found.meta.get("tag_names", {})
    pairs = zip(found.exchanges.initiator.tolist(), found.exchanges.target.tolist(), strict=True)
    return [tuple(named.get(str(tag), tag) for tag in pair) for pair in pairs]


def when(r):
    return START + round(r.time_s * 1e9)


def of_anchor(anchor, make):
    """Return a function that yields a message per planted range to an anchor, given its store and the first header
    fields.
    """

    def messages(store, first):
        for r in PLANT:
            if anchor in (None, r.anchor):
                yield when(r), make(store.types, header(store, when(r), *first), r)

    return messages


def as_range(types, head, r):
    return types[RANGE](head, 0, 0.1, 0.0, 300.0, r.range_m, 0.0)


def as_number(types, _, r):
    return types[NUMBER](r.range_m)


def as_mine(types, head, r):
    return types[MINE](head, str(r.anchor), 1000 * r.range_m, r.power_dbm)


def as_text(types, _, r):
    return types[TEXT](json.dumps({"anchor": r.anchor, "range": r.range_m, "rssi": r.power_dbm}))


def as_stamped(types, head, r):
    ticks, tx1 = round(r.range_m / TICK_M), 10**9 + 10**7 * round(4 * r.time_s) + 10**5 * r.anchor
    return types[STAMPED](head, 7, r.anchor, tx1, tx1 + ticks, tx1 + ticks + 10**5, tx1 + 2 * ticks + 10**5)


def as_array(types, _, values):
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return types["std_msgs/msg/Float32MultiArray"](layout, np.array(values, np.float32))


def rounds(store, _):
    for some in ROUNDS:
        yield when(some[0]), as_array(store.types, None, [r.range_m for r in some])


def lists(store, first):
    one, whole = store.types["uwb_msgs/msg/Range"], store.types["uwb_msgs/msg/Ranges"]
    for some in ROUNDS:
        found = [one(str(r.anchor), r.range_m, r.power_dbm) for r in some]
        yield when(some[0]), whole(header(store, when(some[0]), *first), found)


def posed(store, first):
    types = store.types
    for k in range(60):
        place = types["geometry_msgs/msg/Point"](k / 60, 0.0, 0.0)
        pose = types["geometry_msgs/msg/Pose"](place, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
        yield START + k * 10**9, types[POSE](header(store, START + k * 10**9, *first), pose)


def by_anchor(name, kind, make):
    return {name.format(a): (kind, of_anchor(a, make)) for a in range(4)}


HEIGHT = {"/height/drone": (RANGE, of_anchor(0, as_range)), "/drone/status": (TEXT, lambda *_: ())}
POSES = {"/vrpn_mocap/drone/pose": (POSE, posed)}
RANGES = by_anchor("/uwb/tag7/range_{}", RANGE, as_range)
NUMBERS = by_anchor("/tag7/uwb_anchor{}", NUMBER, as_number)
FORMS = {
    "Range by anchor": (ros2, RANGES | HEIGHT | POSES, "/uwb/tag7/range_{to_id}", ()),
    "Range in ROS 1": (ros1, RANGES, "/uwb/tag7/range_{to_id}", ()),
    "Range without a tag": (ros2, by_anchor("/range/{}", RANGE, as_range), "/range/{to_id}", ("from_id",)),
    "numbers": (ros2, NUMBERS, "/tag7/uwb_anchor{to_id}", ()),
    "an array": (ros2, {"/uwb/ranges": ("std_msgs/msg/Float32MultiArray", rounds)}, "/uwb/ranges", ("from_id",)),
    "lists": (ros2, {"/tag7/uwb": ("uwb_msgs/msg/Ranges", lists)} | POSES, "/tag7/uwb", ()),
    "fields in mm": (ros1, {"/tag7/uwb": (MINE, of_anchor(None, as_mine))}, "/tag7/uwb", ()),
    "fields, and Range": (ros2, {"/tag7/uwb": (MINE, of_anchor(None, as_mine))} | RANGES, "/tag7/uwb", ()),
    "fields without a tag, and Range": (ros2, {"/u": (MINE, of_anchor(None, as_mine))} | RANGES, "/u", ("from_id",)),
    "JSON": (ros2, {"/tag7/uwb": (TEXT, of_anchor(None, as_text))} | HEIGHT, "/tag7/uwb", ()),
    "stamps, and Range": (ros2, {"/uwb": (STAMPED, of_anchor(None, as_stamped))} | RANGES, "/uwb", ()),
}


RARER = ("Range in ROS 1", "Range without a tag", "numbers", "fields, and Range")
"""Forms whose variants are read in every run, here or by another test of this folder."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in RARER)) for name in FORMS])
def test_ranges_of_a_bag_come_in_by_its_guess(tmp_path, name):
    write, topics, template, asked = FORMS[name]
    found = by_guess(tmp_path, write(tmp_path / ("b.bag" if write is ros1 else "b"), topics), asked)
    text = (tmp_path / "map.toml").read_text()
    assert f"[topics.{json.dumps(template)}]\n" in text
    assert "header.stamp" not in text, "the time of a message is used"
    e = found.exchanges
    e = e[np.lexsort((e.target, e.time_ns))]
    expected = [(7, r.anchor, when(r)) for r in PLANT]
    assert list(zip(e.initiator.tolist(), e.target.tolist(), e.time_ns.tolist(), strict=True)) == expected
    # Half a tick, or floats of 32 bits.
    np.testing.assert_allclose(e.range_m, [r.range_m for r in PLANT], atol=0.0024 if "stamps" in name else 1e-6)
    powers = [r.power_dbm if name.startswith(("fields", "lists", "JSON")) else np.nan for r in PLANT]
    np.testing.assert_allclose(e.fpp2_dbm, powers, atol=1e-5)


def test_both_ids_in_names_of_topics_may_be_words(tmp_path):
    """Number 1 of a drone differs from number 1 of an anchor; a topic of another form is left out."""
    pairs = [("drone1", "1"), ("drone2", "1"), ("drone1", "2"), ("drone2", "2")]
    for template, name in (
        ("/{from_id}/range_{to_id}", "/{}/range_anchor{}"),
        ("/to_{to_id}/{from_id}", "/to_{1}/{0}"),
    ):
        topics = {name.format(*pair): (RANGE, of_anchor(k, as_range)) for k, pair in enumerate(pairs)}
        bag = ros2(tmp_path / template.replace("/", "_"), topics | HEIGHT)
        assert f"[topics.{json.dumps(template)}]\n" in guess_map(bag).text
        got = ends(by_guess(tmp_path, bag))
        assert ({(one, str(other)[-1]) for one, other in got}, len(got)) == (set(pairs), len(PLANT))


def test_ids_in_names_of_topics_complete_those_in_messages(tmp_path):
    """Or the id in the names; an id of a robot differs from an id of the anchors in its messages."""
    topics = {f"/robot{k}/uwb": (MINE, of_anchor(k, as_mine)) for k in range(4)}
    found = by_guess(tmp_path, ros2(tmp_path / "fields", topics))
    assert set(ends(found)) == {(f"robot{k}", k) for k in range(4)}
    bag = ros2(tmp_path / "range", by_anchor("/tag1{}/range", RANGE, as_range))
    assert set(ends(by_guess(tmp_path, bag, ("to_id",)))) == {(10, 7), (11, 7), (12, 7), (13, 7)}


def test_topics_that_other_types_resemble_are_listed_with_their_ids(tmp_path):
    topics = {
        f"/uwb/{a}/{b}": (RANGE, of_anchor(k, as_range))
        for k, (a, b) in enumerate([("a", "c"), ("a", "d"), ("b", "c"), ("b", "d")])
    }
    bag = ros2(tmp_path / "b", topics | {"/uwb/a/status": (TEXT, lambda *_: ())})
    assert '[topics."/uwb/b/c"]\nfrom_id = "b"\nto_id = "c"\n' in guess_map(bag).text
    found = by_guess(tmp_path, bag)
    assert found.meta["tag_names"] == {"1": "a", "2": "b", "3": "c", "4": "d"}
    assert len(found.exchanges) == len(PLANT)


NO_TOPIC = r"no topic '/uwb/.*there are /uwb/tag7/b/range_9 \(sensor_msgs"


def test_a_template_of_topics_in_a_map(tmp_path):
    """A placeholder is a part of a name, and the constant of a topic has priority over that of a template."""
    bag = ros2(tmp_path / "b", RANGES | {"/uwb/tag7/b/range_9": (RANGE, of_anchor(0, as_range))})
    text = '[topics."/uwb/tag{from_id}/range_{to_id}"]\nfpp2 = -80\n[topics."/uwb/tag7/range_2"]\nfpp2 = -90\n'
    e = by_map(tmp_path, bag, text + '[columns]\nrange_m = "range"\n').exchanges
    assert len(e) == len(PLANT)
    assert set(zip(e.target.tolist(), e.fpp2_dbm.tolist(), strict=True)) == {(0, -80), (1, -80), (2, -90), (3, -80)}
    for topic, keys, said in (
        ("/uwb/{from_id}/none_{to_id}", "", NO_TOPIC),
        ("/uwb/{to_id}/range_{to_id}", "", NO_TOPIC),
        ("/uwb/{to_id", "", NO_TOPIC),
        ("/uwb/tag{from_id}/range_{to_id}", "fpp9 = 3\n", r"topics\./uwb/tag.*fpp9"),
    ):
        with pytest.raises(ImportTableError, match=said):
            by_map(tmp_path, bag, f'[topics."{topic}"]\n{keys}')


@pytest.fixture
def recorded(tmp_path):
    """A recording of two pairs with powers, and one moving body, in simulated time."""
    n, random = 60, np.random.default_rng(5)
    tx1, flight = np.arange(n) * 10**7, random.integers(100, 3000, n)
    e = Exchanges.from_arrays(
        np.where(np.arange(n) % 2, 1, 3), np.full(n, 2), time_ns=10**9 + np.arange(n) * 10**8,
        tx1=tx1, rx1=tx1 + flight, tx2=tx1 + flight + 10**6, rx2=tx1 + 2 * flight + 10**6,
        fpp1_dbm=random.normal(-85, 3, n), fpp2_dbm=np.where(np.arange(n) < 30, np.nan, -84.5),
        skew1_ppm=random.normal(size=n),
    )  # fmt: skip
    places = np.column_stack([np.arange(n) / 10, np.zeros((n, 2))])
    poses = Poses(e.time_ns, np.full(n, "drone"), places, np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
    held = Contents(exchanges=e, poses=poses, tags=[Tag(k, f"tag{k}", (0.0, 0.0, 0.0)) for k in (1, 2, 3)])
    held.save(tmp_path / "r.uwb")
    return held


@pytest.mark.parametrize("to", ["rosbag2", pytest.param("mcap", marks=pytest.mark.slow)])
def test_our_own_bags_come_in_without_a_map_and_with_powers(tmp_path, recorded, to):
    export_recording(tmp_path / "r.uwb", tmp_path / "out", to=to)
    bag = tmp_path / "out" / ("rosbag2" if to == "rosbag2" else "recording.mcap")
    found = read_source(bag, importer="bag").exchanges
    for name in ("time_ns", "initiator", "target", "range_m", "truth_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm"):
        np.testing.assert_array_equal(getattr(found, name), getattr(recorded.exchanges, name), err_msg=name)
    e = by_guess(tmp_path, bag).exchanges
    np.testing.assert_array_equal([e.time_ns, e.fpp1_dbm], [found.time_ns, found.fpp1_dbm])


def test_topics_named_as_ours_need_no_map(tmp_path):
    bag = ros2(tmp_path / "b", by_anchor("/uwb/range_7_{}", RANGE, as_range) | HEIGHT | POSES)
    assert sorted(ends(read_source(bag, importer="bag"))) == sorted((7, r.anchor) for r in PLANT)


GUESS = ("uwblink", "import", "guess")


def test_the_commands_end_with_true_distances(tmp_path):
    """Each command is the one that the previous command printed."""
    ros2(tmp_path / "b", RANGES | HEIGHT | POSES)
    anchors = "".join(f"[[anchors]]\nid = {a}\nposition_m = [{a}, 2, 0]\n" for a in range(4))
    (tmp_path / "TAGS.toml").write_text(f'[[tags]]\nid = 7\nbody = "drone"\nlever_arm_m = [0, 0, 0]\n{anchors}')
    said = processes.succeed(*GUESS, "b", "-o", "map.toml", cwd=tmp_path).stdout.splitlines()
    command = said[0].partition(", then ")[2]
    assert command == "uwblink import bag b --map map.toml -o b.uwb"
    imported = processes.succeed(*command.split(), cwd=tmp_path).stdout.splitlines()
    assert imported[-1] == said[1], "both name the poses of the bag"
    assert '"/vrpn_mocap/drone/pose"' in said[1]
    command = said[1].partition(": ")[2].partition(" (")[0]
    processes.succeed(*command.split(), cwd=tmp_path)
    assert set(load(tmp_path / "b.uwb").poses.body) == {"drone", "anchor0", "anchor1", "anchor2", "anchor3"}


def test_without_poses_the_command_prints_possible_commands(tmp_path):
    ros2(tmp_path / "b", RANGES)
    said = processes.succeed(*GUESS, "b", "-o", "map.toml", cwd=tmp_path).stdout
    assert all(words in said for words in ("calib survey", "fit_from_ranges", "constants of pairs need true"))
    assert said.splitlines()[1] in (tmp_path / "map.toml").read_text()
    said = processes.succeed("uwblink", "import", "bag", "b", "--map", "map.toml", "-o", "b.uwb", cwd=tmp_path).stdout
    assert "poses" not in said


def test_bags_without_ranges_are_refused_with_their_topics(tmp_path):
    ros2(tmp_path / "b", POSES | HEIGHT)
    naming = ["/vrpn_mocap/drone/pose", "geometry_msgs/msg/PoseStamped", "/height/drone"]
    processes.refuse(*GUESS, "b", "-o", "map.toml", naming=naming, cwd=tmp_path)
    assert not (tmp_path / "map.toml").exists()
    (tmp_path / "t.bag").write_bytes(b"#ROSBAG V2.0\nno more")
    processes.refuse(*GUESS, "t.bag", naming=["t.bag", "cannot be read as a bag"], cwd=tmp_path)


def test_types_that_a_bag_does_not_define_leave_the_others(tmp_path):
    for name, topics in {"both": NUMBERS, "one": {}}.items():
        more = {"/px4/status": (MINE, of_anchor(None, as_mine))}
        bag = ros2(tmp_path / name, topics | more, StoragePlugin.SQLITE3)
        with closing(sqlite3.connect(bag / f"{name}.db3")) as db, db:
            db.execute("DELETE FROM message_definitions")
    assert len(by_guess(tmp_path, tmp_path / "both").exchanges) == len(PLANT)
    with pytest.raises(ImportTableError, match=r"one: .*/px4/status.* has no definition of uwb_msgs/msg/Mine; convert"):
        guess_map(bag)


TEXTS = ["[" * 100_000, '{"a":' * 700 + "1" + "}" * 700, "[1, 2]", '{"ranges": [1, {"x": 3}]}', '{"0": {"0": []}}']


@pytest.mark.parametrize("text", TEXTS)
def test_messages_without_ranges_are_one_line(tmp_path, text):
    def texts(store, _):
        return ((START + k * 10**8, store.types[TEXT](text)) for k in range(12))

    bag = ros2(tmp_path / "b", {"/a/{b": (TEXT, texts)})
    with pytest.raises(ImportTableError, match=one_line("no topic with ranges")):
        guess_map(bag)
    with suppress(ImportTableError):
        by_map(tmp_path, bag, '[topics."/a/{b"]\n[constants]\nfrom_id = 7\nto_id = 8\nrange_m = 3\n')


def test_without_the_extra_the_error_names_the_package_to_install(tmp_path, monkeypatch):
    bag = ros2(tmp_path / "b", RANGES)
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(ImportTableError, match=r"pip install 'uwbcal\[bags\]'"):
        guess_map(bag)
