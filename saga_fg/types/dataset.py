"""The dataset protocol: scenes, frames and poses, labelled objects over time, and suspicions about all of these.

The dataset protocol: scenes, and in each the frames of detections, the poses and, where there is one, the truth.

A new dataset is one class with `scenes` and `scene(name)`; everything downstream (tracking, evaluation, export)
works on `Scene`s alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, StrArray, checked, checked_labels, checked_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame


@dataclass(frozen=True, eq=False)
class Annotations:
    """Ground truth of one moment, in world coordinates.

    id       (N,) names of the objects, unique within the moment and constant over the scene
    boxes         label, position, size, yaw, velocity (NaN where unknown)
    visible  (N,) whether some sensor could see the object; occluded objects are False; all True if left out
    """

    id: StrArray
    boxes: Boxes
    visible: BoolArray = field(default_factory=lambda: np.array(True))

    def __post_init__(self) -> None:
        n = len(self.boxes)
        ids = checked_labels("id", self.id, n)
        if len(np.unique(ids)) != n:
            raise InputError("id: expected unique object ids within one moment")
        visible = np.full(n, self.visible) if np.ndim(self.visible) == 0 else np.asarray(self.visible)
        if visible.shape != (n,) or (n and visible.dtype != np.bool_):
            raise InputError(f"visible: expected {n} booleans, got {visible.dtype} {visible.shape}")
        vars(self).update(id=ids, visible=visible.astype(bool))

    def __len__(self) -> int:
        return len(self.boxes)


@dataclass(frozen=True, eq=False)
class Scene:
    """One recording.

    name          unique within the dataset
    timestamps    (K,) s, strictly increasing: the moments at which tracks are wanted
    world_T_ego   (K, 4, 4) pose of the vehicle at these moments; the identity if left out
    tokens        K names the dataset gives to these moments, "" where it has none
    frames        of all sensors, in order of time
    ground_truth  K annotations, or None
    findings      what is doubtful about how it was read; None where its reader has not looked

    Raises `InputError` for times that repeat or run backwards, and for lengths that differ.
    """

    name: str
    timestamps: FloatArray
    world_T_ego: FloatArray = field(default_factory=lambda: np.eye(4))  # a single pose serves all
    tokens: tuple[str, ...] = ()
    frames: Sequence[Frame] = ()
    ground_truth: Sequence[Annotations] | None = None
    findings: tuple[Finding, ...] | None = None

    def __post_init__(self) -> None:
        timestamps = checked("timestamps", self.timestamps, (None,))
        step = np.diff(timestamps)
        if (step <= 0).any():
            k = int(np.argmax(step <= 0)) + 1
            what = "repeats" if step[k - 1] == 0 else "runs backwards"
            raise InputError(
                f"scene {self.name}: timestamps[{k}]: expected increasing times, time {what} at {timestamps[k]:.6f} s"
            )
        K, tokens = len(timestamps), self.tokens or ("",) * len(timestamps)
        poses = np.tile(self.world_T_ego, (K, 1, 1)) if np.ndim(self.world_T_ego) == 2 else self.world_T_ego
        poses = checked("world_T_ego", poses, (K, 4, 4))
        for k, pose in enumerate(poses):
            checked_transform(f"scene {self.name}: world_T_ego[{k}]", pose)
        for name, column in (("tokens", tokens), ("ground_truth", self.ground_truth)):
            if column is not None and len(column) != K:
                raise InputError(f"scene {self.name}: {name}: expected {K} entries, got {len(column)}")
        times = np.array([frame.timestamp for frame in self.frames])
        if (np.diff(times) < 0).any():
            k = int(np.argmax(np.diff(times) < 0)) + 1
            raise InputError(
                f"scene {self.name}: frames[{k}]: expected frames in order of time, {times[k]:.6f} s comes late"
            )
        vars(self).update(timestamps=timestamps, world_T_ego=poses, tokens=tokens)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def sensors(self) -> tuple[str, ...]:
        """The names of the sensors of this scene, sorted."""
        return tuple(sorted({frame.sensor for frame in self.frames}))


class Dataset(Protocol):
    """A collection of scenes, read one at a time."""

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the scenes."""
        ...

    def scene(self, name: str) -> Scene:
        """Read one scene; raises `InputError` for an unknown name or a broken record."""
        ...


LABEL_GAP = 1.1  # s between labels that are joined by a straight line


