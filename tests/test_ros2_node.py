"""The example node, with stand-ins for rclpy and the messages."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

pytest.importorskip("rosbags")

from tests.data_tools import mcap_example as example

SOURCE = Path(__file__).parents[1] / "docs" / "examples" / "ros2_node.py"


def named(content):
    """Dictionaries as objects with attributes."""
    if isinstance(content, dict):
        return SimpleNamespace(**{key: named(value) for key, value in content.items()})
    return [named(each) for each in content] if isinstance(content, list) else content


class LookupFailedError(Exception):
    pass


class Standin:
    """A node whose publisher, logger and transforms are at hand."""

    def __init__(self, name):
        self.published, self.warnings = [], []

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind, topic, callback, depth):
        self.subscribed = (topic, callback)

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


class StandinBuffer:
    def lookup_transform(self, target, source, time):
        if source != "lidar":
            raise LookupFailedError(f"no frame {source}")
        return SimpleNamespace(transform=named(example.map_to_base(0)["transform"]))


@pytest.fixture
def node(monkeypatch):
    def module(name, **content):
        made = ModuleType(name)
        for key, value in content.items():
            setattr(made, key, value)
        monkeypatch.setitem(sys.modules, name, made)

    messages = {"DetectedObjects": SimpleNamespace, "TrackedObjects": SimpleNamespace}
    module("rclpy")
    module("rclpy.node", Node=Standin)
    module("rclpy.time", Time=SimpleNamespace(from_msg=lambda stamp: stamp))
    module("autoware_perception_msgs")
    module("autoware_perception_msgs.msg", **messages)
    module("rosidl_runtime_py", set_message_fields=lambda message, content: message.__init__(**content))
    listener = {"TransformListener": lambda buffer, node: None, "TransformException": LookupFailedError}
    module("tf2_ros", Buffer=StandinBuffer, **listener)
    spec = importlib.util.spec_from_file_location("ros2_node", SOURCE)
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded.TrackerNode()


def test_the_node_publishes_tracks_of_what_it_hears(node):
    topic, hear = node.subscribed
    assert topic == "detections"
    for k in range(3):
        hear(named(example.detected_objects(k)))
    *_, last = node.published
    assert last.header["frame_id"] == "map"
    assert [each["classification"][0]["label"] for each in last.objects] == [1, 7]
    assert not node.warnings


def test_a_message_that_cannot_be_placed_is_left_out_with_a_warning(node):
    message = named(example.detected_objects(0))
    message.header.frame_id = "radar"
    node.subscribed[1](message)
    assert node.warnings == ["no frame radar"]
    assert not node.published
