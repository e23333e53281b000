"""Recordings to learn interactions from, by kind and place: `kitti=data/kitti`, `file=detections.csv`.

| kind        | trajectories                                                                               |
|-------------|--------------------------------------------------------------------------------------------|
| kitti       | labels; with detections (a detector's folder), what the classical tracker makes of these   |
| nuscenes    | annotations; with detections (a result JSON), what the classical tracker makes of these    |
| simulated   | truth of simulated traffic, the place is the number of scenes                              |
| eth_ucy     | ETH walking pedestrians                                                                    |
| argoverse   | annotations of Argoverse 2 logs                                                            |
| file        | what the classical tracker makes of a table of detections                                  |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.tracking import track_scene
from saga_fg.errors import InputError
from saga_fg.learning import Trajectories

if TYPE_CHECKING:
    from pipelines.config import Family
    from saga_fg.types.dataset import Dataset

KINDS = ("kitti", "nuscenes", "simulated", "eth_ucy", "argoverse", "file")
FAMILIES: dict[str, Family] = {"kitti": "kitti", "simulated": "simulated", "file": "file"}  # nuscenes serves the rest


@dataclass(frozen=True)
class TrajectorySource:
    """One place of recordings of a kind, and which of them; detections where truth is to be left alone."""

    kind: str
    place: str
    names: tuple[str, ...] | None = None
    detections: Path | None = None
    version: str = "v1.0-mini"

    @classmethod
    def parsed(
        cls, value: str, names: tuple[str, ...] | None = None, detections: Path | None = None
    ) -> TrajectorySource:
        """`KIND=PLACE`. Raises `InputError` for another kind, or for detections where they have no effect."""
        kind, _, place = value.partition("=")
        if kind not in KINDS or not place:
            raise InputError(f"--data {value}: expected KIND=PLACE with a kind of {', '.join(KINDS)}")
        if detections is not None and kind not in ("kitti", "nuscenes"):
            raise InputError(f"--detections {detections}: goes with --data kitti=... or nuscenes=...")
        return cls(kind, place, names, detections)

    @property
    def family(self) -> Family:
        """The kind of data whose configuration fits."""
        return FAMILIES.get(self.kind, "nuscenes")

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that are named to be read; the folders of data sets are not among them."""
        table = (Path(self.place),) if self.kind == "file" else ()
        return table if self.detections is None else (*table, self.detections)

    def trajectories(self) -> dict[str, Trajectories]:
        """By recording. Raises `InputError` for what cannot be read."""
        from pipelines.config import load_config

        dataset, chosen = self._dataset()
        if self.kind != "file" and self.detections is None:
            return {name: Trajectories.of_truth(dataset.scene(name)) for name in chosen}
        config = load_config(self.family)
        found = {}
        for name in chosen:
            run = track_scene(dataset.scene(name), config.new_tracker("kf"))
            found[name] = Trajectories.of_tracks(run.tracks)
        return found

    def _dataset(self) -> tuple[Dataset, Sequence[str]]:
        truth, root = self.detections is None, Path(self.place)
        dataset: Dataset
        if self.kind == "kitti":
            from data_tools.datasets.kitti import KittiTracking

            dataset = KittiTracking(root, self.detections, self.names, truth)
        elif self.kind == "nuscenes":
            from data_tools.datasets.nuscenes import NuScenes, split_scenes

            files = {} if self.detections is None else {"lidar": self.detections}
            names = self.names or split_scenes(root, self.version, "all")
            dataset = NuScenes(root, self.version, files, names, truth)
        elif self.kind == "simulated":
            from data_tools.simulator import SimulatedTraffic

            if not self.place.isdecimal() or int(self.place) == 0:
                raise InputError(f"--data simulated={self.place}: expected a number of scenes")
            dataset = SimulatedTraffic(scenes=int(self.place))
        elif self.kind == "eth_ucy":
            from data_tools.datasets.eth_ucy import EthUcy

            dataset = EthUcy(root)
        elif self.kind == "argoverse":
            from data_tools.datasets.argoverse2 import ArgoverseLogs

            dataset = ArgoverseLogs(root)
        else:
            from data_tools.datasets.detection_files import read_detections

            dataset = read_detections(root)
        return dataset, dataset.scenes if self.names is None else self.names
