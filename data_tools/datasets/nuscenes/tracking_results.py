"""Tracking results in the official nuScenes format, written and read.

    {"meta": {"use_camera": bool, ...}, "results": {sample_token: [{sample_token, translation, size (w, l, h),
     rotation (w, x, y, z), velocity (vx, vy), tracking_id, tracking_name, tracking_score}, ...]}}

in the global frame. Every sample of a scene is listed, with at most 500 boxes; a track keeps its class. Source:
https://github.com/nutonomy/nuscenes-devkit, python-sdk/nuscenes/eval/tracking/README.md.

A box written here has one field more, which the official evaluation leaves alone: `position_covariance` (xx, xy, yy of
the horizontal position, m^2). A velocity that is unknown (`saga_fg.types.track.known_velocities`) is written as 0.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.nuscenes.classes import TRACKING_CLASSES
from data_tools.datasets.nuscenes.result_files import ResultMeta, read_result_file, result_entries
from data_tools.files.atomic_files import atomic_file
from data_tools.files.error_messages import error_context
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray, upper_triangle
from saga_fg.numerics.geometry import yaw_quaternion
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks, known_velocities

MAX_BOXES = 500  # per sample, official


def write_tracking_results(
    path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Tracks]]], meta: ResultMeta
) -> None:
    """Write the tracks of some scenes, each with one `Tracks` for each of its timestamps, in order.

    `scenes` may be a generator: it is consumed while the file is written, and the file appears when all is done.
    Only the seven tracking classes are written, per sample the 500 boxes of highest score; an unknown velocity becomes
    zero. Track ids become "scene-id" and so are unique over scenes; of a track that changes its class, what is not of
    the first class is "scene-id-class". Raises `InputError` for a path that is not writable, tracks that do not fit the
    scene, a size or heading that is unknown.
    """
    _write(path, (sample for scene, moments in scenes for sample in _samples(str(path), scene, moments)), meta)


def merge_tracking_results(path: str | Path, parts: Iterable[Path], meta: ResultMeta) -> None:
    """Write the samples of several result files into one, in order; never more than one sample is in memory.

    Raises `InputError` as `write_tracking_results` does, and for parts that are no result files.
    """
    _write(path, ((token, boxes) for part in parts for token, boxes in result_entries(part) if token is not None), meta)


def _write(path: str | Path, samples: Iterable[tuple[str, list[dict[str, Any]]]], meta: ResultMeta) -> None:
    with atomic_file(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", write_through=True)
        file.write(f'{{"meta": {json.dumps(asdict(meta))}, "results": {{')
        written: set[str] = set()
        for token, boxes in samples:
            if not token or token in written:
                raise InputError(f"{path}: expected a token of its own for every sample, got {token!r}")
            file.write(f"{',' if written else ''}\n{json.dumps(token)}: {json.dumps(boxes, allow_nan=False)}")
            written.add(token)
        file.write("\n}}\n")
        file.detach()


def _samples(path: str, scene: Scene, moments: Sequence[Tracks]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Token and boxes of each sample of a scene."""
    with error_context(f"{path}: scene {scene.name}"):
        if len(moments) != len(scene):
            raise InputError(f"expected tracks for {len(scene)} samples, got {len(moments)}")
        class_of: dict[int, str] = {}
        for token, tracks in zip(scene.tokens, moments, strict=True):
            yield token, _boxes(scene.name, token, tracks, class_of)


def _boxes(scene: str, token: str, tracks: Tracks, class_of: dict[int, str]) -> list[dict[str, Any]]:
    rows = np.flatnonzero(np.isin(tracks.boxes.label, TRACKING_CLASSES))
    best = np.argsort(-tracks.score[rows], kind="stable")[:MAX_BOXES]
    chosen = tracks.select(rows[np.sort(best)])
    boxes = chosen.boxes
    names = []
    for id_, label in zip(chosen.id.tolist(), boxes.label.tolist(), strict=True):
        first = class_of.setdefault(id_, label) == label
        names.append(f"{scene}-{id_}" if first else f"{scene}-{id_}-{label}")
    unmeasured = ~np.isfinite(boxes.size).all(axis=1) | ~np.isfinite(boxes.yaw)
    if unmeasured.any():
        id_ = int(chosen.id[np.argmax(unmeasured)])
        raise InputError(f"sample {token}: track {id_}: expected a known size and heading, the format requires them")
    columns = zip(
        boxes.position.round(6).tolist(),
        boxes.size[:, [1, 0, 2]].round(6).tolist(),
        yaw_quaternion(boxes.yaw).round(12).tolist(),
        np.nan_to_num(known_velocities(boxes.velocity, chosen.velocity_covariance)).round(6).tolist(),
        names,
        boxes.label.tolist(),
        chosen.score.tolist(),
        upper_triangle(chosen.position_covariance).round(6).tolist(),
        strict=True,
    )
    return [
        {
            "sample_token": token,
            "translation": translation,
            "size": size,
            "rotation": rotation,
            "velocity": velocity,
            "tracking_id": name,
            "tracking_name": label,
            "tracking_score": score,
            "position_covariance": covariance,
        }
        for translation, size, rotation, velocity, name, label, score, covariance in columns
    ]


@dataclass(frozen=True, eq=False)
class TrackedBoxes:
    """The boxes of one sample of a tracking result: `id` (N,) names of the tracks, `boxes`, `score` (N,).

    position_covariance (N, 2, 2), m^2: NaN where the file has none.
    """

    id: StrArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray

    def __len__(self) -> int:
        return len(self.boxes)


@dataclass(frozen=True, eq=False)
class TrackingResults:
    """A tracking result file: its `meta`, and the boxes of every sample by token."""

    meta: ResultMeta
    samples: dict[str, TrackedBoxes]


def read_tracking_results(path: str | Path) -> TrackingResults:
    """Read a tracking result file. Raises `InputError` naming sample, box and field of what is not as it should be."""
    result = read_result_file(path, "tracking")
    columns = result.boxes
    samples = {}
    for token, rows in columns.rows.items():
        ids = columns.id[rows]
        if len(np.unique(ids)) != len(ids):
            raise InputError(f"{path}: sample {token}: tracking_id: expected each track at most once")
        samples[token] = TrackedBoxes(
            ids, columns.boxes.select(rows), columns.score[rows], columns.position_covariance[rows]
        )
    return TrackingResults(result.meta, samples)
