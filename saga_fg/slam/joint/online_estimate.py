"""A recording estimated as if its frames came one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.batch import check_times
from saga_fg.slam.joint.landmarks import Observations
from saga_fg.slam.joint.odometry import Odometry
from saga_fg.slam.joint.online import OnlineEstimator
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.slam.mapping import MapperSettings
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame
from saga_fg.types.landmark import Landmark


@dataclass(frozen=True, eq=False)
class OnlineEstimate:
    """Poses (n, 4, 4) of n moments, world_T_ego.

    newest       as known when the frame came, covariances (n, 6, 6) in its own frame: rotation vector (rad),
                 translation (m)
    settled      as known when the moment left the window, or at the end
    landmarks    all that were seen
    """

    timestamps: FloatArray
    newest: FloatArray
    covariances: FloatArray
    settled: FloatArray
    landmarks: list[Landmark]


def estimate_online(
    frames: Sequence[Frame],
    odometry: Odometry,
    tracker: Tracker,
    lag: float,
    settings: JointSettings | None = None,
    start: FloatArray | None = None,
    landmarks: Observations | None = None,
    mapper: MapperSettings | None = None,
    providers: Sequence[FactorProvider] = (),
) -> OnlineEstimate:
    """Feed n frames to an `OnlineEstimator`; landmarks: what is observed at each moment; the rest as there.

    Raises `InputError` where frames, odometry and landmarks do not fit together.
    """
    check_times(frames, odometry)
    if landmarks is not None and len(landmarks) != len(frames):
        raise InputError(f"landmarks: expected what is observed at {len(frames)} moments, got {len(landmarks)}")
    estimator = OnlineEstimator(tracker, lag, settings, mapper, start, providers)
    newest, covariances, settled = [], [], []
    for k, frame in enumerate(frames):
        increment = odometry.a_T_b[k - 1] if k else None
        covariance = odometry.covariances[k - 1] if k and odometry.covariances is not None else None
        step = estimator.step(frame, increment, covariance, () if landmarks is None else landmarks[k])
        newest.append(step.newest.world_T_ego[-1])
        covariances.append(step.newest.pose_covariances[-1])
        if step.settled is not None:
            settled.append(step.settled.world_T_ego)
    settled.append(estimator.window().world_T_ego)
    return OnlineEstimate(
        odometry.timestamps,
        np.stack(newest),
        np.stack(covariances),
        np.concatenate(settled),
        estimator.landmarks(),
    )
