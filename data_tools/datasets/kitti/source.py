"""KITTI tracking as a dataset of the command; results in its text format, written, read, and scored.

Tracking results and labels in KITTI's text format: a file `NNNN.txt` for each sequence, one box a line,

    frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z rotation_y score

World boxes go back to the rectified camera frame; the 2D box is the projection of the 3D box, clipped to the image.
Boxes that do not show in the image are left out: the benchmark knows only what the camera sees. `truncated` and
`occluded`, which evaluators do not read in results, are 0.

The format has neither velocities nor covariances, nor what lies outside the image. All of that is in a table beside
the sequences' files, `tracks.csv`, in world coordinates (`data_tools.datasets.detection_files`).

Tracking results in KITTI's text format beside the labels: as the benchmark scores them, and in world coordinates.

Velocities and covariances come from the table `tracks.csv` beside the results, if there is one; else they are unknown.
So is a velocity of a large standard deviation there (`saga_fg.types.track.known_velocities`).

A KITTI tracking result scored: figures averaged over recall, errors at labels, calibration, HOTA.

HOTA is of what the benchmark judges (`data_tools.metrics.kitti_boxes`), by the overlap in the
image as well, as published figures are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_tools.datasets.detection_files import TrackRows, read_tracks, write_tracks
from data_tools.datasets.detection_files.tracks import merge_tables
from data_tools.datasets.kitti.dataset import (
    FRAME_PERIOD,
    Calibration,
    KittiTracking,
    kitti_images,
    kitti_scans,
    local_kitti,
)
from data_tools.datasets.kitti.labels import (
    TYPES,
    image_boxes,
    lower_case_classes,
    observation_angles,
    read_kitti_labels,
)
from data_tools.datasets.results import Results, SceneResult
from data_tools.datasets.source import (
    TRACKING,
    DatasetSource,
    LabelledScenes,
    ResultFormat,
    Surroundings,
    TrackedScenes,
    names,
    option,
    require_measured,
    tracks_of,
)
from data_tools.evaluation import Evaluation, HotaRow, mean_scores
from data_tools.figures import Column, FigureTable
from data_tools.files import atomic_directory, is_url
from data_tools.metrics import (
    KittiObjects,
    KittiSimilarity,
    KittiTrackingMetrics,
    KittiTrackingSequence,
    LabelErrors,
    SceneBoxes,
    camera_boxes_to_world,
    has_box,
    kitti_hota_metrics,
    kitti_tracking_metrics,
    label_errors,
    label_velocities,
    placed_detections,
    world_boxes_to_camera,
)
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import FloatArray, IntArray, inverse_transform
from saga_fg.types import Scene, Tracks, known_velocities

if TYPE_CHECKING:
    from saga_fg.smoothing import Labels

TRACK_TABLE = "tracks.csv"
IMAGE_SIZE = (1242, 375)  # pixels, the largest common to most sequences

_TYPE_OF_LABEL = {name.lower(): name for name in TYPES if name != "DontCare"}


def write_kitti_results(
    directory: str | Path,
    dataset: KittiTracking,
    scenes: Iterable[tuple[Scene, Sequence[Tracks]]],
    table: str = TRACK_TABLE,
) -> None:
    """Write the tracks of some sequences, each with one `Tracks` for each of its timestamps, to directory/NNNN.txt.

    All of them together go to directory/`table` as well, in full.

    `scenes` may be a generator: the files appear when all is done. Raises `InputError` for a directory that is not
    writable, tracks that do not fit the scene, a size or heading that is unknown, a class KITTI does not have.
    """
    with atomic_directory(directory) as folder:
        write_tracks(folder / table, _written(directory, folder, dataset, scenes))


def write_kitti_labels(
    directory: str | Path, dataset: KittiTracking, scenes: Iterable[tuple[Scene, Sequence[Labels]]]
) -> None:
    """Write labels as text of ground truth, without scores, to directory/NNNN.txt; the files appear when all is done.

    Boxes that do not show in the image are left out. Raises `InputError` for a directory that is not writable, a size
    or heading that is unknown, a class KITTI does not have.
    """
    with atomic_directory(directory) as folder:
        for _ in _written(directory, folder, dataset, tracks_of(scenes), with_score=False):
            pass


def _written(
    directory: str | Path, folder: Path, dataset: KittiTracking, scenes: TrackedScenes, with_score: bool = True
) -> Iterator[tuple[Scene, Sequence[Tracks]]]:
    """Write the text of each sequence to the folder that becomes the directory, and pass it on."""
    for scene, moments in scenes:
        with error_context(f"{directory}: sequence {scene.name}"):
            text = kitti_result_text(scene, moments, dataset.calibration(scene.name), with_score)
        (folder / f"{scene.name}.txt").write_text(text, encoding="utf-8")
        yield scene, moments


def kitti_result_text(
    scene: Scene,
    moments: Sequence[Tracks],
    calibration: Calibration,
    with_score: bool = True,
) -> str:
    """The lines of one sequence; without the score they are those of a label file."""
    if len(moments) != len(scene):
        raise InputError(f"expected tracks for {len(scene)} frames, got {len(moments)}")
    lines: list[str] = []
    imu_T_camera = inverse_transform(calibration.camera_T_imu)
    for frame, (tracks, world_T_imu) in enumerate(zip(moments, scene.world_T_ego, strict=True)):
        for label in tracks.boxes.label.tolist():
            if label not in _TYPE_OF_LABEL:
                raise InputError(f"frame {frame}: {unknown_name('class', label, tuple(_TYPE_OF_LABEL))}")
        require_measured(tracks, f"frame {frame}")
        boxes = world_boxes_to_camera(tracks.boxes, world_T_imu @ imu_T_camera)
        bbox = image_boxes(boxes, calibration.projection, IMAGE_SIZE)
        columns = [observation_angles(boxes), bbox, boxes.size, boxes.location, boxes.rotation_y]
        numbers = np.column_stack([*columns, tracks.score] if with_score else columns)
        names = zip(tracks.id.tolist(), tracks.boxes.label.tolist(), strict=True)
        lines += [
            f"{frame} {id_} {_TYPE_OF_LABEL[label]} 0 0 {' '.join(f'{x:.6f}' for x in row)}\n"
            for (id_, label), row, shows in zip(names, numbers.tolist(), np.isfinite(bbox[:, 0]).tolist(), strict=True)
            if shows
        ]
    return "".join(lines)


@dataclass(frozen=True, eq=False)
class ScoredSequence(SceneResult):
    """One sequence: also the lines of its label file and of the result, and the true boxes in world coordinates."""

    labels: KittiObjects
    result: KittiObjects
    truth: SceneBoxes


def read_scored_sequences(
    result: str | Path,
    dataroot: str | Path,
    sequences: Collection[str] | None = None,
    detections: str | Path | None = None,
) -> dict[str, ScoredSequence]:
    """The chosen sequences by name (None: all that folder `result` has a file for).

    Raises `InputError` for missing or broken files, and for results beyond the end of a sequence.
    """
    chosen = result_sequences(result) if sequences is None else sequences
    return scored_sequences(result, KittiTracking(dataroot, detections, chosen, ground_truth=True))


def result_sequences(result: str | Path) -> tuple[str, ...]:
    """The sequences that a folder has results for. Raises `InputError` where there are none."""
    found = tuple(sorted(path.stem for path in Path(result).glob("[0-9]*.txt")))
    if not found:
        raise InputError(f"{result}: expected results NNNN.txt, there are none")
    return found


def scored_sequences(result: str | Path, dataset: KittiTracking) -> dict[str, ScoredSequence]:
    """The sequences of a dataset with ground truth, each with its result; raises as `read_scored_sequences` does."""
    folder, table, scored = Path(result), _table_of(Path(result)), {}
    for name in dataset.scenes:
        scene = dataset.scene(name)
        lines, found = placed_result(folder / f"{name}.txt", scene, dataset)
        found = found if table is None else _with_motion(found, table, name)
        truth = SceneBoxes.of_annotations(scene.ground_truth or ())
        scored[name] = ScoredSequence(scene, found, dataset.labels(name), lines, truth)
    return scored


def _table_of(folder: Path) -> TrackRows | None:
    """The tracks in full beside the text of a result, None where there are none. Raises `InputError` for no folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with results NNNN.txt")
    return read_tracks(folder / TRACK_TABLE) if (folder / TRACK_TABLE).exists() else None


