"""Inputs of jobs: a scene in memory, a sequence of KITTI, a simulated scene, a file of detections."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.input_files import open_bytes
from data_tools.files.remote_files import local_copy, name_of
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.scale_out.job import OpenedInput, sha256
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene


@dataclass(frozen=True, eq=False)
class HeldScene:
    """A scene that is in memory; a dataset of itself. Its parts are its moments and the frames of each sensor."""

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
    def opened(self) -> Iterator[OpenedInput]:
        """Open with the digests of all of the scene but its ground truth."""
        yield OpenedInput(scene_digests(self.held), lambda: self)


@dataclass(frozen=True)
class SimulatedInput:
    """Scene `name` of `SimulatedTraffic(settings, scenes, seed)`, made at the worker."""

    settings: SimulatorSettings
    scenes: int
    seed: int
    name: str

    @contextmanager
    def opened(self) -> Iterator[OpenedInput]:
        """Open with the digest of the settings, seed and name."""
        made_from = f"{self.settings!r} {self.seed} {self.name}".encode()
        yield OpenedInput({"simulator": sha256(made_from)}, self._read)

    def _read(self) -> Dataset:
        return HeldScene(SimulatedTraffic(self.settings, self.scenes, self.seed).scene(self.name))


@dataclass(frozen=True)
class KittiInput:
    """A sequence of KITTI tracking, read at the worker; folders as `KittiTracking` takes them, or their URLs."""

    dataroot: str
    detections: str
    name: str

    @contextmanager
    def opened(self) -> Iterator[OpenedInput]:
        """Open with the digests of its text files."""
        from data_tools.datasets.kitti import local_kitti

        with local_kitti(self.dataroot, self.detections, [self.name]) as dataset:
            files = dataset.files(self.name)
            yield OpenedInput(
                {f"{path.parent.name}/{path.name}": _file_digest(path) for path in files}, lambda: dataset
            )


@dataclass(frozen=True)
class DetectionFileInput:
    """A table of detections of one's own, a local file or one that fsspec can open by its URL, read at the worker."""

    url: str

    @property
    def name(self) -> str:
        """The name of the file without its suffix."""
        return Path(name_of(self.url)).stem

    @contextmanager
    def opened(self) -> Iterator[OpenedInput]:
        """Open with the digest of the file."""
        from data_tools.datasets.detection_files import read_detections

        with local_copy(self.url) as path:
            yield OpenedInput({name_of(self.url): _file_digest(path)}, lambda: read_detections(path))


def scene_digests(scene: Scene) -> dict[str, str]:
    """Return the SHA-256 of a scene's moments and of the frames of each sensor, on which its results depend."""
    moments = hashlib.sha256(repr((scene.name, scene.tokens)).encode())
    for array in (scene.timestamps, scene.world_T_ego):
        moments.update(np.ascontiguousarray(array).tobytes())
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


def _file_digest(path: Path) -> str:
    with open_bytes(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
