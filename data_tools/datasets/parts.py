"""Recordings as parts that workers open one by one, maybe on another machine."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from data_tools.files.input_files import open_bytes
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene


@dataclass(frozen=True, eq=False)
class OpenedPart:
    """A part at hand: the SHA-256 of each of its inputs by name, and how to read it as a dataset."""

    digests: Mapping[str, str]
    read: Callable[[], Dataset]


class Part(Protocol):
    """One scene, or a file of several, that is sent to a worker by pickling."""

    @property
    def name(self) -> str:
        """Unique within a run; results and the manifest are named for it."""
        ...

    def opened(self) -> AbstractContextManager[OpenedPart]:
        """Make the part available for the length of a block; raises `InputError` where it is not."""
        ...


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a dataset, by name, and the dataset they come from if it is open."""

    names: Sequence[str]
    parts: Iterable[Part]
    dataset: Dataset | None = None


@dataclass(frozen=True, eq=False)
class HeldScene:
    """A scene in memory; a dataset of itself. Its inputs are its moments and the frames of each sensor."""

    held: Scene

    @property
    def name(self) -> str:
        return self.held.name

    @property
    def scenes(self) -> tuple[str, ...]:
        """The one name."""
        return (self.held.name,)

    def scene(self, name: str) -> Scene:
        """The scene; raises `InputError` for another name."""
        if name != self.held.name:
            raise InputError(f"scene {name!r}: expected {self.held.name}")
        return self.held

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digests of everything in the scene but its ground truth."""
        yield OpenedPart(scene_digests(self.held), lambda: self)


def scene_digests(scene: Scene) -> dict[str, str]:
    """SHA-256 of a scene's moments and of the frames of each sensor: of all that its results can depend on."""
    moments = hashlib.sha256(repr((scene.name, scene.tokens)).encode())
    for array in (scene.timestamps, scene.world_T_ego):
        moments.update(np.ascontiguousarray(array).tobytes())
    maps = {id(frame.road_map): frame.road_map for frame in scene.frames}  # most bring the same
    moments.update(repr(list(maps.values())).encode())
    digests = {"moments": moments.hexdigest()}
    for sensor in scene.sensors:
        frames = hashlib.sha256()
        for frame in scene.frames:
            if frame.sensor != sensor:
                continue
            boxes = frame.detections.boxes
            frames.update(repr((frame.timestamp, frame.coordinates, frame.token, boxes.label.tolist())).encode())
            pose = np.empty(0) if frame.world_T_ego is None else frame.world_T_ego
            for array in (pose, boxes.position, boxes.size, boxes.yaw, boxes.velocity, frame.detections.score):
                frames.update(np.ascontiguousarray(array).tobytes())
        digests[sensor] = frames.hexdigest()
    return digests


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with open_bytes(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
