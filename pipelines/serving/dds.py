"""Topics of ROS 2 over DDS: payloads in CDR received and sent, without ROS; needs the extra [ros2].

    topic /NAME, type PKG/TYPE      in DDS: rt/NAME, PKG::msg::dds_::TYPE_

What is published on a topic is found by discovery, and subscribed with the reliability that its first publisher offers,
as `ros2 topic echo` does: a request for more would match nothing. Of `TRANSIENT` topics the latest messages of before
are received too. The domain is that of the environment's ROS_DOMAIN_ID, network interfaces are those of CYCLONEDDS_URI.

Sources: https://design.ros2.org/articles/topic_and_service_names.html; the manual of Eclipse Cyclone DDS.
"""

import logging
import os
import re
from collections.abc import Callable, Collection, Mapping
from functools import cache, partial
from typing import Any

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

from data_tools.datasets.mcap.recording import LoggedMessage, Topic
from data_tools.datasets.mcap.ros2_types import NUMBERS, definition, fields_of, plain_type
from saga_fg.errors import InputError

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
    """The same type, whose samples are the payload `data` as it is."""
    kind = structure.__wrapped__(type_)
    kind.serialize = lambda sample, **_: sample.data
    kind.deserialize = kind.deserialize_key = partial(_sample, kind)
    return kind


def _sample(kind: Any, data: bytes) -> Any:
    sample = kind.__new__(kind)
    sample.data = data
    return sample
