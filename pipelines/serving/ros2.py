"""Live tracking as a node of ROS 2: detections and the vehicle's pose in, tracks out; needs the extra [ros2].

Payloads in CDR are received and sent over DDS, without ROS.

    topic /NAME, type PKG/TYPE      in DDS: rt/NAME, PKG::msg::dds_::TYPE_

What is published on a topic is found by discovery, and subscribed with the reliability that its first publisher offers,
as `ros2 topic echo` does: a request for more would match nothing. Of `TRANSIENT` topics the latest messages of before
are received too. The domain is that of the environment's ROS_DOMAIN_ID, network interfaces are those of CYCLONEDDS_URI.

Sources: https://design.ros2.org/articles/topic_and_service_names.html; the manual of Eclipse Cyclone DDS.

From a payload to tracks:

    payload -> message -> detections -> placed by /tf, /tf_static, odometry -> frame -> stream -> tracks -> message

Messages become frames by the code that reads recordings, and frames go to the stream of the service. Tracks are in the
frame `map`, or another. A message waits for the transforms at its time for at most `PATIENCE`, as a filter of tf2 does;
then the pose counts that is known within `HOLD`. A message that cannot be used is counted and named in a line of the
log, one a minute for each topic and kind of fault.
"""

import logging
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from data_tools.datasets.mcap.dataset import RecordingOptions, message_content, placed_frames
from data_tools.datasets.mcap.objects import OBJECT_TYPES, RESULTS, MessageObjects, message_objects
from data_tools.datasets.mcap.recording import LoggedMessage, Topic
from data_tools.datasets.mcap.ros2_types import NUMBERS, definition, encoded, fields_of, plain_type
from data_tools.datasets.mcap.transforms import HOLD, ODOMETRY_TYPES, WORLD, TransformBuffer, find_places
from data_tools.files import one_line
from pipelines.serving.messages import FrameMessage
from pipelines.serving.server import StopRequest
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError, error_context
from saga_fg.types import Frame, Tracks

try:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic as DdsTopic
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    from saga_fg.errors import MissingExtraError

    raise MissingExtraError("DDS needs cyclonedds and rosbags: pip install 'saga-fg[ros2]'") from error


log = logging.getLogger(__name__)

DEPTH = 100  # messages that wait to be read, as tf2's
PUBLISHED_DEPTH = 10  # ROS 2's default
BLOCKING = 100_000_000  # ns that a full reliable writer waits
TRANSIENT = ("/tf_static",)
AT_ONCE = 1000  # publishers
_TYPES: Any = types
PLAIN = {"string": str, "bool": bool} | {name: getattr(_TYPES, name) for name in NUMBERS if name != "bool"}
_DOMAINS = 233


