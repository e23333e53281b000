"""The vehicle as a node of the scene graph: it leads and follows like any other, and is never reported.

It has the id 0 and a state of its own, (position, velocity) by the motion of its class. Its place is measured by every
frame that knows where it is: by the pose that comes with the frame, or that is estimated in the running graph, to
which the node is then tied. A driver behind it does what it does (the edge rules' following), hidden or not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model.interactions import NodeTable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_of
from saga_fg.tracking.box_filter import MOVING
from saga_fg.tracking.ego_pose import RelativePositions
from saga_fg.tracking.joint_state import JointTrackState, Kinematics
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.settings import ClassSettings, EgoNodeSettings, TrackerSettings
from saga_fg.types.by_class import class_settings
from saga_fg.types.frame import Frame

EGO_ID = 0  # tracks begin at 1, the road's nodes count down from -1
_ID = np.array([EGO_ID])


@dataclass(eq=False)
class EgoNode:
    """settings: None if there is no such node; motion: of its class; yaw, rad; time of its latest place, s."""

    settings: EgoNodeSettings | None
    motion: ClassSettings
    present: bool = False
    yaw: float = 0.0
    time: float = -np.inf
    has_moved: bool = False

    @classmethod
    def of(cls, settings: TrackerSettings) -> EgoNode:
        """A node that is nowhere yet."""
        label = "" if settings.ego is None else settings.ego.label
        return cls(settings.ego, class_settings(settings.classes, ClassSettings, label))

    def __len__(self) -> int:
        return int(self.present)

    @property
    def _estimated(self) -> bool:
        return self.settings is not None and self.settings.estimated

    def located(self, frame: Frame, world_T_ego: FloatArray | None) -> Frame:
        """The frame with the pose of the running graph, where that is estimated."""
        if not self._estimated:
            return frame
        if world_T_ego is None:
            raise InputError("ego.estimated: expected a provider that adds the vehicle's pose (saga_fg.providers)")
        return replace(frame, world_T_ego=world_T_ego)

    def sightings(self, frame: Frame, observed: Observed) -> RelativePositions | None:
        """What was observed, in the frame of the vehicle whose pose is estimated; None for what is not seen from it."""
        if not self._estimated or frame.coordinates == "world" or frame.world_T_ego is None:
            return None
        return RelativePositions.of(frame.world_T_ego, observed.boxes.position, observed.R[:, :2, :2])

    def place(self, frame: Frame, time: float, origin: FloatArray, state: JointTrackState) -> None:
        """Take in where a frame of `time`, s, has the vehicle; `origin` (2,) of local positions."""
        if self.settings is None or frame.world_T_ego is None or time <= self.time:
            return
        pose, R, label = frame.world_T_ego, np.zeros((1, 4, 4)), np.array([self.settings.label])
        R[0, :2, :2] = self.settings.deviation**2 * np.eye(2)
        z = np.concatenate([pose[:2, 3] - origin, np.zeros(2)])[None]
        seen = RelativePositions(np.zeros((1, 3)), R[:, :2, :2]) if self.settings.estimated else None
        if self.present:
            state.update(_ID, label, z, R, np.zeros(1, dtype=bool), 0.0, seen)
        else:
            speed = self.motion.initial_speed_deviation**2 * np.eye(2)[None]
            state.add(_ID, label, Kinematics(z[:, :2], z[:, 2:], R[:, :2, :2], speed), seen=seen)
        velocity = state.node(_ID, label).velocity[0]
        self.present, self.time, self.yaw = True, time, float(yaw_of(pose[:3, :3]))
        self.has_moved = self.has_moved or bool(np.hypot(*velocity) > MOVING)

    def beside(self, tracks: NodeTable, state: JointTrackState) -> NodeTable:
        """The table of the tracks with the vehicle after them."""
        if self.settings is None or not self.present:
            return tracks
        label = np.array([self.settings.label])
        now, moved, unseen = state.node(_ID, label), tracks.has_moved, tracks.unseen
        return NodeTable(
            np.concatenate([tracks.id, _ID]),
            np.concatenate([tracks.label, label]),
            tracks.types + state.types_of(label),
            np.concatenate([tracks.position, now.position]),
            np.concatenate([tracks.velocity, now.velocity]),
            np.append(tracks.heading, self.yaw),
            np.append(tracks.length, self.settings.length),
            np.append(tracks.velocity_variance, np.trace(now.P_velocity[0]) / 2),
            None if moved is None else np.append(moved, self.has_moved),
            unseen=None if unseen is None else np.append(unseen, 0.0),
        )
