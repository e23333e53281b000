"""Tracking results and labels in KITTI's text format: a file `NNNN.txt` for each sequence, one box a line,

    frame id type truncated occluded alpha x1 y1 x2 y2 h w l x y z rotation_y score

World boxes go back to the rectified camera frame; the 2D box is the projection of the 3D box, clipped to the image.
Boxes that do not show in the image are left out: the benchmark knows only what the camera sees. `truncated` and
`occluded`, which evaluators do not read in results, are 0.

The format has neither velocities nor covariances, nor what lies outside the image. All of that is in a table beside
the sequences' files, `tracks.csv`, in world coordinates (`data_tools.datasets.detection_files`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_tools.datasets.detection_files import write_tracks
from data_tools.datasets.kitti.calibration import Calibration
from data_tools.datasets.kitti.dataset import KittiTracking
from data_tools.datasets.kitti.image_boxes import image_boxes, observation_angles
from data_tools.datasets.kitti.labels import TYPES
from data_tools.files.atomic_files import atomic_directory
from data_tools.files.error_messages import error_context, unknown_name
from data_tools.kitti_objects import world_boxes_to_camera
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks

if TYPE_CHECKING:
    from saga_fg.smoothing import Labels

TRACK_TABLE = "tracks.csv"
IMAGE_SIZE = (1242, 375)  # pixels, the largest common to most sequences

_TYPE_OF_LABEL = {name.lower(): name for name in TYPES if name != "DontCare"}


def write_kitti_results(
    directory: str | Path,
    dataset: KittiTracking,
    scenes: Iterable[tuple[Scene, Sequence[Tracks]]],
    image_size: tuple[int, int] = IMAGE_SIZE,
) -> None:
    """Write the tracks of some sequences, each with one `Tracks` for each of its timestamps, to directory/NNNN.txt.

    All of them together go to directory/tracks.csv as well, in full.

    `scenes` may be a generator: the files appear when all is done. Raises `InputError` for a directory that is not
    writable, tracks that do not fit the scene, a size or heading that is unknown, a class KITTI does not have.
    """
    with atomic_directory(directory) as folder:

        def written() -> Iterator[tuple[Scene, Sequence[Tracks]]]:
            for scene, moments in scenes:
                with error_context(f"{directory}: sequence {scene.name}"):
                    text = kitti_result_text(scene, moments, dataset.calibration(scene.name), image_size)
                (folder / f"{scene.name}.txt").write_text(text, encoding="utf-8")
                yield scene, moments

        write_tracks(folder / TRACK_TABLE, written())


def write_kitti_labels(
    directory: str | Path, dataset: KittiTracking, scenes: Iterable[tuple[Scene, Sequence[Labels]]]
) -> None:
    """Write labels as text of ground truth, without scores, to directory/NNNN.txt; the files appear when all is done.

    Boxes that do not show in the image are left out. Raises `InputError` for a directory that is not writable, a size
    or heading that is unknown, a class KITTI does not have.
    """
    with atomic_directory(directory) as folder:
        for scene, moments in scenes:
            tracks = [moment.tracks for moment in moments]
            with error_context(f"{directory}: sequence {scene.name}"):
                text = kitti_result_text(scene, tracks, dataset.calibration(scene.name), with_score=False)
            (folder / f"{scene.name}.txt").write_text(text, encoding="utf-8")


def kitti_result_text(
    scene: Scene,
    moments: Sequence[Tracks],
    calibration: Calibration,
    image_size: tuple[int, int] = IMAGE_SIZE,
    with_score: bool = True,
) -> str:
    """The lines of one sequence; without the score they are those of a label file."""
    if len(moments) != len(scene):
        raise InputError(f"expected tracks for {len(scene)} frames, got {len(moments)}")
    imu_T_camera = inverse_transform(calibration.camera_T_imu)
    lines: list[str] = []
    for frame, (tracks, world_T_imu) in enumerate(zip(moments, scene.world_T_ego, strict=True)):
        lines += _lines(frame, tracks, world_T_imu @ imu_T_camera, calibration, image_size, with_score)
    return "".join(lines)


def _lines(
    frame: int,
    tracks: Tracks,
    world_T_camera: FloatArray,
    calibration: Calibration,
    image_size: tuple[int, int],
    with_score: bool,
) -> list[str]:
    types = [_type(frame, label) for label in tracks.boxes.label.tolist()]
    unmeasured = ~np.isfinite(tracks.boxes.size).all(axis=1) | ~np.isfinite(tracks.boxes.yaw)
    if unmeasured.any():
        id_ = int(tracks.id[np.argmax(unmeasured)])
        raise InputError(f"frame {frame}: track {id_}: expected a known size and heading, the format requires them")
    boxes = world_boxes_to_camera(tracks.boxes, world_T_camera)
    bbox = image_boxes(boxes, calibration.projection, image_size)
    columns = [observation_angles(boxes), bbox, boxes.size, boxes.location, boxes.rotation_y]
    numbers = np.column_stack([*columns, tracks.score] if with_score else columns)
    return [
        f"{frame} {id_} {type_} 0 0 {' '.join(f'{x:.6f}' for x in row)}\n"
        for id_, type_, row, shows in zip(
            tracks.id.tolist(), types, numbers.tolist(), np.isfinite(bbox[:, 0]).tolist(), strict=True
        )
        if shows
    ]


def _type(frame: int, label: str) -> str:
    if label not in _TYPE_OF_LABEL:
        raise InputError(f"frame {frame}: {unknown_name('class', label, tuple(_TYPE_OF_LABEL))}")
    return _TYPE_OF_LABEL[label]
