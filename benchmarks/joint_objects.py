"""Errors of objects beside a vehicle whose path is estimated: in the world, and seen from the vehicle.

A pair is an object at a frame, with a detection within `NEAR` of the truth along the true path, of a track that has
detected it in at least `SETTLED` frames before: earlier, velocities are the priors of new tracks. Contenders are
compared on the pairs that all of them have. With the estimated and the true pose (R, t), (R', t') of the vehicle,

    in the world    p - p',  v - v'                     from it    R^T (p - t) - R'^T (p' - t'),  R^T v - R'^T v'
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval, paired_bootstrap
from saga_fg.graph import EGO_POSE, Additions, GraphView
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import Assignment, assign
from saga_fg.slam.joint.estimate import ObjectStates
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections

NEAR, SETTLED = 2.0, 3  # m, of a detection from the object that it is of; frames
_SAME_TIME = 1e-3  # s, between a frame and its truth
MOVING = 1.0  # m/s, from which an object moves
FIGURES = ("world position", "world velocity", "ego position", "ego velocity")
Pair = tuple[int, str]  # frame, object


@dataclass(frozen=True)
class ObjectRow:
    """RMSE of a contender over the pairs of moving or of stationary objects, in the order of `FIGURES`, m and m/s."""

    contender: str
    moving: bool
    pairs: int
    rmse: tuple[float, ...]


@dataclass(frozen=True)
class ObjectChange:
    """Relative change of the pooled RMSE of `contender` against `baseline`, in the order of `FIGURES`."""

    contender: str
    baseline: str
    moving: bool
    changes: tuple[Interval, ...]


class ObjectErrors:
    """Errors (8,) of a contender, in the order of `FIGURES`, by pair."""

    def __init__(self) -> None:
        self.found: dict[Pair, FloatArray] = {}
        self._count: dict[tuple[int, str], int] = {}

    def add(
        self,
        frame: int,
        ids: IntArray,
        states: FloatArray,
        poses: tuple[FloatArray, FloatArray],
        detected: Iterable[tuple[int, int]],
        objects: Mapping[int, int],
        truth: Annotations,
    ) -> None:
        """Take in the states (n, 4) of the tracks `ids` (n,) at a frame.

        poses: of the vehicle (4, 4), estimated and true; detected: a track and its detection each; objects: rows of
        the truth by those of detections
        """
        row = {id_: n for n, id_ in enumerate(ids.tolist())}
        for id_, detection in detected:
            if detection not in objects:
                continue
            n = objects[detection]
            name = str(truth.id[n])
            before = self._count.get((id_, name), 0)
            self._count[id_, name] = before + 1
            true = np.concatenate([truth.boxes.position[n, :2], truth.boxes.velocity[n]])
            if id_ in row and before >= SETTLED and np.isfinite(true).all():
                state = states[row[id_]]
                seen = _from_vehicle(state, poses[0]) - _from_vehicle(true, poses[1])
                self.found[frame, name] = np.concatenate([state - true, seen])


def _from_vehicle(state: FloatArray, pose: FloatArray) -> FloatArray:
    R = pose[:2, :2]
    return np.concatenate([(state[:2] - pose[:2, 3]) @ R, state[2:] @ R])


def truth_at(scene: Scene, time: float) -> Annotations | None:
    """The truth of a moment, s; None where the scene has none then."""
    moment = int(np.argmin(np.abs(scene.timestamps - time)))
    there = scene.ground_truth is not None and abs(scene.timestamps[moment] - time) <= _SAME_TIME
    return scene.ground_truth[moment] if scene.ground_truth is not None and there else None


def planar_states(objects: Boxes | ObjectStates) -> FloatArray:
    """States (n, 4) of objects: place and velocity in the plane."""
    return np.concatenate([objects.position[:, :2], objects.velocity], axis=1)


def detected_by(assignment: Assignment) -> list[tuple[int, int]]:
    """Each track with its detection."""
    return list(zip(assignment.id.tolist(), assignment.detection.tolist(), strict=True))


def true_objects(detections: Detections, world_T_ego: FloatArray | None, truth: Annotations) -> dict[int, int]:
    """Rows of the truth by those of detections in the vehicle's frame."""
    boxes: Boxes = detections.boxes.transformed(np.eye(4) if world_T_ego is None else world_T_ego)
    apart = boxes.position[:, None, :2] - truth.boxes.position[None, :, :2]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    same = boxes.label[:, None] == truth.boxes.label[None, :]
    return dict(zip(*(rows.tolist() for rows in assign(distance, same & (distance < NEAR), NEAR)), strict=True))


