"""Recordings of ROS 2 as a dataset of the command, and tracks as messages.

Tracks as messages of a file of MCAP, in the type that the detections had, and read back.

The topic is `/saga_fg/tracks`, the frame the one that was tracked in, the times are those of the detections.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Self

import numpy as np

from data_tools.datasets.detection_file_source import JUDGED, DetectedTruth, score_tables
from data_tools.datasets.detection_files import TableImport, TrackRows, TruthTable, read_tracks, read_truth
from data_tools.datasets.mcap.dataset import McapRecording, RecordedScene, RecordingOptions, recorded_messages
from data_tools.datasets.mcap.objects import OBJECT_TYPES, MessageObjects, message_objects
from data_tools.datasets.mcap.recording import Recording
from data_tools.datasets.mcap.ros2_types import definition, encoded
from data_tools.datasets.mcap.transforms import DEFAULT_EGO
from data_tools.datasets.results import Results, table_results
from data_tools.datasets.source import (
    TRACKING,
    DatasetSource,
    HeldScene,
    OpenedPart,
    Part,
    Parts,
    ResultFormat,
    TrackedScenes,
    file_digest,
    option,
)
from data_tools.files import atomic_file, local_copy
from saga_fg.errors import InputError, error_context
from saga_fg.tables import pairs
from saga_fg.types import Boxes, Dataset, Scene, Tracks

TOPIC = "/saga_fg/tracks"


def write_track_messages(path: Path, dataset: McapRecording, scenes: Iterable[tuple[Scene, Sequence[Tracks]]]) -> None:
    """Write the tracks of a recording, a message for each moment; the file appears when all is done.

    Classes go back to the names of the recording. Raises `InputError` for a path that is not writable.
    """
    from mcap.writer import Writer

    type_ = dataset.form.result
    with atomic_file(path) as file:
        writer: Any = Writer(file)
        writer.start(profile="ros2", library="saga-fg")
        text = definition(type_) or ""
        schema = writer.register_schema(type_.replace("/", "/msg/"), "ros2msg", text.encode())
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for scene, moments in scenes:
            assert isinstance(scene, RecordedScene)
            for token, tracks in zip(scene.tokens, moments, strict=True):
                stamp = int(token)
                message = dataset.form.message(tracks, stamp, scene.world, dataset.options.names)
                writer.add_message(channel, stamp, encoded(type_, message), stamp)
        writer.finish()


def read_track_messages(
    path: Path, scene: str, classes: Mapping[str, str], world: str | None = None, topic: str | None = None
) -> TrackRows:
    """Tracks of one scene, of this or another tracker, or true objects.

    scene  its name, of all rows
    world  frame that they are in; None: not checked
    topic  None: our topic or, where it is missing, the only one with objects

    Raises `InputError` naming file, topic, message and field; and for tracks in another frame.
    """
    recording = Recording(path)
    fit = [each.name for each in recording.topics.values() if each.type in OBJECT_TYPES]
    if topic is None:
        topic = TOPIC if TOPIC in fit or len(fit) != 1 else fit[0]
    if topic not in fit:
        raise InputError(f"{path}: expected a topic {topic} with tracks, there are {', '.join(fit) or 'none'}")
    parts: list[MessageObjects] = []
    for logged in recorded_messages(recording, [topic]):
        with error_context(f"{path}: {topic}: message {logged.number}"):
            found = message_objects(logged.message, classes)
            if (found.id == "").any():
                raise InputError(f"expected objects with ids, object {int(np.argmax(found.id == ''))} has none")
            if world is not None and len(found.id) and found.frame not in ("", world.lstrip("/")):
                raise InputError(
                    f"expected tracks in the frame {world} of the recording, got {found.frame}; "
                    f"add --world {found.frame}, if they were tracked in it"
                )
            parts.append(found)
    n = [len(each.id) for each in parts]
    none = np.empty((0, 2, 2))
    return TrackRows.from_columns(
        np.full(sum(n), scene),
        np.repeat([each.stamp / 1e9 for each in parts], n),
        np.concatenate([np.empty(0, dtype="<U1"), *(each.id for each in parts)]),
        Boxes.concatenate([each.detections.boxes for each in parts]),
        np.concatenate([np.empty(0), *(each.detections.score for each in parts)]),
        np.concatenate([none, *(each.detections.position_covariance for each in parts)]),
        np.concatenate([none, *(each.velocity_covariance for each in parts)]),
    )


class McapFormat(ResultFormat):
    """Messages, or a table."""

    tracks = "File to write: .mcap for messages of the type that the detections have; a table: .csv, .ndjson, .parquet."
    tracks_example = "tracks.mcap"

    def write_tracks(self, output: Path, dataset: McapRecording, scenes: TrackedScenes) -> None:
        if output.suffix != ".mcap":
            super().write_tracks(output, dataset, scenes)
            return
        write_track_messages(output, dataset, scenes)


@dataclass(frozen=True, kw_only=True)
class McapSource(DatasetSource):
    """Recordings of ROS 2: a file of MCAP or a bag folder; needs the extra [mcap], no installation of ROS.

    Topics of Autoware's DetectedObjects and TrackedObjects, and vision_msgs/Detection3DArray; the pose of the vehicle
    from /tf or nav_msgs/Odometry. Without --topic, the one topic that holds objects is taken, and if there are several,
    they are listed.
    """

    name = "mcap"
    written = McapFormat()
    has_truth = False
    truth_option = "--truth"
    summarised = True
    example = "drive.mcap --topic /perception/objects"
    recording: list[str] | None = option(
        "MCAP file or bag folder. In parallel: several of them.",
        None,
        metavar="RECORDING",
        required=(*TRACKING, "learn interactions", "evaluate labels", "report", "view"),
        argument=True,
    )
    topic: list[str] | None = option(
        "Topic that holds objects, a sensor of its own; repeatable.", None, metavar="[SENSOR=]TOPIC"
    )
    classes: str | None = option(
        "Names of classes: CAR=car,PERSON=pedestrian. `SIGN=` leaves a class out.", None, metavar="THEIRS=OURS,..."
    )
    world: str | None = option("Frame to track in; the topmost above the vehicle if left out.", None, metavar="FRAME")
    ego: str = option("Frame of the vehicle.", DEFAULT_EGO, metavar="FRAME")
    odometry: str | None = option(
        "Topic of nav_msgs/Odometry for the pose of the vehicle; /tf if left out.", None, metavar="TOPIC"
    )
    truth: str | None = option(
        "True objects: a table with a row for each and moment, an MCAP file, or a topic of the recording, else of the "
        "result.",
        None,
        metavar="FILE|TOPIC",
        verbs=JUDGED,
    )

    def __post_init__(self) -> None:
        vars(self)["has_truth"] = self.truth is not None

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        judged = truth and self.truth is not None
        yield DetectedTruth(self._true_scenes(Path(self._one())), self.recorded()) if judged else self.recorded()

    def recorded(self) -> McapRecording:
        """The one recording. Raises `InputError` for several, and topics that are not there or hold no objects."""
        topics = sensor_topics("--topic", self.topic or ())
        options = RecordingOptions(topics, pairs("--classes", self.classes), self.world, self.ego, self.odometry)
        return McapRecording(self._one(), options)

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        parts = [recording_part(replace(self, recording=[path]), Path(path)) for path in self.recording or ()]
        yield Parts([part.name for part in parts], parts)

    def kept(self) -> Mapping[str, Any]:
        return {} if self.world is None else {"world": self.world}

    def with_kept(self, kept: Mapping[str, Any]) -> Self:
        return self if self.world is not None or "world" not in kept else replace(self, world=str(kept["world"]))

    def read_results(self, result: Path, truth: bool = True) -> Results:
        if truth and self.truth is not None and not self.recording:
            rows = self._tracks(result, result.stem, self.world)
            return Results(table_results(rows, result, self._true_scenes(result), judged=True), score_tables)
        with self.open(truth) as dataset:
            (name,) = dataset.scenes
            scene = dataset.scene(name)
        assert isinstance(scene, RecordedScene)
        rows, judged = self._tracks(result, name, scene.world), scene.ground_truth is not None
        return Results(table_results(rows, result, HeldScene(scene), every_scene=True, judged=judged), score_tables)

    def _tracks(self, result: Path, scene: str, world: str | None) -> TrackRows:
        if result.suffix != ".mcap":
            return read_tracks(result, lenient=True)
        return read_track_messages(result, scene, pairs("--classes", self.classes), world)

    def _true_scenes(self, recorded: Path) -> TruthTable:
        """The scene of --truth, which may be a topic of `recorded`."""
        assert self.truth is not None
        classes, path = pairs("--classes", self.classes), Path(self.truth)
        if path.suffix == ".mcap":
            return TruthTable(path, read_track_messages(path, path.stem, classes, self.world))
        if self.truth.startswith("/") and not path.suffix:
            return TruthTable(recorded, read_track_messages(recorded, recorded.stem, classes, self.world, self.truth))
        with local_copy(self.truth) as table:
            return read_truth(table, TableImport(classes=classes))

    def _one(self) -> str:
        if len(self.recording or ()) != 1:
            raise InputError("expected one recording; several need --workers N or --ray, and a folder as --output")
        return (self.recording or [""])[0]


def sensor_topics(option: str, values: Iterable[str]) -> dict[str, str]:
    """Return the topic of each sensor by the values of an option, TOPIC or SENSOR=TOPIC.

    Raises `InputError` for others.
    """
    topics: dict[str, str] = {}
    for value in values:
        sensor, equals, topic = value.rpartition("=")
        sensor = sensor if equals else topic.lstrip("/")
        if not sensor or not topic:
            raise InputError(f"{option} {value}: expected a topic, or SENSOR=TOPIC")
        if sensor in topics:
            raise InputError(f"{option} {value}: the sensor {sensor} is given twice")
        if topic in topics.values():
            raise InputError(f"{option} {value}: the topic {topic} is given twice")
        topics[sensor] = topic
    return topics


def recording_part(source: McapSource, path: Path) -> Part:
    """A recording, by the name of the file without its suffix, or of the folder."""
    return Part(path.stem if path.suffix in (".mcap", ".db3") else path.name, partial(_opened, source))


@contextmanager
def _opened(source: McapSource) -> Iterator[OpenedPart]:
    """Open the one recording with the digests of the files, and of the options."""
    dataset = source.recorded()
    digests = {file.name: file_digest(file) for file in dataset.files}
    options = sha256(repr(dataset.options).encode()).hexdigest()
    yield OpenedPart({**digests, "options": options}, lambda: dataset)
