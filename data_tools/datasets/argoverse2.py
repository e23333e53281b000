"""Argoverse 2 sensor logs: annotations and poses, in; `Scene`s with ground truth alone, out.

    LOG/annotations.feather            timestamp_ns, track_uuid, category, length_m, width_m, height_m,
                                       qw, qx, qy, qz, tx_m, ty_m, tz_m (in the ego frame), num_interior_pts
    LOG/city_SE3_egovehicle.feather    timestamp_ns, qw, qx, qy, qz, tx_m, ty_m, tz_m

A moment is an annotated time (10 Hz). World coordinates are the city's; a box is visible if points lie inside. Classes
are those of `CLASSES`, and the category in lower case where it is not there.

Source: Wilson et al., Argoverse 2, NeurIPS 2021 datasets track; https://argoverse.github.io/user-guide/. Feather
needs pyarrow (extra [parquet]).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.annotated import AnnotatedSource
from data_tools.datasets.central_differences import central_differences
from data_tools.datasets.source import option
from data_tools.files.arrow_tables import all_of, read_arrow_table
from data_tools.files.error_messages import error_context, unknown_name
from data_tools.files.remote_files import local_tree
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import checked_quaternions, quaternion_rotation, yaw_of
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Dataset, Scene

CLASSES = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
    "BUS": "bus",
    "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus",
    "VEHICULAR_TRAILER": "trailer",
}
_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")
_ANNOTATIONS = ("timestamp_ns", "track_uuid", "category", *_SIZE, *_POSE, "num_interior_pts")
_LONGEST_GAP = 0.5  # s between boxes of an object, for a velocity
_REACH = 2  # moments to either side, for a velocity


class ArgoverseLogs:
    """The logs below `root`: folders with annotations.feather and city_SE3_egovehicle.feather.

    Files are read when asked for. Raises `InputError` for a root without any.
    """

    def __init__(self, root: str | Path) -> None:
        self._root = Path(root)
        self._scenes = tuple(sorted(path.parent.name for path in self._root.glob("*/annotations.feather")))
        if not self._scenes:
            raise InputError(f"{self._root}: expected LOG/annotations.feather, there is none")

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the logs."""
        return self._scenes

    def scene(self, name: str) -> Scene:
        """Read a log; raises `InputError` for an unknown name, a missing column, or a time without a pose."""
        if name not in self._scenes:
            raise InputError(f"{self._root}: {unknown_name('log', name, self._scenes)}")
        path = self._root / name / "annotations.feather"
        rows = _columns(path, _ANNOTATIONS)
        stamp: IntArray = rows["timestamp_ns"]
        stamps, moment = np.unique(stamp, return_inverse=True)
        poses = self._poses(name, stamps)
        with error_context(str(path)):
            ego_T_box = _transforms(rows)
            world_T_box = poses[moment] @ ego_T_box
            category: StrArray = rows["category"].astype(np.str_)
            label = np.array([CLASSES.get(c, c.lower()) for c in category.tolist()], dtype=np.str_)
            ids: StrArray = rows["track_uuid"].astype(np.str_)
            time = (stamps - stamps[0]) * 1e-9 if len(stamps) else np.empty(0)
            position = world_T_box[:, :3, 3]
            velocity = central_differences(ids, time[moment], position[:, :2], _LONGEST_GAP, _REACH)
            size = np.stack([rows[name] for name in _SIZE], axis=1).astype(np.float64)
            boxes = Boxes(label, position, size, yaw_of(world_T_box[:, :3, :3]), velocity)
            seen = rows["num_interior_pts"] > 0
            of_moment = [np.flatnonzero(moment == k) for k in range(len(stamps))]
            truth = [Annotations(ids[at], boxes.select(at), seen[at]) for at in of_moment]
        return Scene(name, time, poses, tuple(map(str, stamps.tolist())), [], truth)

    def _poses(self, name: str, stamps: IntArray) -> FloatArray:
        """city_T_ego (K, 4, 4) at the annotated times."""
        path = self._root / name / "city_SE3_egovehicle.feather"
        rows = _columns(path, ("timestamp_ns", *_POSE))
        order = np.argsort(rows["timestamp_ns"])
        known = rows["timestamp_ns"][order]
        at = np.minimum(np.searchsorted(known, stamps), max(len(known) - 1, 0))
        absent = known[at] != stamps if len(known) else np.ones(len(stamps), dtype=bool)
        if absent.any():
            raise InputError(
                f"{path}: timestamp_ns: expected a pose at every annotated time, {stamps[absent][0]} has none"
            )
        with error_context(str(path)):
            return _transforms(rows)[order][at]


def _transforms(rows: dict[str, Any]) -> FloatArray:
    """(N, 4, 4) of the pose columns."""
    quaternion, translation = (np.stack([rows[name] for name in names], axis=1) for names in (_POSE[:4], _POSE[4:]))
    T = np.tile(np.eye(4), (len(quaternion), 1, 1))
    T[:, :3, :3] = quaternion_rotation(checked_quaternions("qw qx qy qz", quaternion))
    T[:, :3, 3] = translation
    return T


def _columns(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """The named columns of a Feather file as arrays."""
    table = read_arrow_table(path, all_of(path, names))
    empty = [name for name in names if table[name].null_count]
    if empty:
        raise InputError(f"{path}: {empty[0]}: expected a value in every row")
    columns = {name: table[name].to_numpy() for name in names}
    for name, column in columns.items():
        kinds = {"timestamp_ns": "iu", "track_uuid": "OU", "category": "OU"}.get(name, "iuf")
        if column.dtype.kind not in kinds:
            expected = "text" if kinds == "OU" else "whole numbers" if kinds == "iu" else "numbers"
            raise InputError(f"{path}: {name}: expected {expected}, got {column.dtype}")
    return columns


@dataclass(frozen=True, kw_only=True)
class ArgoverseSource(AnnotatedSource):
    """Argoverse 2 sensor logs, annotated ten times a second; needs the extra [parquet]."""

    name = "argoverse2"
    family = "nuscenes"
    example = "--dataroot data/av2"
    dataroot: str = option("Folder of the logs, in each annotations.feather, city_SE3_egovehicle.feather; or its URL.")

    @contextmanager
    def annotated(self) -> Iterator[Dataset]:
        with local_tree(self.dataroot, ["*/annotations.feather", "*/city_SE3_egovehicle.feather"]) as root:
            yield ArgoverseLogs(root)
