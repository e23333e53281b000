"""Argoverse 2 as a dataset of the command, and results in its formats.

Tracks in Argoverse's formats, and read back.

.feather   the columns of the detection task and `track_id`: a row for each box, in the frame of the vehicle; and the
           velocity `vx_m`, `vy_m` in the city's frame, m/s, null where unknown
.pkl       what the official evaluation of tracking reads: {log: [frame, ...]}, a frame being a dictionary of arrays
           (track_id, score, label, name, translation_m, size, yaw, velocity_m_per_s) in the city's frame, with
           timestamp_ns, seq_id and ego_translation_m; only the 26 categories that are scored

A track's category is the one that the detections near it have said most, weighted with their scores. Only .feather
files are read: to read a .pkl is to run what is in it.

Source: https://github.com/argoverse/av2-api, src/av2/evaluation/tracking/SUBMISSION_FORMAT.md and eval.py.
"""

import pickle
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.argoverse2.logs import (
    CLASSES,
    FILES,
    KINDS,
    POSE,
    SIZE,
    AnnotatedLogs,
    ArgoverseLogs,
    ArgoverseScene,
    DetectedLogs,
    argoverse_maps,
    boxes_of,
    transforms,
)
from data_tools.datasets.detection_files import TrackRows, read_detections
from data_tools.datasets.results import Results, scene_result
from data_tools.datasets.source import (
    ChosenScenes,
    DatasetSource,
    ResultFormat,
    Surroundings,
    TrackedScenes,
    option,
    require_measured,
)
from data_tools.files import arrow_arrays, atomic_file, is_url, local_copy, local_tree
from saga_fg.errors import InputError, error_context
from saga_fg.numerics import (
    FloatArray,
    IntArray,
    StrArray,
    inverse_transform,
    quaternion_rotation,
    rigid_transforms,
    rotation_quaternion,
    yaw_quaternion,
)
from saga_fg.types import Dataset, Scene, Tracks, known_velocities

