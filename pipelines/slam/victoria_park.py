"""SLAM past trees of unknown identity, with odometry that is worse than its covariances.

The covariances of a recording's odometry assume independent errors. True errors persist (a wheel slips through the
whole bend), and add up to more. So a scale of the covariances is chosen first, the likeliest of a few on the beginning
of the drive (`LandmarkMapper.log_evidence`); the identities in the file are not used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from data_tools.datasets.victoria_park import TreeObservations
from pipelines.tracking import Progress
from saga_fg.model.landmarks.point import PointLandmark
from saga_fg.settings import Range, Settings, setting, settings_group
from saga_fg.slam.mapping import LandmarkMap, LandmarkMapper, MapperSettings
from saga_fg.types.landmark import Observation

_START = 1e-6  # variance of the first pose, m^2 and rad^2


@dataclass(frozen=True)
class ParkSettings(Settings):
    """Settings of mapping a drive past trees."""

    mapper: MapperSettings = settings_group(lambda: MapperSettings(smooth_every=300), "association of trees")
    tree: PointLandmark = settings_group(
        lambda: PointLandmark(name="tree", density=0.01), "the landmarks; one tree on 10 m by 10 m"
    )
    odometry_scales: tuple[float, ...] = setting(
        (1.0, 4.0, 16.0, 64.0, 256.0), "factors on the covariance to choose of"
    )
    beginning: Annotated[int, Range(1, 10**9)] = setting(2000, "poses on which that is chosen")


@dataclass(frozen=True, eq=False)
class ParkMap:
    """map: of trees; odometry_scale: the chosen one; log_evidence: of each scale that was tried."""

    map: LandmarkMap
    odometry_scale: float
    log_evidence: dict[float, float]


def map_park(
    drive: TreeObservations, settings: ParkSettings | None = None, progress: Progress | None = None
) -> ParkMap:
    """Map the trees of a drive, one pose after the other."""
    settings = settings or ParkSettings()
    scales = settings.odometry_scales
    evidence: dict[float, float] = {}
    if len(scales) > 1:
        for scale in scales:
            evidence[scale] = _driven(drive, scale, settings, settings.beginning, progress).log_evidence()
    chosen = max(scales, key=lambda scale: evidence.get(scale, 0.0))
    return ParkMap(_driven(drive, chosen, settings, None, progress).map(), chosen, evidence)


def _driven(
    drive: TreeObservations,
    scale: float,
    settings: ParkSettings,
    poses: int | None,
    progress: Progress | None,
) -> LandmarkMapper:
    """Return the mapper after the first poses, or all of them."""
    mapper = LandmarkMapper(np.eye(3), _START * np.eye(3), settings.mapper)
    total = min(poses or len(drive.a_T_b) + 1, len(drive.a_T_b) + 1)
    begin = np.searchsorted(drive.pose, np.arange(total + 1))
    for pose in range(total):
        if pose:
            mapper.move(drive.a_T_b[pose - 1], scale * drive.odometry_covariance[pose - 1])
        rows = range(int(begin[pose]), int(begin[pose + 1]))
        mapper.observe([Observation(settings.tree, drive.place[row], drive.covariance[row]) for row in rows])
        if progress is not None:
            progress(f"odometry covariance x {scale:g}", pose + 1, total)
    return mapper
