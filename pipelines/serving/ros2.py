"""Live tracking as a node of ROS 2: detections and the vehicle's pose in, tracks out; needs the extra [ros2].

From a payload in CDR to tracks:

    payload -> message -> detections -> placed by /tf, /tf_static, odometry -> frame -> stream -> tracks -> message

Messages become frames by the code that reads recordings, and frames go to the stream of the service. Tracks are in the
frame `map`, or another. A message waits for the transforms at its time for at most `PATIENCE`, as a filter of tf2 does;
then the pose counts that is known within `HOLD`. A message that cannot be used is counted and named in a line of the
log, one a minute for each topic and kind of fault.
"""

import logging
import re
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from data_tools.datasets.mcap import (
    HOLD,
    OBJECT_TYPES,
    ODOMETRY_TYPES,
    RESULTS,
    WORLD,
    LoggedMessage,
    MessageObjects,
    RecordingOptions,
    TransformBuffer,
    decoder,
    encoded,
    find_places,
    message_content,
    message_objects,
    placed_frames,
)
from data_tools.files import one_line
from pipelines.serving.messages import FrameMessage
from pipelines.serving.ros2_network import Ros2Network
from pipelines.serving.server import StopRequest
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError, error_context, require_extra
from saga_fg.types import Frame, Tracks

require_extra("ros2", "a node of ROS 2", "rosbags")

log = logging.getLogger(__name__)

Middleware = Literal["rclpy", "cyclonedds"]


def open_network(wanted: Mapping[str, Collection[str]], middleware: Middleware | None = None) -> Ros2Network:
    """Return the network of a middleware, by default that of the ROS that is installed, without one Cyclone DDS.

    wanted: topics to subscribe, each with the types that it takes

    Raises `MissingExtraError` for one that is not installed, and `InputError` where it cannot be started.
    """
    if middleware == "rclpy" or (middleware is None and find_spec("rclpy") is not None):
        from pipelines.serving.ros2_rclpy import RclpyNetwork

        return RclpyNetwork(wanted)
    from pipelines.serving.ros2_dds import DdsNetwork

    return DdsNetwork(wanted)


PATIENCE = 0.5  # s
_TOPIC = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
POLL = 0.05  # s between looks at the clock
UNHEARD = 5.0  # s, after which topics that nobody publishes are named
DETECTION_TYPES = tuple(OBJECT_TYPES)
RESULT_TYPES = {name.partition("/")[2]: name for name in RESULTS}
TRANSFORMS = {"/tf": ("tf2_msgs/TFMessage",), "/tf_static": ("tf2_msgs/TFMessage",)}


def shown_tracks(tracks: Tracks) -> dict[str, Any]:
    """Return the stream's answer for a node: the tracks as they are."""
    return {"type": "tracks", "tracks": tracks}


def result_topics(values: Iterable[str]) -> dict[str, str | None]:
    """Return the type of each topic of results by values TOPIC or TYPE=TOPIC; None: that of the detections.

    Raises `InputError` for an unknown type.
    """
    found: dict[str, str | None] = {}
    for value in values:
        kind, equals, topic = value.rpartition("=")
        if equals and kind not in RESULT_TYPES:
            raise InputError(f"--tracks {value}: expected TOPIC or TYPE=TOPIC with one of {', '.join(RESULT_TYPES)}")
        if topic in found:
            raise InputError(f"--tracks {value}: the topic {topic} is given twice")
        found[topic] = RESULT_TYPES[kind] if equals else None
    return found


