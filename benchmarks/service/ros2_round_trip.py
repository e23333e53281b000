"""Detections in and tracks out over DDS at true rate: `saga-fg serve ros2` in a process of its own.

This process publishes the vehicle's pose and Autoware's detections in the vehicle's frame, as two nodes of ROS 2 would,
and reads the tracks. A frame is lost that has no tracks of its time 2 s after the last one.
"""

from __future__ import annotations

import os
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner import PROGRAM, each
from benchmarks.service.served import CirclingObjects
from data_tools.datasets.mcap.objects import AUTOWARE_CLASSES, poses, vectors
from data_tools.datasets.mcap.recording import LoggedMessage
from data_tools.datasets.mcap.ros2_types import decoder, encoded, header, ros_message
from pipelines.serving.ros2_dds import DdsNetwork
from saga_fg.errors import SagaError

INTERVAL = 0.1  # s between frames
_STAMP = struct.Struct("<4xiI")  # at the beginning of a message
WARM_UP = 20  # frames that are not counted: tracks are new
PATIENCE = 2.0  # s to wait for the last tracks
SPEED = 10.0  # m/s of the vehicle
DETECTED, TRACKED = "autoware_perception_msgs/DetectedObjects", "autoware_perception_msgs/TrackedObjects"
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces></General>"
    "</Domain></CycloneDDS>"
)


def detected_objects(stamp: int, frame: str, position: np.ndarray[Any, Any]) -> Any:
    """Return a `DetectedObjects` of cars at positions (N, 3), m, of unknown heading and velocity; stamp: ns."""
    nothing, size = vectors(np.array([[0.0, 0.0, 0.0], [4.5, 1.9, 1.6]]))
    twist = ros_message("geometry_msgs/Twist", nothing, nothing)
    motion = ros_message("geometry_msgs/TwistWithCovariance", twist, np.zeros(36))
    car = [ros_message("autoware_perception_msgs/ObjectClassification", AUTOWARE_CLASSES.index("car"), 1.0)]
    shape = ros_message("autoware_perception_msgs/Shape", 0, ros_message("geometry_msgs/Polygon", []), size)
    objects = []
    for pose in poses(position, np.zeros(len(position))):
        place = ros_message("geometry_msgs/PoseWithCovariance", pose, np.zeros(36))
        known = place, False, 0, motion, False, False
        kinematics = ros_message("autoware_perception_msgs/DetectedObjectKinematics", *known)
        objects.append(ros_message("autoware_perception_msgs/DetectedObject", 0.9, car, kinematics, shape))
    return ros_message(DETECTED, header(stamp, frame), objects)


def vehicle_transform(stamp: int, position: np.ndarray[Any, Any]) -> Any:
    """Return a `TFMessage` of a vehicle that looks along x."""
    (pose,), (at,) = poses(position[None], np.zeros(1)), vectors(position[None])
    transform = ros_message("geometry_msgs/Transform", at, pose.orientation)
    stamped = ros_message("geometry_msgs/TransformStamped", header(stamp, "map"), "base_link", transform)
    return ros_message("tf2_msgs/TFMessage", [stamped])


class Peer:
    """Publishes frames of circling objects, and notes when their tracks come."""

    def __init__(self, objects: int, seed: int) -> None:
        self._scene, self._rng = CirclingObjects(objects, seed), np.random.default_rng([seed, 5])
        self._network = DdsNetwork({"/tracks": (TRACKED,)})
        self._transform = self._network.publisher("/tf", "tf2_msgs/TFMessage")
        self._detected = self._network.publisher("/detections", DETECTED)
        self.sent: dict[int, float] = {}  # by stamp, ns
        self.came: dict[int, float] = {}
        self.last = b""  # message

    def publish(self, stamp: int) -> None:
        """Publish the vehicle's pose and what it detects at a time, ns."""
        time_ = stamp / 1e9
        at = np.array([SPEED * (time_ % 1000.0), 0.0, 0.0])
        rows = self._scene.detections(time_, self._rng)
        position = np.array([[row["x"], row["y"], 0.8] for row in rows]) - at
        transform = encoded("tf2_msgs/TFMessage", vehicle_transform(stamp, at))
        detected = encoded(DETECTED, detected_objects(stamp, "base_link", position))
        self.sent[stamp] = time.monotonic()
        self._transform(transform)
        self._detected(detected)

    def read(self, until: float) -> list[LoggedMessage]:
        """Return the tracks that come until a time by `time.monotonic()`."""
        found: list[LoggedMessage] = []
        while (left := until - time.monotonic()) > 0:
            found += self._note(self._network.received(left))
        return found

    def _note(self, payloads: list[LoggedMessage]) -> list[LoggedMessage]:
        now = time.monotonic()
        for payload in payloads:
            seconds, nanoseconds = _STAMP.unpack_from(payload.message)
            self.came.setdefault(seconds * 10**9 + nanoseconds, now)
            self.last = payload.message
        return payloads

    @property
    def tracks(self) -> int:
        """How many tracks the last message has."""
        return len(decoder(TRACKED)(self.last).objects)

    def wait(self, process: subprocess.Popen[Any], seconds: float, stamp: int | None = None) -> None:
        """Publish, at one time, ns, or now, until tracks come. Raises `SagaError` where none do."""
        end = time.monotonic() + seconds
        while not self.came:
            if time.monotonic() > end or process.poll() is not None:
                raise SagaError("saga-fg serve ros2 publishes no tracks")
            self.publish(stamp or time.time_ns())
            self.read(time.monotonic() + INTERVAL)


def over_dds(objects: int, seconds: float, seed: int, domain: int = 71) -> dict[str, float]:
    """Return how many of the frames have no tracks, percentiles of the time to the tracks, ms, CPU a frame, ms, and MB.

    Raises `SagaError` when the node does not come up.
    """
    os.environ.update(ROS_DOMAIN_ID=str(domain))
    os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
    command = [*PROGRAM, "serve", "ros2", "--detections", "lidar=/detections", "--tracks", "TrackedObjects=/tracks"]
    node = subprocess.Popen(command)
    try:
        peer = Peer(objects, seed)
        peer.wait(node, 300.0)
        frames = WARM_UP + round(seconds / INTERVAL)
        begin, clock, before = time.monotonic(), time.time_ns(), 0.0
        stamps = [clock + round(k * INTERVAL * 1e9) for k in range(frames)]
        for k, stamp in enumerate(each(stamps, "frames")):
            if k == WARM_UP:
                before = _cpu_seconds(node.pid)
            peer.read(begin + k * INTERVAL)
            peer.publish(stamp)
        cpu = 1e3 * (_cpu_seconds(node.pid) - before) / (frames - WARM_UP)
        peer.read(time.monotonic() + PATIENCE)
        memory = _memory(node.pid)
    finally:
        node.terminate()
        node.wait(60)
    counted = stamps[WARM_UP:]
    times = [1e3 * (peer.came[stamp] - peer.sent[stamp]) for stamp in counted if stamp in peer.came]
    p50, p90, p99 = np.percentile(times, (50, 90, 99)).tolist() if times else (np.nan,) * 3
    about: dict[str, float] = {"objects": objects, "frames": len(counted), "lost": len(counted) - len(times)}
    about["tracks"] = peer.tracks
    return {
        **about,
        "p50": p50,
        "p90": p90,
        "p99": p99,
        "longest": max(times, default=np.nan),
        "CPU a frame": cpu,
        "MB": memory,
    }


def _cpu_seconds(pid: int) -> float:
    """CPU time of a process; Linux only."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)