SCORED = (
    *("ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOLLARD", "BOX_TRUCK", "BUS", "CONSTRUCTION_BARREL"),
    *("CONSTRUCTION_CONE", "DOG", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN"),
    *("MOTORCYCLE", "MOTORCYCLIST", "PEDESTRIAN", "REGULAR_VEHICLE", "SCHOOL_BUS", "SIGN", "STOP_SIGN", "STROLLER"),
    *("TRUCK", "TRUCK_CAB", "VEHICULAR_TRAILER", "WHEELCHAIR", "WHEELED_DEVICE", "WHEELED_RIDER"),
)
COLUMNS = ("log_id", "timestamp_ns", "track_id", "score", "category", *SIZE, *POSE)
_VELOCITY = ("vx_m", "vy_m")
_NEAR = 2.0  # m between a track and a detection that tells its category
_CATEGORY = {ours: theirs for theirs, ours in reversed(CLASSES.items())}
TrackedLogs = Iterable[tuple[Scene, Sequence[Tracks]]]


def write_feather_tracks(path: Path, scenes: TrackedLogs) -> None:
    """Write the tracks of some logs as .feather. Raises `InputError` where that is not possible."""
    import pyarrow
    from pyarrow import ipc

    numbers = dict.fromkeys((*SIZE, *POSE, *_VELOCITY, "score"), pyarrow.float64())
    whole = dict.fromkeys(("timestamp_ns", "track_id"), pyarrow.int64())
    kinds = {**numbers, **whole, "log_id": pyarrow.string(), "category": pyarrow.string()}
    schema = pyarrow.schema([(name, kinds[name]) for name in (*COLUMNS, *_VELOCITY)])
    with atomic_file(path) as file, ipc.new_file(file, schema) as writer:
        for scene, moments in scenes:
            columns = _columns(scene, moments)
            writer.write_table(pyarrow.table({name: columns[name] for name in schema.names}, schema=schema))


def write_submission(path: Path, scenes: TrackedLogs) -> None:
    """Write the tracks of some logs as .pkl. Raises `InputError` for a path that is not writable."""
    logs = {scene.name: list(_frames(scene, moments)) for scene, moments in scenes}
    with atomic_file(path) as file:
        pickle.dump(logs, file)


def merge_feather_tracks(path: Path, parts: Iterable[Path]) -> None:
    """Join several files of tracks to one."""
    from pyarrow import feather, ipc

    with atomic_file(path) as file:
        tables = (feather.read_table(part, memory_map=False) for part in parts)
        first = next(tables, None)
        if first is None:
            return
        with ipc.new_file(file, first.schema) as writer:
            writer.write_table(first)
            for table in tables:
                writer.write_table(table)


def read_feather_tracks(path: Path, scenes: Mapping[str, Scene]) -> TrackRows:
    """Tracks of some logs, in world coordinates. Raises `InputError` for a missing column and an unknown time."""
    rows = arrow_arrays(path, COLUMNS, KINDS, optional=_VELOCITY)
    log: StrArray = rows["log_id"].astype(np.str_)
    kept = np.flatnonzero(np.isin(log, list(scenes)))
    rows, log = {name: values[kept] for name, values in rows.items()}, log[kept]
    stamp: IntArray = rows["timestamp_ns"].astype(np.int64)
    time, poses = np.zeros(len(log)), np.tile(np.eye(4), (len(log), 1, 1))
    for name, scene in scenes.items():
        mine = np.flatnonzero(log == name)
        known: IntArray = np.array(scene.tokens, dtype=np.int64)
        at = np.minimum(np.searchsorted(known, stamp[mine]), len(known) - 1)
        if (known[at] != stamp[mine]).any():
            strange = stamp[mine][known[at] != stamp[mine]][0]
            raise InputError(f"{path}: log {name}: timestamp_ns: expected times of the log, it has none at {strange}")
        time[mine], poses[mine] = scene.timestamps[at], scene.world_T_ego[at]
    with error_context(str(path)):
        boxes = boxes_of(rows, poses @ transforms(rows))
    if all(name in rows for name in _VELOCITY):
        velocity = np.stack([rows[name] for name in _VELOCITY], axis=1).astype(np.float64)
        boxes = replace(boxes, velocity=velocity)
    return TrackRows.from_columns(log, time, rows["track_id"].astype(np.str_), boxes, rows["score"].astype(np.float64))


def track_categories(scene: Scene, moments: Sequence[Tracks]) -> dict[int, str]:
    """The category of each track by id."""
    votes: dict[int, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    labels = {
        id_: label
        for tracks in moments
        for id_, label in zip(tracks.id.tolist(), tracks.boxes.label.tolist(), strict=True)
    }
    at_time = dict(zip(scene.timestamps.tolist(), moments, strict=True))
    categories = scene.categories if isinstance(scene, ArgoverseScene) else ()
    for frame, category in zip(scene.frames, categories, strict=False):
        tracks = at_time.get(frame.timestamp)
        if tracks is None or not len(tracks) or not len(frame):
            continue
        found = frame.detections
        if frame.coordinates == "ego":
            assert frame.world_T_ego is not None
            found = found.transformed(frame.world_T_ego)
        offset = tracks.boxes.position[:, None, :2] - found.boxes.position[None, :, :2]
        distance = np.hypot(offset[..., 0], offset[..., 1])
        distance[tracks.boxes.label[:, None] != found.boxes.label[None, :]] = np.inf
        nearest = distance.argmin(axis=1)
        for row in np.flatnonzero(distance.min(axis=1) < _NEAR).tolist():
            column = int(nearest[row])
            votes[int(tracks.id[row])][str(category[column])] += max(float(found.score[column]), 1e-9)
    voted = {id_: max(of, key=lambda name: of[name]) for id_, of in votes.items()}
    names = {id_: voted.get(id_, label) for id_, label in labels.items()}
    return {id_: name if name.isupper() else _CATEGORY.get(name, name.upper()) for id_, name in names.items()}


def _columns(scene: Scene, moments: Sequence[Tracks]) -> dict[str, Any]:
    """The columns of `COLUMNS` of a log, in the frame of the vehicle."""
    category_of, counts = track_categories(scene, moments), [len(tracks) for tracks in moments]
    moment, tracks = np.repeat(np.arange(len(scene)), counts), Tracks.concatenate([Tracks.empty(0.0), *moments])
    require_measured(tracks, f"log {scene.name}")
    boxes, velocity = tracks.boxes, known_velocities(tracks.boxes.velocity, tracks.velocity_covariance)
    world_T_box = rigid_transforms(quaternion_rotation(yaw_quaternion(boxes.yaw)), boxes.position)
    ego_T_box = inverse_transform(scene.world_T_ego[moment]) @ world_T_box
    columns = {
        "log_id": [scene.name] * len(boxes),
        "timestamp_ns": np.array(scene.tokens, dtype=np.int64)[moment],
        "track_id": tracks.id,
        "score": tracks.score,
        **dict(zip(_VELOCITY, velocity.T, strict=True)),
        "category": [category_of[each] for each in tracks.id.tolist()],
        **dict(zip(SIZE, boxes.size.T, strict=True)),
        **dict(zip(POSE[4:], ego_T_box[:, :3, 3].T, strict=True)),
    }
    quaternion = rotation_quaternion(ego_T_box[:, :3, :3]) if len(boxes) else np.empty((0, 4))
    return {**columns, **dict(zip(POSE[:4], quaternion.T, strict=True))}


def _frames(scene: Scene, moments: Sequence[Tracks]) -> Iterator[dict[str, Any]]:
    """The frames of a log for the official evaluation."""
    category_of = track_categories(scene, moments)
    for token, pose, tracks in zip(scene.tokens, scene.world_T_ego, moments, strict=True):
        names = np.array([category_of[id_] for id_ in tracks.id.tolist()], dtype="<U31")
        kept = np.flatnonzero(np.isin(names, SCORED))
        boxes = tracks.boxes.select(kept)
        velocity: FloatArray = np.column_stack([np.nan_to_num(boxes.velocity), np.zeros(len(kept))])
        yield {
            "seq_id": scene.name,
            "timestamp_ns": int(token),
            "ego_translation_m": pose[:3, 3].tolist(),  # the evaluation masks all arrays of a frame
            "track_id": tracks.id[kept],
            "score": tracks.score[kept],
            "label": np.array([SCORED.index(name) for name in names[kept].tolist()], dtype=np.int64),
            "name": names[kept],
            "translation_m": np.array(boxes.position),
            "size": np.array(boxes.size),
            "yaw": np.array(boxes.yaw),
            "velocity_m_per_s": velocity,
            "velocity": velocity,
        }


class ArgoverseFormat(ResultFormat):
    """Feather, the official submission, or a table."""

    tracks = "File to write: .feather (boxes with track_id), .pkl (official submission), or a table: .csv, .ndjson."
    tracks_example = "tracks.feather"
    merged = ("tracks.feather", "")
    all_tracks = "tracks.feather"

    def write_tracks(self, output: Path, dataset: Dataset, scenes: TrackedScenes) -> None:
        if output.suffix == ".feather":
            write_feather_tracks(output, scenes)
        elif output.suffix == ".pkl":
            write_submission(output, scenes)
        else:
            super().write_tracks(output, dataset, scenes)

    def merge(self, output: Path, stems: Sequence[str], dataset: Dataset | None, labels: bool) -> None:
        merge_feather_tracks(output / self.merged[0], [output / "tracks" / f"{stem}.feather" for stem in stems])


@dataclass(frozen=True, kw_only=True)
class ArgoverseSource(DatasetSource):
    """Argoverse 2 sensor logs, with detections as Feather in the official format; needs the extra [parquet]."""

    name = "argoverse2"
    written = ArgoverseFormat()
    family = "nuscenes"
    example = "--dataroot data/av2/val --detections detections.feather"
    shows = ("maps",)
    dataroot: str = option("Folder of the logs, in each annotations.feather, city_SE3_egovehicle.feather; or its URL.")
    detections: str | None = option(
        "Official detections (.feather) of any number of logs, or a table (.csv, .ndjson, .jsonl, .npz), s from the "
        "log's first moment; without it, what is annotated and visible is detected, without identities and velocities.",
        None,
        metavar="FILE",
    )
    scenes: str | None = option("Recordings with commas between them; all if left out.", None)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        with local_tree(self.dataroot, [f"*/{name}" for name in FILES]) as root:
            logs = ArgoverseLogs(root)
            if self.detections is None:
                yield self._chosen(AnnotatedLogs(logs, None))
                return
            with local_copy(self.detections) as path:
                official = path.suffix == ".feather"
                yield self._chosen(DetectedLogs(logs, path) if official else AnnotatedLogs(logs, read_detections(path)))

    def read_results(self, result: Path, truth: bool = True) -> Results:
        if result.suffix == ".pkl":
            raise InputError(
                f"{result}: expected .feather or a table; a .pkl is not read, as that would run its content"
            )
        if result.suffix != ".feather":
            return super().read_results(result, truth)
        there = dict.fromkeys(arrow_arrays(result, ("log_id",), KINDS)["log_id"].tolist())
        with self.open(truth) as dataset:
            names = [name for name in dataset.scenes if self.scenes is not None or not there or name in there]
            if not names:
                raise InputError(f"{result}: log_id: expected one of the logs, such as {dataset.scenes[0]}")
            scenes = {name: dataset.scene(name) for name in names}
            rows = read_feather_tracks(result, scenes)
        return Results({name: scene_result(scene, rows, result) for name, scene in scenes.items()})

    def surroundings(self, scenes: Mapping[str, Scene]) -> Surroundings:
        root = self.dataroot
        return Surroundings() if is_url(root) else Surroundings(maps=lambda: argoverse_maps(Path(root), scenes))

    def _chosen(self, dataset: Dataset) -> Dataset:
        return dataset if self.scenes is None else ChosenScenes(dataset, self.scenes)
