"""All evidence of a recording as one table, and its association with objects over the whole time.

Data association over a whole recording: detections to objects, frame by frame, and tracklets to objects.

Detections are assigned at least total cost to given states, online or smoothed, by the squared distance

    d^2 = (z - m)^T (P + R)^-1 (z - m)

A tracker has no track yet where an object first shows itself by weak detections, and none any more after an occlusion.
A smoother reaches there from the object's later and earlier states: free detections are assigned to the objects that
have none in that frame.

Tracklets are stitched: an end i and a later beginning j, extended towards each other by the smoother, meet at the
moment j begins with the difference d of their states. That they are one object rather than that i left unseen and j is
new costs

    1/2 d^T S^-1 d + 1/2 log |2 pi S| + miss_cost * frames + log(new_object_density) - 1/2 log |2 pi V|,   S = P_i + P_j

nats, with V the covariance of the velocity of a new object and `frames` the frames in the gap that should have shown
it; pairs are stitched where that is negative in total. Objects are chains of tracklets that do not overlap, so that the
cheapest set of chains is a bipartite assignment (minimum-cost path cover; Zhang, Li and Nevatia, CVPR 2008, with the
tracklet in place of the detection). Only pairs within the gate are candidates, found by distance, moment by moment.

Everything that sensors measured in a recording, as one table, and the score of an object by its evidence.

A recording has moments t_0 < t_1 < ...: the times of all its frames and all times at which boxes are wanted. A row of
the table is a usable detection (see `saga_fg.tracking.measurements`), with the sensor's model of its noise; a frame,
empty or not, is an opportunity to detect what is in its field of view.

    score = sum_k p_k / (opportunities + prior)

p_k the probabilities of an object's detections, opportunities the frames that had it in view during its life: the
posterior mean of its hit ratio, with the detector's probabilities in place of yes and no, from a Beta prior that counts
as `prior` opportunities without a detection. A lone detection scores low, however probable, and a long track scores its
mean.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from saga_fg.model import Sensor, sensor_model
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    StrArray,
    gate,
    least_total,
    mahalanobis_of_pairs,
    near_pairs,
)
from saga_fg.smoothing.states import Lifespans, StateTable, lifespans_of
from saga_fg.tracking import ClassSettings, ConfusedClasses, frame_measurements
from saga_fg.types import Boxes, Frame


@dataclass(frozen=True, eq=False)
class EvidenceFrame:
    """A frame: its moment, the sensor's model, and the pose of the vehicle, (4, 4) or None."""

    moment: int
    sensor: Sensor
    world_T_ego: FloatArray | None


@dataclass(frozen=True, eq=False)
class Evidence:
    """N usable detections of a recording, in order of time, positions from a local `origin`.

    times        (K,) s, of all moments
    frames       L frames in order of time
    origin       (2,) world coordinates of the local origin
    frame        (N,) which frame
    boxes                     positions local in the plane
    probability  (N,)
    R            (N, 4, 4)    of position and velocity
    with_velocity (N,)        whether the velocity was measured
    z_noise, yaw_noise (N,)   standard deviations, m and rad
    distance     (N,)         from the vehicle, m; NaN where its place is unknown
    confused     classes that the sensors confuse; class_likelihood (N, C) of each detection in them
    corrected    (N,)         of boxes that a person gave: weight of their sizes, in detections; else 0
    """

    times: FloatArray
    frames: tuple[EvidenceFrame, ...]
    origin: FloatArray
    frame: IntArray
    boxes: Boxes
    probability: FloatArray
    R: FloatArray
    with_velocity: BoolArray
    z_noise: FloatArray
    yaw_noise: FloatArray
    distance: FloatArray
    confused: ConfusedClasses
    class_likelihood: FloatArray
    corrected: FloatArray

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def moment(self) -> IntArray:
        """(N,) the moment of each detection."""
        moments = np.array([frame.moment for frame in self.frames], dtype=np.int64)
        return moments[self.frame] if len(self) else np.empty(0, dtype=np.int64)

    def lifespans(self, object_of: IntArray) -> Lifespans:
        """The lifespans of all objects, with the likeliest class of each by all of its detections.

        object_of (N,): the object of each detection, negative for none
        """
        found, rows, confused = lifespans_of(object_of, self.boxes.label, self.moment), object_of >= 0, self.confused
        if not len(confused):
            return found
        belief = np.tile(confused.log_prior, (len(found), 1))
        with np.errstate(divide="ignore"):
            np.add.at(belief, found.rows_of(object_of[rows]), np.log(self.class_likelihood[rows]))
        return replace(found, label=confused.labels(belief, found.label))

    def rows_of_frame(self) -> list[slice]:
        """The rows of each frame."""
        bounds = np.searchsorted(self.frame, np.arange(len(self.frames) + 1)).tolist()
        return [slice(a, b) for a, b in pairwise(bounds)]