def placed_result(path: Path, scene: Scene, dataset: KittiTracking) -> tuple[KittiObjects, SceneBoxes]:
    """The lines of a result, and its boxes in the world. Raises as `read_scored_sequences` does."""
    if not path.is_file():
        raise InputError(f"{path}: expected the results of sequence {scene.name}, there is no such file")
    result = read_kitti_labels(path)
    if len(result) and result.frame.max() >= len(scene):
        raise InputError(f"{path}: frame {result.frame.max()}: expected frames 0 to {len(scene) - 1} only")
    world_T_camera = scene.world_T_ego @ inverse_transform(dataset.calibration(scene.name).camera_T_imu)
    with error_context(str(path)):
        return result, _in_world(result, world_T_camera)


def given_result(path: Path, scene: Scene, dataset: KittiTracking, table: TrackRows | None) -> SceneResult:
    """A result without ground truth; boxes without a score are sure. table: the tracks in full, where there are some"""
    result, found = placed_result(path, scene, dataset)
    if np.isnan(result.score).all():
        found = replace(found, score=np.ones(len(found)))
    if table is None:
        return SceneResult(scene, found)
    at = _rows_of(found, table, scene.name)
    return SceneResult(scene, found, coasting=np.where(at >= 0, table.coasting[at], np.nan) if len(table) else None)


