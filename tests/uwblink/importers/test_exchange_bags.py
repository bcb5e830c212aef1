"""Exchanges in bags of ROS 1, ROS 2 and MCAP, with message types defined here, by a map of their fields."""

import numpy as np
import pytest

from uwblink.errors import ArgumentError, ImportTableError
from uwblink.importers import import_recording, read_source

pytest.importorskip("rosbags", reason="the extra uwbcal[bags] is not installed")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EXCHANGE = "std_msgs/Header header\nuint16 a\nuint16 b\nuint64[6] stamps\nfloat32 power\nfloat64 odd\n"
RANGE = "string anchor\nfloat64 distance\nfloat32 rssi\n"
ARRAY = "std_msgs/Header header\nuint16 tag\nfloat32[8] dis_arr\n"
RANGES = "std_msgs/Header header\nuwb_msgs/Range[] ranges\n"
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
    for name, text in (("Exchange", EXCHANGE), ("Range", RANGE), ("Ranges", RANGES), ("Array", ARRAY)):
        store.register(get_types_from_msg(text, f"uwb_msgs/msg/{name}"))
    return store


def header(store, time_ns, *first):
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9))
    return types["std_msgs/msg/Header"](*first, stamp, "map")


def ros2(path, topics, plugin=StoragePlugin.MCAP):
    store = store_of(Stores.ROS2_JAZZY)
    with Writer2(path, version=9, storage_plugin=plugin) as bag:
        for topic, (kind, make) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=store)
            for time_ns, message in make(store, ()):
                bag.write(connection, time_ns, store.serialize_cdr(message, kind))
    return path


def ros1(path, topics):
    store = store_of(Stores.ROS1_NOETIC)
    with Writer1(path) as bag:
        for topic, (kind, make) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=store)
            for time_ns, message in make(store, (0,)):
                bag.write(connection, time_ns, store.serialize_ros1(message, kind))
    return path


def exchanges(store, first):
    for time_ns, (a, b), stamps, _ in truths():
        head = header(store, time_ns, *first)
        kind = store.types["uwb_msgs/msg/Exchange"]
        yield time_ns + 5, kind(head, a, b, np.array(stamps, dtype=np.uint64), -80.5, float("nan"))


def ranges(store, first):
    for time_ns, (a, b), _, truth in truths():
        one = store.types["uwb_msgs/msg/Range"]
        listed = [one(f"anchor{a}", truth * 100, -79.5), one(f"anchor{b}", truth * 200, -78.5)]
        yield time_ns, store.types["uwb_msgs/msg/Ranges"](header(store, time_ns, *first), listed)


EXCHANGES = {"/uwb": ("uwb_msgs/msg/Exchange", exchanges)}
RANGED = {"/tag/ranges": ("uwb_msgs/msg/Ranges", ranges), **EXCHANGES}
NAMED = "\n".join(f'{name} = "stamps.{k}"' for k, name in enumerate(("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")))


@pytest.mark.parametrize("write", [ros1, ros2])
def test_exchanges_by_the_fields_of_a_message(tmp_path, write):
    bag = write(tmp_path / ("b.bag" if write is ros1 else "b"), EXCHANGES)
    (tmp_path / "m.toml").write_text(f'[columns]\nfrom_id = "a"\nto_id = "b"\nfpp1 = "power"\nfpp2 = "odd"\n{NAMED}\n')
    count = import_recording(bag, tmp_path / "o.uwb", importer="bag", map_file=tmp_path / "m.toml")
    found = read_source(bag, importer="bag", map_file=tmp_path / "m.toml")
    expected = list(truths())
    e = found.exchanges
    assert count == len(e) == len(expected)
    assert e.time_ns.tolist() == [row[0] for row in expected], "to the nanosecond"
    assert list(zip(e.initiator.tolist(), e.target.tolist(), strict=True)) == [row[1] for row in expected]
    assert (e.bits, set(e.protocol), set(e.fpp1_dbm)) == (40, {"ds"}, {-80.5})
    assert np.isnan(e.fpp2_dbm).all()
    np.testing.assert_allclose(e.range_m, [row[3] for row in expected], atol=1e-9)
    assert (found.meta["source"], found.meta["imported_from"]) == ("import bag", bag.name)


def test_a_list_of_ranges_in_each_message_of_one_topic_of_several(tmp_path):
    bag = ros2(tmp_path / "b", RANGED)
    (tmp_path / "m.toml").write_text(
        'each = "ranges"\n[topics."/tag/ranges"]\nfrom_id = "drone"\n[units]\ndistance = "cm"\n'
        '[columns]\nto_id = "ranges.anchor"\nrange_m = "ranges.distance"\nrxp2 = "ranges.rssi"\n'
    )
    found = read_source(bag, importer="bag", map_file=tmp_path / "m.toml")
    expected = [factor * row[3] for row in truths() for factor in (1, 2)]
    np.testing.assert_allclose(found.exchanges.range_m, expected, rtol=1e-12)
    assert set(found.meta["tag_names"].values()) == {"drone", "anchor4", "anchor7", "anchor9"}
    assert found.powers["rxp2_dbm"][:2].tolist() == [-79.5, -78.5]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"`map_file` must name the topics.*there are /tag/ranges \(uwb_msgs/msg/Ranges\), /uwb"),
        ('[topics."/none"]\n', "no topic '/none'; there are /tag/ranges"),
        ('each = "ranges"\n[topics."/uwb"]\n', "a message of /uwb has no list 'ranges'"),
        ('[topics."/uwb"]\n', "column 'from_id' is missing; there are header.stamp, header.frame_id, a, b, stamps"),
        ('[topics."/uwb"]\nfrom_id = [1]\n', r"topics\./uwb\.from_id"),
        ("each = 3\n", "each: found 3"),
    ],
)
def test_missing_topics_and_fields_are_named(tmp_path, text, said):
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(ImportTableError, match=said):
        read_source(ros2(tmp_path / "b", RANGED), importer="bag", map_file=tmp_path / "m.toml")


def test_other_files_than_bags_are_refused(tmp_path):
    (tmp_path / "no.bag").write_bytes(b"nothing")
    (tmp_path / "folder").mkdir()
    (tmp_path / "t.csv").write_text("from_id,to_id,range_m\n1,2,3\n")
    (tmp_path / "m.toml").write_text('each = "x"\n')
    for name, more, said in (
        ("no.bag", {}, "cannot be read as a bag"),
        ("folder", {"importer": "bag"}, "cannot be read as a bag"),
        ("absent.mcap", {}, "no such bag"),
        ("t.csv", {"map_file": tmp_path / "m.toml"}, "the key each is for JSON lines, bags and logs"),
    ):
        with pytest.raises(ImportTableError, match=said):
            read_source(tmp_path / name, **more)
    with pytest.raises(ArgumentError, match="needs one file, found 2"):
        read_source([tmp_path / "no.bag"] * 2, importer="bag")