@dataclass(frozen=True, eq=False)
class LabelledObjects:
    """N objects at K moments, NaN where they are not labelled.

    time (K,) s; id (N,), label (N,); length (N,) m, 0 where unknown; position (K, N, 2) m, world, or about some origin;
    heading (K, N) rad and velocity (K, N, 2) m/s, NaN where unknown
    """

    time: FloatArray
    id: StrArray
    label: StrArray
    length: FloatArray
    position: FloatArray
    heading: FloatArray
    velocity: FloatArray

    @classmethod
    def from_scene(cls, scene: Scene) -> Self:
        """All objects of a scene. Raises `InputError` for one without ground truth."""
        if scene.ground_truth is None:
            raise InputError(f"scene {scene.name}: expected ground truth, there is none")
        truth = scene.ground_truth
        names = np.unique(np.concatenate([np.empty(0, dtype=np.str_), *(moment.id for moment in truth)]))
        K, N = len(truth), len(names)
        position, velocity, heading = np.full((K, N, 2), np.nan), np.full((K, N, 2), np.nan), np.full((K, N), np.nan)
        length, label = np.zeros(N), np.full(N, "", dtype="U64")
        for k, moment in enumerate(truth):
            at, boxes = np.searchsorted(names, moment.id), moment.boxes
            position[k, at], velocity[k, at], heading[k, at] = boxes.position[:, :2], boxes.velocity, boxes.yaw
            length[at], label[at] = np.nan_to_num(boxes.size[:, 0]), boxes.label
        return cls(scene.timestamps, names, label, length, position, heading, velocity)

    def __len__(self) -> int:
        return len(self.time)

    def at(self, time: float) -> FloatArray:
        """(N, 2) places at a time, s, on the line between labels up to `LABEL_GAP` apart; NaN where there are none."""
        after = int(np.searchsorted(self.time, time - 1e-6))
        if after < len(self.time) and self.time[after] - time < 1e-6:
            return np.asarray(self.position[after])
        if after in (0, len(self.time)) or self.time[after] - self.time[after - 1] > LABEL_GAP:
            return np.full(self.position.shape[1:], np.nan)
        share = (time - self.time[after - 1]) / (self.time[after] - self.time[after - 1])
        return np.asarray((1 - share) * self.position[after - 1] + share * self.position[after])


FILL_IN = "..."
"""Stands for a name that only the owner of the data knows."""


@dataclass(frozen=True)
class Mend:
    """Entries of a `TableImport` that mend a suspicion.

    columns      by our name: the column, by our name for it as it is read now, that it should be read from
    classes      by the name as it is read now; `FILL_IN` where it is not known
    units        by kind
    coordinates  of rows that say none, "" to leave them
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    classes: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    coordinates: Literal["", "world", "ego", "camera"] = ""

    def __or__(self, other: Mend) -> Mend:
        """Both."""
        return Mend(
            {**self.columns, **other.columns},
            {**self.classes, **other.classes},
            {**self.units, **other.units},
            self.coordinates or other.coordinates,
        )


@dataclass(frozen=True)
class Finding:
    """One suspicion.

    kind      names it; each is told once
    what      what is seen, and what it looks like
    expected  what should be given instead
    mend      what mends it where a table is read; None for none
    option    that of the command, or argument in a program, which mends it, "" for none
    stops     whether the data contradict how they are read; its option mends all that do
    """

    kind: str
    what: str
    expected: str
    mend: Mend | None = None
    option: str = ""
    stops: bool = False

    @property
    def contradicts(self) -> bool:
        """True if another unit, frame or column explains the data, not merely other names."""
        return self.mend is not None and bool(self.mend.units or self.mend.columns or self.mend.coordinates)

    def __str__(self) -> str:
        if not self.option:
            return f"{self.what}; {self.expected}"
        return f"{self.what}; {'fill in and add' if FILL_IN in self.option else 'add'} {self.option}"


def refuse_contradictions(findings: Iterable[Finding], otherwise: str = "--as-given") -> None:
    """Raise one `InputError` for all that contradicts how the data are read, with what mends it."""
    stops = [finding for finding in findings if finding.stops]
    if stops:
        what = "; ".join(dict.fromkeys(finding.what for finding in stops))
        raise InputError(f"{replace(stops[0], what=what)}; {otherwise} reads it as it is")
