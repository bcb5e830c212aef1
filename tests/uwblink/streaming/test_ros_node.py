"""The ROS 2 node of docs/boards.md, with a stand-in for rclpy that accepts only what the real one accepts."""

import re
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import uwblink
from tests.boards import bench_scenario
from uwbsim.boards.virtual_board import VirtualPorts

PAGE = Path(__file__).parents[3] / "docs" / "boards.md"


class Range(types.SimpleNamespace):
    """Fields of sensor_msgs/Range of ROS 2 Jazzy; no others are accepted."""

    NAMES = ("radiation_type", "field_of_view", "min_range", "max_range", "range", "variance")

    def __init__(self, **values):
        assert values.keys() <= {*self.NAMES}
        assert {type(value) for value in values.values()} <= {float}
        super().__init__(header=types.SimpleNamespace(), **dict.fromkeys(self.NAMES, 0.0) | values)


class Time:
    def __init__(self, *, nanoseconds):
        assert type(nanoseconds) is int
        self.nanoseconds = nanoseconds

    def to_msg(self):
        return types.SimpleNamespace(**dict(zip(("sec", "nanosec"), divmod(self.nanoseconds, 10**9), strict=True)))


def stand_in(published, values):
    class Node:
        def __init__(self, name):
            assert re.fullmatch(r"[A-Za-z_]\w*", name)

        def declare_parameter(self, name, default):
            return types.SimpleNamespace(value=values.get(name, default))

        def create_publisher(self, kind, topic, depth):
            assert kind is Range
            assert re.fullmatch(r"[A-Za-z_/][\w/]*", topic)
            assert depth > 0
            return types.SimpleNamespace(publish=lambda message: published.append((topic, message)))

        def destroy_node(self):
            published.append("destroyed")

    modules = {name: types.ModuleType(name) for name in ("rclpy", "rclpy.node", "rclpy.time", "sensor_msgs.msg")}
    modules["sensor_msgs"] = types.ModuleType("sensor_msgs")
    for module, name, thing in (
        ("rclpy", "init", lambda: published.append("begun")),
        ("rclpy", "ok", lambda: len(published) < 40),
        ("rclpy.node", "Node", Node),
        ("rclpy.time", "Time", Time),
        ("sensor_msgs.msg", "Range", Range),
    ):
        setattr(modules[module], name, thing)
    return modules


@pytest.fixture
def node():
    (text,) = (found for found in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S) if "rclpy" in found)
    assert text.split("class RangeNode")[1].split("if __name__")[0].count("\n") <= 40
    return compile(text, "docs/boards.md", "exec")


def test_the_node_publishes_corrected_ranges_until_ros_ends(node, monkeypatch):
    published: list[Any] = []
    ports = VirtualPorts(bench_scenario())
    names = list(ports.names.values())
    for name, module in stand_in(published, {"ports": names, "calibration": "mine.json"}).items():
        monkeypatch.setitem(__import__("sys").modules, name, module)
    real = uwblink.stream

    def stream(given, *, calibration, stop):
        assert (given, calibration) == (names, "mine.json")

        def correct(exchanges):
            known = np.where(exchanges.target == 3, np.nan, 1.0)
            return {"corrected_m": (exchanges.range_m - 0.5) * known, "sigma_m": 0.25 * known}

        return real(given, calibration=correct, stop=stop, using=ports)

    monkeypatch.setattr(uwblink, "stream", stream)
    exec(node, {"__name__": "__main__"})  # noqa: S102 - the code of our own page is what is tested
    assert (published[0], published[-1]) == ("begun", "destroyed")
    messages = published[1:-1]
    assert len(messages) >= 39
    assert {topic for topic, _ in messages} == {"uwb/range_1_2"}, "of tag 3 nothing is known"
    assert all(m.range == pytest.approx(2.5, abs=0.3) and m.variance == 0.0625 for _, m in messages)
    assert messages[0][1].header.frame_id == "uwb_1"
    assert {*vars(messages[0][1]), *vars(messages[0][1].header)} == {"header", "frame_id", "stamp", *Range.NAMES}
    times = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in messages]
    assert [0, *times] == sorted([0, *times])