def _in_world(objects: KittiObjects, world_T_camera: FloatArray) -> SceneBoxes:
    """Objects with a 3D box; `world_T_camera` (K, 4, 4) of the frames."""
    objects = objects.select(has_box(objects) & (objects.track_id >= 0))
    objects = objects.select(np.argsort(objects.frame, kind="stable"))
    boxes = camera_boxes_to_world(objects.boxes, lower_case_classes(objects.type), world_T_camera[objects.frame])
    return SceneBoxes(objects.frame, objects.track_id.astype(np.str_), boxes, np.nan_to_num(objects.score))


def _rows_of(found: SceneBoxes, table: TrackRows, scene: str) -> IntArray:
    """(N,) the rows of the same frames and tracks in a table, -1 for none."""
    rows = np.flatnonzero(table.scene == scene)
    frame = np.rint(table.timestamp[rows] / FRAME_PERIOD).astype(np.int64)
    row_of = dict(zip(zip(frame.tolist(), table.id[rows].tolist(), strict=True), rows.tolist(), strict=True))
    wanted = zip(found.frame.tolist(), found.id.tolist(), strict=True)
    return np.array([row_of.get(key, -1) for key in wanted], dtype=np.int64)


def _with_motion(found: SceneBoxes, table: TrackRows, scene: str) -> SceneBoxes:
    """The boxes with velocities and covariances of the rows of the same frame and track."""
    at = _rows_of(found, table, scene)
    known = at >= 0
    velocity, covariance = found.boxes.velocity.copy(), found.position_covariance.copy()
    velocity[known] = known_velocities(table.boxes.velocity[at[known]], table.velocity_covariance[at[known]])
    covariance[known] = table.position_covariance[at[known]]
    return replace(found, boxes=replace(found.boxes, velocity=velocity), position_covariance=covariance)


CLASSES = ("car", "pedestrian", "cyclist")
IOUS = (0.25, 0.5, 0.7)
REACH = 5  # frames to either side for a label's velocity, 0.5 s
_COLUMNS = (
    Column("sAMOTA", "samota", 2, 100),
    Column("safe", "samota_safe", 2, 100),
    *(Column(name, name.lower(), 2, 100) for name in ("AMOTA", "AMOTP", "MOTA", "MOTP")),
    *(Column(name, name.lower()) for name in ("IDS", "FRAG")),
    *(Column(name, name, 2, 100) for name in ("recall", "precision")),
    *(Column(name, name.lower()) for name in ("TP", "FP", "FN", "GT")),
    *(Column(name, name.lower(), 2, 100) for name in ("MT", "ML")),
)
SIMILARITIES: dict[str, KittiSimilarity] = {"image": "image", "2D": "bev_iou", "3D": "iou_3d"}
ByIou = Mapping[float, KittiTrackingMetrics]


def evaluate_kitti(
    scored: Mapping[str, ScoredSequence], with_hota: bool = False, innovations: Mapping[str, FloatArray] | None = None
) -> Evaluation:
    """Score the tracks of the sequences that were read; errors are those at the labels that their detections match.

    innovations  of the journal of the run, by class, to be among the figures

    Raises `MissingExtraError` for HOTA without trackeval.
    """
    pairs = [KittiTrackingSequence(each.labels, each.result) for each in scored.values()]
    tracking: dict[str, ByIou] = {}
    for label in CLASSES:
        found = ((iou, kitti_tracking_metrics(pairs, label, iou)) for iou in IOUS)
        by_iou = {iou: figures for iou, figures in found if figures is not None}
        if by_iou:
            tracking[label] = by_iou
    best = {label: next(iter(by_iou.values())).threshold_safe for label, by_iou in tracking.items()}
    return Evaluation(
        kitti_table("KITTI 3D tracking metrics, in %", tracking),
        {"sequences": tuple(scored), "per_class": tracking},
        LabelErrors.pool(map(kitti_label_errors, scored.values())),
        kitti_hota(pairs, best) if with_hota else (),
        innovations or {},
    )


def kitti_label_errors(scored: ScoredSequence) -> LabelErrors:
    """The errors at the labels of one sequence: those that a detection matches, if there are any."""
    truth = scored.truth.select(np.isin(scored.truth.boxes.label, CLASSES))
    velocity = label_velocities(truth, scored.scene.timestamps, REACH)
    return label_errors(truth, scored.found, velocity, placed_detections(scored.scene) if scored.scene.frames else None)


