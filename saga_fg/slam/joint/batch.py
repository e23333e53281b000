"""Path of the vehicle and objects around it, from a whole recording at once.

Two discrete unknowns depend on the path: the association of detections and the stationarity of objects. They are
decided along the odometry's path, the graph of all epochs is solved, and they are decided again along the path found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from factors import SolverSettings
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider, SceneFactorGraph, ask_all
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.estimate import JointEstimate, read_estimate
from saga_fg.slam.joint.graph import Record, stationary_factors
from saga_fg.slam.joint.landmarks import Observations, nearest_landmarks
from saga_fg.slam.joint.lanes import LaneAssociation
from saga_fg.slam.joint.odometry import OdometryIncrements
from saga_fg.slam.joint.providers import StationaryPairs, VehicleAndObjects
from saga_fg.slam.joint.record import record_epochs
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.joint.stationarity import SlowErrors, stationary_probabilities
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame

TOLERANCE = 1.0  # standard deviations of the last step, over all variables together


def estimate_jointly(
    frames: Sequence[Frame],
    odometry: OdometryIncrements,
    new_tracker: Callable[[], Tracker],
    settings: JointSettings | None = None,
    start: FloatArray | None = None,
    landmarks: Observations | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
) -> JointEstimate:
    """Estimate the path (n poses) and the objects of n frames, in increasing order of time.

    odometry: between the frames' times; new_tracker: gives a new tracker, which associates detections; start: first
    pose (4, 4), by default the identity; landmarks: observations at each of the n epochs; new_providers: gives new
    providers of other factors, asked epoch by epoch (`saga_fg.slam.mapping.LandmarkObservations` for landmarks of known
    identity). Detections are in ego or sensor coordinates, or in those of the world with the pose they were transformed
    by. Raises `InputError` where frames, odometry and landmarks do not fit together.
    """
    settings = settings or JointSettings()
    landmarks = checked_landmarks(frames, odometry, landmarks)
    path = odometry.path(start)
    slow = SlowErrors.at_start(settings)
    estimate = None
    for _ in range(settings.passes):
        tracker = new_tracker()
        lanes = LaneAssociation(settings.lanes, [tracker.settings.road_map, *(frame.road_map for frame in frames)])
        record = record_epochs(frames, path, odometry, tracker, settings.motion_noise)
        stationary = stationary_probabilities(record, path, slow, settings)
        seen = nearest_landmarks(landmarks, path, settings.max_landmark_distance)
        first = [None] if estimate is None else []
        estimate = _solve(record, path, [*first, stationary], lanes, [seen, *new_providers()], settings)
        estimate = replace(estimate, observations=seen)
        path, slow = estimate.world_T_ego, estimate.slow_errors
    assert estimate is not None
    return estimate


def checked_landmarks(
    frames: Sequence[Frame], odometry: OdometryIncrements, landmarks: Observations | None
) -> Observations:
    """The observations at each frame, none by default.

    Raises `InputError` unless odometry and landmarks are of the times of the frames.
    """
    times = np.array([frame.timestamp for frame in frames])
    if len(times) != len(odometry) or not np.allclose(times, odometry.timestamps, atol=1e-6):
        raise InputError(f"frames: expected one at each of the {len(odometry)} times of the odometry, got {len(times)}")
    if landmarks is not None and len(landmarks) != len(frames):
        raise InputError(f"landmarks: expected observations at {len(frames)} times, got {len(landmarks)}")
    return landmarks or [()] * len(frames)


def _solve(
    record: Record,
    path: FloatArray,
    stationary: Sequence[Sequence[FloatArray] | None],
    lanes: LaneAssociation,
    providers: Sequence[FactorProvider],
    settings: JointSettings,
) -> JointEstimate:
    """Solve several times, each from the solution before: with all objects moving (None), which needs no good start, or
    with stationary ones by these probabilities; at last with vehicles assigned to lanes along the solution before.
    """
    graph, solver = SceneFactorGraph(), SolverSettings(max_iterations=settings.max_iterations, tolerance=TOLERANCE)
    epochs = VehicleAndObjects(record, path, settings)
    for now in record:
        graph.advance(now.time)
        ask_all([epochs, *providers], graph)
    name = StationaryPairs.name
    for probabilities in stationary:
        if probabilities is not None:
            graph.add_factors(name, stationary_factors(record, probabilities, settings), name)
        solution = graph.solve(solver)
    for _ in range(lanes.rounds):
        lanes.assign(record, read_estimate(record, solution), stationary[-1] or ())
        ask_all([lanes], graph)
        solution = graph.solve(solver)
    return read_estimate(record, solution)
