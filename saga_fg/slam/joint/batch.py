"""Path of the vehicle and objects around it, from a whole recording at once.

Discrete unknowns depend on the path: the association of detections, and the identity and stationarity of objects. A
pass associates along the path so far, starting with the odometry's, takes the probabilities of stationarity from the
detections, solves the graph of all epochs, weighs the detections by the objects found, and solves again. Passes end
when associations repeat.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from factors import SolverSettings
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider, SceneFactorGraph, ask_all
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.association import (
    SlowErrors,
    stationary_probabilities,
    with_all_identities,
)
from saga_fg.slam.joint.graph import JointEstimate, detections, read_estimate, stationary_factors
from saga_fg.slam.joint.providers import StationaryPairs, VehicleAndObjects, detections_name
from saga_fg.slam.joint.record import MAX_ITERATIONS, JointSettings, OdometryIncrements, record_epochs
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame

TOLERANCE = 1.0  # standard deviations of the last step, over all variables together


def estimate_jointly(
    frames: Sequence[Frame],
    odometry: OdometryIncrements,
    new_tracker: Callable[[], Tracker],
    settings: JointSettings | None = None,
    start: FloatArray | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
) -> JointEstimate:
    """Estimate the path (n poses) and the objects of n frames, in increasing order of time.

    odometry: between the frames' times; new_tracker: gives a new tracker, which associates detections; start: first
    pose (4, 4), by default the identity; new_providers: gives new providers of other factors, asked with each frame
    (`saga_fg.slam.mapping.LandmarkObservations` for landmarks). Detections are in ego or sensor coordinates, or in
    those of the world with the pose they were transformed by. Raises `InputError` where frames and odometry do not fit
    together.
    """
    settings = settings or JointSettings()
    times = np.array([frame.timestamp for frame in frames])
    if len(times) != len(odometry) or not np.allclose(times, odometry.timestamps, atol=1e-6):
        raise InputError(f"frames: expected one at each of the {len(odometry)} times of the odometry, got {len(times)}")
    path = odometry.path(start)
    slow = SlowErrors.at_start(settings)
    estimate = None
    links: list[list[int]] = []
    for _ in range(settings.passes):
        tracker = new_tracker()
        record = record_epochs(frames, path, odometry, tracker)
        before, links = links, [now.seen.id.tolist() for now in record]
        if links == before:
            break
        clutter = tracker.settings.association.clutter_area
        start_moving = estimate is None
        epochs = VehicleAndObjects(record, path, settings)
        estimate = _solve(epochs, frames, slow, start_moving, clutter, new_providers())
        path, slow = estimate.world_T_ego, estimate.slow_errors
    assert estimate is not None
    return estimate


def _solve(
    epochs: VehicleAndObjects,
    frames: Sequence[Frame],
    slow: SlowErrors,
    start_moving: bool,
    clutter_area: float,
    providers: Sequence[FactorProvider],
) -> JointEstimate:
    """Solve the epochs of a record several times, each from the solution before: if `start_moving` with all objects
    moving, which needs no good start; with those stationary that seem so along the path; with identities by the
    solution.
    """
    graph, solver = SceneFactorGraph(), SolverSettings(max_iterations=MAX_ITERATIONS, tolerance=TOLERANCE)
    record, settings = epochs.record, epochs.settings
    for now, frame in zip(record, frames, strict=True):
        graph.advance(now.time)
        ask_all([epochs, *providers], graph, frame)
    if start_moving:
        graph.solve(solver)
    probabilities = stationary_probabilities(record, np.asarray(epochs.path), slow, settings)
    name = StationaryPairs.name
    graph.add_factors(name, stationary_factors(record, probabilities), name)
    estimate = read_estimate(record, graph.solve(solver), probabilities)
    places = [one.position for one in estimate.objects]
    record = with_all_identities(record, estimate.world_T_ego, places, clutter_area)
    graph.add_factors(epochs.name, detections(record, settings), detections_name(record[-1]))
    return read_estimate(record, graph.solve(solver), probabilities)
