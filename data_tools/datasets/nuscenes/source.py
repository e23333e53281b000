"""nuScenes as a dataset of the command; its tracking results beside the ground truth of their scenes, and figures."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from data_tools.datasets.nuscenes.dataset import NuScenes, nuscenes_images, nuscenes_maps, nuscenes_scans
from data_tools.datasets.nuscenes.results import (
    MAX_BOXES,
    ResultBoxes,
    merge_tracking_results,
    read_tracking_results,
    write_tracking_results,
)
from data_tools.datasets.nuscenes.tables import CATEGORY_OF_CLASS, read_annotations, split_scenes
from data_tools.datasets.nuscenes.writer import merge_label_parts, write_label_part, write_nuscenes_labels
from data_tools.datasets.results import Results, SceneResult
from data_tools.datasets.source import (
    TRACKING,
    DatasetSource,
    HeldScene,
    LabelledScenes,
    Parts,
    ResultFormat,
    Surroundings,
    TrackedScenes,
    names,
    option,
    tracks_of,
)
from data_tools.evaluation import Evaluation, HotaRow, hota, sweep_table
from data_tools.files import is_url, local_copy, local_tree
from data_tools.metrics import (
    LabelErrors,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    PlacedBoxes,
    SceneBoxes,
    best_thresholds,
    label_errors,
    label_velocities,
    nuscenes_tracking_metrics,
    placed_detections,
)
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray
from saga_fg.types import Scene


@dataclass(frozen=True, eq=False)
class ScoredScene(SceneResult):
    """One scene: also as the official metrics compare it."""

    tracking: NuScenesTrackingScene


def read_scored_scenes(
    result: str | Path,
    dataroot: str | Path,
    version: str,
    scenes: Collection[str] | None = None,
    detections: Mapping[str, str | Path] | None = None,
) -> dict[str, ScoredScene]:
    """The chosen scenes by name (None: all), each with its ground truth and the tracks that file `result` has for it.

    detections  files by sensor, as `NuScenes` takes them

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes or has more
    than 500 boxes in one: the official evaluation takes neither.
    """
    dataset = NuScenes(dataroot, version, detections or {}, scenes, ground_truth=True)
    found = read_tracking_results(result).samples
    racks = read_annotations(dataset.folder, dataset.records, {"static_object.bicycle_rack": "bicycle_rack"})
    scored = {}
    for name in dataset.scenes:
        scene = dataset.scene(name)
        truth = scene.ground_truth or ()
        tracking = NuScenesTrackingScene(
            timestamps=scene.timestamps,
            ego_position=scene.world_T_ego[:, :2, 3],
            truth=SceneBoxes.of_annotations(truth, hidden=False),
            found=_found(str(result), scene, found),
            racks=[each.boxes for each in racks[name]],
        )
        scored[name] = ScoredScene(scene, tracking.found, tracking)
    return scored


def _found(path: str, scene: Scene, found: Mapping[str, ResultBoxes]) -> SceneBoxes:
    """The tracks of a scene among those of all samples."""
    for token in scene.tokens:
        if token not in found:
            raise InputError(f"{path}: expected every sample of scene {scene.name}, {token} is missing")
        if len(found[token]) > MAX_BOXES:
            raise InputError(f"{path}: sample {token}: expected at most {MAX_BOXES} boxes")
    samples = [found[token] for token in scene.tokens]
    tracks = ResultBoxes.concatenate(samples)
    frame = np.repeat(np.arange(len(samples)), [len(sample) for sample in samples])
    return SceneBoxes(frame, tracks.id, tracks.boxes, tracks.score, tracks.position_covariance)


REACH = 1  # keyframes to either side for a label's velocity, 0.5 s


def evaluate_nuscenes(
    scored: Mapping[str, ScoredScene], with_hota: bool = False, innovations: Mapping[str, FloatArray] | None = None
) -> Evaluation:
    """Score the tracks of the scenes that were read; errors are those at the labels that their detections match.

    innovations  of the journal of the run, by class, to be among the figures

    Raises `MissingExtraError` for HOTA without trackeval.
    """
    tracking = nuscenes_tracking_metrics([each.tracking for each in scored.values()])
    return Evaluation(
        sweep_table("nuScenes tracking metrics; AMOTP, MOTP in m, TID, LGD in s", tracking),
        {
            "scenes": tuple(scored),
            "overall": tracking.overall,
            "per_class": tracking.per_class,
            "curves": tracking.curves,
        },
        LabelErrors.pool(
            nuscenes_label_errors(each.tracking, placed_detections(each.scene) if each.scene.frames else None)
            for each in scored.values()
        ),
        nuscenes_hota([each.tracking for each in scored.values()], tracking) if with_hota else (),
        innovations or {},
        tracking.curves,
    )


def nuscenes_hota(scenes: Sequence[NuScenesTrackingScene], tracking: NuScenesTrackingMetrics) -> list[HotaRow]:
    """HOTA, at the scores of the best MOTA. Raises `MissingExtraError` without trackeval."""
    return hota([in_range(scene) for scene in scenes], best_thresholds(tracking))


def nuscenes_label_errors(scene: NuScenesTrackingScene, detections: PlacedBoxes | None = None) -> LabelErrors:
    """The errors at the labels of one scene, those without a LiDAR or radar point left out."""
    velocity = label_velocities(scene.truth, scene.timestamps, REACH)
    return label_errors(scene.truth, scene.found, velocity, detections)


def in_range(scene: NuScenesTrackingScene) -> tuple[SceneBoxes, SceneBoxes]:
    """Truth and tracks within the distance from the vehicle up to which their class is scored."""
    limits = NuScenesTrackingSettings().class_range

    def near(table: SceneBoxes) -> SceneBoxes:
        reach = np.array([limits.get(label, 0.0) for label in table.boxes.label.tolist()])
        offset = table.boxes.position[:, :2] - scene.ego_position[table.frame]
        return table.select(np.flatnonzero(np.hypot(offset[:, 0], offset[:, 1]) < reach))

    return near(scene.truth), near(scene.found)


class NuScenesFormat(ResultFormat):
    """Official tracking-result JSON; labels as tables."""

    tracks = "Official tracking-result JSON to write."
    tracks_example = "tracks.json"
    merged = ("tracks.json", "tracking.json")
    all_tracks = submission = "tracks.json"
    classes = tuple(CATEGORY_OF_CLASS)

    def write_tracks(self, output: Path, dataset: NuScenes | HeldScene, scenes: TrackedScenes) -> None:
        write_tracking_results(output, scenes, dataset.meta)

    def write_labels(self, folder: Path, dataset: NuScenes, scenes: LabelledScenes, part: str = "") -> None:
        if part:
            for kind in ("tracking", "objects"):
                (folder / kind).mkdir()
            self.write_tracks(folder / "tracking" / f"{part}.json", dataset, tracks_of(scenes))
            write_label_part(folder / "objects" / f"{part}.ndjson", scenes)
            return
        self.write_tracks(folder / self.merged[1], dataset, tracks_of(scenes))
        write_nuscenes_labels(folder, dataset.dataroot, dataset.version, scenes)

    def merge(self, output: Path, stems: Sequence[str], dataset: NuScenes, labels: bool) -> None:
        parts = (output / ("tracking" if labels else "tracks") / f"{stem}.json" for stem in stems)
        merge_tracking_results(output / self.merged[labels], parts, dataset.meta)
        if labels:
            objects = (output / "objects" / f"{stem}.ndjson" for stem in stems)
            merge_label_parts(output, dataset.dataroot, dataset.version, objects)


@dataclass(frozen=True, kw_only=True)
class NuScenesSource(DatasetSource):
    """nuScenes recordings, with detections as official detection-result JSON, one file a sensor."""

    name = "nuscenes"
    written = NuScenesFormat()
    family = "nuscenes"
    example = "--dataroot data/nuscenes --split mini_train --detections lidar=megvii.json"
    shows = ("scans", "maps", "images")
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
            parts = (HeldScene(dataset.scene(name), dataset.meta).part for name in dataset.scenes)
            yield Parts(dataset.scenes, parts, dataset)

    def surroundings(self, scenes: Mapping[str, Scene]) -> Surroundings:
        if is_url(self.dataroot):
            return Surroundings()
        root, tables = Path(self.dataroot), Path(self.dataroot) / self.version
        return Surroundings(
            lambda: {k: found for k in scenes if (found := nuscenes_scans(root, tables, k, False)) is not None},
            lambda: nuscenes_maps(root, tables, scenes),
            lambda: nuscenes_images(root, tables, scenes),
        )

    def read_results(self, result: Path, truth: bool = True) -> Results:
        if not truth:
            with self.open() as dataset:
                samples, scenes = read_tracking_results(result).samples, [dataset.scene(n) for n in dataset.scenes]
            return Results({each.name: SceneResult(each, _found(str(result), each, samples)) for each in scenes})
        with self._local() as (root, files):
            scored = read_scored_scenes(result, root, self.version, self._chosen(root), files)
        return Results(scored, evaluate_nuscenes)

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
