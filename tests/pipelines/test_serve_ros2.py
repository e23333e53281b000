"""`saga-fg serve ros2`: over DDS on the loopback interface alone, and payloads given by hand."""

import importlib
import os
import re
import signal
import subprocess
import sys
import time
from collections import deque
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the extra [ros2] is not installed")

from benchmarks.service.ros2_round_trip import INTERVAL, LOOPBACK, TRACKED, Peer
from data_tools.datasets.mcap.dataset import RecordingOptions
from data_tools.datasets.mcap.objects import autoware_rows, message_objects
from data_tools.datasets.mcap.recording import LoggedMessage, Topic
from data_tools.datasets.mcap.ros2_types import decoder
from pipelines.config import load_config
from pipelines.serving import StreamSettings, StreamTracker
from pipelines.serving.ros2 import Ros2Node, open_network, result_topics, shown_tracks
from pipelines.serving.ros2_dds import DdsNetwork, structure
from saga_fg import InputError
from saga_fg.errors import MissingExtraError
from tests.data_tools import mcap_example as example
from tests.pipelines.command import COMMAND
from tests.pipelines.running_service import wait_for

DOMAIN = 40 + os.getpid() % 30  # of this test run alone
DETECTED = "autoware_perception_msgs/DetectedObjects"


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))