class Ros2Network:
    """A participant that subscribes topics, each with the types it takes; `subscribed`: those that are published.

    Raises `InputError` where DDS cannot be started.
    """

    def __init__(self, wanted: Mapping[str, Collection[str]]) -> None:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if domain not in map(str, range(_DOMAINS)):
            raise InputError(f"ROS_DOMAIN_ID: expected a number from 0 to {_DOMAINS - 1}, got {domain[:40]!r}")
        self._wanted = wanted
        self.subscribed: dict[str, Topic] = {}
        self._readers: dict[str, Any] = {}
        self._reliable: set[str] = set()
        try:
            self._participant = DomainParticipant(int(domain))
        except DDSException as error:
            uri = os.environ.get("CYCLONEDDS_URI", "")[:200]
            raise InputError(f"domain {domain}: DDS cannot be started with CYCLONEDDS_URI={uri!r}: {error}") from error
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._waiting = WaitSet(self._participant)
        self._attach(self._publications)

    def received(self, timeout: float) -> list[LoggedMessage]:
        """Return the payloads (bytes) that have come, topic by topic, after at most `timeout` s of waiting.

        Their times are those of sending; they are not numbered.
        """
        self._waiting.wait(int(timeout * 1e9))
        for found in self._publications.take(AT_ONCE):
            if (topic := (found.topic_name or "").removeprefix("rt")) in self._wanted:
                self._discover(topic, re.sub(r"::msg::dds_::(\w+)_$", r"/\1", found.type_name), found.qos)
        return [
            LoggedMessage(self.subscribed[topic], 0, sample.sample_info.source_timestamp, sample.data)
            for topic, reader in self._readers.items()
            for sample in reader.take(DEPTH)
            if sample.sample_info.valid_data
        ]

    def publisher(self, topic: str, type_: str) -> Callable[[bytes], None]:
        """Return the function that publishes payloads of a type, reliably."""
        kind = _sample_type(type_)
        quality = _quality(Policy.Reliability.Reliable(BLOCKING), PUBLISHED_DEPTH)
        writer = DataWriter(self._participant, DdsTopic(self._participant, f"rt{topic}", kind), quality)
        return lambda data: writer.write(_sample(kind, data))

    def _discover(self, topic: str, type_: str, offered: Any) -> None:
        """Subscribe a topic that is published, if it is not subscribed so far."""
        before = self.subscribed.get(topic)
        types = self._wanted[topic] if before is None else [before.type]
        if plain_type(type_) not in types:
            wanted = " or ".join(types)
            expected = f"expected messages of {wanted}"
            log.warning("%s: %s, %s is published: left out", topic, expected, type_, extra={"kind": (topic, type_)})
            return
        best_effort = offered[Policy.Reliability] == Policy.Reliability.BestEffort
        if before is not None:
            if best_effort and topic in self._reliable:
                text = "%s: a publisher offers best effort, and the topic is subscribed reliably: left out"
                log.warning(text, topic, extra={"kind": (topic, "best effort")})
            return
        if not best_effort:
            self._reliable.add(topic)
        reliability = Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(BLOCKING)
        quality = _quality(reliability, DEPTH, topic in TRANSIENT)
        dds_topic = DdsTopic(self._participant, f"rt{topic}", _sample_type(type_))
        self.subscribed[topic] = Topic(topic, plain_type(type_), 0)
        self._readers[topic] = DataReader(self._participant, dds_topic, quality)
        self._attach(self._readers[topic])

    def _attach(self, reader: Any) -> None:
        any_state = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self._waiting.attach(ReadCondition(reader, any_state))


def payload_decoder(type_: str) -> Callable[[bytes], Any]:
    """Return the function that decodes payloads of a type that is known here; it raises what it will for others."""
    store, name = get_typestore(Stores.EMPTY), plain_type(type_).replace("/", "/msg/")
    store.register(get_types_from_msg(definition(type_) or "", name))
    return partial(store.deserialize_cdr, typename=name)


def _quality(reliability: Any, depth: int, transient: bool = False) -> Any:
    durability = Policy.Durability.TransientLocal if transient else Policy.Durability.Volatile
    return Qos(reliability, durability, Policy.History.KeepLast(depth))


@cache
def structure(type_: str) -> Any:
    """Return the type of DDS that a type of ROS 2 is, so that the definitions of both ends can be compared."""
    fields: dict[str, Any] = {}
    for name, of, length in fields_of(plain_type(type_)):
        kind = PLAIN[of] if of in PLAIN else structure(of)
        fields[name] = kind if length is None else _TYPES.array[kind, length] if length else _TYPES.sequence[kind]
    package, _, name = type_.partition("/")
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)


@cache
def _sample_type(type_: str) -> Any:
    """Return the type of a topic whose samples hold the serialised payload `data`."""
    kind = structure.__wrapped__(type_)
    kind.serialize = lambda sample, **_: sample.data
    kind.deserialize = kind.deserialize_key = partial(_sample, kind)
    return kind


def _sample(kind: Any, data: bytes) -> Any:
    sample = kind.__new__(kind)
    sample.data = data
    return sample


PATIENCE = 0.5  # s
_TOPIC = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
POLL = 0.05  # s between looks at the clock
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

    Raises `InputError` for names that are no topics of ROS 2, and as `Ros2Network` does.
    """

    def __init__(
        self, stream: StreamTracker[LoggedMessage], options: RecordingOptions, results: Mapping[str, str | None]
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
        self._network = Ros2Network(inputs)
        self._transforms = TransformBuffer()
        self._numbers: Counter[str] = Counter()
        self._decode = {type_: payload_decoder(type_) for types in inputs.values() for type_ in types}
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
        while not stopped:
            payloads = self._network.received(POLL)
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
