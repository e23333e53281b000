"""Path of the vehicle and objects around it, from a whole recording at once.

Two discrete questions depend on the path that is sought: which detection belongs to which object, and which objects
stand. So they are answered along the odometry's path, the graph of all moments is solved, and the answers are given
anew along the path found.
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
from saga_fg.slam.joint.graph import Keyed, standing_factors
from saga_fg.slam.joint.landmarks import Observations, nearest_landmarks
from saga_fg.slam.joint.lane_keeping import LaneKeeping
from saga_fg.slam.joint.odometry import Odometry
from saga_fg.slam.joint.providers import Moments, Standing
from saga_fg.slam.joint.record import register
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.joint.standing import SlowErrors, standing_probabilities
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame

TOLERANCE = 1.0  # standard deviations of the last step, over all variables together


def estimate_jointly(
    frames: Sequence[Frame],
    odometry: Odometry,
    new_tracker: Callable[[], Tracker],
    settings: JointSettings | None = None,
    start: FloatArray | None = None,
    landmarks: Observations | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
) -> JointEstimate:
    """Estimate the path (n poses) and the objects of n frames, in increasing order of time.

    odometry: between the frames' times; new_tracker: gives a fresh tracker, which registers detections; start: first
    pose (4, 4), by default the identity; landmarks: what is observed of them at each of the n moments; new_providers:
    gives new providers of other factors, asked moment by moment (`saga_fg.slam.mapping.LandmarkObservations` for
    landmarks of known identity). Detections are in ego or sensor coordinates, or in those of the world with the
    pose they were transformed by. Raises `InputError` where frames, odometry and landmarks do not fit together.
    """
    settings = settings or JointSettings()
    check_times(frames, odometry)
    if landmarks is not None and len(landmarks) != len(frames):
        raise InputError(f"landmarks: expected what is observed at {len(frames)} moments, got {len(landmarks)}")
    path = odometry.path(start)
    slow = SlowErrors.at_start(settings)
    estimate = None
    for _ in range(settings.rounds):
        tracker = new_tracker()
        lanes = LaneKeeping(settings.lanes, [tracker.settings.road_map, *(frame.road_map for frame in frames)])
        moments = register(frames, path, odometry, tracker, settings.motion_noise)
        standing = standing_probabilities(moments, path, slow, settings)
        seen = nearest_landmarks(landmarks or [()] * len(frames), path, settings.landmark_reach)
        first = [None] if estimate is None else []
        record = list(enumerate(moments))
        estimate = _solved(record, path, [*first, standing], lanes, [seen, *new_providers()], settings)
        estimate = replace(estimate, observations=seen)
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
    lanes: LaneKeeping,
    providers: Sequence[FactorProvider],
    settings: JointSettings,
) -> JointEstimate:
    """One solution after the other, each from the one before: all objects moving, which needs no good start (None), or
    with those that stand; at last with vehicles drawn to the lanes they are on by the solution before.
    """
    graph, solver = SceneFactorGraph(), SolverSettings(max_iterations=settings.max_iterations, tolerance=TOLERANCE)
    moments = Moments(record, path, settings)
    for _, moment in record:
        graph.advance(moment.time)
        ask_all([moments, *providers], graph)
    for probabilities in standing:
        if probabilities is not None:
            graph.add_factors(Standing.name, standing_factors(record, probabilities, settings), Standing.name)
        solution = graph.solve(solver)
    for _ in range(lanes.rounds):
        lanes.assign(record, read_estimate(record, solution), standing[-1] or ())
        ask_all([lanes], graph)
        solution = graph.solve(solver)
    return read_estimate(record, solution)