class Running:
    """A node as a process of its own, and the lines of its log."""

    def __init__(self, folder, *options):
        self.log = folder / f"log{len(list(folder.iterdir()))}"
        command = [*COMMAND, "serve", "ros2", "--detections", "lidar=/detections", "--tracks", "/tracks", *options]
        with self.log.open("w") as stderr:
            self.process = subprocess.Popen(command, stderr=stderr)
        wait_for(lambda: "reading /detections" in self.log.read_text() or self.process.poll() is not None)

    def end(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        return self.process.wait(60)


def test_every_frame_at_true_rate_has_its_tracks_and_a_killed_node_goes_on(tmp_path):
    state = str(tmp_path / "state.saga")
    peer = Peer(20, 0)
    node = Running(tmp_path, "--snapshot", state, "--every", "0.1")
    try:
        peer.wait(node.process, 60)
        stamps = [time.time_ns() + round(k * INTERVAL * 1e9) for k in range(30)]
        begin = time.monotonic()
        for k, stamp in enumerate(stamps):
            peer.read(begin + k * INTERVAL)
            peer.publish(stamp)
        wait_for(lambda: peer.read(time.monotonic() + INTERVAL) is not None and peer.came.keys() >= set(stamps))
        before = {row.id for row in autoware_rows(decoder(TRACKED)(peer.last)).objects}
        assert len(before) == 20
        time.sleep(0.5)  # written by now
        assert node.end(signal.SIGKILL) == -signal.SIGKILL
        node = Running(tmp_path, "--snapshot", state)
        assert "going on from" in node.log.read_text()
        peer.came.clear()
        peer.wait(node.process, 60, stamps[-1] + round(INTERVAL * 1e9))
        after = {row.id for row in autoware_rows(decoder(TRACKED)(peer.last)).objects}
        assert before == after
    finally:
        assert node.end() == 143
    assert "0 refused" in node.log.read_text()


def test_types_and_qualities_of_publishers_are_found_and_other_types_are_named(tmp_path, caplog):
    """The peer here writes CDR by cyclonedds' own code."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    odometry = "nav_msgs/Odometry"
    network = DdsNetwork({"/odom": (odometry,), "/objects": (DETECTED,)})
    participant = DomainParticipant(DOMAIN)
    kind, header = structure.__wrapped__(odometry), structure.__wrapped__("std_msgs/Header")
    writer = DataWriter(participant, Topic(participant, "rt/odom", kind), Qos(Policy.Reliability.BestEffort))
    other = DataWriter(participant, Topic(participant, "rt/objects", header))
    content = example.odometry(3)
    found = []

    def heard():
        writer.write(as_instance(kind, content))
        other.write(as_instance(header, content["header"]))
        found.extend(network.received(0.05))
        return found and any("is published" in line for line in caplog.messages)

    wait_for(heard)
    assert [(topic, each.type) for topic, each in network.subscribed.items()] == [("/odom", odometry)]
    message = decoder(odometry)(found[0].message)
    assert message.child_frame_id == "base_link"
    assert message.pose.pose.position.y == content["pose"]["pose"]["position"]["y"]
    assert set(caplog.messages) == {
        f"/objects: expected messages of {DETECTED}, std_msgs/Header is published: left out"
    }


def as_instance(kind, content):
    hints = kind.__annotations__
    values = {
        name: as_instance(hints[name], value) if isinstance(value, dict) else value for name, value in content.items()
    }
    return kind(**values)


class Published:
    """A node that is given payloads, and what it publishes."""

    def __init__(self, monkeypatch, results=("TrackedObjects=/tracks",), settings=None, **options):
        self.sent = []

        def publisher(network, topic, type_):
            return lambda data: self.sent.append((topic, type_, decoder(type_)(data)))

        monkeypatch.setattr(DdsNetwork, "publisher", publisher)
        config = load_config("file")
        self.stream = StreamTracker(lambda: config.new_tracker("saga"), settings, shown=shown_tracks)
        topics = {"lidar": "/objects"}
        self.node = Ros2Node(self.stream, RecordingOptions(topics, **options), result_topics(results))

    def take(self, k, type_=example.DETECTED, content=None, topic="/objects", data=None, patience=0.0, little=True):
        content = example.detected_objects(k) if content is None else content
        store = example.typestore()
        data = data or bytes(store.serialize_cdr(example._typed(store, type_, content), type_, little_endian=little))
        self.node.take([LoggedMessage(Topic(topic, type_.replace("/msg/", "/"), 0), 0, 1, data)], patience)

    def pose(self, k):
        self.take(k, example.TF, {"transforms": [example.map_to_base(k)]}, "/tf")

    def mount(self):
        self.take(0, example.TF, {"transforms": [example.BASE_TO_LIDAR]}, "/tf_static")


@pytest.mark.parametrize("little", [True, False])
def test_tracks_are_where_the_objects_are_in_the_map(monkeypatch, little):
    node = Published(monkeypatch, ("TrackedObjects=/tracks", "MarkerArray=/markers", "Detection3DArray=/boxes"))
    node.mount()
    for k in range(10):
        node.pose(k)
        node.take(k, little=little)
    found = {type_: message for _, type_, message in node.sent[-3:]}
    tracked = message_objects(autoware_rows(found[TRACKED]), {})
    assert (tracked.frame, tracked.stamp) == ("map", example.START + 9 * example.STEP)
    expected = {label: place for label, place, *_ in example.objects(9)}
    for label, place in zip(tracked.detections.boxes.label, tracked.detections.boxes.position, strict=True):
        np.testing.assert_allclose(place, expected[label], atol=0.3)
    assert len(found["visualization_msgs/MarkerArray"].markers) == 5
    assert len(found["vision_msgs/Detection3DArray"].detections) == 2
    assert node.stream.status()["frames"] == 10


def test_a_message_waits_for_the_pose_at_its_time(monkeypatch):
    node = Published(monkeypatch)
    node.mount()
    node.pose(0)
    node.take(1, patience=60.0)
    assert not node.sent
    node.pose(2)  # between them the pose is known
    assert len(node.sent) == 1
    node.take(3, patience=0.0)  # within 0.1 s of the newest pose, and no more waiting
    assert len(node.sent) == 2


def test_odometry_and_a_frame_that_stands_still(monkeypatch):
    node = Published(monkeypatch, odometry="/odom")
    node.mount()
    node.take(0, example.ODOMETRY, example.odometry(0), "/odom")
    node.take(0)
    roadside = Published(monkeypatch, world="lidar")
    roadside.take(0)
    assert len(node.sent) == len(roadside.sent) == 1


def test_what_cannot_be_used_is_one_line_and_the_node_goes_on(monkeypatch, caplog, subtests):
    node = Published(monkeypatch, settings=StreamSettings(max_detections=3, max_message=5000))
    node.mount()
    node.pose(0)
    nan, radar, many = (example.detected_objects(0) for _ in range(3))
    nan["objects"][1]["kinematics"]["pose_with_covariance"]["pose"]["position"]["x"] = float("nan")
    radar["header"]["frame_id"] = "radar"
    many["objects"] *= 2
    huge = {**many, "objects": many["objects"] * 3}
    broken = example.map_to_base(0)
    broken["transform"]["rotation"]["w"] = 5.0
    whole = bytes(
        example.typestore().serialize_cdr(
            example._typed(example.typestore(), example.DETECTED, example.detected_objects(0)), example.DETECTED
        )
    )
    cases = {
        "cut off": ({"data": whole[:200]}, r"/objects: message \d+: .*not readable: "),
        "a header alone": ({"data": b"\0\1\0\0"}, r"/objects: message \d+: .*not readable: "),
        "no header": ({"data": b"\0"}, r"/objects: message \d+: .*not readable: "),
        "another type": ({"data": b"\0\1\0\0" + b"\xff" * 200}, r"/objects: message \d+: "),
        "no number": ({"content": nan}, r"objects\[1\]\.kinematics.*position: expected finite numbers"),
        "an unknown frame": ({"content": radar}, "unknown frame 'radar'"),
        "too late for poses": ({"k": 15}, r"expected transforms from lidar to map at its time, 1700000001.500 s"),
        "too many": ({"content": many}, "detections: expected at most 3, got 4"),
        "too large": ({"content": huge}, "expected at most 5000 bytes"),
        "no rotation": (
            {"type_": example.TF, "content": {"transforms": [broken]}, "topic": "/tf"},
            "transform of base_link: rotation",
        ),
    }
    for name, (given, expected) in cases.items():
        with subtests.test(name):
            caplog.clear()
            node.take(**{"k": 0, **given})
            assert len(caplog.messages) == 1
            (line,) = caplog.messages
            assert "\n" not in line
            assert re.search(expected, line), line
    assert not node.sent
    assert node.stream.status()["refused"] == len(cases)
    node.take(0)
    assert len(node.sent) == 1


def test_a_topic_that_nobody_publishes_is_named_once(monkeypatch, caplog):
    node = Published(monkeypatch).node
    monkeypatch.setattr("pipelines.serving.ros2.UNHEARD", 0.0)
    stops, looks = [], []

    def received(network, timeout):
        looks.append(timeout)
        if len(looks) == 3:
            stops[0]()
        return []

    monkeypatch.setattr(DdsNetwork, "received", received)
    node.run(SimpleNamespace(notify=stops.append))
    assert [line for line in caplog.messages if "nobody" in line] == ["/objects: nobody publishes this topic so far"]


def test_names_that_are_no_topics(monkeypatch):
    for name in ("tracks", "/a b", "/1", "//a", "/a/"):
        with pytest.raises(InputError, match=f"'{name}': expected a topic of letters, digits and _ after slashes"):
            Published(monkeypatch, (name,))
    with pytest.raises(InputError, match="the topic /tracks is given twice"):
        result_topics(["/tracks", "MarkerArray=/tracks"])
    with pytest.raises(InputError, match="/objects: expected another topic for tracks"):
        Published(monkeypatch, ("/objects",))
    with pytest.raises(InputError, match="TYPE=TOPIC with one of TrackedObjects, Detection3DArray, MarkerArray"):
        result_topics(["Tracks=/tracks"])
    monkeypatch.setenv("ROS_DOMAIN_ID", "one")
    with pytest.raises(InputError, match="ROS_DOMAIN_ID: expected a number from 0 to 232"):
        Published(monkeypatch)
    monkeypatch.setenv("ROS_DOMAIN_ID", "97")
    monkeypatch.setenv("CYCLONEDDS_URI", "<Nonsense/>")
    with pytest.raises(InputError, match="DDS cannot be started with CYCLONEDDS_URI"):
        Published(monkeypatch)


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds.builtin", None)
    monkeypatch.delitem(sys.modules, "pipelines.serving.ros2_dds")
    with pytest.raises(MissingExtraError, match=r"pip install 'saga-fg\[ros2\]'"):
        importlib.import_module("pipelines.serving.ros2_dds")


class FakeRos:
    """What `pipelines.serving.ros2_rclpy` uses of rclpy and rosidl_runtime_py, in one process; it passes bytes."""

    def __init__(self, monkeypatch):
        self.published, self.subscriptions, self.publishers, self.running = [], {}, {}, None
        policies = SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort")
        durabilities = SimpleNamespace(TRANSIENT_LOCAL="transient", VOLATILE="volatile")
        modules = {
            "rclpy": {"init": self.init, "create_node": lambda name, context: self},
            "rclpy.context": {"Context": lambda: SimpleNamespace(try_shutdown=lambda: None)},
            "rclpy.executors": {"SingleThreadedExecutor": lambda context: self},
            "rclpy.qos": {
                "QoSProfile": SimpleNamespace,
                "ReliabilityPolicy": policies,
                "DurabilityPolicy": durabilities,
            },
            "rosidl_runtime_py": {},
            "rosidl_runtime_py.utilities": {"get_message": self.get_message},
        }
        for name, content in modules.items():
            module = ModuleType(name)
            vars(module).update(content)
            module.__spec__ = ModuleSpec(name, None)
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setitem(sys.modules, "pipelines.serving.ros2_rclpy", None)
        del sys.modules["pipelines.serving.ros2_rclpy"]  # imported anew here, and gone after the test
        self.waiting = deque()

    def init(self, context):
        self.running = context

    @staticmethod
    def get_message(name):
        package, _, message = name.split("/")
        if package == "nav_msgs":
            raise ModuleNotFoundError("No module named 'nav_msgs'")
        return f"{package}.msg.{message}"

    def add_node(self, node):
        assert node is self

    def spin_once(self, timeout_sec):
        if self.waiting:
            callback, data = self.waiting.popleft()
            callback(data)

    def offer(self, topic, type_, reliability="reliable"):
        found = SimpleNamespace(
            topic_type=type_,
            endpoint_gid=[len(self.publishers.get(topic, []))],
            qos_profile=SimpleNamespace(reliability=reliability),
        )
        self.publishers.setdefault(topic, []).append(found)

    def get_publishers_info_by_topic(self, topic):
        return self.publishers.get(topic, [])

    def create_subscription(self, kind, topic, callback, quality, raw):
        assert raw
        self.subscriptions[topic] = (kind, quality, callback)

    def create_publisher(self, kind, topic, quality):
        assert quality.reliability == "reliable"

        def publish(data):
            assert type(data) is bytes
            self.published.append((topic, kind, data))

        return SimpleNamespace(publish=publish)

    def send(self, topic, data):
        self.waiting.append((self.subscriptions[topic][2], data))


def test_the_node_runs_by_rclpy_where_that_is_installed(monkeypatch):
    ros, store = FakeRos(monkeypatch), example.typestore()
    stream = StreamTracker(lambda: load_config("file").new_tracker("saga"), shown=shown_tracks)
    node = Ros2Node(stream, RecordingOptions({"lidar": "/objects"}), result_topics(["/tracks"]))
    assert ros.running is not None
    ros.offer("/objects", example.DETECTED, "best effort")
    ros.offer("/tf", example.TF)
    ros.offer("/tf_static", example.TF)

    class Stop:
        """Requests to stop when everything that was sent has been read."""

        def __init__(self):
            self.left = 10

        def notify(self, act):
            self.act = act

    def payload(type_, content):
        return bytes(store.serialize_cdr(example._typed(store, type_, content), type_))

    stop, spin_once = Stop(), ros.spin_once

    def played(timeout_sec):
        if timeout_sec and not ros.waiting and stop.left:
            k, stop.left = 10 - stop.left, stop.left - 1
            ros.send("/tf_static", payload(example.TF, {"transforms": [example.BASE_TO_LIDAR]}))
            ros.send("/tf", payload(example.TF, {"transforms": [example.map_to_base(k)]}))
            ros.send("/objects", payload(example.DETECTED, example.detected_objects(k)))
        elif timeout_sec:
            stop.act()
        spin_once(timeout_sec)

    ros.spin_once = played
    node.run(stop)
    assert stream.status()["frames"] == 10
    qualities = {topic: (q.reliability, q.durability) for topic, (_, q, _) in ros.subscriptions.items()}
    assert qualities == {
        "/objects": ("best effort", "volatile"),
        "/tf": ("reliable", "volatile"),
        "/tf_static": ("reliable", "transient"),
    }
    assert {(topic, kind) for topic, kind, _ in ros.published} == {("/tracks", TRACKED.replace("/", ".msg."))}
    assert len(ros.published) == 10
    tracked = message_objects(autoware_rows(decoder(TRACKED)(ros.published[-1][2])), {})
    expected = {label: place for label, place, *_ in example.objects(9)}
    for label, place in zip(tracked.detections.boxes.label, tracked.detections.boxes.position, strict=True):
        np.testing.assert_allclose(place, expected[label], atol=0.3)


def test_packages_that_ros_lacks_and_other_types_are_named(monkeypatch, caplog):
    ros = FakeRos(monkeypatch)
    with pytest.raises(InputError, match=r"^/odom: needs nav_msgs, installed in ROS$"):
        open_network({"/objects": (DETECTED,), "/odom": ("nav_msgs/Odometry",)}, "rclpy")
    network = open_network({"/objects": (DETECTED, "nav_msgs/Odometry")}, "rclpy")
    assert caplog.messages == ["/objects: nav_msgs is not installed in ROS, its messages cannot be read"]
    caplog.clear()
    for type_ in ("std_msgs/Header", "nav_msgs/Odometry"):
        ros.offer("/objects", type_.replace("/", "/msg/"))
        for _ in range(2):
            assert network.received(0.0) == []
        assert f"/objects: expected messages of {DETECTED}, {type_} is published: left out" in caplog.messages
    assert len(caplog.messages) == 2
    with pytest.raises(InputError, match="nav_msgs/Odometry: expected its package to be installed in ROS"):
        network.publisher("/tracks", "nav_msgs/Odometry")


def test_the_middleware_is_what_is_asked_for(monkeypatch):
    assert isinstance(open_network({}), DdsNetwork)
    with pytest.raises(MissingExtraError, match=r"rclpy comes with ROS 2: .* --middleware cyclonedds"):
        open_network({}, "rclpy")
    FakeRos(monkeypatch)
    assert not isinstance(open_network({}), DdsNetwork)
    assert isinstance(open_network({}, "cyclonedds"), DdsNetwork)
