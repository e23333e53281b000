"""Tables of true objects: a row per object and moment, with the columns of tracks and `visible`, 0 where hidden.

The moments of a scene are the times of its rows. Velocities that are not there are central differences of positions
over about half a second; positions in coordinates of the vehicle are moved to the world by its pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_tools.datasets.central_differences import central_differences
from data_tools.datasets.detection_files.columns import POSE, QUATERNION, ROTATIONS, RawTable
from data_tools.datasets.detection_files.formats import Layout, read_raw_table
from data_tools.datasets.detection_files.table_import import TableImport
from data_tools.datasets.detection_files.track_rows import REQUIRED, TrackRows, track_rows_of
from data_tools.datasets.detection_files.tracks import SETTLED, TRACK_COLUMNS
from data_tools.files.error_messages import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene

LAYOUT = Layout(
    (*TRACK_COLUMNS, SETTLED, *QUATERNION, "coordinates", *POSE, *ROTATIONS["ego_yaw"], "visible"),
    REQUIRED,
    lenient=True,
)
REACH = 0.25  # s to either side, for a velocity
LONGEST_GAP = 2.5  # steps between rows of an object, for a velocity


class TruthFile:
    """The scenes of one table of true objects, with ground truth alone. `named`: whether the table names its scenes."""

    def __init__(self, path: str | Path, how: TableImport | None = None) -> None:
        """Read and check everything. Raises `InputError` naming file, row and column."""
        raw = read_raw_table(Path(path), LAYOUT, how)
        self.path = raw.path
        self.rows = track_rows_of(raw)
        if not len(self.rows.id):
            raise InputError(f"{path}: expected at least one row, the table is empty")
        kept = np.flatnonzero(~raw.labels()[1])
        self._visible = _visible(raw)[kept]
        self._pose = _poses(raw)[kept]
        self._in_ego = (raw.texts("coordinates", raw.how.coordinates or "world") == "ego")[kept]
        self._in_ego &= np.isfinite(self._pose).all(axis=1)
        self._with_velocity = {"vx", "vy"} <= raw.columns.keys()
        self.named = self.rows.named
        _, first = np.unique(self.rows.scene, return_index=True)
        self.scenes: tuple[str, ...] = tuple(self.rows.scene[np.sort(first)].tolist())

    def scene(self, name: str) -> Scene:
        """One of the scenes; raises `InputError` for an unknown name and an object that is there twice at a time."""
        if name not in self.scenes:
            raise InputError(f"{self.path}: {unknown_name('scene', name, self.scenes)}")
        rows = np.flatnonzero(self.rows.scene == name)
        times, moment = np.unique(self.rows.timestamp[rows], return_inverse=True)
        poses = _scene_poses(self.rows, rows, moment, self._pose)
        boxes = _in_world(self.rows.boxes.select(rows), self._in_ego[rows], poses[moment])
        if not self._with_velocity and len(times) > 1:
            step = float(np.median(np.diff(times)))
            reach = max(1, round(REACH / step))
            ids = self.rows.id[rows]
            velocity = central_differences(ids, times[moment], boxes.position[:, :2], LONGEST_GAP * step, reach)
            boxes = replace(boxes, velocity=velocity)
        truth = []
        for k, at in enumerate(np.split(np.argsort(moment, kind="stable"), np.cumsum(np.bincount(moment))[:-1])):
            with error_context(f"{self.path}: scene {name}: {times[k]} s"):
                truth.append(Annotations(self.rows.id[rows][at], boxes.select(at), self._visible[rows][at]))
        return Scene(name, times, poses, ("",) * len(times), (), truth)


def _scene_poses(rows: TrackRows, at: Sequence[int] | np.ndarray, moment: np.ndarray, pose: FloatArray) -> FloatArray:
    """world_T_ego (K, 4, 4): those of the table, else an upright vehicle amid all objects."""
    _, first = np.unique(moment, return_index=True)
    if np.isfinite(pose[at]).all():
        return np.array([yaw_transform(*each) for each in pose[at][first].tolist()])
    poses = np.tile(np.eye(4), (len(first), 1, 1))
    poses[:, :2, 3] = np.median(rows.boxes.position[at, :2], axis=0)
    return poses


def _in_world(boxes: Boxes, in_ego: BoolArray, world_T_ego: FloatArray) -> Boxes:
    """Boxes (N) with those in coordinates of the vehicle moved to the world; poses (N, 4, 4) of their moments."""
    if not in_ego.any():
        return boxes
    R, t = world_T_ego[:, :3, :3], world_T_ego[:, :3, 3]
    turn = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    position = np.einsum("nij,nj->ni", R, boxes.position) + t
    velocity = np.einsum("nij,nj->ni", R[:, :2, :2], boxes.velocity)
    return replace(
        boxes,
        position=np.where(in_ego[:, None], position, boxes.position),
        velocity=np.where(in_ego[:, None], velocity, boxes.velocity),
        yaw=np.where(in_ego, boxes.yaw + turn, boxes.yaw),
    )


def _poses(raw: RawTable) -> FloatArray:
    """x, y, z, yaw (N, 4) of the vehicle, NaN where the table has none."""
    return np.stack([raw.numbers(name, 0.0 if name == "ego_z" else np.nan) for name in POSE], axis=-1)


def _visible(raw: RawTable) -> BoolArray:
    """Mask (N,) of the objects that can be seen: all that no column `visible` calls 0 or false."""
    values = raw.columns.get("visible", ())
    if not len(values):
        return np.ones(raw.length, dtype=np.bool_)
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    return np.array([str(value).strip().lower() not in ("0", "0.0", "false") for value in listed], dtype=np.bool_)
