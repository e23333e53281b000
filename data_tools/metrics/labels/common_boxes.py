"""Errors of several systems on common true boxes: those that every system matches.

Pairs are the nearest within a gate, frame by frame and class by class (`nearest_pairs`): first with the visible
objects, then, of the remaining boxes, with the hidden ones. A pair counts if its track is paired with no other object
more often: where one system has no box any more, the nearest one is that of a neighbour. A system that finds more boxes
also finds more difficult ones, so systems are compared on the boxes that all of them find.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from data_tools.metrics.consistency import nees
from data_tools.metrics.error_sample import ErrorSample
from data_tools.metrics.nearest_pairs import nearest_pairs
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import wrap_angle

QUANTITIES = ("position", "heading", "size", "velocity", "nees")


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """One scene: N true boxes, and the boxes of several systems.

    truth     all objects, hidden ones too
    visible   (N,) True for objects that a sensor could see
    velocity  (N, 2) m/s, NaN where unknown
    distance  (N,) from the vehicle, m
    systems   boxes by name of the system
    """

    truth: SceneBoxes
    visible: BoolArray
    velocity: FloatArray
    distance: FloatArray
    systems: Mapping[str, SceneBoxes]


@dataclass(frozen=True, eq=False)
class CommonBoxes:
    """M true boxes that every system matches.

    label (M,), distance (M,) m, visible (M,)
    errors  by system and quantity (M,): position m, heading rad, size m (mean of length, width, height), velocity m/s,
            nees (squared position error over its covariance, 2 degrees of freedom); NaN where unknown
    """

    label: StrArray
    distance: FloatArray
    visible: BoolArray
    errors: Mapping[str, Mapping[str, FloatArray]]

    def __len__(self) -> int:
        return len(self.label)

    def select(self, rows: BoolArray | IntArray) -> Self:
        """The boxes of a mask or of row indices."""
        errors = {name: {q: column[rows] for q, column in of.items()} for name, of in self.errors.items()}
        return type(self)(self.label[rows], self.distance[rows], self.visible[rows], errors)

    @classmethod
    def pool(cls, parts: Iterable[CommonBoxes]) -> Self:
        """The boxes of all scenes, which have the same systems."""
        scenes = list(parts)
        errors = {
            name: {q: np.concatenate([scene.errors[name][q] for scene in scenes]) for q in QUANTITIES}
            for name in (scenes[0].errors if scenes else ())
        }
        return cls(
            np.concatenate([np.empty(0, dtype="<U1"), *(scene.label for scene in scenes)]),
            np.concatenate([np.empty(0), *(scene.distance for scene in scenes)]),
            np.concatenate([np.empty(0, dtype=np.bool_), *(scene.visible for scene in scenes)]),
            errors,
        )

    def sample(self, system: str, quantity: str) -> ErrorSample:
        """The known errors of a system."""
        return ErrorSample.known(self.errors[system][quantity])


def common_boxes(scene: LabelledScene, gate: float) -> CommonBoxes:
    """The true boxes that every system matches within `gate` (m), with the errors of each system."""
    errors = {name: _errors(scene, table, gate) for name, table in scene.systems.items()}
    found = np.ones(len(scene.truth), dtype=np.bool_)
    for of in errors.values():
        found &= np.isfinite(of["position"])
    whole = CommonBoxes(scene.truth.boxes.label, scene.distance, scene.visible, errors)
    return whole.select(found)


def visible_then_hidden(
    truth: SceneBoxes, visible: BoolArray, found: SceneBoxes, gate: float
) -> tuple[IntArray, IntArray]:
    """Rows of matched true and found boxes: visible objects are matched first, then hidden ones."""
    free = np.arange(len(found))
    pairs = []
    for rows in (np.flatnonzero(visible), np.flatnonzero(~visible)):
        a, b = truth.select(rows), found.select(free)
        i, j, _ = nearest_pairs((a.frame, a.boxes), (b.frame, b.boxes), gate)
        pairs.append((rows[i], free[j]))
        free = np.setdiff1d(free, free[j])
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def _errors(scene: LabelledScene, found: SceneBoxes, gate: float) -> dict[str, FloatArray]:
    """The errors of one system at all true boxes, NaN where it has none."""
    columns = {name: np.full(len(scene.truth), np.nan) for name in QUANTITIES}
    row, column = visible_then_hidden(scene.truth, scene.visible, found, gate)
    own = _holds_most(scene.truth.id[row], found.id[column])
    row, column = row[own], column[own]
    a, b = scene.truth.boxes.select(row), found.boxes.select(column)
    offset = (b.position - a.position)[:, :2]
    columns["position"][row] = np.hypot(*offset.T)
    columns["heading"][row] = np.abs(wrap_angle(b.yaw - a.yaw))
    columns["size"][row] = np.abs(b.size - a.size).mean(axis=1)
    columns["velocity"][row] = np.hypot(*(b.velocity - scene.velocity[row]).T)
    columns["nees"][row] = nees(offset, found.position_covariance[column])
    return columns


def _holds_most(objects: StrArray, tracks: StrArray) -> BoolArray:
    """(P,) of pairs whose track is paired with no other object more often."""
    track, of_track = np.unique(tracks, return_inverse=True)
    pair, of_pair, count = np.unique(
        np.stack([of_track, np.unique(objects, return_inverse=True)[1]]),
        axis=1,
        return_inverse=True,
        return_counts=True,
    )
    most = np.zeros(len(track), dtype=np.int64)
    np.maximum.at(most, pair[0], count)
    return np.asarray(count[of_pair.ravel()] == most[of_track])
