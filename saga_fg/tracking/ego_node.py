"""The vehicle as a node of the scene graph: it leads and follows like any other, and is never reported.

It has the id 0 and a state of its own, (position, velocity) by the motion of its class. Its position is measured by
every frame with a pose: the pose that comes with the frame, or the one estimated in the running graph, to which the
node is then tied. By the edge rules drivers behind it follow it, also while they are hidden.

A detection seen from an estimated pose (R, t) measures r = R^T (p - t) - z of the pose and the object's position p. The
errors of both depend on earlier detections, so that a detection is compared with the covariance of r, not of p.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factors import relative_detection_factors
from saga_fg.errors import InputError
from saga_fg.graph import EGO_POSE, key_of
from saga_fg.model.interactions import POSITION, NodeTable
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import yaw_of
from saga_fg.tracking.box_filter import MOVING
from saga_fg.tracking.joint_state import JointTrackState
from saga_fg.tracking.kinematics import Kinematics, RelativePositions
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.settings import ClassSettings, EgoNodeSettings, TrackerSettings
from saga_fg.types.by_class import class_settings
from saga_fg.types.frame import Frame

EGO_ID = 0  # tracks begin at 1, nodes of the map count down from -1
_ID = np.array([EGO_ID])


@dataclass(eq=False)
class EgoNode:
    """settings: None if there is no such node; motion: of its class; yaw, rad; time of its latest position, s."""

    settings: EgoNodeSettings | None
    motion: ClassSettings
    present: bool = False
    yaw: float = 0.0
    time: float = -np.inf
    has_moved: bool = False

    @classmethod
    def of(cls, settings: TrackerSettings) -> EgoNode:
        """A node without a position."""
        label = "" if settings.ego is None else settings.ego.label
        return cls(settings.ego, class_settings(settings.classes, ClassSettings, label))

    def __len__(self) -> int:
        return int(self.present)

    @property
    def _estimated(self) -> bool:
        return self.settings is not None and self.settings.estimated

    def located(self, frame: Frame, world_T_ego: FloatArray | None) -> Frame:
        """Return the frame, with the pose of the running graph where that is estimated."""
        if not self._estimated:
            return frame
        if world_T_ego is None:
            raise InputError("ego.estimated: expected a provider that adds the vehicle's pose (saga_fg.providers)")
        return replace(frame, world_T_ego=world_T_ego)

    def relative_positions(self, measurements: FrameMeasurements, frame: Frame) -> RelativePositions | None:
        """Measurements in the frame of a vehicle whose pose is estimated; None for measurements in the world."""
        if not self._estimated or frame.coordinates == "world" or frame.world_T_ego is None:
            return None
        return RelativePositions.of(frame.world_T_ego, measurements.boxes.position, measurements.R[:, :2, :2])

    def update(self, frame: Frame, time: float, origin: FloatArray, joint: JointTrackState) -> None:
        """Take in the vehicle's position at a frame of `time`, s; `origin` (2,) of local positions."""
        if self.settings is None or frame.world_T_ego is None or time <= self.time:
            return
        pose, R, label = frame.world_T_ego, np.zeros((1, 4, 4)), np.array([self.settings.label])
        R[0, :2, :2] = self.settings.deviation**2 * np.eye(2)
        z = np.concatenate([pose[:2, 3] - origin, np.zeros(2)])[None]
        relative = RelativePositions(np.zeros((1, 3)), R[:, :2, :2]) if self.settings.estimated else None
        if self.present:
            joint.update(_ID, label, z, R, np.zeros(1, dtype=bool), 0.0, relative)
        else:
            speed = self.motion.initial_speed_deviation**2 * np.eye(2)[None]
            joint.add(_ID, label, Kinematics(z[:, :2], z[:, 2:], R[:, :2, :2], speed), relative=relative)
        velocity = joint.kinematics_of(_ID, label).velocity[0]
        self.present, self.time, self.yaw = True, time, float(yaw_of(pose[:3, :3]))
        self.has_moved = self.has_moved or bool(np.hypot(*velocity) > MOVING)

    def appended_to(self, tracks: NodeTable, joint: JointTrackState) -> NodeTable:
        """Return the node table of the tracks with the vehicle after them."""
        if self.settings is None or not self.present:
            return tracks
        label = np.array([self.settings.label])
        now, moved, unseen = joint.kinematics_of(_ID, label), tracks.has_moved, tracks.unseen
        existence = tracks.existence
        return NodeTable(
            np.concatenate([tracks.id, _ID]),
            np.concatenate([tracks.label, label]),
            tracks.types + joint.types_of(label),
            np.concatenate([tracks.position, now.position]),
            np.concatenate([tracks.velocity, now.velocity]),
            np.append(tracks.heading, self.yaw),
            np.append(tracks.length, self.settings.length),
            np.append(tracks.velocity_variance, np.trace(now.P_velocity[0]) / 2),
            None if moved is None else np.append(moved, self.has_moved),
            unseen=None if unseen is None else np.append(unseen, 0.0),
            existence=None if existence is None else np.append(existence, 1.0),
            paths=tracks.paths,
        )


def relative_covariances(joint: JointTrackState, ids: IntArray, label: StrArray) -> FloatArray:
    """Covariances (n, 2, 2) of positions relative to the vehicle's estimated pose, in the axes of the world."""
    estimator = joint.estimator
    key = key_of(EGO_POSE, 0, estimator.auxiliary.epoch)
    pose = estimator.auxiliary.state(key)
    T, d, result = pose.matrix(), pose.dim(), np.zeros((len(ids), 2, 2))
    n, turn = len(T) - 1, T[:2, :2]
    for node_type, rows in joint.rows_by_type(label):
        x, y = node_type.index(POSITION).tolist()
        states, poses = estimator.mean(ids[rows]), np.broadcast_to(T, (len(rows), *T.shape))
        places = np.tile(T[:n, n], (len(rows), 1))
        places[:, :2] = states[:, [x, y]]
        keys = np.stack([np.zeros(len(rows)), np.arange(1, len(rows) + 1)], axis=1).astype(np.uint64)
        seen = relative_detection_factors(keys, (places - T[:n, n]) @ T[:n, :n], np.eye(2), node_type.dim, (x, y))
        assert seen.jacobians is not None
        J_pose, J_state = (np.asarray(J) for J in seen.jacobians(poses, states))
        G = turn @ np.concatenate([J_pose, J_state], axis=2)
        P = estimator.covariance_with([key], ids[rows])
        for k, row in enumerate(rows.tolist()):
            mine = np.r_[0:d, d + k * node_type.dim : d + (k + 1) * node_type.dim]
            result[row] = G[k] @ P[np.ix_(mine, mine)] @ G[k].T
    return result