def gather_evidence(
    frames: Sequence[Frame],
    wanted: FloatArray,
    sensors: Mapping[str, Sensor],
    classes: Mapping[str, ClassSettings],
) -> Evidence:
    """Build the table of a recording's frames, in order of measurement.

    wanted (M,): times at which boxes are wanted, s
    """
    ordered = measured_in_order(frames, sensors)
    stamps = np.array([time for time, _ in ordered])
    times = np.unique(np.concatenate([wanted, stamps]))
    origin = _origin(frames)
    confused = ConfusedClasses.of(sensors, classes)
    taken, parts = [], []
    for time, frame in ordered:
        sensor = sensor_model(sensors, frame.sensor)
        taken.append(EvidenceFrame(int(np.searchsorted(times, time)), sensor, frame.world_T_ego))
        parts.append(frame_measurements(frame, sensor, classes, confused))
    boxes = Boxes.concatenate([part.boxes for part in parts])
    poses = [part.world_T_ego for part in parts]
    places = [np.full(2, np.nan) if pose is None else pose[:2, 3] for pose in poses]
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])

    def column(name: str, *shape: int, dtype: type = float) -> Any:
        return np.concatenate([np.empty((0, *shape), dtype), *(getattr(part, name) for part in parts)])

    return Evidence(
        times=times,
        frames=tuple(taken),
        origin=origin,
        frame=number,
        boxes=replace(boxes, position=boxes.position - [*origin, 0.0]),
        probability=column("probability"),
        R=column("R", 4, 4),
        with_velocity=column("with_velocity", dtype=bool),
        z_noise=column("z_noise"),
        yaw_noise=column("yaw_noise"),
        distance=np.hypot(*(boxes.position[:, :2] - np.reshape(places, (-1, 2))[number]).T),
        confused=confused,
        class_likelihood=column("class_likelihood", len(confused)),
        corrected=np.zeros(len(boxes)),
    )


def measured_in_order(frames: Sequence[Frame], sensors: Mapping[str, Sensor]) -> list[tuple[float, Frame]]:
    """Sort frames by their times of measurement (s), which are returned with them: offline, no frame is late."""
    timed = [(sensor_model(sensors, frame.sensor).measured_at(frame), frame) for frame in frames]
    return sorted(timed, key=lambda pair: pair[0])


def _origin(frames: Sequence[Frame]) -> FloatArray:
    """(2,) a place near the detections, in whole metres: world coordinates leave too few digits."""
    for frame in frames:
        if frame.world_T_ego is not None:
            return np.asarray(np.round(frame.world_T_ego[:2, 3]))
        if len(frame):
            return np.asarray(np.round(frame.detections.boxes.position[0, :2]))
    return np.zeros(2)


def evidence_scores(
    evidence: Evidence, object_of: IntArray, lifespans: Lifespans, states: StateTable, prior_opportunity_time: float
) -> FloatArray:
    """(n,) scores in [0, 1). prior_opportunity_time: of missed opportunities that every object starts with, s."""
    rows = np.flatnonzero(object_of >= 0)
    owner = lifespans.rows_of(object_of[rows])
    total = np.bincount(owner, evidence.probability[rows], minlength=len(lifespans))
    seen = np.bincount(owner, minlength=len(lifespans))
    count = np.maximum(opportunities(evidence, lifespans, states), seen)
    return np.asarray(total / (count + prior_opportunity_time * frame_rate(evidence)))


