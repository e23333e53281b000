"""The tracks as others see them: boxes in the world, nodes for edge rules, places for traffic to learn from, reports.

Nothing here changes a track. Of n tracks, `columns` and `box` have a row each; kinematics are local, from `origin` (2,)
in the world; `rows` (k,) choose some.
"""

from __future__ import annotations

import numpy as np

from saga_fg.model.interactions import NodeTable
from saga_fg.model.node import NodeType
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.tracking.box_filter import BoxFilter
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.existence import reported_score
from saga_fg.tracking.joint_state import Kinematics
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.told_covariance import told_covariance
from saga_fg.tracking.traffic_flow import Passages
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame
from saga_fg.types.track import Tracks


def local_origin(frame: Frame) -> FloatArray:
    """The local origin of a scene, (2,): where the vehicle, else the first detection, is first.

    Global coordinates reach 4e6 m and would eat the digits.
    """
    if frame.world_T_ego is not None:
        return np.round(frame.world_T_ego[:2, 3])
    if frame.ego is not None and frame.ego.gps is not None:
        return np.round(frame.ego.gps.position[:2])
    if len(frame) and frame.coordinates == "world":
        return np.round(frame.detections.boxes.position[0, :2])
    return np.zeros(2)


def speed_deviation(now: Kinematics) -> FloatArray:
    """(n,) standard deviation of the velocity in a mean direction, m/s."""
    P = now.P_velocity
    return np.asarray(np.sqrt((P[:, 0, 0] + P[:, 1, 1]) / 2))


def boxes_of(
    columns: TrackColumns, box: BoxFilter, rows: IntArray, position: FloatArray, velocity: FloatArray
) -> Boxes:
    """Tracks `rows` at positions (k, 2), world, with velocities (k, 2)."""
    centre = np.concatenate([position, box.z[rows, None]], axis=1)
    return Boxes(columns.label[rows], centre, box.size[rows], box.yaw[rows], velocity)


def nodes_of(
    columns: TrackColumns, box: BoxFilter, types: tuple[NodeType, ...], told: Kinematics, time: float
) -> NodeTable:
    """All tracks as edge rules see them at `time`, s; the course stands in for a heading that is not known."""
    velocity, P = told.velocity, told.P_velocity
    return NodeTable(
        columns.id,
        columns.label,
        types,
        told.position,
        velocity,
        np.where(np.isfinite(box.yaw), box.yaw, np.arctan2(velocity[:, 1], velocity[:, 0])),
        np.where(np.isfinite(box.size[:, 0]), box.size[:, 0], 0.0),
        (P[:, 0, 0] + P[:, 1, 1]) / 2,
        columns.has_moved.copy(),
        unseen=columns.coasting(time),
    )


def passages_of(
    columns: TrackColumns,
    box: BoxFilter,
    rows: IntArray,
    now: Kinematics,
    standing: FloatArray,
    origin: FloatArray,
    time: float,
) -> Passages:
    """Where tracks `rows` pass at a time, s; standing (n,) the belief that they stand."""
    yaw = box.yaw[rows]
    ahead = np.nan_to_num(np.stack([np.cos(yaw), np.sin(yaw)], axis=-1))
    return Passages(
        columns.id[rows],
        columns.label[rows],
        now.position[rows] + origin,
        yaw,
        np.einsum("ni,ni->n", ahead, now.velocity[rows]),
        np.einsum("ni,nij,nj->n", ahead, now.P_velocity[rows], ahead),
        standing[rows],
        np.full(len(rows), time),
    )


def reported_tracks(
    timestamp: float,
    columns: TrackColumns,
    box: BoxFilter,
    told: Kinematics,
    origin: FloatArray,
    now: float,
    settings: TrackerSettings,
) -> Tracks:
    """The tracks that are believed and were seen of late, as of `timestamp`; `now`, s, is the state's time."""
    coasting = columns.coasting(now)
    shown = (
        (columns.accepted | (settings.unconfirmed_score_factor > 0))
        & (columns.confirmed | (columns.existence >= settings.existence.report_above))
        & (coasting <= settings.report_coasting)
        & columns.ready
    )
    rows = np.flatnonzero(shown)
    position, velocity, P, P_velocity = (column[rows] for column in told)
    boxes = boxes_of(columns, box, rows, position + origin, velocity)
    P = told_covariance(P, boxes.yaw, columns.told[rows], columns.shared[rows])
    score = reported_score(columns, coasting > 0, settings.existence)[rows]
    score = np.where(columns.accepted[rows], score, settings.unconfirmed_score_factor * score)
    return Tracks(timestamp, columns.id[rows], boxes, score, P, P_velocity, coasting[rows])
