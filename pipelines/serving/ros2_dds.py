"""ROS 2's topics over DDS, without ROS; needs the extra [ros2].

    topic /NAME, type PKG/TYPE      in DDS: rt/NAME, PKG::msg::dds_::TYPE_

The domain is that of the environment's ROS_DOMAIN_ID, network interfaces are those of CYCLONEDDS_URI.

Sources: https://design.ros2.org/articles/topic_and_service_names.html; the manual of Eclipse Cyclone DDS.
"""

import os
import re
from collections.abc import Callable, Collection, Mapping
from functools import cache, partial
from typing import Any

from data_tools.datasets.mcap import LoggedMessage, fields_of, plain_type
from pipelines.serving.ros2_network import DEPTH, PUBLISHED_DEPTH, TRANSIENT, Ros2Network
from saga_fg.errors import InputError, MissingExtraError

try:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic as DdsTopic
except ImportError as error:
    raise MissingExtraError("DDS needs cyclonedds: pip install 'saga-fg[ros2]'") from error

BLOCKING = 100_000_000  # ns that a full reliable writer waits
AT_ONCE = 1000  # publishers
_TYPES: Any = types
NUMBERS = ("uint8", "int8", "uint16", "int32", "uint32", "float32", "float64")
PLAIN = {"string": str, "bool": bool} | {name: getattr(_TYPES, name) for name in NUMBERS}
_DOMAINS = 233


class DdsNetwork(Ros2Network):
    """A participant in DDS.

    Raises `InputError` where DDS cannot be started.
    """

    def __init__(self, wanted: Mapping[str, Collection[str]]) -> None:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if domain not in map(str, range(_DOMAINS)):
            raise InputError(f"ROS_DOMAIN_ID: expected a number from 0 to {_DOMAINS - 1}, got {domain[:40]!r}")
        super().__init__(wanted)
        self._readers: dict[str, Any] = {}
        try:
            self._participant = DomainParticipant(int(domain))
        except DDSException as error:
            uri = os.environ.get("CYCLONEDDS_URI", "")[:200]
            raise InputError(f"domain {domain}: DDS cannot be started with CYCLONEDDS_URI={uri!r}: {error}") from error
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._waiting = WaitSet(self._participant)
        self._attach(self._publications)

    def received(self, timeout: float) -> list[LoggedMessage]:
        """Return the payloads that have come, with the times of sending."""
        self._waiting.wait(int(timeout * 1e9))
        for found in self._publications.take(AT_ONCE):
            if (topic := (found.topic_name or "").removeprefix("rt")) in self._wanted:
                is_reliable = found.qos[Policy.Reliability] != Policy.Reliability.BestEffort
                self._discover(topic, re.sub(r"::msg::dds_::(\w+)_$", r"/\1", found.type_name), is_reliable)
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

    def _subscribe(self, topic: str, type_: str, is_reliable: bool) -> None:
        reliability = Policy.Reliability.Reliable(BLOCKING) if is_reliable else Policy.Reliability.BestEffort
        quality = _quality(reliability, DEPTH, topic in TRANSIENT)
        dds_topic = DdsTopic(self._participant, f"rt{topic}", _sample_type(type_))
        self._readers[topic] = DataReader(self._participant, dds_topic, quality)
        self._attach(self._readers[topic])

    def _attach(self, reader: Any) -> None:
        any_state = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self._waiting.attach(ReadCondition(reader, any_state))


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
