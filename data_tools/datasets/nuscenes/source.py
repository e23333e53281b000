"""nuScenes as a dataset of the command."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Self

from data_tools.datasets.nuscenes.dataset import NuScenes, NuScenesScans, nuscenes_images, nuscenes_maps, nuscenes_scans
from data_tools.datasets.nuscenes.results import ResultMeta, merge_tracking_results, write_tracking_results
from data_tools.datasets.nuscenes.tables import split_scenes
from data_tools.datasets.nuscenes.writer import merge_label_parts, write_label_part, write_nuscenes_labels
from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import (
    TRACKING,
    AreaMap,
    DatasetSource,
    HeldScene,
    Images,
    Innovations,
    LabelledScenes,
    OpenedPart,
    Parts,
    TrackedScenes,
    names,
    option,
    scene_digests,
    tracks_of,
)
from data_tools.files.input_files import is_url, local_copy, local_tree
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene

if TYPE_CHECKING:
    from data_tools.evaluation import Evaluation


@dataclass(frozen=True, kw_only=True)
class NuScenesSource(DatasetSource):
    """nuScenes recordings, with detections as official detection-result JSON, one file a sensor."""

    name = "nuscenes"
    family = "nuscenes"
    example = "--dataroot data/nuscenes --split mini_train --detections lidar=megvii.json"
    tracks = "Official tracking-result JSON to write."
    tracks_example = "tracks.json"
    merged = ("tracks.json", "tracking.json")
    all_tracks = submission = "tracks.json"
    dataroot: str = option("Folder that holds the folder of tables, or its URL.")
    detections: list[str] | None = option(
        "Detection-result JSON of a sensor, or its URL; repeatable.", None, metavar="NAME=FILE", required=TRACKING
    )
    version: str = option("Name of the folder of tables.", "v1.0-mini")
    split: str | None = option("An official split, or one of splits.json beside the tables.", None)
    scenes: str | None = option("Scene names with commas between them.", None)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[NuScenes]:
        with self._local() as (root, files):
            yield NuScenes(root, self.version, files, self._chosen(root), truth)

    def restricted(self, scenes: Collection[str]) -> Self:
        return replace(self, split=None, scenes=",".join(scenes))

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        with self.open() as dataset:
            parts = (NuScenesPart(dataset.scene(name), dataset.meta) for name in dataset.scenes)
            yield Parts(dataset.scenes, parts, dataset)

    def scans(self, scenes: Collection[str]) -> Mapping[str, NuScenesScans]:
        if is_url(self.dataroot):
            return {}
        return nuscenes_scans(NuScenes(self.dataroot, self.version, {}, scenes), self.dataroot)

    def maps(self, scenes: Mapping[str, Scene]) -> Mapping[str, AreaMap]:
        if is_url(self.dataroot):
            return {}
        return nuscenes_maps(Path(self.dataroot), Path(self.dataroot) / self.version, scenes)

    def images(self, scenes: Mapping[str, Scene]) -> Mapping[str, Images]:
        if is_url(self.dataroot):
            return {}
        return nuscenes_images(Path(self.dataroot), Path(self.dataroot) / self.version, scenes)

    def write_tracks(self, output: Path, dataset: Dataset, scenes: TrackedScenes) -> None:
        assert isinstance(dataset, NuScenes | NuScenesPart)
        write_tracking_results(output, scenes, dataset.meta)

    def write_labels(self, folder: Path, dataset: Dataset, scenes: LabelledScenes) -> None:
        assert isinstance(dataset, NuScenes)
        self.write_tracks(folder / self.merged[1], dataset, tracks_of(scenes))
        write_nuscenes_labels(folder, dataset.dataroot, dataset.version, scenes)

    def write_label_part(self, folder: Path, stem: str, dataset: Dataset, scenes: LabelledScenes) -> None:
        for kind in ("tracking", "objects"):
            (folder / kind).mkdir()
        self.write_tracks(folder / "tracking" / f"{stem}.json", dataset, tracks_of(scenes))
        write_label_part(folder / "objects" / f"{stem}.ndjson", scenes)

    def merge_tracks(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        assert isinstance(dataset, NuScenes)
        parts = (output / "tracks" / f"{stem}.json" for stem in stems)
        merge_tracking_results(output / self.merged[0], parts, dataset.meta)

    def merge_labels(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        assert isinstance(dataset, NuScenes)
        parts = (output / "tracking" / f"{stem}.json" for stem in stems)
        merge_tracking_results(output / self.merged[1], parts, dataset.meta)
        objects = (output / "objects" / f"{stem}.ndjson" for stem in stems)
        merge_label_parts(output, dataset.dataroot, dataset.version, objects)

    def read_results(self, result: Path) -> Mapping[str, SceneResult]:
        from data_tools.datasets.nuscenes.evaluation import read_scored_scenes

        with self._local() as (root, files):
            return read_scored_scenes(result, root, self.version, self._chosen(root), files)

    def evaluate(
        self,
        results: Mapping[str, SceneResult],
        hota: bool = False,
        innovations: Innovations | None = None,
    ) -> Evaluation:
        from data_tools.datasets.nuscenes.evaluation import ScoredScene, evaluate_nuscenes

        scored = {name: each for name, each in results.items() if isinstance(each, ScoredScene)}
        return evaluate_nuscenes(scored, hota, innovations)

    @contextmanager
    def _local(self) -> Iterator[tuple[Path, dict[str, Path]]]:
        """The folder that holds the tables, and the files of detections by sensor."""
        urls = sensor_locations(self.detections or ())
        with ExitStack() as stack:
            root = stack.enter_context(local_tree(self.dataroot, [f"{self.version}/*.json"]))
            yield root, {sensor: stack.enter_context(local_copy(url)) for sensor, url in urls.items()}

    def _chosen(self, root: Path) -> tuple[str, ...]:
        if (self.split is None) == (self.scenes is None):
            raise InputError("expected either --split NAME or --scenes A,B")
        if self.split is not None:
            return split_scenes(root, self.version, self.split)
        return names("--scenes", self.scenes or "")


@dataclass(frozen=True, eq=False)
class NuScenesPart(HeldScene):
    """A scene in memory, and what its detections rest on."""

    meta: ResultMeta

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        digests = {**scene_digests(self.held), "meta": sha256(repr(self.meta).encode()).hexdigest()}
        yield OpenedPart(digests, lambda: self)


def sensor_locations(values: Sequence[str]) -> dict[str, str]:
    """`["lidar=a.json", "camera=b.json"]` as a mapping; a lone file without a name is the sensor "lidar".

    Raises `InputError` for several files without names and a sensor that is given twice.
    """
    files: dict[str, str] = {}
    for value in values:
        sensor, equals, path = value.partition("=")
        if "://" in sensor:  # a URL without a name before it
            sensor, equals, path = value, "", ""
        if not equals and len(values) == 1:
            sensor, path = "lidar", value
        if not sensor or not path:
            raise InputError(f"--detections {value}: expected NAME=FILE, e.g. lidar={value or 'detections.json'}")
        if sensor in files:
            raise InputError(f"--detections {value}: the sensor {sensor} is given twice")
        files[sensor] = path
    return files
