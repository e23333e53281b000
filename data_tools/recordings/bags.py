"""Scans in a recording of ROS 2, MCAP or a bag folder, with the vehicle's other sensors and coordinate frames.

    sensor_msgs/PointCloud2   scans of a LiDAR: places, intensity, time of each point
    sensor_msgs/LaserScan     scans of a planar laser
    sensor_msgs/Imu, NavSatFix, nav_msgs/Odometry (its twist)     imu, gps, wheels
    tf2_msgs/TFMessage, nav_msgs/Odometry                          where sensors are, and where the vehicle was

One pass reads everything but points, which are read when a scan is asked for. Times are those of the headers. A
recording may have two clocks, as that of a LiDAR which counts from its start: the median of the time logged minus that
of the header tells them apart. Times of topics whose clock is another than that of the scans are shifted by the
difference. Sources: the definitions in https://github.com/ros2/common_interfaces; REP 103, 105 and 145.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_tools.datasets.kitti.dataset import world_position
from data_tools.datasets.mcap import (
    SUFFIXES,
    TRANSFORM_TYPES,
    LoggedMessage,
    Recording,
    Topic,
    TransformRecord,
    TransformTree,
    checked_time,
    decoded_messages,
    frame_name,
    nanoseconds,
    transform_records,
    xyz,
)
from data_tools.files import isolated
from data_tools.laser.carmen import LaserLog, padded
from data_tools.lidar import Columns, RecordingOptions, ScanRecording, scan_columns, scan_of_columns
from saga_fg import InputError
from saga_fg.errors import error_context, unknown_name
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.slam.sensors import SensorName

CLOUD, LASER, ODOMETRY = "sensor_msgs/PointCloud2", "sensor_msgs/LaserScan", "nav_msgs/Odometry"
_SENSORS: Mapping[SensorName, str] = {"imu": "sensor_msgs/Imu", "gps": "sensor_msgs/NavSatFix", "wheels": ODOMETRY}
_KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # of the datatypes 1 to 8 of a PointField
_AT_ONCE = 20  # scans that are read ahead
_CLOCKS = 0.5  # s, more than messages wait before they are logged
_HIGHEST = 85.0  # deg of latitude
_FLAT = 0.9  # cosine of the tilt of a planar laser
_log = logging.getLogger(__name__)


def is_bag(path: Path) -> bool:
    """True for a file of MCAP or SQLite, and for a folder with such files."""
    if path.is_dir():
        return any(each.suffix in SUFFIXES for each in path.iterdir())
    return path.suffix in SUFFIXES


def cloud_columns(message: Any) -> Columns:
    """The columns of a PointCloud2. Raises `InputError` naming the field where sizes contradict each other."""
    step, height, width = message.point_step, message.height, message.width
    kinds, offsets = dict[str, Any](), list[int]()
    for k, each in enumerate(message.fields):
        if not 1 <= each.datatype <= len(_KINDS):
            raise InputError(f"fields[{k}].datatype: expected 1 to {len(_KINDS)}, got {each.datatype}")
        kind = np.dtype((">" if message.is_bigendian else "<") + _KINDS[each.datatype - 1])
        end = each.offset + kind.itemsize * max(each.count, 1)
        if end > step:
            raise InputError(f"point_step: expected at least {end} bytes, as {each.name!r:.40} ends there, got {step}")
        if each.count <= 1 and each.name not in kinds:
            kinds[each.name] = kind
            offsets.append(each.offset)
    row = message.row_step if height > 1 else width * step
    if row < width * step or len(message.data) != height * row:
        raise InputError(
            f"data: expected height x width x point_step = {height} x {width} x {step} bytes, got {len(message.data)} "
            f"in rows of {message.row_step}"
        )
    record = np.dtype({"names": [*kinds], "formats": [*kinds.values()], "offsets": offsets, "itemsize": step})
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(height, row)[:, : width * step]
    points = np.ascontiguousarray(rows).reshape(-1).view(record)
    return {name: points[name] for name in kinds}


def _contents(path: Path, files: Sequence[Path], topics: Mapping[str, Topic]) -> Iterator[LoggedMessage]:
    """Messages without the points of clouds: (stamp, frame, numbers), or transforms."""
    for logged in decoded_messages(files, topics):
        with error_context(f"{path}: {logged.topic.name}: message {logged.number}"):
            try:
                content = _content(logged)
            except AttributeError as error:
                raise InputError(f"{error.name}: expected this field in {logged.topic.type}") from error
        yield replace(logged, message=content)


def _content(logged: LoggedMessage) -> Any:
    message, kind = logged.message, logged.topic.type
    if kind in TRANSFORM_TYPES:
        return list(transform_records(logged))
    stamp, frame = nanoseconds(message.header.stamp), frame_name(message.header.frame_id)
    numbers: Any = None
    if kind == LASER:
        ranges = np.array(message.ranges, dtype=np.float64)
        ranges[~((ranges >= message.range_min) & (ranges < message.range_max))] = np.nan
        numbers = ranges, message.angle_min, message.angle_increment
    elif kind == ODOMETRY:
        numbers = message.twist.twist.linear.x, list(transform_records(logged))
    elif kind == _SENSORS["imu"]:
        numbers = (*xyz(message.linear_acceleration), *xyz(message.angular_velocity))
    elif kind == _SENSORS["gps"]:
        fix = (message.latitude, message.longitude, message.altitude)
        numbers = fix if message.status.status >= 0 else None
    return stamp, frame, numbers


def _points(
    path: Path, files: Sequence[Path], topics: Mapping[str, Topic], since: int, skip: int, count: int
) -> Iterator[dict[str, NDArray[Any]]]:
    """The columns of `count` clouds logged from `since`, ns, without the first ones of these."""
    for logged in islice(decoded_messages(files, topics, since), skip, skip + count):
        with error_context(f"{path}: {logged.topic.name}"):
            columns = cloud_columns(logged.message)
        yield {name: np.ascontiguousarray(column) for name, column in scan_columns(columns).items()}


@dataclass(eq=False)
class _Clouds:
    """Columns of the clouds of a topic by number; several at once where they are asked for one after the other."""

    recording: Recording
    topic: str
    logged: IntArray
    _first: int = 0
    _read: list[dict[str, NDArray[Any]]] = field(default_factory=list)

    def __call__(self, number: int) -> Columns:
        if not 0 <= number - self._first < len(self._read):
            since, skip = int(self.logged[number]), int((self.logged[:number] >= self.logged[number]).sum())
            count = _AT_ONCE if number == self._first + len(self._read) else 1
            chosen = self.recording.chosen([self.topic])
            path, files = self.recording.path, self.recording.files
            self._first, self._read = number, []
            try:
                for columns in isolated("not readable", _points, path, files, chosen, since, skip, count):
                    self._read.append(columns)
            except InputError:
                if not self._read:  # else that of a later one
                    raise
        if not self._read:
            raise InputError(f"expected message {number + 1} of {self.topic} as before, there is none")
        return self._read[number - self._first]


@dataclass(eq=False)
class _Messages:
    """Messages of one topic: times (n,), ns, of headers (of the log where these have none) and logged; content."""

    topic: Topic
    stamps: list[int] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    numbers: list[Any] = field(default_factory=list)

    @property
    def clock(self) -> int:
        """Median of the time logged minus that of the header, ns."""
        return int(np.median(np.array(self.logged) - np.array(self.stamps))) if self.stamps else 0


class _Bag:
    """A recording, read once but for points. wanted: types whose messages are kept."""

    def __init__(self, path: Path, options: RecordingOptions, main: str, wanted: Sequence[str]) -> None:
        self.recording, self.options = Recording(path), options
        self.path, topics = path, self.recording.topics
        named: dict[str, str] = {"lidar": CLOUD, "laser": LASER} | {str(name): kind for name, kind in _SENSORS.items()}
        for name, topic in options.topics.items():
            if name not in named:
                raise InputError(f"--topic {name}=: {unknown_name('sensor', name, tuple(named))}")
            if topic not in topics or topics[topic].type != named[name]:
                fit = tuple(sorted(each.name for each in topics.values() if each.type == named[name]))
                raise InputError(f"--topic {name}={topic}: {unknown_name(f'topic of {named[name]}', topic, fit)}")
        chosen = {kind: options.topics[name] for name, kind in named.items() if name in options.topics}
        self.of: dict[str, list[_Messages]] = {}
        for each in topics.values():
            if each.count and each.type in (main, *wanted) and chosen.get(each.type, each.name) == each.name:
                self.of.setdefault(each.type, []).append(_Messages(each))
        self.main = self._one(main, "lidar" if main == CLOUD else "laser")
        if self.main is None:
            there = ", ".join(sorted({each.type for each in topics.values()}))
            raise InputError(f"expected messages of {main}, there are {there or 'none'}")
        self.records = self._read([each.name for each in topics.values() if each.type in TRANSFORM_TYPES])
        self.tree = TransformTree(self.records)

    def _one(self, kind: str, option: str) -> _Messages | None:
        found = self.of.get(kind, [])
        if len(found) > 1:
            names = ", ".join(f"{each.topic.name} ({each.topic.count})" for each in found)
            raise InputError(f"expected --topic {option}=TOPIC with one of {names}")
        return found[0] if found else None

    def _read(self, transforms: Sequence[str]) -> list[TransformRecord]:
        records, by_topic = list[tuple[TransformRecord, int]](), dict[str, _Messages]()
        for kind in self.of.values():
            by_topic |= {each.topic.name: each for each in kind}
        chosen = self.recording.chosen([*by_topic, *transforms])
        for logged in isolated("not readable", _contents, self.path, self.recording.files, chosen):
            into, log_time = by_topic.get(logged.topic.name), checked_time(logged.log_time)
            if into is None:
                records += [(record, log_time) for record in logged.message]
                continue
            stamp, frame, numbers = logged.message
            if into.topic.type == ODOMETRY:
                numbers, edges = numbers
                records += [(record, log_time) for record in edges]
            into.stamps.append(stamp or log_time)
            into.logged.append(log_time)
            into.frames.append(frame)
            into.numbers.append(numbers)
        if self.main is not None and not self.main.stamps:
            what = f"{self.main.topic.count} messages, as its summary tells"
            raise InputError(f"{self.path}: {self.main.topic.name}: expected {what}, there are none")
        if self.main is not None and len(names := dict.fromkeys(self.main.frames)) > 1:
            what = f"expected scans of one sensor, in one frame, got {', '.join(names):.80}"
            raise InputError(f"{self.path}: {self.main.topic.name}: {what}")
        return self._one_clock([each for each in by_topic.values() if each.stamps], records)

    def _one_clock(
        self, read: Sequence[_Messages], records: list[tuple[TransformRecord, int]]
    ) -> list[TransformRecord]:
        """Bring all times to the clock of the scans, with a warning where they are not."""
        main = self.main
        assert main is not None
        clock, others = main.clock, list[str]()
        for each in read:
            shift = each.clock - clock
            if abs(shift) > _CLOCKS * 1e9:
                each.stamps = [checked_time(stamp + shift) for stamp in each.stamps]
                others.append(f"{each.topic.name} by {shift / 1e9:+.3f} s")
        moving = [logged - record.time for record, logged in records if not record.static]
        shift = int(np.median(moving)) - clock if moving else 0
        if abs(shift) > _CLOCKS * 1e9:
            records = [(record._replace(time=checked_time(record.time + shift)), logged) for record, logged in records]
            others.append(f"transforms by {shift / 1e9:+.3f} s")
        if others:
            _log.warning(
                "%s: two clocks: times of headers are shifted to the clock of %s by when they were logged: %s",
                self.path, main.topic.name, ", ".join(others),
            )  # fmt: skip
        elif abs(clock) > _CLOCKS * 1e9:
            _log.info("%s: headers are %.3f s before the time they were logged at", self.path, clock / 1e9)
        return [record for record, _ in records]

    def ego(self) -> str | None:
        """The frame of the vehicle, None if the recording does not have it."""
        return self.options.ego if self.options.ego in self.tree.frames else None

    def mount(self, frame: str, what: str) -> FloatArray | None:
        """ego_T_sensor (4, 4) by the transforms, None where these do not say it; warns then."""
        ego = self.ego()
        assert self.main is not None
        if ego is not None and frame in self.tree.frames and self.tree.connected(ego, frame):
            places, known = self.tree.lookup(ego, frame, np.array(self.main.stamps[len(self.main.stamps) // 2 :]))
            if known.any():
                return np.asarray(places[np.argmax(known)])
        if frame != self.options.ego:
            _log.warning(
                "%s: no transforms (/tf, /tf_static) between %s and %s: %s is taken to be at the vehicle's origin, its "
                "axes ahead, left and up",
                self.path, self.options.ego, frame or "''", what,
            )  # fmt: skip
        return None

    def poses(self, world: str | None, times: IntArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """world_T_ego (K, 4, 4) at some times (K,), ns, and where they are known."""
        ego = self.ego()
        if ego is None or world is None:
            return np.tile(np.eye(4), (len(times), 1, 1)), np.zeros(len(times), dtype=bool)
        return self.tree.lookup(world, ego, times)

    def place(self, row: int) -> str:
        assert self.main is not None
        return f"{self.path}: {self.main.topic.name}: message {row + 1}"

    def tables(self) -> dict[SensorName, FloatArray]:
        """Tables of the sensors; those of several topics are left out, with a warning."""
        found: dict[SensorName, FloatArray] = {}
        for name, kind in _SENSORS.items():
            try:
                messages = self._one(kind, name)
            except InputError as error:
                _log.warning("%s: %s is left out: %s", self.path, name, error)
                continue
            rows = (
                [] if messages is None else [(time, *np.atleast_1d(numbers)) for time, numbers in _measured(messages)]
            )
            if messages is None or not rows:
                continue
            table = np.array([row[1:] for row in rows], dtype=np.float64)
            time, where = 1e-9 * np.array([row[0] for row in rows]), f"{self.path}: {messages.topic.name}: measurement"
            if not (known := np.isfinite(table).all(axis=1)).all():
                raise InputError(f"{where} {int(np.argmin(known)) + 1}: expected finite numbers")
            new = np.diff(time, prepend=-np.inf)  # some are sent twice
            if (new < 0).any():
                row = int(np.argmax(new < 0))
                expected = f"time: expected one after {time[row - 1]:.6f} s"
                raise InputError(f"{where} {row + 1}: {expected}, got {time[row]:.6f} s")
            found[name] = np.column_stack([time, table])[new > 0]
        return found


def _measured(messages: _Messages) -> Iterator[tuple[int, Any]]:
    return (
        (stamp, numbers)
        for stamp, numbers in zip(messages.stamps, messages.numbers, strict=True)
        if numbers is not None
    )


def open_bag(path: Path, options: RecordingOptions) -> ScanRecording:
    """The scans of a recording. Raises `InputError` naming file, topic and message of what is wrong.

    Sensors are placed on the vehicle by the transforms. Poses are those of the vehicle in the topmost frame above it.
    Where on Earth that is, nobody knows; fixes are in metres east, north and up of the first one.
    """
    bag = _Bag(path, options, CLOUD, [*_SENSORS.values()])
    main = bag.main
    assert main is not None
    stamps = np.array(main.stamps, dtype=np.int64)
    clouds = _Clouds(bag.recording, main.topic.name, np.array(main.logged, dtype=np.int64))
    ego_T_lidar = bag.mount(main.frames[0], "the LiDAR") if options.mount is None else options.mount
    ego = bag.ego()
    world_T_ego, known = bag.poses(
        None if ego is None or bag.tree.moves_in(ego) is None else bag.tree.root(ego), stamps
    )
    if known.any() and not known.all():
        _log.warning(
            "%s: the transforms tell the vehicle's pose at %d of %d scans: they are left out",
            path,
            known.sum(),
            len(known),
        )
    mounts: dict[SensorName, FloatArray] = {}

    def sensors() -> Mapping[SensorName, FloatArray]:
        tables = bag.tables()
        for name in [name for name in tables if name != "wheels"]:
            if (place := bag.mount(bag.of[_SENSORS[name]][0].frames[0], name)) is not None:
                mounts[name] = place
        if "gps" in tables:
            time, latitude, longitude, altitude = tables["gps"].T
            if (np.abs(latitude) > _HIGHEST).any() or (np.abs(longitude) > 180).any():
                raise InputError(f"{path}: gps: expected latitudes within {_HIGHEST:g} and longitudes within 180 deg")
            begin = np.array([latitude[0], longitude[0], altitude[0]])
            tables["gps"] = np.column_stack([time, world_position(latitude, longitude, altitude, begin)])
        return tables

    return ScanRecording(
        "bag",
        np.asarray(stamps * 1e-9),
        lambda row: scan_of_columns(clouds(row), stamps[row] * 1e-9),
        bag.place,
        np.eye(4) if ego_T_lidar is None else ego_T_lidar,
        world_T_ego if known.all() else None,
        None,
        sensors,
        mounts,
    )


def read_bag_laser(path: str | Path, options: RecordingOptions | None = None) -> LaserLog:
    """The log of a planar laser in a recording: LaserScan, and the wheels by nav_msgs/Odometry or transforms.

    Scans at times at which the wheels are unknown are left out, with a warning. Raises `InputError` for no odometry,
    and for a laser that does not lie flat.
    """
    path, options = Path(path), options or RecordingOptions()
    bag = _Bag(path, options, LASER, [ODOMETRY])
    main = bag.main
    assert main is not None
    ego = bag.ego()
    if ego is None or (wheels := bag.tree.moves_in(ego)) is None:
        raise InputError(
            f"{path}: expected odometry of {options.ego}, by nav_msgs/Odometry or /tf; frames there are "
            f"{', '.join(bag.tree.frames) or 'none'}"
        )
    stamps = np.array(main.stamps, dtype=np.int64)
    poses, known = bag.poses(wheels, stamps)
    if not known.any():
        raise InputError(f"{path}: expected odometry at the times of the scans, there is none")
    if not known.all():
        _log.warning("%s: left out %d of %d scans, without odometry", path, (~known).sum(), len(known))
    place = bag.mount(main.frames[0], "the laser")
    R, at = (np.eye(3), np.zeros(3)) if place is None else (place[:3, :3], place[:3, 3])
    if abs(R[2, 2]) < _FLAT:
        raise InputError(f"{path}: {main.topic.name}: expected a laser that lies flat, {main.frames[0]} is tilted")
    rows = [numbers for numbers, is_known in zip(main.numbers, known, strict=True) if is_known]
    ranges = padded([measured for measured, _, _ in rows])
    angles = padded([np.sign(R[2, 2]) * (begin + step * np.arange(len(each))) for each, begin, step in rows])
    poses = poses[known]
    planar = np.column_stack([poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])
    return LaserLog(
        np.asarray(stamps[known] * 1e-9), ranges, angles, planar, np.array([*at[:2], np.arctan2(R[1, 0], R[0, 0])])
    )
