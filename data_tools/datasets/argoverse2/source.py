"""Argoverse 2 as a dataset of the command."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from data_tools.datasets.annotated import AnnotatedSource
from data_tools.datasets.area_map import AreaMap
from data_tools.datasets.argoverse2.detections import AnnotatedLogs, DetectedLogs, is_feather
from data_tools.datasets.argoverse2.logs import FILES, ArgoverseLogs
from data_tools.datasets.argoverse2.results import (
    merge_feather_tracks,
    read_feather_tracks,
    write_feather_tracks,
    write_submission,
)
from data_tools.datasets.argoverse2.vector_maps import argoverse_maps
from data_tools.datasets.detection_files import read_detections
from data_tools.datasets.results import SceneResult, scene_result
from data_tools.datasets.source import ChosenScenes, TrackedScenes, option
from data_tools.files.remote_files import is_url, local_copy, local_tree
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene


@dataclass(frozen=True, kw_only=True)
class ArgoverseSource(AnnotatedSource):
    """Argoverse 2 sensor logs, with detections as Feather in the official format; needs the extra [parquet]."""

    name = "argoverse2"
    family = "nuscenes"
    example = "--dataroot data/av2/val --detections detections.feather"
    tracks = "File to write: .feather (boxes with track_id), .pkl (official submission), or a table: .csv, .ndjson."
    tracks_example = "tracks.feather"
    merged = ("tracks.feather", "")
    all_tracks = "tracks.feather"
    dataroot: str = option("Folder of the logs, in each annotations.feather, city_SE3_egovehicle.feather; or its URL.")
    detections: str | None = option(
        "Official detections (.feather) of any number of logs, or a table (.csv, .ndjson, .jsonl, .npz), s from the "
        "log's first moment; without it, what is annotated and visible is detected, without identities and velocities.",
        None,
        metavar="FILE",
    )

    @property
    def tracks_suffix(self) -> str:
        return ".feather"

    @contextmanager
    def annotated(self) -> Iterator[ArgoverseLogs]:
        with local_tree(self.dataroot, [f"*/{name}" for name in FILES]) as root:
            yield ArgoverseLogs(root)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        with self.annotated() as logs:
            if self.detections is None:
                yield self._chosen(AnnotatedLogs(logs, None))
                return
            with local_copy(self.detections) as path:
                feather = is_feather(str(path))
                yield self._chosen(DetectedLogs(logs, path) if feather else AnnotatedLogs(logs, read_detections(path)))

    def write_tracks(self, output: Path, dataset: Dataset, scenes: TrackedScenes) -> None:
        if output.suffix == ".feather":
            write_feather_tracks(output, scenes)
        elif output.suffix == ".pkl":
            write_submission(output, scenes)
        else:
            super().write_tracks(output, dataset, scenes)

    def merge_tracks(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        merge_feather_tracks(output / self.merged[0], [output / "tracks" / f"{stem}.feather" for stem in stems])

    def read_results(self, result: Path) -> Mapping[str, SceneResult]:
        if result.suffix == ".pkl":
            raise InputError(
                f"{result}: expected .feather or a table; a .pkl is not read, as that would run its content"
            )
        if result.suffix != ".feather":
            return super().read_results(result)
        from data_tools.datasets.argoverse2.logs import columns_of

        there = dict.fromkeys(columns_of(result, ("log_id",))["log_id"].tolist())
        with self.open(truth=True) as dataset:
            names = [name for name in dataset.scenes if self.scenes is not None or not there or name in there]
            if not names:
                raise InputError(f"{result}: log_id: expected one of the logs, such as {dataset.scenes[0]}")
            scenes = {name: dataset.scene(name) for name in names}
            rows = read_feather_tracks(result, scenes)
        return {name: scene_result(scene, rows, result) for name, scene in scenes.items()}

    def maps(self, scenes: Mapping[str, Scene]) -> Mapping[str, AreaMap]:
        return {} if is_url(self.dataroot) else argoverse_maps(Path(self.dataroot), scenes)

    def _chosen(self, dataset: Dataset) -> Dataset:
        return dataset if self.scenes is None else ChosenScenes(dataset, self.scenes)