def object_rows(contenders: Mapping[str, ObjectErrors], speeds: Mapping[Pair, float]) -> tuple[ObjectRow, ...]:
    """The figures of contenders over their common pairs; speeds: true ones, m/s."""
    common = sorted(set.intersection(*(set(one.found) for one in contenders.values())))
    rows = []
    for moving in (True, False):
        chosen = [pair for pair in common if (speeds[pair] > MOVING) == moving]
        for name, errors in contenders.items():
            off = np.array([errors.found[pair] for pair in chosen]).reshape(-1, len(FIGURES), 2)
            rmse = np.sqrt((off**2).sum(axis=2).mean(axis=0)) if chosen else np.full(len(FIGURES), np.nan)
            rows.append(ObjectRow(name, moving, len(chosen), tuple(rmse.tolist())))
    return tuple(rows)


def object_changes(
    recordings: Mapping[str, Sequence[tuple[ObjectRow, ...]]], contender: str, baselines: Sequence[str]
) -> tuple[ObjectChange, ...]:
    """Changes with intervals over recordings, each with the rows of its runs."""
    found = []
    for baseline in baselines:
        for moving in (True, False):
            changes = []
            for k in range(len(FIGURES)):
                sums = np.zeros((2, len(recordings), 2))
                for n, runs in enumerate(recordings.values()):
                    for one in (one for run in runs for one in run if one.moving == moving and one.pairs):
                        for side, name in enumerate((contender, baseline)):
                            if one.contender == name:
                                sums[side, n] += one.pairs * one.rmse[k] ** 2, one.pairs
                changes.append(paired_bootstrap(sums[0], sums[1]))
            found.append(ObjectChange(contender, baseline, moving, tuple(changes)))
    return tuple(found)


def object_tables(
    recordings: Mapping[str, Sequence[tuple[ObjectRow, ...]]], changes: Sequence[ObjectChange]
) -> list[FigureTable]:
    """RMSE of moving objects by recording, and the changes of the pooled ones."""
    rows = []
    for name, runs in recordings.items():
        moving = [one for run in runs for one in run if one.moving and one.pairs]
        for contender in dict.fromkeys(one.contender for one in moving):
            mine = [one for one in moving if one.contender == contender]
            pairs = np.array([one.pairs for one in mine])
            pooled = np.sqrt(np.average(np.square([one.rmse for one in mine]), axis=0, weights=pairs))
            rows.append((name, contender, str(pairs.sum()), *map(cell, pooled.tolist())))
    columns = ("recording", "method", "pairs", *(f"{name}, {_unit(name)}" for name in FIGURES))
    against = tuple(
        (
            f"{one.contender} against {one.baseline}",
            "moving" if one.moving else "stationary",
            *map(percent, one.changes),
        )
        for one in changes
    )
    return [
        FigureTable("RMSE of moving objects, at every frame", columns, tuple(rows)),
        FigureTable("changes of pooled errors of objects, 95 % intervals", ("compared", "objects", *FIGURES), against),
    ]


def _unit(figure: str) -> str:
    return "m/s" if figure.endswith("velocity") else "m"


@dataclass(frozen=True, eq=False)
class HeldPath:
    """Provider that holds the vehicle on a path (n, 4, 4), so that objects are estimated along it."""

    path: FloatArray
    name: str = "held path"

    def factors(self, view: GraphView) -> Additions:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
        pose = gtsam.Pose3(self.path[view.epoch])
        return Additions(factors=[gtsam.PriorFactorPose3(view.key(EGO_POSE, 0), pose, noise)])


def true_speeds(names: Iterable[tuple[int, Annotations]]) -> dict[Pair, float]:
    """Speeds of all objects of frames and their truth."""
    return {
        (frame, str(name)): float(np.hypot(*velocity))
        for frame, truth in names
        for name, velocity in zip(truth.id, truth.boxes.velocity, strict=True)
    }


def by_recording(rows: Iterable[tuple[str, tuple[ObjectRow, ...]]]) -> dict[str, list[tuple[ObjectRow, ...]]]:
    """Figures of runs by the name of their recording."""
    found: dict[str, list[tuple[ObjectRow, ...]]] = {}
    for name, figures in rows:
        found.setdefault(name, []).append(figures)
    return found
