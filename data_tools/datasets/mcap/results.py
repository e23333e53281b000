"""Tracks as messages of a file of MCAP, in the type that the detections had, and read back.

The topic is `/saga_fg/tracks`, the frame the one that was tracked in, the times are those of the detections.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from data_tools.datasets.detection_files import TrackRows
from data_tools.datasets.mcap.dataset import McapRecording, RecordedScene
from data_tools.datasets.mcap.definitions import definition
from data_tools.datasets.mcap.messages import OBJECT_TYPES, recorded_messages
from data_tools.datasets.mcap.objects import MessageObjects, message_objects
from data_tools.datasets.mcap.recording import Recording
from data_tools.files.atomic_files import atomic_file
from data_tools.files.error_messages import error_context
from saga_fg.errors import InputError
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks

TOPIC = "/saga_fg/tracks"


def write_track_messages(path: Path, dataset: McapRecording, scenes: Iterable[tuple[Scene, Sequence[Tracks]]]) -> None:
    """Write the tracks of a recording, a message for each moment; the file appears when all is done.

    Classes go back to the names of the recording. Raises `InputError` for a path that is not writable.
    """
    names: dict[str, str] = {}
    for theirs, ours in dataset.options.classes.items():
        names.setdefault(ours, theirs)
    with atomic_file(path) as file:
        write, finish = _writer(file, dataset.form.RESULT)
        for scene, moments in scenes:
            assert isinstance(scene, RecordedScene)
            for token, tracks in zip(scene.tokens, moments, strict=True):
                stamp = int(token)
                message = dataset.form.result(tracks, stamp, scene.world, names)
                write(message, stamp)
        finish()


def _writer(file: BinaryIO, type_: str) -> tuple[Callable[[Any, int], None], Callable[[], None]]:
    """Functions that write a message of a type with its time, ns, and that end the file."""
    import mcap_protobuf.writer
    import mcap_ros2.writer

    text = definition(type_)
    if text is None:
        protobuf: Any = mcap_protobuf.writer.Writer(file)
        return lambda message, time: protobuf.write_message(TOPIC, message, time, time), protobuf.finish
    ros: Any = mcap_ros2.writer.Writer(file)
    schema = ros.register_msgdef(type_.replace("/", "/msg/"), text)
    return lambda message, time: ros.write_message(TOPIC, schema, message, time, time), ros.finish


def read_track_messages(path: Path, scene: RecordedScene, classes: Mapping[str, str], topic: str = TOPIC) -> TrackRows:
    """Tracks of one scene, of this or another tracker.

    Raises `InputError` naming file, topic, message and field; and for tracks in another frame than the scene's.

    topic  the one that is read; where it is missing, the only one that holds objects
    """
    recording = Recording(path)
    fit = [each.name for each in recording.topics.values() if each.type in OBJECT_TYPES]
    if topic not in fit:
        if len(fit) != 1:
            raise InputError(f"{path}: expected a topic {topic} with tracks, there are {', '.join(fit) or 'none'}")
        topic = fit[0]
    parts: list[MessageObjects] = []
    for logged in recorded_messages(recording, [topic]):
        with error_context(f"{path}: {topic}: message {logged.number}"):
            found = message_objects(logged.message, classes)
            if (found.id == "").any():
                raise InputError(f"expected objects with ids, object {int(np.argmax(found.id == ''))} has none")
            if len(found.id) and found.frame not in ("", scene.world.lstrip("/")):
                raise InputError(
                    f"expected tracks in the frame {scene.world} of the recording, got {found.frame}; "
                    f"add --world {found.frame}, if they were tracked in it"
                )
            parts.append(found)
    n = [len(each.id) for each in parts]
    boxes = Boxes.concatenate([each.detections.boxes for each in parts])
    none = np.empty((0, 2, 2))
    return TrackRows(
        np.full(sum(n), scene.name),
        np.repeat([each.stamp / 1e9 for each in parts], n),
        np.concatenate([np.empty(0, dtype="<U1"), *(each.id for each in parts)]),
        boxes,
        np.concatenate([np.empty(0), *(each.detections.score for each in parts)]),
        np.concatenate([none, *(each.detections.position_covariance for each in parts)]),
        np.concatenate([none, *(each.velocity_covariance for each in parts)]),
        np.full(sum(n), np.nan),
    )
