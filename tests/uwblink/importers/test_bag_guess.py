"""Bags of ROS 1, ROS 2 and MCAP, some with message types defined here: topics of ranges, which are guessed and imported
without other files, notes on their poses, and exchanges by a map of their fields.
"""

import json
import sqlite3
import struct
from contextlib import closing, suppress
from typing import Any

import numpy as np
import pytest

from tests import processes
from tests.errors import one_line
from tests.uwblink.importers.test_forms import PLANT, ROUNDS
from uwblink import Contents, Exchanges, Poses, load
from uwblink.errors import ArgumentError, ImportTableError
from uwblink.exporters import export_recording
from uwblink.importers import import_recording, read_source
from uwblink.importers.guess import guess_map
from uwblink.importers.poses import read_poses

pytest.importorskip("rosbags", reason="the extra uwbcal[bags] is not installed")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HEADER = "std_msgs/Header header\n"
TYPES = {
    "Exchange": HEADER + "uint16 a\nuint16 b\nuint64[6] stamps\nfloat32 power\nfloat64 odd\n",
    "Range": "string anchor\nfloat64 distance\nfloat32 rssi\n",
    "Ranges": HEADER + "uwb_msgs/Range[] ranges\n",
    "Mine": HEADER + "string dest\nfloat32 range_mm\nfloat32 rssi\n",
    "Stamped": HEADER + "uint16 src\nuint16 dst\nuint64 tx1\nuint64 rx1\nuint64 tx2\nuint64 rx2\n",
}
TICK_M = 299_702_547.0 / (128 * 499_200_000)
WHEN = 1_706_822_508_042_560_815


def truths(count=40):
    random = np.random.default_rng(8)
    for k in range(count):
        flight, reply, later = (
            int(v) for v in random.integers([200, 2 * 10**7, 8 * 10**7], [3000, 4 * 10**7, 9 * 10**7])
        )
        mine, other = (int(v) for v in random.integers(2**40, size=2))
        tx2, rx2 = other + flight + reply, mine + 2 * flight + reply
        stamps = [mine, other + flight, tx2, rx2, tx2 + later, rx2 + later]
        yield WHEN + k * 10**7, (4, 9) if k % 2 else (9, 7), [s % 2**40 for s in stamps], flight * TICK_M


def store_of(kind):
    store = get_typestore(kind)
    for name, text in TYPES.items():
        store.register(get_types_from_msg(text, f"uwb_msgs/msg/{name}"))
    return store


def header(store, time_ns, *first):
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9))
    return types["std_msgs/msg/Header"](*first, stamp, "map")


def bag_of(path, topics, plugin=StoragePlugin.MCAP):
    """Write a bag of ROS 1 if the path ends with .bag, else one of ROS 2; return the path."""
    old = path.suffix == ".bag"
    store = store_of(Stores.ROS1_NOETIC if old else Stores.ROS2_JAZZY)
    writer: Any = Writer1(path) if old else Writer2(path, version=9, storage_plugin=plugin)
    serialize: Any = store.serialize_ros1 if old else store.serialize_cdr
    with writer as bag:
        for topic, (kind, make) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=store)
            for time_ns, message in make(store, (0,) if old else ()):
                bag.write(connection, time_ns, serialize(message, kind))
    return path


def exchanges(store, first):
    for time_ns, (a, b), stamps, _ in truths():
        head = header(store, time_ns, *first)
        kind = store.types["uwb_msgs/msg/Exchange"]
        yield time_ns + 5, kind(head, a, b, np.array(stamps, dtype=np.uint64), -80.5, float("nan"))


EXCHANGES = {"/uwb": ("uwb_msgs/msg/Exchange", exchanges)}
NAMED = "\n".join(f'{name} = "stamps.{k}"' for k, name in enumerate(("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")))


# Topics of ranges.


