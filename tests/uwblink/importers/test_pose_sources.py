"""Poses as written by drivers of motion capture: messages, topics, several files, anchors."""

import numpy as np
import pytest

from tests import processes
from tests.errors import one_line
from uwblink.errors import ImportTableError, PlanError
from uwblink.exporters import export_recording
from uwblink.importers import add_poses
from uwblink.importers.poses import read_poses
from uwblink.recording.contents import Contents, load
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import Exchanges

TURNED = [0.0, 0.0, 0.6, 0.8]


def bag(path, messages):
    """Write a ROS 2 bag of (topic, kind, position, frame) at seconds 0, 1, 2."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="the extra uwbcal[bags] is not installed")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = {name.split("/")[-1]: kind for name, kind in store.types.items()}
    turned, uncertain = t["Quaternion"](*TURNED), "PoseWithCovarianceStamped"

    def made(kind, k, place, frame):
        header = t["Header"](t["Time"](k, 500), "world")
        pose = t["Pose"](t["Point"](place + k, 2.0, 3.0), turned)
        with_covariance = t["PoseWithCovariance"](pose, np.zeros(36))
        still = t["TwistWithCovariance"](t["Twist"](t["Vector3"](0, 0, 0), t["Vector3"](0, 0, 0)), np.zeros(36))
        transform = t["TransformStamped"](header, frame, t["Transform"](t["Vector3"](place + k, 2.0, 3.0), turned))
        return {
            "geometry_msgs/msg/PoseStamped": lambda: t["PoseStamped"](header, pose),
            f"geometry_msgs/msg/{uncertain}": lambda: t[uncertain](header, with_covariance),
            "nav_msgs/msg/Odometry": lambda: t["Odometry"](header, frame, with_covariance, still),
            "geometry_msgs/msg/TransformStamped": lambda: transform,
            "tf2_msgs/msg/TFMessage": lambda: t["TFMessage"]([transform]),
        }[kind]()

    with rosbag2.Writer(path, version=9) as writer:
        for topic, kind, place, frame in messages:
            connection = writer.add_connection(topic, kind, typestore=store)
            for k in range(3):
                writer.write(connection, k * 10**9, store.serialize_cdr(made(kind, k, place, frame), kind))


@pytest.mark.parametrize(
    ("topic", "kind", "frame"),
    [
        ("/vrpn_mocap/drone/pose", "geometry_msgs/msg/PoseStamped", ""),
        ("/mocap/rigid_bodies/drone/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ""),
        ("/qualisys/drone/odom", "nav_msgs/msg/Odometry", "base"),
        ("/vicon/anything", "geometry_msgs/msg/TransformStamped", "vicon/drone/drone"),
        ("/tf", "tf2_msgs/msg/TFMessage", "drone"),
    ],
)
def test_every_kind_of_message(tmp_path, topic, kind, frame):
    bag(tmp_path / "bag", [(topic, kind, 5.0, frame)])
    poses = read_poses(tmp_path / "bag")
    assert (poses.body.tolist(), poses.time_ns.tolist()) == (["drone"] * 3, [500, 1_000_000_500, 2_000_000_500])
    assert poses.position_m.tolist() == [[5.0, 2.0, 3.0], [6.0, 2.0, 3.0], [7.0, 2.0, 3.0]]
    np.testing.assert_allclose(poses.quaternion, [TURNED] * 3)


def test_topics_by_body(tmp_path):
    pose, odometry = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"
    bag(tmp_path / "bag", [("/a/pose", pose, 1.0, ""), ("/b/pose", pose, 2.0, ""), ("/c/odom", odometry, 3.0, "x")])
    assert set(read_poses(tmp_path / "bag").body) == {"a", "b"}
    poses = read_poses(tmp_path / "bag", topics={"drone": "/b/pose", "car": "/c/odom"})
    assert [poses[poses.body == body].position_m[0, 0] for body in ("drone", "car")] == [2.0, 3.0]
    (tmp_path / "t.tum").write_text("0 1 2 3 0 0 0 1\n")
    for name, said in (
        ("bag", "'/d' is not there; topics with poses are /a/pose, /b/pose, /c/odom"),
        ("t.tum", "has no topics"),
    ):
        with pytest.raises(ImportTableError, match=said):
            read_poses(tmp_path / name, topics={"drone": "/d"})


@pytest.fixture
def recording(tmp_path):
    """A recording of tag 1 on a car, 2 on a drone and anchor 9, and a trajectory of each body in our format."""
    ids = np.array([[1, 2], [1, 9], [2, 9]] * 5)
    when = np.arange(15) * 100_000_000
    e = Exchanges.from_arrays(ids[:, 0], ids[:, 1], time_ns=when, tx1=[0] * 15, rx1=5, tx2=1005, rx2=3000)
    tags = [Tag(k, body, (0.0, 0.0, 0.0)) for k, body in ((1, "car"), (2, "drone"), (9, "tag9"))]
    for body, x in (("car", 0.0), ("drone", 4.0)):
        poses = Poses.from_arrays(np.arange(20) * 10**8, body, [[x, 0.0, k / 10] for k in range(20)])
        Contents(exchanges=e, poses=poses).save(tmp_path / "one.uwb", force=True)
        export_recording(tmp_path / "one.uwb", tmp_path / body, to="tum")
    Contents(exchanges=e, tags=tags).save(tmp_path / "r.uwb")
    return tmp_path / "r.uwb"


def test_bodies_without_poses_are_named_whether_some_or_no_ranges_have_both_ends(recording, tmp_path):
    """Of the pairs 1-2, 1-9 and 2-9, car and drone have poses, or none."""
    places, files = tmp_path / "places.toml", ["--from", f"car={tmp_path / 'car' / 'car.tum'}"]
    done = processes.run("uwblink", "poses", recording, *files, "--from", f"drone={tmp_path / 'drone' / 'drone.tum'}")
    assert (done.returncode, done.stderr) == (0, "")
    assert "5 of 15 measurements have a true distance; no poses of tag9" in done.stdout
    places.write_text("".join(f'[[tags]]\nid = {k}\nbody = "{name}"\n' for k, name in ((1, "Car"), (2, "car"))))
    done = processes.run("uwblink", "poses", recording, *files, "--tags", places, "--offset", "auto", "--force")
    assert (done.returncode, done.stdout) == (2, "")
    assert "bodies are car, but those of the tags are Car, car; give the bodies of tags 9, which range," in done.stderr


def test_trajectories_of_several_bodies_and_anchors(recording, tmp_path):
    (tmp_path / "places.toml").write_text("[[anchors]]\nid = 9\nposition_m = [0.0, 3.0, 0.0]\n")
    files = {body: tmp_path / body / f"{body}.tum" for body in ("car", "drone")}
    found = add_poses(recording, files, tags_from=tmp_path / "places.toml")
    assert (found.bodies, found.covered, found.exchanges) == (("anchor9", "car", "drone"), 15, 15)
    held = load(recording)
    assert {tag.tag: tag.body for tag in held.tags} == {1: "car", 2: "drone", 9: "anchor9"}
    assert (held.poses.body == "anchor9").sum() == 1
    e = held.exchanges
    true_m = distances_m(held.poses, held.tags, e.initiator, e.target, e.time_ns)
    np.testing.assert_allclose(true_m[:2], [4.0, np.hypot(3.0, 0.1)])


def test_wrong_anchors_are_refused(recording, tmp_path):
    for text, fragment in (
        ("[[anchors]]\nid = 9\n", "anchors[0].position_m"),
        ("[[anchors]]\nid = 9\nposition_m = [1, 2]\n", "three numbers"),
        ("[[anchors]]\nid = 9\nposition_m = [1, 2, 3]\n" * 2, "found 9, expected another id"),
        ("[[anchors]]\nid = 9\nposition_m = [1, 2, 3]\ncovariance_m2 = [1.0]\n", "six numbers"),
        ("[[anchors]]\nid = 9\nplace = [1, 2, 3]\n", "unknown key"),
        ("anchors = 3\n", "expected tables [[anchors]]"),
        ("a = 3\n", "a: unknown key"),
    ):
        (tmp_path / "places.toml").write_text(text)
        with pytest.raises(PlanError, match=one_line(fragment)):
            add_poses(recording, tmp_path / "car" / "car.tum", body="car", tags_from=tmp_path / "places.toml")
    assert not load(recording).poses
