"""Path of the vehicle and objects around it, from a whole recording at once.

Two discrete questions depend on the path that is sought: which detection belongs to which object, and which objects
stand. So they are answered along the odometry's path, the graph of all moments is solved, and the answers are given
anew along the path found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from factors import ERROR_DIM, SolverSettings, nonlinear_graph, solve
from saga_fg.arrays import FloatArray
from saga_fg.ego.estimate import JointEstimate, read_estimate
from saga_fg.ego.graph import Keyed, error_key, linear_graph, nonlinear_factors, object_key, pose_key, start_graph
from saga_fg.ego.landmarks import LandmarkPart, Observations, landmark_part
from saga_fg.ego.lanes import KnownLane, keepings, known_lanes, lane_factors, lane_key, lane_priors
from saga_fg.ego.odometry import Odometry
from saga_fg.ego.record import register
from saga_fg.ego.settings import JointSettings
from saga_fg.ego.standing import SlowErrors, standing_probabilities
from saga_fg.errors import InputError
from saga_fg.frame import Frame
from saga_fg.geometry import transform_points
from saga_fg.interactions import POSITION
from saga_fg.tracking import Tracker

TOLERANCE = 1.0  # standard deviations of the last step, over all variables together


def estimate_jointly(
    frames: Sequence[Frame],
    odometry: Odometry,
    new_tracker: Callable[[], Tracker],
    settings: JointSettings | None = None,
    start: FloatArray | None = None,
    landmarks: Observations | LandmarkPart | None = None,
) -> JointEstimate:
    """Estimate the path (n poses) and the objects of n frames, in increasing order of time.

    odometry: between the frames' times; new_tracker: gives a fresh tracker, which registers detections; start: first
    pose (4, 4), by default the identity; landmarks: what is observed of them at each of the n moments, or their part of
    the graph where somebody knows already which observation is of which. Detections are in ego or sensor coordinates,
    or in those of the world with the pose they were transformed by. Raises `InputError` where frames, odometry and
    landmarks do not fit together.
    """
    settings = settings or JointSettings()
    check_times(frames, odometry)
    if landmarks is None:
        landmarks = [()] * len(frames)
    if not isinstance(landmarks, LandmarkPart) and len(landmarks) != len(frames):
        raise InputError(f"landmarks: expected what is observed at {len(frames)} moments, got {len(landmarks)}")
    path = odometry.path(start)
    slow = SlowErrors.at_start(settings)
    estimate = None
    for _ in range(settings.rounds):
        tracker = new_tracker()
        lanes = known_lanes([tracker.settings.road_map, *(frame.road_map for frame in frames)])
        moments = register(frames, path, odometry, tracker, settings.motion_noise)
        standing = standing_probabilities(moments, path, slow, settings)
        if isinstance(landmarks, LandmarkPart):
            seen = landmarks
        else:
            seen = landmark_part(landmarks, path, settings.landmark_reach)
        first = [None] if estimate is None else []
        estimate = _solved(list(enumerate(moments)), path, [*first, standing], seen, lanes, settings)
        path, slow = estimate.world_T_ego, estimate.slow_errors
    assert estimate is not None
    return estimate


def check_times(frames: Sequence[Frame], odometry: Odometry) -> None:
    """Raise `InputError` unless each moment of the odometry is that of a frame."""
    times = np.array([frame.timestamp for frame in frames])
    if len(times) != len(odometry) or not np.allclose(times, odometry.timestamps, atol=1e-6):
        raise InputError(
            f"frames: expected one at each of the {len(odometry)} moments of the odometry, got {len(times)}"
        )


def _solved(
    record: Keyed,
    path: FloatArray,
    standing: Sequence[Sequence[FloatArray] | None],
    landmarks: LandmarkPart,
    lanes: Sequence[KnownLane],
    settings: JointSettings,
) -> JointEstimate:
    """One solution after the other, each from the one before: all objects moving, which needs no good start (None), or
    with those that stand; at last with vehicles drawn to the lanes they are on by the solution before.
    """
    graph = start_graph(0, path[0], settings)
    graph.push_back(linear_graph(record))
    graph.push_back(landmarks.graph)
    solver = SolverSettings(max_iterations=settings.max_iterations, tolerance=TOLERANCE)
    values = start_values(record, path)
    values.insert(landmarks.start)
    for probabilities in standing:
        factors = [*nonlinear_factors(record, settings, probabilities), *landmarks.factors]
        solution = solve(graph, factors, values, solver)
        values = solution.values
    if settings.lanes is None or not lanes:
        return read_estimate(record, solution)
    graph.push_back(nonlinear_graph(lane_priors(lanes), {lane_key(lane.number): 1 for lane in lanes}))
    for lane in lanes:
        values.insert(lane_key(lane.number), np.zeros(1))
    for _ in range(settings.lanes.rounds):
        estimate = read_estimate(record, solution)
        poses = zip(estimate.world_T_ego, estimate.pose_covariances, strict=True)
        stands = standing[-1] or [np.zeros(len(moment.objects.id)) for _, moment in record]
        kept = [
            one
            for (k, moment), objects, stand, pose in zip(record, estimate.objects, stands, poses, strict=True)
            for one in keepings(k, objects, moment.seen.id, stand, pose, lanes, settings.lanes)
        ]
        solution = solve(graph, [*factors, *lane_factors(record, kept, settings.lanes)], values, solver)
        values = solution.values
    return read_estimate(record, solution)


def start_values(record: Keyed, path: FloatArray) -> gtsam.Values:
    """Where to begin: along a path (n, 4, 4), objects where they were last detected, at rest."""
    values = gtsam.Values()
    place: dict[int, FloatArray] = {}
    for (k, moment), pose in zip(record, path, strict=True):
        values.insert(pose_key(k), gtsam.Pose3(pose))
        values.insert(error_key(k), np.zeros(ERROR_DIM))
        place.update(zip(moment.seen.id.tolist(), transform_points(pose, moment.seen.z)[:, :2], strict=True))
        for name, node_type in zip(moment.objects.id.tolist(), moment.objects.types, strict=True):
            state = np.zeros(node_type.dim)
            state[node_type.index(POSITION)] = place[name]
            values.insert(object_key(k, name), state)
    return values
