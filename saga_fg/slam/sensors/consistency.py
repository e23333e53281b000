"""Consistency of each sensor's measurements with the rest of the graph.

A sensor that sits elsewhere or looks elsewhere than its settings say leaves residuals larger than its noise allows, or
drives its biases away. Of the newest factors of a provider, d_i residuals each, whitened and after the solution,

    median_i  || r_i ||^2 / d_i   >  `LARGEST`

is a misfit; with half of the residuals wrong, outliers are no excuse. Biases are compared with their prior.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from saga_fg.graph import EGO_BIAS, SceneFactorGraph
from saga_fg.graph.linearisation_point import LinearisationPoint
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.sensors.settings import SensorSettings

WINDOW = 60  # factors of a sensor that are looked at
LEAST = 15  # that are needed
LARGEST = 2.0  # median of the squared residuals by dimension: below 1 where all is well; robust losses bound it
_BOUND = 0.9  # of the squared scale of a Cauchy loss: a residual three times that scale
_BIAS = 4.0  # standard deviations of the prior


def misfits(
    graph: SceneFactorGraph, sensors: Collection[str], settings: SensorSettings
) -> tuple[dict[str, str], dict[str, str]]:
    """Inconsistent sensors, the least consistent one first, and those that have measured too little to judge them.

    Each has an explanation, by name. graph: as solved, of providers by `sensor_providers`
    """
    point, found, unjudged = graph.point(), dict[str, tuple[float, str]](), dict[str, str]()
    for sensor in sensors:
        name = getattr(settings, sensor).name
        scores = residual_scores(graph, name, point)
        if len(scores) < LEAST:
            unjudged[sensor] = (
                f"{name}: too few measurements to judge whether it fits: {len(scores)}, {LEAST} are needed"
            )
        elif np.median(scores) > LARGEST:
            found[sensor] = (
                float(np.median(scores)),
                (
                    f"{name}: the residuals of its last {len(scores)} measurements are larger than its noise allows; "
                    "check where its settings place it on the vehicle, its units, and its noise"
                ),
            )
    if "imu" in sensors:
        share, bias = _bias(graph, settings)
        if share > _BIAS and share**2 > found.get("imu", (0.0, ""))[0]:
            found["imu"] = (
                share**2,
                (
                    f"{settings.imu.name}: its biases are {share:.1f} times as large as its settings expect "
                    f"({np.abs(bias[:3]).max():.2f} m/s^2, {np.abs(bias[3:]).max():.3f} rad/s); "
                    "check how its settings turn it on the vehicle, its units, and gravity"
                ),
            )
    return {sensor: text for sensor, (_, text) in sorted(found.items(), key=lambda one: -one[1][0])}, unjudged


def false_fixes(graph: SceneFactorGraph, settings: SensorSettings) -> str:
    """How many fixes by GPS lie so far off that the robust loss hardly counts them, in words; empty for none."""
    loss = settings.gps.outlier_scale
    scores = residual_scores(graph, settings.gps.name, graph.point(), most=len(graph.variables))
    off = int((3 * scores > _BOUND * loss**2).sum())  # a residual that is weighted by the loss stays below its scale
    if not np.isfinite(loss) or not off:
        return ""
    name, far = settings.gps.name, 3 * loss
    return f"{name}: {off} of {len(scores)} fixes lie more than {far:.0f} deviations off, and hardly count"


def residual_scores(
    graph: SceneFactorGraph, provider: str, point: LinearisationPoint, most: int = WINDOW
) -> FloatArray:
    """Squared whitened residuals by dimension (n,) of the newest factors of a provider, those of priors left out."""
    scores: list[float] = []
    for held in reversed(list(graph.groups.values())):
        if held.provider != provider:
            continue
        moving = [
            row
            for row in held.rows.tolist()
            if any(graph.variables[key].time is not None for key in held.factors.rows[row])
        ]
        for factor in graph.linearised(held, np.array(moving, dtype=np.int64), point) if moving else ():
            step = np.concatenate([point.increment(key) for key in factor.keys()])  # noqa: SIM118 -- a factor of GTSAM
            r = factor.augmentedJacobian()[:, -1] - factor.augmentedJacobian()[:, :-1] @ step
            scores.append(float(r @ r) / len(r))
        if len(scores) >= most:
            break
    return np.array(scores[:most])


def _bias(graph: SceneFactorGraph, settings: SensorSettings) -> tuple[float, FloatArray]:
    """The newest bias (6,) of the inertial sensor, and its largest component in standard deviations of its prior."""
    known = graph.of(EGO_BIAS, graph.epoch)
    if not known:
        return 0.0, np.zeros(6)
    bias = np.asarray(graph.state(known[0].key).vector())
    deviations = np.repeat([settings.imu.accelerometer_bias, settings.imu.gyroscope_bias], 3)
    return float(np.abs(bias / deviations).max()), bias