def opportunities(evidence: Evidence, lifespans: Lifespans, states: StateTable) -> IntArray:
    """(n,) number of frames with each object in their field of view."""
    count = np.zeros(len(lifespans), dtype=np.int64)
    for frame in evidence.frames:
        rows = states.at(frame.moment)
        position = states.mean[rows, :2] + evidence.origin
        count[lifespans.rows_of(states.id[rows])] += frame.sensor.sees(position, frame.world_T_ego)
    return count


def frame_rate(evidence: Evidence) -> float:
    """Frames per second, of all sensors."""
    moments = [frame.moment for frame in evidence.frames]
    if len(set(moments)) < 2:
        return 1.0
    return (len(moments) - 1) / float(evidence.times[moments[-1]] - evidence.times[moments[0]])


NEW_OBJECT_DENSITY = 0.005  # density of objects that appear anew, 1/m^2
MISS_COST = 0.3  # cost of a frame in the gap that should have shown the object, nats
GATE = 0.999  # share of true links inside the chi-square gate


def assign_detections(
    label: StrArray,
    position: FloatArray,
    covariance: FloatArray,
    evidence: Evidence,
    rows: IntArray,
    share: float,
    max_distance: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Rows of objects and of the evidence that belong together at one moment.

    label (n,), position (n, 2), covariance (n, 2, 2), max_distance (n,) of objects; rows (m,) of the evidence; share:
    of true pairs that the chi-square gate lets through
    """
    objects, detections = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    group, reported = evidence.confused.numbers(label, evidence.boxes.label[rows])
    for number in np.intersect1d(group, reported):
        a, b = np.flatnonzero(group == number), rows[reported == number]
        z = evidence.boxes.position[b, :2]
        row, column = near_pairs(position[a], z, max_distance[a])
        innovation = z[column] - position[a][row]
        d2, log_det = mahalanobis_of_pairs(innovation, covariance[a][row] + evidence.R[b, :2, :2][column])
        limit = gate(share)
        possible = (d2 < limit) & (np.hypot(*innovation.T) < max_distance[a][row])
        row, column, cost, log_det = row[possible], column[possible], (d2 + log_det)[possible], log_det[possible]
        chosen = least_total(row, column, cost - limit - log_det.max(initial=0.0))
        objects.append(a[row[chosen]])
        detections.append(b[column[chosen]])
    return np.concatenate(objects), np.concatenate(detections)


def assign_free_detections(
    evidence: Evidence,
    object_of: IntArray,
    lifespans: Lifespans,
    states: StateTable,
    share: float,
    max_distance: float,
) -> IntArray:
    """(N,) the object of each detection, once the free ones are assigned; none loses its object.

    share: of true pairs that the gate lets through; max_distance: between a state and a detection, m
    """
    result = object_of.copy()
    for frame, rows in zip(evidence.frames, evidence.rows_of_frame(), strict=True):
        free = rows.start + np.flatnonzero(result[rows] < 0)
        there = states.at(frame.moment)
        there = there.start + np.flatnonzero(~np.isin(states.id[there], result[rows]))
        if len(free) == 0 or len(there) == 0:
            continue
        ids, mean, P = states.id[there], states.mean[there, :2], states.covariance[there, :2, :2]
        label, reach = lifespans.label[lifespans.rows_of(ids)], np.full(len(ids), max_distance)
        objects, detections = assign_detections(label, mean, P, evidence, free, share, reach)
        result[detections] = ids[objects]
    return result


def stitch_tracklets(
    seen: Lifespans, states: StateTable, velocity_prior: FloatArray, evidence: Evidence, max_gap: float
) -> IntArray:
    """(n,) the object of each tracklet: the id of the first tracklet of its chain.

    seen: the tracklets, from first to last detection; states: theirs, reaching beyond both ends; velocity_prior
    (n, 2, 2): covariance of the velocity of a new object; max_gap: longest between two tracklets of an object, s
    """
    limit = gate(GATE, 4)
    (group,) = evidence.confused.numbers(seen.label)
    end, begin, a, b = _meetings(seen, group, states, evidence.times, max_gap, limit)
    d = states.mean[a] - states.mean[b]
    S = states.covariance[a] + states.covariance[b]
    d2 = np.einsum("ni,ni->n", d, np.linalg.solve(S, d[..., None])[..., 0])
    inside = d2 <= limit
    end, begin, d2, S = end[inside], begin[inside], d2[inside], S[inside]
    cost = (d2 + _log_det(S)) / 2 + MISS_COST * _opportunities_between(evidence, seen, states, end, begin)
    cost -= _log_det(velocity_prior[begin]) / 2 - np.log(NEW_OBJECT_DENSITY)
    stitched = least_total(end, begin, cost)
    before = np.arange(len(seen))
    before[begin[stitched]] = end[stitched]
    for row in np.argsort(seen.first, kind="stable"):  # predecessors come earlier, so that they are settled
        before[row] = before[before[row]]
    return np.asarray(seen.id[before])


def _meetings(
    seen: Lifespans, group: IntArray, states: StateTable, times: FloatArray, max_gap: float, limit: float
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Pairs of tracklets of one group (n,) of classes, one that ended at most `max_gap` s before the other begins, with
    states that may be inside the gate there: rows (p,) of both, and rows (p,) of their states at the later one's start.

    limit: of d^2, which is at least |d|^2 / tr S of the positions alone; the pairs are found by these
    """
    trace = np.trace(states.covariance[:, :2, :2], axis1=1, axis2=2)
    reach = np.sqrt(limit * trace) * (1 + 1e-9)  # |d| <= sqrt(limit (tr P_i + tr P_j)), which is at most their sum
    order = np.argsort(seen.first, kind="stable")
    moments, starts, counts = np.unique(seen.first[order], return_index=True, return_counts=True)
    found = [np.empty((4, 0), dtype=np.int64)]
    for moment, start, count in zip(moments.tolist(), starts.tolist(), counts.tolist(), strict=True):
        begin = order[start : start + count]
        there = states.at(moment)
        a = np.arange(there.start, there.stop)
        end = seen.rows_of(states.id[there])
        gap = times[moment] - times[seen.last[end]]
        ended = (gap > 0) & (gap <= max_gap)
        a, end = a[ended], end[ended]
        b = states.rows_of(np.full(len(begin), moment), seen.id[begin])
        begin, b = begin[b >= 0], b[b >= 0]
        i, j = near_pairs(states.mean[a, :2], states.mean[b, :2], reach[a], reach[b])
        alike = group[end[i]] == group[begin[j]]
        i, j = i[alike], j[alike]
        found.append(np.stack([end[i], begin[j], a[i], b[j]]))
    pairs = np.concatenate(found, axis=1)
    return pairs[0], pairs[1], pairs[2], pairs[3]


def _log_det(P: FloatArray) -> FloatArray:
    """log |2 pi P|"""
    return np.asarray(np.linalg.slogdet(2 * np.pi * P)[1])


def _opportunities_between(
    evidence: Evidence, seen: Lifespans, states: StateTable, end: IntArray, begin: IntArray
) -> FloatArray:
    """(p,) number of frames in the gap of each pair with the smoothed object in their field of view."""
    count = np.zeros(len(end))
    for frame in evidence.frames:
        within = np.flatnonzero((seen.last[end] < frame.moment) & (frame.moment < seen.first[begin]))
        at = states.rows_of(np.full(len(within), frame.moment), seen.id[end[within]])
        position = states.mean[np.maximum(at, 0), :2] + evidence.origin
        count[within] += frame.sensor.sees(position, frame.world_T_ego) & (at >= 0)
    return count
