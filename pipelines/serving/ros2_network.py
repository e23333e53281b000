"""Topics of ROS 2, subscribed and published as payloads in CDR, whatever brings them.

What is published on a topic is found by discovery, and subscribed with the reliability that its first publisher offers,
as `ros2 topic echo` does: a request for more would match nothing. Of `TRANSIENT` topics the latest messages of before
are received too. `pipelines.serving.ros2_dds` speaks DDS itself, `pipelines.serving.ros2_rclpy` by an installed ROS.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping

from data_tools.datasets.mcap import LoggedMessage, Topic, plain_type

log = logging.getLogger(__name__)

DEPTH = 100  # messages that wait to be read, as tf2's
PUBLISHED_DEPTH = 10  # ROS 2's default
TRANSIENT = ("/tf_static",)


class Ros2Network(ABC):
    """A participant that subscribes topics, each with the types it takes; `subscribed`: those that are published."""

    def __init__(self, wanted: Mapping[str, Collection[str]]) -> None:
        self._wanted = wanted
        self.subscribed: dict[str, Topic] = {}
        self._reliable: set[str] = set()

    @abstractmethod
    def received(self, timeout: float) -> list[LoggedMessage]:
        """Return the payloads (bytes) that have come, topic by topic, after at most `timeout` s of waiting.

        They are not numbered.
        """

    @abstractmethod
    def publisher(self, topic: str, type_: str) -> Callable[[bytes], None]:
        """Return the function that publishes payloads of a type, reliably."""

    @abstractmethod
    def _subscribe(self, topic: str, type_: str, is_reliable: bool) -> None:
        """Receive a topic of a type PKG/TYPE from now on."""

    def _discover(self, topic: str, type_: str, is_reliable: bool) -> None:
        """Subscribe a topic that is published, if it is not subscribed so far."""
        before = self.subscribed.get(topic)
        types = self._wanted[topic] if before is None else [before.type]
        if plain_type(type_) not in types:
            wanted = " or ".join(types)
            expected = f"expected messages of {wanted}"
            log.warning("%s: %s, %s is published: left out", topic, expected, type_, extra={"kind": (topic, type_)})
        elif before is None:
            self._subscribe(topic, type_, is_reliable)
            self.subscribed[topic] = Topic(topic, plain_type(type_), 0)
            if is_reliable:
                self._reliable.add(topic)
        elif not is_reliable and topic in self._reliable:
            text = "%s: a publisher offers best effort, and the topic is subscribed reliably: left out"
            log.warning(text, topic, extra={"kind": (topic, "best effort")})
