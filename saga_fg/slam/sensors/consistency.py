"""Consistency of each sensor's measurements with the rest of the graph.

A sensor that sits elsewhere or looks elsewhere than its settings say leaves residuals larger than its noise allows, or
drives its biases away. Of the newest factors of a provider, d_i residuals each, whitened and after the solution,

    median_i  || r_i ||^2 / d_i   >  `LARGEST`

is a misfit; with half of the residuals wrong, outliers are no excuse. Biases are compared with their prior.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection

import numpy as np

from saga_fg.graph import EGO_BIAS, SceneFactorGraph
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.sensors.settings import SensorSettings

WINDOW = 60  # factors of a sensor that are looked at
LEAST = 15  # that are needed
LARGEST = 2.0  # median of the squared residuals by dimension: below 1 where all is well; robust losses bound it
_BOUND = 0.9  # of the squared scale of a Cauchy loss: a residual three times that scale
_LOG = logging.getLogger(__name__)
_BIAS = 4.0  # standard deviations of the prior


class SensorConsistency:
    """Whether sensors fit the graph that they are part of; sensors: their names, settings: theirs.

    `observe` takes a graph, of providers by `sensor_providers`, as it is solved. Where a graph forgets, it is called
    again before: each factor counts with its last residual.
    """

    def __init__(self, sensors: Collection[str], settings: SensorSettings) -> None:
        self._sensors, self._settings = tuple(sensors), settings
        self._scores: dict[str, dict[tuple[float, str, int], float]] = {sensor: {} for sensor in sensors}
        self._bias: FloatArray | None = None  # (6,), the newest
        self._observed = -math.inf  # s
        self._stated: dict[str, str] = {}  # what is known of sensors without the graph

    def state(self, sensor: str, misfit: str) -> None:
        """Take an explanation why a sensor does not fit from elsewhere, and warn at once."""
        self._stated[sensor] = misfit
        _LOG.warning(misfit)

    def observe(self, graph: SceneFactorGraph, every: float = 0.0) -> None:
        """Take the residuals of a graph at its solution, and its newest biases; at most once in `every` s."""
        if graph.time < self._observed + every:
            return
        self._observed = graph.time
        for sensor, scores in self._scores.items():
            name = getattr(self._settings, sensor).name
            found = _residual_scores(graph, name, None if sensor == "gps" else WINDOW)
            scores |= dict(sorted(found.items()))
        if "imu" in self._sensors and (known := graph.of(EGO_BIAS, graph.epoch)):
            self._bias = np.asarray(graph.state(known[0].key).vector())

    def forget(self, since: float) -> None:
        """Drop the residuals from a time on, s, as the poses there turned out wrong."""
        for scores in self._scores.values():
            for key in [key for key in scores if key[0] >= since]:
                del scores[key]

    @property
    def misfits(self) -> dict[str, str]:
        """Inconsistent sensors, the least consistent one first, each with an explanation, by name."""
        found: dict[str, tuple[float, str]] = {}
        for sensor in self._sensors:
            name, scores = getattr(self._settings, sensor).name, self._newest(sensor)
            if len(scores) >= LEAST and np.median(scores) > LARGEST:
                found[sensor] = (
                    float(np.median(scores)),
                    (
                        f"{name}: the residuals of its last {len(scores)} measurements are larger than its noise "
                        "allows; check where its settings place it on the vehicle, its units, and its noise"
                    ),
                )
        if self._bias is not None:
            imu = self._settings.imu
            deviations = np.repeat([imu.accelerometer_bias, imu.gyroscope_bias], 3)
            share = float(np.abs(self._bias / deviations).max())
            if share > _BIAS and share**2 > found.get("imu", (0.0, ""))[0]:
                force, rate = np.abs(self._bias[:3]).max(), np.abs(self._bias[3:]).max()
                found["imu"] = (
                    share**2,
                    (
                        f"{imu.name}: its biases are {share:.1f} times as large as its settings expect "
                        f"({force:.2f} m/s^2, {rate:.3f} rad/s); "
                        "check how its settings turn it on the vehicle, its units, and gravity"
                    ),
                )
        ranked = {sensor: text for sensor, (_, text) in sorted(found.items(), key=lambda one: -one[1][0])}
        return {**ranked, **self._stated}

    @property
    def unjudged(self) -> dict[str, str]:
        """Sensors with too few factors in the graph to judge them, likewise."""
        counts = {sensor: len(self._newest(sensor)) for sensor in self._sensors}
        return {
            sensor: f"{getattr(self._settings, sensor).name}: "
            + (
                f"factors in the graph: {count}, too few to judge whether it fits; {LEAST} are needed"
                if count
                else "not used so far, the graph has no factors of it"
            )
            for sensor, count in counts.items()
            if count < LEAST
        }

    @property
    def false_fixes(self) -> str:
        """How many fixes by GPS lie so far off that the robust loss hardly counts them, in words; empty for none."""
        gps, scores = self._settings.gps, np.array(list(self._scores.get("gps", {}).values()))
        loss = gps.outlier_scale
        off = int((3 * scores > _BOUND * loss**2).sum())  # residuals weighted by the loss stay below its scale
        if not np.isfinite(loss) or not off:
            return ""
        return f"{gps.name}: {off} of {len(scores)} fixes lie more than {3 * loss:.0f} deviations off, and hardly count"

    def warn(self) -> None:
        """Log all of these, but for those that were stated before."""
        for text in filter(None, (*self.misfits.values(), *self.unjudged.values(), self.false_fixes)):
            if text not in self._stated.values():
                _LOG.warning(text)

    def _newest(self, sensor: str) -> list[float]:
        return list(self._scores[sensor].values())[-WINDOW:]


def _residual_scores(graph: SceneFactorGraph, provider: str, most: int | None) -> dict[tuple[float, str, int], float]:
    """Squared whitened residuals by dimension of the newest factors of a provider, those of priors left out.

    By the time, name and row of each; most: of them, None for all
    """
    scores: dict[tuple[float, str, int], float] = {}
    point = graph.point()
    for held in reversed(list(graph.groups.values())):
        if held.provider != provider:
            continue
        times = {
            row: max(moments)
            for row in held.rows.tolist()
            if (moments := [t for key in held.factors.rows[row] if (t := graph.variables[key].time) is not None])
        }
        linear = graph.linearised(held, np.array(list(times), dtype=np.int64), point) if times else ()
        for (row, time), factor in zip(times.items(), linear, strict=True):
            step = np.concatenate([point.increment(key) for key in factor.keys()])  # noqa: SIM118 -- a factor of GTSAM
            r = factor.augmentedJacobian()[:, -1] - factor.augmentedJacobian()[:, :-1] @ step
            scores[time, held.factors.name, row] = float(r @ r) / len(r)
        if most is not None and len(scores) >= most:
            break
    return scores
