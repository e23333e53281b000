"""KITTI tracking as a dataset of the command."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from data_tools.datasets.detection_files.tracks import merge_tables
from data_tools.datasets.kitti.dataset import KittiTracking, kitti_images, local_kitti
from data_tools.datasets.kitti.results import (
    TRACK_TABLE,
    ScoredSequence,
    result_sequences,
    scored_sequences,
    write_kitti_labels,
    write_kitti_results,
)
from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import (
    TRACKING,
    DatasetSource,
    Images,
    Innovations,
    LabelledScenes,
    OpenedPart,
    Parts,
    TrackedScenes,
    file_digest,
    names,
    option,
    tracks_of,
)
from data_tools.files.input_files import is_url
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene

if TYPE_CHECKING:
    from data_tools.datasets.kitti.dataset import KittiScans
    from data_tools.evaluation import Evaluation


@dataclass(frozen=True, kw_only=True)
class KittiSource(DatasetSource):
    """KITTI tracking sequences."""

    name = "kitti"
    family = "kitti"
    example = "--dataroot data/kitti --detections data/kitti/detections/pointrcnn --sequences 0000,0011"
    tracks = "Folder to write: NNNN.txt in the benchmark's format, tracks.csv with velocities and covariances."
    tracks_example = "results"
    all_tracks = "tracks"
    submission = "tracks/[0-9]*.txt"
    merged = (f"tracks/{TRACK_TABLE}", f"results/{TRACK_TABLE}")
    dataroot: str = option("Folder that holds training/, or oxts/, calib/ and, for scores, label_02/; or its URL.")
    detections: str | None = option(
        "Folder with Car/, Pedestrian/, Cyclist/, in each NNNN.txt; or its URL.", None, required=TRACKING
    )
    sequences: str | None = option("Sequences with commas between them; all if left out.", None)
    iou: str = option("Least 3D overlaps of a pair, with commas.", "0.25,0.5,0.7", verbs=("evaluate", "benchmark"))
    classes: str = option("Classes, with commas.", "car,pedestrian,cyclist", verbs=("evaluate", "benchmark"))

    persons: str = option(
        "Boxes at `Person` labels (who sits): false, as in the usual evaluation, or exempt, as in HOTA.",
        "false",
        metavar="false|exempt",
        verbs=("evaluate", "benchmark"),
    )

    def __post_init__(self) -> None:
        if self.persons not in ("false", "exempt"):
            raise InputError(f"--persons: expected false or exempt, got {self.persons!r}")
        overlaps(self.iou)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[KittiTracking]:
        with local_kitti(self.dataroot, self.detections, self._chosen(), truth) as dataset:
            yield dataset

    def restricted(self, scenes: Collection[str]) -> Self:
        return replace(self, sequences=",".join(scenes))

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        with self.open() as dataset:
            scenes = dataset.scenes
        yield Parts(scenes, (KittiPart(self.restricted([name]), name) for name in scenes))

    def scans(self, scenes: Collection[str]) -> Mapping[str, KittiScans]:
        from data_tools.datasets.kitti.dataset import KittiScans

        if is_url(self.dataroot):
            return {}
        root = self._folder()
        there = (name for name in scenes if (root / "velodyne" / name).is_dir())
        return {name: KittiScans(root, name, timed=False) for name in there}

    def images(self, scenes: Mapping[str, Scene]) -> Mapping[str, Images]:
        return {} if is_url(self.dataroot) else kitti_images(self._folder(), scenes)

    def write_tracks(self, output: Path, dataset: Dataset, scenes: TrackedScenes) -> None:
        assert isinstance(dataset, KittiTracking)
        write_kitti_results(output, dataset, scenes)

    def write_labels(self, folder: Path, dataset: Dataset, scenes: LabelledScenes) -> None:
        self.write_label_part(folder, Path(TRACK_TABLE).stem, dataset, scenes)

    def write_track_part(self, folder: Path, stem: str, dataset: Dataset, scenes: TrackedScenes) -> None:
        assert isinstance(dataset, KittiTracking)
        write_kitti_results(folder / "tracks", dataset, scenes, f"{stem}.csv")

    def write_label_part(self, folder: Path, stem: str, dataset: Dataset, scenes: LabelledScenes) -> None:
        assert isinstance(dataset, KittiTracking)
        write_kitti_labels(folder / "label_02", dataset, scenes)
        write_kitti_results(folder / "results", dataset, tracks_of(scenes), f"{stem}.csv")

    def merge_tracks(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        merge_tables(output / self.merged[0], [output / "tracks" / f"{stem}.csv" for stem in stems])

    def merge_labels(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        merge_tables(output / self.merged[1], [output / "results" / f"{stem}.csv" for stem in stems])

    def read_results(self, result: Path) -> Mapping[str, SceneResult]:
        chosen = self._chosen()
        chosen = result_sequences(result) if chosen is None else chosen
        with self.restricted(chosen).open(truth=True) as dataset:
            return scored_sequences(result, dataset)

    def evaluate(
        self,
        results: Mapping[str, SceneResult],
        hota: bool = False,
        innovations: Innovations | None = None,
    ) -> Evaluation:
        from data_tools.datasets.kitti.results import evaluate_kitti

        scored = {name: each for name, each in results.items() if isinstance(each, ScoredSequence)}
        classes, exempt = names("--classes", self.classes), self.persons == "exempt"
        return evaluate_kitti(scored, classes, overlaps(self.iou), hota, innovations, exempt)

    def _folder(self) -> Path:
        root = Path(self.dataroot)
        return root / "training" if (root / "training").is_dir() else root

    def _chosen(self) -> tuple[str, ...] | None:
        return None if self.sequences is None else names("--sequences", self.sequences)


@dataclass(frozen=True)
class KittiPart:
    """A sequence, read at the worker."""

    source: KittiSource
    name: str

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digests of its text files."""
        with self.source.open() as dataset:
            files = dataset.files(self.name)
            yield OpenedPart({f"{path.parent.name}/{path.name}": file_digest(path) for path in files}, lambda: dataset)


def overlaps(text: str) -> tuple[float, ...]:
    """Overlaps with commas between them. Raises `InputError` for others than those above 0 and at most 1."""
    try:
        values = tuple(float(value) for value in names("--iou", text))
    except ValueError:
        raise InputError(f"--iou: expected numbers with commas between them, got {text!r}") from None
    if not all(0 < value <= 1 for value in values):
        raise InputError(f"--iou: expected overlaps above 0 and at most 1, got {text!r}")
    return values