def kitti_hota(sequences: Sequence[KittiTrackingSequence], thresholds: Mapping[str, float]) -> list[HotaRow]:
    """Judge the tracks that reach the threshold of their class. Raises `MissingExtraError` without trackeval."""
    rows = []
    for label, threshold in thresholds.items():
        scored = [replace(each, found=_surer_lines(each.found, label, threshold)) for each in sequences]
        for overlap, similarity in SIMILARITIES.items():
            rows.append(HotaRow(label, overlap, threshold, kitti_hota_metrics(scored, label, similarity)))
    return rows


def _surer_lines(found: KittiObjects, label: str, threshold: float) -> KittiObjects:
    """Select the objects of a class in tracks whose mean score is at least `threshold`; no score counts as infinite."""
    rows = np.flatnonzero(np.char.lower(found.type) == label)
    score = np.nan_to_num(found.score[rows], nan=np.inf)
    return found.select(rows[mean_scores(found.track_id[rows], score) >= threshold - 1e-12])


def kitti_table(title: str, tracking: Mapping[str, ByIou]) -> FigureTable:
    """A row for each class and overlap."""
    rows = (((label, f"{iou:g}"), f) for label, by_iou in tracking.items() for iou, f in by_iou.items())
    return FigureTable.of(title, ("class", "3D IoU"), _COLUMNS, rows)


class KittiFormat(ResultFormat):
    """Text of the benchmark's format, and a table."""

    tracks = "Folder to write: NNNN.txt in the benchmark's format, tracks.csv with velocities and covariances."
    tracks_example = "results"
    all_tracks = "tracks"
    submission = "tracks/[0-9]*.txt"
    merged = (f"tracks/{TRACK_TABLE}", f"results/{TRACK_TABLE}")

    def write_tracks(self, output: Path, dataset: KittiTracking, scenes: TrackedScenes) -> None:
        write_kitti_results(output, dataset, scenes)

    def write_labels(self, folder: Path, dataset: KittiTracking, scenes: LabelledScenes, part: str = "") -> None:
        write_kitti_labels(folder / "label_02", dataset, scenes)
        write_kitti_results(folder / "results", dataset, tracks_of(scenes), f"{part}.csv" if part else TRACK_TABLE)

    def write_track_part(self, part: Path, dataset: KittiTracking, scenes: TrackedScenes) -> None:
        write_kitti_results(part.parent, dataset, scenes, part.name)

    def merge(self, output: Path, stems: Sequence[str], dataset: KittiTracking | None, labels: bool) -> None:
        merged = output / self.merged[labels]
        merge_tables(merged, [merged.parent / f"{stem}.csv" for stem in stems])


@dataclass(frozen=True, kw_only=True)
class KittiSource(DatasetSource):
    """KITTI tracking sequences."""

    name = "kitti"
    written = KittiFormat()
    family = "kitti"
    example = "--dataroot data/kitti --detections data/kitti/detections/pointrcnn --scenes 0000,0011"
    shows = ("scans", "images")
    dataroot: str = option("Folder that holds training/, or oxts/, calib/ and, for scores, label_02/; or its URL.")
    detections: str | None = option(
        "Folder with Car/, Pedestrian/, Cyclist/, in each NNNN.txt; or its URL.", None, required=TRACKING
    )
    scenes: str | None = option("Names of sequences with commas between them; all if left out.", None)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[KittiTracking]:
        with local_kitti(self.dataroot, self.detections, self._chosen(), truth) as dataset:
            yield dataset

    def surroundings(self, scenes: Mapping[str, Scene]) -> Surroundings:
        if is_url(self.dataroot):
            return Surroundings()
        root = Path(self.dataroot)
        root = root / "training" if (root / "training").is_dir() else root
        there = [name for name in scenes if (root / "velodyne" / name).is_dir()]
        return Surroundings(
            scans=lambda: {name: kitti_scans(root, name) for name in there},
            images=lambda: kitti_images(root, scenes),
        )

    def read_results(self, result: Path, truth: bool = True) -> Results:
        chosen = self._chosen() or result_sequences(result)
        with self.restricted(chosen).open(truth) as dataset:
            if not truth:
                scenes, table = [dataset.scene(name) for name in dataset.scenes], _table_of(result)
                given = (given_result(result / f"{scene.name}.txt", scene, dataset, table) for scene in scenes)
                return Results({each.scene.name: each for each in given})
            return Results(scored_sequences(result, dataset), evaluate_kitti)

    def _chosen(self) -> tuple[str, ...] | None:
        return None if self.scenes is None else names("--scenes", self.scenes)
