"""Recorded traffic as datasets of the command: trajectories are recorded, detections are made from them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal

from benchmarks.recordings.ngsim import MAPS, WINDOWS, ngsim_windows
from benchmarks.recordings.openacc import FILE, openacc_platoons
from benchmarks.recordings.sensed import MAST, VEHICLE, sensed_scene, true_scene
from benchmarks.recordings.traffic import RecordedTraffic, Recordings
from data_tools.datasets.source import ChosenScenes, DatasetSource, option
from data_tools.files import local_tree
from data_tools.simulator import SimulatorSettings
from saga_fg.errors import InputError, unknown_name
from saga_fg.types import Dataset, Scene

_VIEWPOINT = "Place of the sensors: mast (6 m above the middle), above, vehicle, the id of one, or X,Y,Z in m."


class TrafficScenes:
    """The scenes of recorded traffic, each made when it is asked for: with detections, or of ground truth alone."""

    def __init__(self, recordings: Recordings, make: Callable[[RecordedTraffic], Scene]) -> None:
        self.scenes, self._read, self._make = recordings.names, recordings.read, make

    def scene(self, name: str) -> Scene:
        """Make one scene; raises `InputError` for an unknown name or a broken record."""
        if name not in self.scenes:
            raise InputError(unknown_name("recording", name, self.scenes))
        return self._make(self._read(name))


@dataclass(frozen=True, kw_only=True)
class TrafficSource(DatasetSource):
    """Recorded trajectories, and detections made from them by the sensors of the simulator."""

    family = "traffic"
    dataroot: str
    scenes: str | None = option("Recordings with commas between them; all if left out.", None)
    viewpoint: str = option(_VIEWPOINT, MAST)
    seed: int = option("The same seed makes the same detections.", 0, least=0)
    simulator: SimulatorSettings | None = option(
        "YAML file of the sensors; see `saga-fg config --simulator`. A LiDAR if left out.", None, metavar="FILE"
    )

    @abstractmethod
    def recordings(self) -> AbstractContextManager[Recordings]:
        """The recorded trajectories, for the length of a block."""

    def open(self, truth: bool = False) -> AbstractContextManager[Dataset]:
        sensed = partial(sensed_scene, viewpoint=self.viewpoint, settings=self.simulator, seed=self.seed)
        return self._opened(sensed)

    def ground_truth(self) -> AbstractContextManager[Dataset]:
        return self._opened(true_scene)

    @contextmanager
    def _opened(self, make: Callable[[RecordedTraffic], Scene]) -> Iterator[Dataset]:
        with self.recordings() as recordings:
            dataset = TrafficScenes(recordings, make)
            yield dataset if self.scenes is None else ChosenScenes(dataset, self.scenes)


@dataclass(frozen=True, kw_only=True)
class Ngsim(TrafficSource):
    """NGSIM windows of dense traffic: a motorway, and crossings with lanes, stop lines and signals."""

    name = "benchmarks.recordings:Ngsim"
    example = "--dataroot data/ngsim --scenes USA_Lanker-2_6_T-1"
    dataroot: str = option("Folder of windows.csv.gz and maps.json.gz, or its URL.")
    road: Literal["signals", "map", "none"] = option(
        "Of the road is given: map and colours of the lights (signals), the map alone, or nothing.", "signals"
    )

    @contextmanager
    def recordings(self) -> Iterator[Recordings]:
        with local_tree(self.dataroot, [*WINDOWS, *MAPS]) as root:
            yield ngsim_windows(root, self.road)


@dataclass(frozen=True, kw_only=True)
class OpenAcc(TrafficSource):
    """OpenACC platoons of cars on test tracks, driven by people and by adaptive cruise control; needs [parquet]."""

    name = "benchmarks.recordings:OpenAcc"
    example = "--dataroot data/openacc --scenes short_setting-dynamic_part4"
    dataroot: str = option("Folder of platoons.parquet, or its URL.")
    viewpoint: str = option(_VIEWPOINT, VEHICLE)

    @contextmanager
    def recordings(self) -> Iterator[Recordings]:
        with local_tree(self.dataroot, [FILE]) as root:
            yield openacc_platoons(root)