START = 1_706_822_508_000_000_000
RANGE, NUMBER, TEXT = "sensor_msgs/msg/Range", "std_msgs/msg/Float32", "std_msgs/msg/String"
MINE, POSE = "uwb_msgs/msg/Mine", "geometry_msgs/msg/PoseStamped"
STAMPED = "uwb_msgs/msg/Stamped"


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
NUMBERS = by_anchor("/tag7/uwb_anchor{}", NUMBER, lambda types, _, r: types[NUMBER](r.range_m))
FORMS = {
    "Range by anchor": ("b", RANGES | HEIGHT | POSES, "/uwb/tag7/range_{to_id}", ()),
    "Range in ROS 1": ("b.bag", RANGES, "/uwb/tag7/range_{to_id}", ()),
    "Range without a tag": ("b", by_anchor("/range/{}", RANGE, as_range), "/range/{to_id}", ("from_id",)),
    "numbers": ("b", NUMBERS, "/tag7/uwb_anchor{to_id}", ()),
    "an array": ("b", {"/uwb/ranges": ("std_msgs/msg/Float32MultiArray", rounds)}, "/uwb/ranges", ("from_id",)),
    "lists": ("b", {"/tag7/uwb": ("uwb_msgs/msg/Ranges", lists)} | POSES, "/tag7/uwb", ()),
    "fields in mm": ("b.bag", {"/tag7/uwb": (MINE, of_anchor(None, as_mine))}, "/tag7/uwb", ()),
    "fields, and Range": ("b", {"/tag7/uwb": (MINE, of_anchor(None, as_mine))} | RANGES, "/tag7/uwb", ()),
    "fields without a tag, and Range": ("b", {"/u": (MINE, of_anchor(None, as_mine))} | RANGES, "/u", ("from_id",)),
    "JSON": ("b", {"/tag7/uwb": (TEXT, of_anchor(None, as_text))} | HEIGHT, "/tag7/uwb", ()),
    "stamps, and Range": ("b", {"/uwb": (STAMPED, of_anchor(None, as_stamped))} | RANGES, "/uwb", ()),
}


