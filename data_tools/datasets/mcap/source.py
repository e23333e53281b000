"""Recordings of ROS 2 and Foxglove as a dataset of the command."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, Self

from data_tools.datasets.detection_files.table_import import pairs
from data_tools.datasets.mcap.dataset import McapRecording, RecordingOptions
from data_tools.datasets.mcap.messages import DEFAULT_EGO
from data_tools.datasets.mcap.results import read_track_messages, write_track_messages
from data_tools.datasets.parts import OpenedPart, Parts, file_digest
from data_tools.datasets.results import SceneResult, read_table_results, scene_result
from data_tools.datasets.source import TRACKING, DatasetSource, TrackedScenes, option
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class McapSource(DatasetSource):
    """Recordings of ROS 2 or Foxglove: a file of MCAP or a bag folder; needs the extra [mcap], no installation of ROS.

    Topics of Autoware's DetectedObjects and TrackedObjects, vision_msgs/Detection3DArray and Foxglove's SceneUpdate;
    the pose of the vehicle from /tf or nav_msgs/Odometry. Without --topic, the one topic that holds objects is taken,
    and if there are several, they are listed.
    """

    name = "mcap"
    has_truth = False
    example = "drive.mcap --topic /perception/objects"
    tracks = "File to write: .mcap for messages of the type that the detections have; a table: .csv, .ndjson, .jsonl."
    tracks_example = "tracks.mcap"
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
    table: Literal["mcap", "csv", "ndjson"] = option("Format of the results, in parallel.", "mcap", verbs=("track",))

    @property
    def tracks_suffix(self) -> str:
        return f".{self.table}"

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[McapRecording]:
        yield McapRecording(self._one(), self._options())

    def restricted(self, scenes: Collection[str]) -> Self:
        return self

    def input_files(self) -> tuple[Path, ...]:
        return tuple(Path(path) for path in self.recording or ())

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        parts = [McapPart(replace(self, recording=[path])) for path in self.recording or ()]
        yield Parts([part.name for part in parts], parts)

    def write_tracks(self, output: Path, dataset: Dataset, scenes: TrackedScenes) -> None:
        if output.suffix != ".mcap":
            super().write_tracks(output, dataset, scenes)
            return
        assert isinstance(dataset, McapRecording)
        write_track_messages(output, dataset, scenes)

    def kept(self) -> Mapping[str, Any]:
        return {} if self.world is None else {"world": self.world}

    def with_kept(self, kept: Mapping[str, Any]) -> Self:
        return self if self.world is not None or "world" not in kept else replace(self, world=str(kept["world"]))

    def read_results(self, result: Path) -> Mapping[str, SceneResult]:
        with self.open() as dataset:
            if result.suffix != ".mcap":
                return read_table_results(result, dataset, every_scene=True)
            (name,) = dataset.scenes
            scene = dataset.scene(name)
            rows = read_track_messages(result, scene, pairs("--classes", self.classes))
            return {name: scene_result(scene, rows, result)}

    def _options(self) -> RecordingOptions:
        topics: dict[str, str] = {}
        for value in self.topic or ():
            sensor, equals, topic = value.rpartition("=")
            sensor = sensor if equals else topic.lstrip("/")
            if not sensor or not topic:
                raise InputError(f"--topic {value}: expected a topic, or SENSOR=TOPIC")
            if sensor in topics:
                raise InputError(f"--topic {value}: the sensor {sensor} is given twice")
            topics[sensor] = topic
        return RecordingOptions(topics, pairs("--classes", self.classes), self.world, self.ego, self.odometry)

    def _one(self) -> str:
        if len(self.recording or ()) != 1:
            raise InputError("expected one recording; several need --workers N or --ray, and a folder as --output")
        return (self.recording or [""])[0]


@dataclass(frozen=True)
class McapPart:
    """A recording, read at the worker."""

    source: McapSource

    @property
    def name(self) -> str:
        """The name of the file without its suffix, or of the folder."""
        path = Path((self.source.recording or [""])[0])
        return path.stem if path.suffix in (".mcap", ".db3") else path.name

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digests of the files, and of the options."""
        with self.source.open() as dataset:
            digests = {file.name: file_digest(file) for file in dataset.files}
            options = sha256(repr((dataset.options, self.source.table)).encode()).hexdigest()
            yield OpenedPart({**digests, "options": options}, lambda: dataset)
