"""The joint kinematic state of all tracks and nodes: an estimator, addressed by ids and class labels.

Positions are local, counted from the scene's origin.

Measurements that arrive late, as measurements of the present state, along the objects' own motion.

    x(t - delay) = exp(-A delay) (x(t) - w),   w ~ N(0, Q)
    z = H x(t - delay) + v = H exp(-A delay) x(t) + v',   v' ~ N(0, R + H exp(-A delay) Q exp(-A delay)^T H^T)

Source: Bar-Shalom, Update with out-of-sequence measurements in tracking, IEEE Transactions on Aerospace and Electronic
Systems 38(3), 2002; here without the correlation of w with the present estimate.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators import Estimator, Measurements
from saga_fg.graph import EGO_POSE, SceneFactorGraph, key_of
from saga_fg.model import POSITION, VELOCITY, Mixture, ModeTable, Motion, NodeType, SceneGraph, discretise, own_motion
from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray, distinct, shallow_copy, yaw_transform
from saga_fg.providers import RelativeDetections
from saga_fg.tracking.identities import exchanged
from saga_fg.tracking.track_filters import Kinematics, RelativePositions
from saga_fg.types import Frame


def moved_to_present(node_type: NodeType, H: FloatArray, R: FloatArray, delay: float) -> tuple[FloatArray, FloatArray]:
    """H (..., m, d) and R (..., m, m) of a measurement `delay` s old, as one of the present state."""
    F, Q = own_motion(node_type, delay)
    H_past = H @ np.linalg.inv(F)
    return H_past, R + H_past @ Q @ np.swapaxes(H_past, -1, -2)


def past_position(node_type: NodeType, delay: float) -> FloatArray:
    """(2, d) matrix that takes the present state to the position `delay` s ago."""
    H = node_type.selector(POSITION)
    return H @ np.linalg.inv(own_motion(node_type, delay)[0]) if delay > 0 else H


_UNKNOWN_POSITION = 1e5  # standard deviation, m


class JointTrackState:
    """Tracks by id and label over one estimator. `motion` gives the own motion of a class."""

    def __init__(self, estimator: Estimator, motion: Callable[[str], Motion]) -> None:
        self.estimator = estimator
        self._motion = motion
        self._types: dict[Motion, NodeType] = {}  # classes that move alike share one
        self._type_of: dict[str, NodeType] = {}
        self._kinds: dict[tuple[tuple[str, ...], bool], tuple[list[NodeType], IntArray]] = {}
        self._initiated: dict[int, float] = {}  # on the estimator's clock
        self._modes: dict[Mixture, ModeTable] = {}  # of tracks that move by a mixture
        self._kinematics: Kinematics | None = None  # until the state changes

    def type_of(self, label: str) -> NodeType:
        """The node type of a class."""
        found = self._type_of.get(label)
        if found is None:
            motion = self._motion(label)
            found = self._types.setdefault(motion, NodeType(type(motion).__name__, motion))
            self._type_of[label] = found
        return found

    def types_of(self, label: StrArray) -> tuple[NodeType, ...]:
        """The node type of each row (n,)."""
        classes, index = distinct(label)
        types = [self.type_of(c) for c in classes]
        return tuple([types[k] for k in index.tolist()])

    def add(
        self,
        ids: IntArray,
        label: StrArray,
        now: Kinematics,
        delay: float = 0.0,
        relative: RelativePositions | None = None,
        appended: bool = False,
    ) -> None:
        """Add tracks as they were `delay` s ago; components that `now` does not have start at 0.

        `relative` positions, seen from the vehicle, stand in for those of `now`. If `appended`, the rows come after
        those of the last call of `kinematics`, whose estimates stay as they are.
        """
        before = self._kinematics if appended and relative is None else None
        if relative is not None:
            now = now._replace(P=np.tile(_UNKNOWN_POSITION**2 * np.eye(2), (len(ids), 1, 1)))
        for node_type, rows in self.rows_by_type(label, delay > 0):
            mean = np.zeros((len(rows), node_type.dim))
            P = np.zeros((len(rows), node_type.dim, node_type.dim))
            P.reshape(len(rows), -1)[:, :: node_type.dim + 1] = node_type.initial_deviation**2
            at_p = node_type.index(POSITION)
            mean[:, at_p], P[:, at_p[:, None], at_p] = now.position[rows], now.P[rows]
            if node_type.has(VELOCITY):
                at_v = node_type.index(VELOCITY)
                mean[:, at_v], P[:, at_v[:, None], at_v] = now.velocity[rows], now.P_velocity[rows]
            if delay > 0:
                F, Q = own_motion(node_type, delay)
                mean, P = mean @ F.T, F @ P @ F.T + Q
            if isinstance(node_type.motion, Mixture):
                new, old = ModeTable.new(node_type.motion, ids[rows], mean, P), self._modes.get(node_type.motion)
                self._modes[node_type.motion] = new if old is None else old.append(new)
            labels = dict(zip(ids[rows].tolist(), label[rows].tolist(), strict=True))
            self._estimator_to_change().add_unchecked(ids[rows], mean, P, labels)
        self._initiated.update(dict.fromkeys(ids.tolist(), self.estimator.time))
        if relative is not None:
            self._add_relative(ids, label, relative)
        if before is not None:
            as_given = delay == 0 and (self.places(label) >= 0).all()
            self._kinematics = before.append(now if as_given else self.kinematics_of(ids, label))

    def remove(self, ids: IntArray, kept: IntArray | None = None) -> None:
        """Marginalise tracks; their information on their neighbours stays, and so do the estimates of all others.

        kept: rows of the other tracks where `ids` are some of those of the last call of `kinematics`
        """
        before = self._kinematics
        self._estimator_to_change().marginalise(ids)
        if kept is not None and before is not None and len(before.P) == len(kept) + len(ids):
            self._kinematics = before.select(kept)
        self._modes = {k: t.select(np.flatnonzero(~np.isin(t.ids, ids))) for k, t in self._modes.items()}
        for track in ids.tolist():
            del self._initiated[track]

    def reclassify(self, ids: IntArray, label: StrArray, new: StrArray, speed: FloatArray) -> None:
        """Give tracks (k,) of classes `label` new ones. Those that move by another kind of motion keep what they have
        in common with it, position and velocity, and lose their correlation with others.

        speed (k,): standard deviation of a velocity that they did not have, m/s
        """
        pairs = zip(label.tolist(), new.tolist(), strict=True)
        apart = np.flatnonzero([len(self._kinds_of(pair, False)[0]) > 1 for pair in pairs])
        if len(apart):
            now, fixed = self.kinematics_of(ids[apart], label[apart]), self.places(label[apart])[:, 2] < 0
            unknown = speed[apart, None, None] ** 2 * np.eye(2)
            now = now._replace(P_velocity=np.where(fixed[:, None, None], unknown, now.P_velocity))
            self.remove(ids[apart])
            self.add(ids[apart], new[apart], now)

    def exchange(self, ids: IntArray, label: StrArray) -> None:
        """Give each of two tracks, ids (2,) of classes `label` (2,), the state and the modes of the other.

        They take each other's class, are to a smoother as initiated now, and lose their correlation with others.
        """
        (a, b), estimator, modes = ids.tolist(), self.estimator, self._modes
        states = [(estimator.mean(ids[k : k + 1]), estimator.covariance(ids[k : k + 1])) for k in range(2)]
        self.remove(ids)
        for k, (mean, P) in enumerate(states):
            to = ids[1 - k : 2 - k]
            self._estimator_to_change().add_unchecked(to, mean, P, {int(to[0]): str(label[k])})
        self._modes = {k: replace(table, ids=exchanged(table.ids, a, b)) for k, table in modes.items()}
        self._initiated.update(dict.fromkeys((a, b), self.estimator.time))

    def predict(self, graph: SceneGraph, dt: float) -> None:
        """Move all tracks by `dt` s under the graph's dynamics."""
        estimator = self._estimator_to_change()
        if not self._modes:
            estimator.predict(discretise(graph, dt))
            return
        self._anchor_modes()
        graph = replace(graph, motions=graph.motions + tuple(self._modes.values()))
        estimator.predict(discretise(graph, dt))
        scale = [graph.diffusion_scale[graph.rows(table.ids)] for table in self._modes.values()]
        later = [t.predicted(dt, s)[0] for t, s in zip(self._modes.values(), scale, strict=True)]
        self._modes = dict(zip(self._modes, later, strict=True))
        self._anchor_modes()

    def update(
        self,
        ids: IntArray,
        label: StrArray,
        z: FloatArray,
        R: FloatArray,
        with_velocity: BoolArray,
        delay: float,
        relative: RelativePositions | None = None,
    ) -> None:
        """Take in one measurement each of some tracks, made `delay` s ago; positions by `relative`, where it is given.

        z (k, 4) position and velocity, R (k, 4, 4); velocities are used `with_velocity` (k,). A smoother puts a late
        measurement at its time; a filter, or a track initiated since, moves it to the present along own motion.
        """
        if relative is not None:
            self._add_relative(ids, label, relative)
        kinds: list[Measurements] = []
        for node_type, of_type in self.rows_by_type(label, delay > 0):
            measured = with_velocity[of_type] & node_type.has(VELOCITY)
            for velocity in (True, False):
                rows = of_type[measured == velocity]
                names = (POSITION if relative is None else ()) + (VELOCITY if velocity else ())
                if len(rows) == 0 or not names:
                    continue
                k = slice(0 if relative is None else 2, 4 if velocity else 2)
                H = np.broadcast_to(node_type.selector(names), (len(rows), len(names), node_type.dim))
                kinds.append(self._at_present(node_type, ids[rows], z[rows, k], H, R[rows, k, k], delay))
        self._take_in(kinds)

    def _add_relative(self, ids: IntArray, label: StrArray, relative: RelativePositions) -> None:
        estimator = self._estimator_to_change()
        for node_type, rows in self.rows_by_type(label):
            x, y = node_type.index(POSITION).tolist()
            estimator.extend([RelativeDetections(ids[rows], relative.z[rows], relative.R[rows], node_type.dim, (x, y))])

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        """Set the frame that providers see from now on; positions are from `origin` (2,)."""
        if self.estimator.providers:
            self._estimator_to_change().set_frame(frame, origin)

    def ask_providers(self) -> None:
        """Let factor providers add their factors."""
        if self.estimator.providers:
            self._estimator_to_change().ask_providers()

    @property
    def empty(self) -> bool:
        """True without any track or other variable."""
        return len(self.estimator.nodes) + len(self.estimator.others) == 0

    def pose(self) -> FloatArray | None:
        """The vehicle's pose (4, 4) in the running graph, local; None where there is none."""
        return _local_pose(self.estimator.auxiliary)

    def kinematics(self, ids: IntArray, label: StrArray) -> Kinematics:
        """The estimates of all tracks; `ids` must be in the order of the last call until the state changes."""
        if self._kinematics is None or len(self._kinematics.P) != len(ids):
            self._kinematics = self.kinematics_of(ids, label)
        return self._kinematics

    def kinematics_of(self, ids: IntArray, label: StrArray) -> Kinematics:
        """The estimates of some nodes, which need not be tracks."""
        x, P = self.estimator.planar_marginals(ids, self.places(label))
        return Kinematics(x[:, :2], x[:, 2:], P[:, :2, :2], P[:, 2:, 2:])

    def settled(self, ids: IntArray) -> BoolArray:
        """(k,) tracks for which the solver has found the minimum of the graph; all where it is linear."""
        unsettled = self.estimator.unsettled
        return ~np.isin(ids, unsettled) if len(unsettled) else np.ones(len(ids), dtype=bool)

    def check_nodes(self, ids: IntArray, label: StrArray) -> None:
        """Raise `InputError` unless there are nodes of these ids, of the sizes of these classes."""
        layout = self.estimator.posterior().layout
        expected = [node_type.dim for node_type in self.types_of(label)]
        if layout.dims[layout.rows(ids)].tolist() != expected:
            raise InputError(f"state: expected nodes of the sizes {expected} for the classes {label.tolist()}")

    def places(self, label: StrArray) -> IntArray:
        """(n, 4) where x, y, vx, vy are in the state of each track, -1 for none."""
        classes, index = distinct(label)
        return np.array([self.type_of(c).planar for c in classes], dtype=np.int64).reshape(-1, 4)[index]

    def position_covariance(self, ids: IntArray, label: StrArray) -> FloatArray:
        """(2n, 2n) joint covariance of the positions of n tracks, track by track."""
        types = self.types_of(label)
        start = np.cumsum([0, *(node_type.dim for node_type in types)])
        at = [offset + node_type.index(POSITION) for offset, node_type in zip(start[:-1], types, strict=True)]
        places = np.concatenate([np.empty(0, dtype=np.int64), *at])
        return np.asarray(self.estimator.joint_covariance(ids)[np.ix_(places, places)])

    def snapshot(self) -> Any:
        """The state as a value."""
        return self.estimator.snapshot(), dict(self._initiated), dict(self._modes)

    def restore(self, snapshot: Any) -> None:
        """Continue from a snapshot."""
        state, self._initiated, self._modes = snapshot
        self._estimator_to_change().restore(state)

    @property
    def window(self) -> float:
        """Age up to which a late measurement is put at its own time, s; 0 where it is moved to the present."""
        return self.estimator.lag

    def copied(self, taking_over: bool = False) -> JointTrackState:
        """Return a state that changes independently of this one.

        taking_over: it goes on with the solver that this one has, and this one is rarely needed again
        """
        twin = shallow_copy(self)
        twin.estimator = self.estimator.handed_over() if taking_over else copy.copy(self.estimator)
        twin._initiated, twin._modes = dict(self._initiated), dict(self._modes)
        return twin

    def measure(
        self, node_type: NodeType, ids: IntArray, z: FloatArray, H: FloatArray, R: FloatArray, delay: float
    ) -> None:
        """Take in linear measurements of tracks of one type: z (k, m), H (k, m, d), R (k, m, m), `delay` s old.

        Not checked: detections and the settings of sensors are, when they are made.
        """
        self._take_in([self._at_present(node_type, ids, z, H, R, delay)])

    def _at_present(
        self, node_type: NodeType, ids: IntArray, z: FloatArray, H: FloatArray, R: FloatArray, delay: float
    ) -> Measurements:
        """Measurements as of now; those that a smoother puts at their own time are taken in and left out."""
        estimator = self._estimator_to_change()
        if isinstance(node_type.motion, Mixture) and delay == 0 and len(ids):
            self._modes[node_type.motion], z, H = self._modes[node_type.motion].updated(ids, z, H, R)
            R = np.broadcast_to(np.eye(node_type.dim), H.shape)
        if delay > 0 and estimator.lag > 0:
            then = estimator.time - delay
            known = [self._initiated[track] <= then for track in ids.tolist()]
            there = np.array(known, dtype=np.bool_) & estimator.remembered(ids, then)
            if there.any():
                estimator.update(Measurements.unchecked(ids[there], z[there], H[there], R[there]), time=then)
            ids, z, H, R = ids[~there], z[~there], H[~there], R[~there]
        if delay > 0:
            H, R = moved_to_present(node_type, H, R, delay)
        return Measurements.unchecked(ids, z, H, R)

    def _take_in(self, kinds: Sequence[Measurements]) -> None:
        """Correct the estimator, once if it takes several kinds together."""
        self._estimator_to_change().update(kinds)

    def _anchor_modes(self) -> None:
        estimator = self.estimator
        for mixture, table in self._modes.items():
            marginals = estimator.mean(table.ids), estimator.covariance(table.ids)
            self._modes[mixture] = table.anchored(*marginals) if len(table) else table

    def _estimator_to_change(self) -> Estimator:
        self._kinematics = None
        return self.estimator

    def rows_by_type(self, label: StrArray, moving: bool = False) -> list[tuple[NodeType, IntArray]]:
        """Rows whose states have the same components, with a type of theirs; if `moving`, the same motion too.

        Nonlinear motions and mixtures are always separate.
        """
        classes, index = distinct(label)
        types, kind = self._kinds.get((classes, moving)) or self._kinds_of(classes, moving)
        if len(types) == 1:
            return [(types[0], np.arange(len(label)))]
        of_row = kind[index]
        return [(node_type, (of_row == k).nonzero()[0]) for k, node_type in enumerate(types)]

    def _kinds_of(self, classes: tuple[str, ...], moving: bool) -> tuple[list[NodeType], IntArray]:
        """A type of each kind that `rows_by_type` distinguishes, and the kind (k,) of each class."""
        types = [self.type_of(c) for c in classes]
        number: dict[object, int] = {}
        apart = [moving or t.flow is not None or isinstance(t.motion, Mixture) for t in types]
        names = [id(t) if own else t.components for own, t in zip(apart, types, strict=True)]
        kind = [number.setdefault(name, len(number)) for name in names]
        found = [types[kind.index(k)] for k in range(len(number))], np.array(kind, dtype=np.int64)
        self._kinds[classes, moving] = found
        return found


def _local_pose(graph: SceneFactorGraph) -> FloatArray | None:
    """The vehicle's present pose (4, 4), counted from the graph's origin; None where no provider has added one."""
    key = key_of(EGO_POSE, 0, graph.epoch) if graph.epoch >= 0 else -1
    if key not in graph.variables:
        return None
    pose = graph.state(key)
    return pose.matrix() if isinstance(pose, gtsam.Pose3) else yaw_transform(pose.x(), pose.y(), 0.0, pose.theta())