RARER = ("Range in ROS 1", "Range without a tag", "numbers", "fields, and Range")
"""Forms whose variants are read in every run, here or by another test of this folder."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in RARER)) for name in FORMS])
def test_ranges_of_a_bag_come_in_by_its_guess(tmp_path, name):
    file, topics, template, asked = FORMS[name]
    found = by_guess(tmp_path, bag_of(tmp_path / file, topics), asked)
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
        bag = bag_of(tmp_path / template.replace("/", "_"), topics | HEIGHT)
        assert f"[topics.{json.dumps(template)}]\n" in guess_map(bag).text
        got = ends(by_guess(tmp_path, bag))
        assert ({(one, str(other)[-1]) for one, other in got}, len(got)) == (set(pairs), len(PLANT))


def test_ids_in_names_of_topics_complete_those_in_messages(tmp_path):
    """Or the id in the names; an id of a robot differs from an id of the anchors in its messages."""
    topics = {f"/robot{k}/uwb": (MINE, of_anchor(k, as_mine)) for k in range(4)}
    assert set(ends(by_guess(tmp_path, bag_of(tmp_path / "fields", topics)))) == {(f"robot{k}", k) for k in range(4)}
    bag = bag_of(tmp_path / "range", by_anchor("/tag1{}/range", RANGE, as_range))
    assert set(ends(by_guess(tmp_path, bag, ("to_id",)))) == {(10, 7), (11, 7), (12, 7), (13, 7)}


def test_topics_that_other_types_resemble_are_listed_with_their_ids(tmp_path):
    topics = {
        f"/uwb/{a}/{b}": (RANGE, of_anchor(k, as_range))
        for k, (a, b) in enumerate([("a", "c"), ("a", "d"), ("b", "c"), ("b", "d")])
    }
    bag = bag_of(tmp_path / "b", topics | {"/uwb/a/status": (TEXT, lambda *_: ())})
    assert '[topics."/uwb/b/c"]\nfrom_id = "b"\nto_id = "c"\n' in guess_map(bag).text
    found = by_guess(tmp_path, bag)
    assert found.meta["tag_names"] == {"1": "a", "2": "b", "3": "c", "4": "d"}
    assert len(found.exchanges) == len(PLANT)


NO_TOPIC = r"no topic '/uwb/.*there are /uwb/tag7/b/range_9 \(sensor_msgs"


def test_a_template_of_topics_in_a_map(tmp_path):
    """A placeholder is a part of a name, and the constant of a topic has priority over that of a template."""
    bag = bag_of(tmp_path / "b", RANGES | {"/uwb/tag7/b/range_9": (RANGE, of_anchor(0, as_range))})
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


def test_topics_named_as_ours_need_no_map(tmp_path):
    bag = bag_of(tmp_path / "b", by_anchor("/uwb/range_7_{}", RANGE, as_range) | HEIGHT | POSES)
    assert sorted(ends(read_source(bag, importer="bag"))) == sorted((7, r.anchor) for r in PLANT)


GUESS = ("uwblink", "import", "guess")


def test_the_commands_end_with_true_distances(tmp_path):
    """Each command is the one that the previous command printed."""
    bag_of(tmp_path / "b", RANGES | HEIGHT | POSES)
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
    bag_of(tmp_path / "b", RANGES)
    said = processes.succeed(*GUESS, "b", "-o", "map.toml", cwd=tmp_path).stdout
    assert all(words in said for words in ("calib survey", "fit_from_ranges", "constants of pairs need true"))
    assert said.splitlines()[1] in (tmp_path / "map.toml").read_text()
    said = processes.succeed("uwblink", "import", "bag", "b", "--map", "map.toml", "-o", "b.uwb", cwd=tmp_path).stdout
    assert "poses" not in said


def test_bags_without_ranges_are_refused_with_their_topics(tmp_path):
    bag_of(tmp_path / "b", POSES | HEIGHT)
    naming = ["/vrpn_mocap/drone/pose", "geometry_msgs/msg/PoseStamped", "/height/drone"]
    processes.refuse(*GUESS, "b", "-o", "map.toml", naming=naming, cwd=tmp_path)
    assert not (tmp_path / "map.toml").exists()
    (tmp_path / "t.bag").write_bytes(b"#ROSBAG V2.0\nno more")
    processes.refuse(*GUESS, "t.bag", naming=["t.bag", "cannot be read as a bag"], cwd=tmp_path)


def test_types_that_a_bag_does_not_define_leave_the_others(tmp_path):
    for name, topics in {"both": NUMBERS, "one": {}}.items():
        more = {"/px4/status": (MINE, of_anchor(None, as_mine))}
        bag = bag_of(tmp_path / name, topics | more, StoragePlugin.SQLITE3)
        with closing(sqlite3.connect(bag / f"{name}.db3")) as db, db:
            db.execute("DELETE FROM message_definitions")
    assert len(by_guess(tmp_path, tmp_path / "both").exchanges) == len(PLANT)
    with pytest.raises(ImportTableError, match=r"one: .*/px4/status.* has no definition of uwb_msgs/msg/Mine; convert"):
        guess_map(bag)


TEXTS = ["[" * 100_000, '{"a":' * 700 + "1" + "}" * 700, "[1, 2]", '{"ranges": [1, {"x": 3}]}', '{"0": {"0": []}}']


@pytest.mark.parametrize("text", TEXTS)
def test_messages_without_ranges_are_one_line(tmp_path, text):
    texts = {"/a/{b": (TEXT, lambda store, _: ((START + k * 10**8, store.types[TEXT](text)) for k in range(12)))}
    bag = bag_of(tmp_path / "b", texts)
    with pytest.raises(ImportTableError, match=one_line("no topic with ranges")):
        guess_map(bag)
    with suppress(ImportTableError):
        by_map(tmp_path, bag, '[topics."/a/{b"]\n[constants]\nfrom_id = 7\nto_id = 8\nrange_m = 3\n')


def test_without_the_extra_the_error_names_the_package_to_install(tmp_path, monkeypatch):
    bag = bag_of(tmp_path / "b", RANGES)
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(ImportTableError, match=r"pip install 'uwbcal\[bags\]'"):
        guess_map(bag)


# Exchanges by a map of the fields of messages.


@pytest.mark.parametrize("name", ["b.bag", "b"])
def test_exchanges_by_the_fields_of_a_message(tmp_path, name):
    bag = bag_of(tmp_path / name, EXCHANGES)
    found = by_map(tmp_path, bag, f'[columns]\nfrom_id = "a"\nto_id = "b"\nfpp1 = "power"\nfpp2 = "odd"\n{NAMED}\n')
    e, expected = found.exchanges, list(truths())
    count = import_recording(bag, tmp_path / "o.uwb", importer="bag", map_file=tmp_path / "map.toml")
    assert count == len(e) == len(expected)
    assert e.time_ns.tolist() == [row[0] for row in expected], "to the nanosecond"
    assert list(zip(e.initiator.tolist(), e.target.tolist(), strict=True)) == [row[1] for row in expected]
    assert (e.bits, set(e.protocol), set(e.fpp1_dbm)) == (40, {"ds"}, {-80.5})
    assert np.isnan(e.fpp2_dbm).all()
    np.testing.assert_allclose(e.range_m, [row[3] for row in expected], atol=1e-9)
    assert (found.meta["source"], found.meta["imported_from"]) == ("import bag", bag.name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"`map_file` must name the topics.*there are /tag7/uwb \(uwb_msgs/msg/Ranges\), /uwb"),
        ('[topics."/none"]\n', "no topic '/none'; there are /tag7/uwb"),
        ('each = "ranges"\n[topics."/uwb"]\n', "a message of /uwb has no list 'ranges'"),
        ('[topics."/uwb"]\n', "column 'from_id' is missing; there are header.stamp, header.frame_id, a, b, stamps"),
        ('[topics."/uwb"]\nfrom_id = [1]\n', r"topics\./uwb\.from_id"),
        ("each = 3\n", "each: found 3"),
    ],
)
def test_missing_topics_and_fields_are_named(tmp_path, text, said):
    with pytest.raises(ImportTableError, match=said):
        by_map(tmp_path, bag_of(tmp_path / "b", FORMS["lists"][1] | EXCHANGES), text)


def test_other_files_than_bags_are_refused(tmp_path):
    (tmp_path / "no.bag").write_bytes(b"nothing")
    (tmp_path / "folder").mkdir()
    for name, more, said in (
        ("no.bag", {}, "cannot be read as a bag"),
        ("folder", {"importer": "bag"}, "no metadata.yaml"),
        ("absent.mcap", {}, "no such bag"),
    ):
        with pytest.raises(ImportTableError, match=said):
            read_source(tmp_path / name, **more)
    with pytest.raises(ArgumentError, match="needs one file, found 2"):
        read_source([tmp_path / "no.bag"] * 2, importer="bag")


# MCAP files of JSON messages: exports of the project, which are imported again, and files of the library `mcap`.


@pytest.fixture
def exported(tmp_path):
    """A recording of two pairs and two bodies with some unknown values, and the folder of its export."""
    rng = np.random.default_rng(3)
    n = 40
    tx1, reply, flight = (rng.integers(low, high, n) for low, high in ((0, 10**9), (10**7, 2 * 10**7), (100, 3000)))
    exchanges = Exchanges.from_arrays(
        np.where(np.arange(n) % 2, 1, 3), np.full(n, 2), time_ns=WHEN + np.arange(n) * 10**7,
        tx1=tx1, rx1=tx1 + flight, tx2=tx1 + flight + reply, rx2=tx1 + 2 * flight + reply,
        fpp1_dbm=rng.normal(-85, 3, n), fpp2_dbm=np.where(np.arange(n) < 30, np.nan, -84.5),
        skew1_ppm=rng.normal(size=n), truth_m=rng.normal(4, 1, n),
    )  # fmt: skip
    attitude = rng.normal(size=(20, 4))
    poses = Poses(
        WHEN + np.arange(20) * 10**8, np.array(["drone", "car"] * 10), rng.normal(size=(20, 3)),
        attitude / np.linalg.norm(attitude, axis=1)[:, None],
    )  # fmt: skip
    held = Contents(exchanges=exchanges, poses=poses)
    held.save(tmp_path / "r.uwb")
    for to in ("mcap", "rosbag2"):
        export_recording(tmp_path / "r.uwb", tmp_path / to, to=to)
    return held, tmp_path / "mcap" / "recording.mcap"


@pytest.mark.parametrize("name", ["mcap/recording.mcap", "rosbag2/rosbag2"])
def test_exports_are_imported_without_a_map_and_by_the_guess(exported, tmp_path, name):
    """They have distances and powers; the map that is guessed has no distances."""
    held, found = exported[0].exchanges, read_source(tmp_path / name, importer="bag").exchanges
    names = "time_ns initiator target range_m truth_m fpp1_dbm fpp2_dbm skew1_ppm skew2_ppm"
    for column in names.split():
        np.testing.assert_array_equal(getattr(found, column), getattr(held, column), err_msg=column)
    assert not found.tx1.any()
    e = by_guess(tmp_path, tmp_path / name).exchanges
    np.testing.assert_array_equal([e.time_ns, e.fpp1_dbm], [held.time_ns, held.fpp1_dbm])
    poses = read_poses(tmp_path / name)
    for column in ("time_ns", "body", "position_m"):
        assert getattr(poses, column).tolist() == getattr(exported[0].poses, column).tolist()
    np.testing.assert_allclose(poses.quaternion, exported[0].poses.quaternion, atol=1e-15)
    assert set(read_poses(tmp_path / name, topics={"lorry": "/poses/car"}).body) == {"lorry"}


def written(path, messages, schema="uwb_msgs.Range", compressed=False):
    """Write messages by topic with the library of the format, in chunks."""
    mcap = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    kind = mcap.CompressionType.ZSTD if compressed else mcap.CompressionType.NONE
    with path.open("wb") as file:
        writer = mcap.Writer(file, compression=kind, chunk_size=500)
        writer.start()
        number = writer.register_schema(schema, "jsonschema", b'{"type": "object"}')
        for topic, contents in messages.items():
            channel = writer.register_channel(topic, "json", number)
            for k, content in enumerate(contents):
                data = content if isinstance(content, bytes) else json.dumps(content).encode()
                writer.add_message(channel, WHEN + k * 10**7, data, WHEN + k * 10**7)
        writer.finish()
    return path


@pytest.mark.parametrize("compressed", [False, True])
def test_others_messages_in_chunks_by_a_map(tmp_path, compressed):
    rows = [
        {"header": {"stamp": {"sec": 100 + k, "nsec": 5}}, "tag": 7, "to": {"anchor": 1 + k % 3}, "mm": 1000 + k}
        for k in range(50)
    ]
    path = written(tmp_path / "t.mcap", {"/uwb": rows, "/other": [{"a": 1}]}, compressed=compressed)
    (tmp_path / "m.toml").write_text(
        '[topics."/uwb"]\n[columns]\nfrom_id = "tag"\nto_id = "to.anchor"\nrange_m = "mm"\n[units]\ndistance = "mm"\n'
    )
    found = read_source(path, map_file=tmp_path / "m.toml").exchanges
    assert found.time_ns.tolist() == [(100 + k) * 10**9 + 5 for k in range(50)]
    assert found.target.tolist() == [1 + k % 3 for k in range(50)]
    np.testing.assert_allclose(found.range_m, 1 + np.arange(50) / 1000, atol=1e-12)


def in_frame(x=1.0, sec=1):
    pose = {"position": {"x": x, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    return {"timestamp": {"sec": sec, "nsec": 0}, "pose": pose}


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (b"{", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        ([1], "is not an object of JSON"),
        ({"timestamp": 3, "pose": {}}, "is no foxglove.PoseInFrame"),
        (in_frame(x="here"), "is no foxglove.PoseInFrame"),
        (in_frame(x=float("nan")), "is no foxglove.PoseInFrame"),
        (in_frame(sec=10**30), "is no foxglove.PoseInFrame"),
    ],
)
def test_wrong_poses_are_one_line(tmp_path, message, said):
    path = written(tmp_path / "t.mcap", {"/poses/a": [message]}, "foxglove.PoseInFrame")
    with pytest.raises(ImportTableError, match=said):
        read_poses(path)


# Versions of rosbags before 0.11.9 do not close a file that they refuse.
@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO.*z.mcap:pytest.PytestUnraisableExceptionWarning")
def test_cut_broken_and_endless_files_are_one_line(exported, tmp_path):
    data, path = exported[1].read_bytes(), tmp_path / "t.mcap"
    # A chunk that is larger than the memory when it is unpacked.
    content = struct.pack("<QQQII", 0, 0, 2**40, 0, 4) + b"zstd" + struct.pack("<Q", 0)
    bomb = b"\x89MCAP0\r\n" + struct.pack("<BQ", 0x01, 8) + bytes(8) + struct.pack("<BQ", 0x06, len(content)) + content
    longest = data[: data.index(b"uwbcal") + 6] + struct.pack("<BQ", 0x05, 2**63)
    cuts = [(data[:cut], "") for cut in range(9, len(data) - 40, 1013)]
    for broken, said in (*cuts, (longest, ""), (bomb, "a chunk unpacks to 1099511627776 bytes")):
        path.write_bytes(broken)
        with pytest.raises(ImportTableError, match=one_line("t.mcap", said)):
            read_source(path)
    path.unlink()
    # An object that is nested too deeply.
    with pytest.raises(ImportTableError, match=one_line("t.mcap")):
        read_source(written(path, {"/uwb": [b'{"a":' * 700 + b"1" + b"}" * 700]}))
