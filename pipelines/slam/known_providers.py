"""Factor providers of what LiDAR SLAM has associated: landmarks seen from keyframes, and loops between these."""

from __future__ import annotations

from collections.abc import Sequence

from pipelines.slam.lidar_slam_types import LidarSlamResult
from saga_fg.slam.mapping import LandmarkObservations
from saga_fg.slam.submaps import Loops, SubmapSettings
from saga_fg.types.landmark import Observation


def known_providers(
    result: LidarSlamResult, epochs: Sequence[int], settings: SubmapSettings
) -> tuple[LandmarkObservations, Loops]:
    """Providers of landmarks seen from keyframes and of loops between these, whose poses are those of `epochs`."""
    start = {mark.number: mark.state for mark in result.landmarks}
    seen: dict[int, list[tuple[int, Observation]]] = {}
    for one in result.observations:
        if one.landmark in start:
            seen.setdefault(epochs[one.pose], []).append((one.landmark, one.observation))
    return LandmarkObservations(seen, start, settings.robust), Loops(result.loops, epochs)