class Ros2Node:
    """Tracks what is detected on some topics, and publishes the tracks.

    stream   with `shown_tracks` as its answers
    options  topics of detections by sensor, classes, frames, odometry
    results  type of each topic of tracks, None: that of the detections

    Raises `InputError` for names that are no topics of ROS 2, and as `open_network` does.
    """

    def __init__(
        self,
        stream: StreamTracker[LoggedMessage],
        options: RecordingOptions,
        results: Mapping[str, str | None],
        middleware: Middleware | None = None,
    ) -> None:
        inputs = {**dict.fromkeys(options.topics.values(), DETECTION_TYPES), **TRANSFORMS}
        if options.odometry is not None:
            if options.odometry in inputs:
                raise InputError(f"--odometry {options.odometry}: expected another topic than those of detections")
            inputs[options.odometry] = ODOMETRY_TYPES
        for topic in (*inputs, *results):
            if not _TOPIC.fullmatch(topic):
                raise InputError(f"{topic!r}: expected a topic of letters, digits and _ after slashes, as /detections")
            if topic in results and topic in inputs:
                raise InputError(f"{topic}: expected another topic for tracks than those that are read")
        self._stream, self._options, self._results = stream, options, results
        self._world = options.world or WORLD
        self._sensor_of = {topic: sensor for sensor, topic in options.topics.items()}
        self._network = open_network(inputs, middleware)
        self._transforms = TransformBuffer()
        self._numbers: Counter[str] = Counter()
        self._decode = {type_: decoder(type_) for types in inputs.values() for type_ in types}
        self._publishers: dict[str, tuple[str, Callable[[bytes], None]]] = {}
        self._waiting: list[tuple[LoggedMessage, MessageObjects, float]] = []  # with when they came
        self._open_results()

    @property
    def about(self) -> str:
        """The topics, in a line."""
        return f"reading {', '.join(self._sensor_of)}, publishing {', '.join(self._results)}"

    def run(self, stop: StopRequest) -> None:
        """Track until `stop` is requested; what was received by then is tracked."""
        stopped: list[bool] = []
        stop.notify(partial(stopped.append, True))
        begin, silent = time.monotonic(), set(self._sensor_of)
        while not stopped:
            payloads = self._network.received(POLL)
            if silent and time.monotonic() > begin + UNHEARD:
                for topic in sorted(silent - set(self._network.subscribed)):
                    log.warning("%s: nobody publishes this topic so far", topic)
                silent.clear()
            self._open_results()
            self.take(payloads)
        self.take(self._network.received(0.0), patience=0.0)
        self._publish(self._stream.flush())

    def _open_results(self) -> None:
        """Offer the topics of results whose types are known by now."""
        heard = [each.type for name, each in self._network.subscribed.items() if name in self._sensor_of]
        for topic, given in self._results.items():
            type_ = given or (OBJECT_TYPES[heard[0]].result if heard else None)
            if topic not in self._publishers and type_ is not None:
                self._publishers[topic] = type_, self._network.publisher(topic, type_)

    def take(self, payloads: Iterable[LoggedMessage], patience: float = PATIENCE) -> None:
        """Take in what was received, and track the messages that can be placed by now."""
        for payload in payloads:
            self._numbers[payload.topic.name] += 1
            logged = replace(payload, number=self._numbers[payload.topic.name])
            with self._refusing(logged):
                self._read(logged)
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            logged, objects, received = each
            last, frame = time.monotonic() - received >= patience, None
            with self._refusing(logged):
                frame = self._frame(logged, objects, last)
                if frame is None:
                    self._waiting.append(each)
            if frame is not None:
                message = FrameMessage(frame, None, frame.detections.boxes.yaw)
                self._publish(self._stream.handle(message, logged, received))

    @contextmanager
    def _refusing(self, logged: LoggedMessage) -> Iterator[None]:
        """Count and name what is wrong with a message."""
        try:
            with error_context(f"{logged.topic.name}: message {logged.number}"):
                yield
        except InputError as error:
            self._say(logged, self._stream.refuse(error)["message"])

    @staticmethod
    def _say(logged: LoggedMessage, text: str) -> None:
        kind = re.sub(r"[-+.\w]*\d[-+.\w]*", "", text)  # the fault without numbers
        log.warning("%s", text, extra={"kind": (logged.topic.name, kind)})

    def _read(self, logged: LoggedMessage) -> None:
        """Take in one payload: transforms at once, objects to be placed."""
        limits, type_ = self._stream.settings, logged.topic.type
        if len(logged.message) > limits.max_message:
            raise InputError(f"expected at most {limits.max_message} bytes, got {len(logged.message)}")
        with one_line("not readable", type_):
            content = message_content(replace(logged, message=self._decode[type_](logged.message)))
        if type_ not in OBJECT_TYPES:
            for record in content:
                self._transforms.add(record)
            return
        objects = message_objects(content, self._options.classes)
        if len(objects.detections) > limits.max_detections:
            raise InputError(f"detections: expected at most {limits.max_detections}, got {len(objects.detections)}")
        self._waiting.append((replace(logged, message=objects.stamp), objects, time.monotonic()))

    def _frame(self, logged: LoggedMessage, objects: MessageObjects, last: bool) -> Frame | None:
        """The frame of a message; None where transforms may come. Raises `InputError` where they have not."""
        source, ego, time_ = objects.frame, self._options.ego, np.array([objects.stamp])
        tree = self._transforms.tree([source, ego], objects.stamp)
        vehicle = ego if ego in tree.frames and tree.connected(self._world, ego) else None
        try:
            places = find_places(tree, self._world, vehicle, [source], time_, HOLD if last else 0.0)
            frames = placed_frames([(logged, objects)], self._sensor_of, places)
            if frames:
                return frames[0]
            named = f"{source or ego} to {self._world}"
            raise InputError(
                f"expected transforms from {named} at its time, {objects.stamp / 1e9:.3f} s, there are none"
            )
        except InputError:
            if last:
                raise
        return None

    def _publish(self, answers: Iterable[tuple[LoggedMessage, dict[str, Any]]]) -> None:
        """Publish the tracks of the answers, and say what the others are."""
        for logged, answer in answers:
            if answer["type"] == "tracks":
                tracks = answer["tracks"]
                stamp = logged.message if logged.message / 1e9 == tracks.timestamp else round(tracks.timestamp * 1e9)
                for type_, publish in self._publishers.values():
                    publish(encoded(type_, RESULTS[type_](tracks, stamp, self._world, self._options.names)))
            elif answer["type"] == "error":
                self._say(logged, f"{logged.topic.name}: message {logged.number}: {answer['message']}")
