"""ROS 2's topics by rclpy, the client library of an installed ROS 2, as a node of it: any middleware of ROS.

Payloads are serialised messages on both sides (`raw=True`), as in DDS. The class of a message is that of its package,
which has to be installed; its code is not used. Untested with an installation of ROS.

Source: the manual of rclpy, https://docs.ros.org/en/jazzy/p/rclpy/.
"""

import atexit
import logging
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

from data_tools.datasets.mcap.recording import LoggedMessage
from pipelines.serving.ros2_network import DEPTH, PUBLISHED_DEPTH, TRANSIENT, Ros2Network
from saga_fg.errors import InputError, MissingExtraError

try:
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from rosidl_runtime_py.utilities import get_message
except ImportError as error:
    raise MissingExtraError(
        "rclpy comes with ROS 2: source its setup.bash first, or --middleware cyclonedds"
    ) from error

log = logging.getLogger(__name__)


class RclpyNetwork(Ros2Network):
    """A node of ROS 2; messages of packages that are not installed are left out, and told.

    Raises `InputError` for a topic that could have no others.
    """

    def __init__(self, wanted: Mapping[str, Collection[str]]) -> None:
        super().__init__({topic: _installed(topic, types) for topic, types in wanted.items()})
        self._context = Context()  # of its own, which leaves signals alone
        rclpy.init(context=self._context)
        atexit.register(self._context.try_shutdown)
        self._node = rclpy.create_node("saga_fg", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: set[tuple[str, ...]] = set()  # that were found
        self._came: list[LoggedMessage] = []

    def received(self, timeout: float) -> list[LoggedMessage]:
        """Return the payloads that have come, with the times at which they did."""
        for topic in self._wanted:
            for found in self._node.get_publishers_info_by_topic(topic):
                publisher = topic, found.topic_type, str(found.endpoint_gid)
                if publisher not in self._publishers:
                    self._publishers.add(publisher)
                    is_reliable = found.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT
                    self._discover(topic, found.topic_type.replace("/msg/", "/"), is_reliable)
        self._executor.spin_once(timeout_sec=timeout)
        waiting = 0
        while len(self._came) > waiting:  # one callback at a time
            waiting = len(self._came)
            self._executor.spin_once(timeout_sec=0)
        came, self._came = self._came, []
        return came

    def publisher(self, topic: str, type_: str) -> Callable[[bytes], None]:
        """Return the function that publishes payloads of a type, reliably."""
        quality = QoSProfile(depth=PUBLISHED_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        publisher = self._node.create_publisher(_message_class(type_), topic, quality)
        return lambda data: publisher.publish(bytes(data))

    def _subscribe(self, topic: str, type_: str, is_reliable: bool) -> None:
        reliability = ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT
        durability = DurabilityPolicy.TRANSIENT_LOCAL if topic in TRANSIENT else DurabilityPolicy.VOLATILE
        quality = QoSProfile(depth=DEPTH, reliability=reliability, durability=durability)
        take = partial(self._take, topic)
        self._node.create_subscription(_message_class(type_), topic, take, quality, raw=True)

    def _take(self, topic: str, data: bytes) -> None:
        self._came.append(LoggedMessage(self.subscribed[topic], 0, time.time_ns(), data))


def _installed(topic: str, types: Collection[str]) -> list[str]:
    """The types of a topic whose message packages are installed."""
    found, lacking = [], {}
    for type_ in types:
        try:
            _message_class(type_)
            found.append(type_)
        except InputError as error:
            lacking[type_.partition("/")[0]] = error
    if not found:
        raise InputError(f"{topic}: needs {' or '.join(lacking)}, installed in ROS") from next(iter(lacking.values()))
    for package in lacking:
        log.warning("%s: %s is not installed in ROS, its messages cannot be read", topic, package)
    return found


def _message_class(type_: str) -> Any:
    """The class of a type PKG/TYPE. Raises `InputError` where its package is not installed."""
    try:
        return get_message(type_.replace("/", "/msg/"))
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"{type_}: expected its package to be installed in ROS: {error}") from error
