"""Recorded traffic as datasets of the command: trajectories are recorded, detections are made from them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import Literal, Self

from data_tools.datasets.ngsim.windows import MAPS, WINDOWS, NgsimWindows
from data_tools.datasets.openacc import FILE, OpenAccPlatoons
from data_tools.datasets.recorded_traffic import TrafficRecordings
from data_tools.datasets.source import ChosenScenes, DatasetSource, option
from data_tools.files.remote_files import local_tree
from data_tools.simulator.recorded_world import MAST, VEHICLE, sensed_scene, true_scene
from data_tools.simulator.settings import SimulatorSettings
from saga_fg.types.dataset import Dataset, Scene

_VIEWPOINT = "Place of the sensors: mast (6 m above the middle), above, vehicle, the id of one, or X,Y,Z in m."


class SensedRecordings:
    """The scenes of recorded traffic, whose detections are made when a scene is asked for."""

    def __init__(
        self, recordings: TrafficRecordings, viewpoint: str, settings: SimulatorSettings | None, seed: int
    ) -> None:
        self._recordings, self._viewpoint, self._settings, self._seed = recordings, viewpoint, settings, seed

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the recordings."""
        return self._recordings.names

    def scene(self, name: str) -> Scene:
        """Make one scene; raises `InputError` for an unknown name or a broken record."""
        return sensed_scene(self._recordings.recording(name), self._viewpoint, self._settings, self._seed)


class TrueRecordings:
    """The scenes of recorded traffic without detections: no viewpoint, all vehicles visible."""

    def __init__(self, recordings: TrafficRecordings) -> None:
        self._recordings = recordings

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the recordings."""
        return self._recordings.names

    def scene(self, name: str) -> Scene:
        """Read one scene; raises `InputError` for an unknown name or a broken record."""
        return true_scene(self._recordings.recording(name))


@dataclass(frozen=True, kw_only=True)
class RecordedTrafficSource(DatasetSource):
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
    def recordings(self) -> AbstractContextManager[TrafficRecordings]:
        """The recorded trajectories, for the length of a block."""

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        with self.recordings() as recordings:
            dataset = SensedRecordings(recordings, self.viewpoint, self.simulator, self.seed)
            yield dataset if self.scenes is None else ChosenScenes(dataset, self.scenes)

    @contextmanager
    def ground_truth(self) -> Iterator[Dataset]:
        with self.recordings() as recordings:
            dataset = TrueRecordings(recordings)
            yield dataset if self.scenes is None else ChosenScenes(dataset, self.scenes)

    def restricted(self, scenes: Collection[str]) -> Self:
        return replace(self, scenes=",".join(scenes))


@dataclass(frozen=True, kw_only=True)
class NgsimSource(RecordedTrafficSource):
    """NGSIM windows of dense traffic: a motorway, and crossings with lanes, stop lines and signals."""

    name = "ngsim"
    example = "--dataroot data/ngsim --scenes USA_Lanker-2_6_T-1"
    dataroot: str = option("Folder of windows.csv.gz and maps.json.gz, or its URL.")
    road: Literal["signals", "map", "none"] = option(
        "Of the road is given: map and colours of the lights (signals), the map alone, or nothing.", "signals"
    )

    @contextmanager
    def recordings(self) -> Iterator[TrafficRecordings]:
        with local_tree(self.dataroot, [*WINDOWS, *MAPS]) as root:
            yield NgsimWindows(root, self.road)


@dataclass(frozen=True, kw_only=True)
class OpenAccSource(RecordedTrafficSource):
    """OpenACC platoons of cars on test tracks, driven by people and by adaptive cruise control; needs [parquet]."""

    name = "openacc"
    example = "--dataroot data/openacc --scenes short_setting-dynamic_part4"
    dataroot: str = option("Folder of platoons.parquet, or its URL.")
    viewpoint: str = option(_VIEWPOINT, VEHICLE)

    @contextmanager
    def recordings(self) -> Iterator[TrafficRecordings]:
        with local_tree(self.dataroot, [FILE]) as root:
            yield OpenAccPlatoons(root)
