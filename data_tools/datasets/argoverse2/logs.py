"""Argoverse 2 sensor logs: annotations and poses, in; `Scene`s with ground truth alone, out.

A log without annotations, as of the test split, has no moments of its own.

    LOG/annotations.feather            timestamp_ns, track_uuid, category, length_m, width_m, height_m,
                                       qw, qx, qy, qz, tx_m, ty_m, tz_m (in the ego frame), num_interior_pts
    LOG/city_SE3_egovehicle.feather    timestamp_ns, qw, qx, qy, qz, tx_m, ty_m, tz_m

A moment is an annotated time (10 Hz). World coordinates are the city's; a box is visible if points lie inside. Classes
are those of `CLASSES`, and the category in lower case where it is not there.

Source: Wilson et al., Argoverse 2, NeurIPS 2021 datasets track; https://argoverse.github.io/user-guide/. Feather
needs pyarrow (extra [parquet]).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.central_differences import central_differences
from data_tools.files.arrow_tables import WHOLE, all_of, read_arrow_arrays
from data_tools.files.error_messages import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import checked_quaternions, quaternion_rotation, yaw_of
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene

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
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")
_ANNOTATIONS = ("timestamp_ns", "track_uuid", "category", *SIZE, *POSE, "num_interior_pts")
FILES = ("annotations.feather", "city_SE3_egovehicle.feather")
KINDS = {
    **dict.fromkeys(("timestamp_ns", "track_id"), WHOLE),
    **dict.fromkeys(("track_uuid", "category", "log_id"), "OU"),
}  # of NumPy, of columns that are no numbers
_LONGEST_GAP = 0.5  # s between boxes of an object, for a velocity
_REACH = 2  # moments to either side, for a velocity


@dataclass(frozen=True, eq=False)
class ArgoverseScene(Scene):
    """A log; categories: of the detections of each frame, (n,), in the words of Argoverse."""

    categories: Sequence[StrArray] = ()


class ArgoverseLogs:
    """The logs below `root`: folders with city_SE3_egovehicle.feather and, but for the test split, annotations.feather.

    Files are read when asked for. Raises `InputError` for a root without any.
    """

    def __init__(self, root: str | Path) -> None:
        self._root = Path(root)
        files = [path for name in FILES for path in self._root.glob(f"*/{name}")]
        self._scenes = tuple(sorted({path.parent.name for path in files}))
        if not self._scenes:
            if not self._root.is_dir():
                raise InputError(f"{self._root}: expected the folder of the logs, there is no such folder")
            if any((self._root / name).is_file() for name in FILES):
                raise InputError(
                    f"{self._root}: expected the folder of the logs, this is one log: give {self._root.parent}"
                )
            raise InputError(f"{self._root}: expected LOG/annotations.feather, there is none")

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the logs."""
        return self._scenes

    def annotated(self, name: str) -> bool:
        """True if a log has annotations."""
        return (self._root / name / FILES[0]).is_file()

    def scene(self, name: str) -> ArgoverseScene:
        """Read a log with annotations; its frames are none, its categories those of the annotations.

        Raises `InputError` for an unknown name, a missing column, or a time without a pose.
        """
        if name not in self._scenes:
            raise InputError(f"{self._root}: {unknown_name('log', name, self._scenes)}")
        path = self._root / name / "annotations.feather"
        rows = columns_of(path, _ANNOTATIONS)
        stamp: IntArray = rows["timestamp_ns"]
        stamps, moment = np.unique(stamp, return_inverse=True)
        poses = self.poses(name, stamps)
        with error_context(str(path)):
            ego_T_box = transforms(rows)
            world_T_box = poses[moment] @ ego_T_box
            category: StrArray = rows["category"].astype(np.str_)
            label = class_names(category)
            ids: StrArray = rows["track_uuid"].astype(np.str_)
            time = (stamps - stamps[0]) * 1e-9 if len(stamps) else np.empty(0)
            position = world_T_box[:, :3, 3]
            velocity = central_differences(ids, time[moment], position[:, :2], _LONGEST_GAP, _REACH)
            size = np.stack([rows[name] for name in SIZE], axis=1).astype(np.float64)
            boxes = Boxes(label, position, size, yaw_of(world_T_box[:, :3, :3]), velocity)
            seen = rows["num_interior_pts"] > 0
            of_moment = [np.flatnonzero(moment == k) for k in range(len(stamps))]
            truth = [Annotations(ids[at], boxes.select(at), seen[at]) for at in of_moment]
        categories = [category[at] for at in of_moment]
        return ArgoverseScene(name, time, poses, tuple(map(str, stamps.tolist())), [], truth, categories)

    def poses(self, name: str, stamps: IntArray) -> FloatArray:
        """city_T_ego (K, 4, 4) at some times, ns. Raises `InputError` for one without a pose."""
        path = self._root / name / "city_SE3_egovehicle.feather"
        rows = columns_of(path, ("timestamp_ns", *POSE))
        order = np.argsort(rows["timestamp_ns"])
        known = rows["timestamp_ns"][order]
        at = np.minimum(np.searchsorted(known, stamps), max(len(known) - 1, 0))
        absent = known[at] != stamps if len(known) else np.ones(len(stamps), dtype=bool)
        if absent.any():
            raise InputError(
                f"{path}: timestamp_ns: expected a pose at every time of boxes, {stamps[absent][0]} has none"
            )
        with error_context(str(path)):
            return transforms(rows)[order][at]


def class_names(category: StrArray) -> StrArray:
    """Our names of classes (N,) for categories (N,)."""
    return np.array([CLASSES.get(each, each.lower()) for each in category.tolist()], dtype=np.str_)


def transforms(rows: dict[str, Any]) -> FloatArray:
    """(N, 4, 4) of the pose columns."""
    quaternion, translation = (np.stack([rows[name] for name in names], axis=1) for names in (POSE[:4], POSE[4:]))
    T = np.tile(np.eye(4), (len(quaternion), 1, 1))
    T[:, :3, :3] = quaternion_rotation(checked_quaternions("qw qx qy qz", quaternion))
    T[:, :3, 3] = translation
    return T


def columns_of(path: Path, names: tuple[str, ...], may_lack: tuple[str, ...] = ()) -> dict[str, Any]:
    """The named columns of a Feather file as arrays, and those of `may_lack` that it has."""

    def choose(there: list[str]) -> list[str]:
        return [*all_of(path, names)(there), *(name for name in may_lack if name in there)]

    return read_arrow_arrays(path, choose, KINDS, names)
