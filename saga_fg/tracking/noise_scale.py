"""The noise of a sensor of which nothing is known, told by its own successive detections, without ground truth.

A divided difference of order k of an object's k + 1 detections z_j at times t_j, `STEP` apart, is free of all motion
along a polynomial of degree k - 1 in time. What is left is noise, of a known share of the variance of a detection:

    D_k = sum over j of c_j z_j,   c_j = product over i /= j of 1 / (t_j - t_i),   cov D_k = R sum over j of c_j^2
    s^2 = least over k = 1, 2, 3 of the 90 % quantile of ( D_k^T R^-1 D_k / sum of c_j^2 ) / chi^2_2(90 %)

with R the noise by the sensor's model. Orders that motion is still part of are larger, and the quantile is that up to
which ellipses are meant to hold. Until there are enough differences, gates are those of `UNKNOWN` times its noise:
with too small ones a tracker would only see the small errors.

More noise than the model says widens gates and slows the filter (factor max(s, 1) on the deviations R). Less noise
narrows the reported ellipses alone (min(s, 1), `saga_fg.tracking.reporting`): errors that all detections of an object
share do not show in differences, and a filter that believes too much loses objects. Where these detections differ
by less than a detector errs, their errors are mostly shared: such an s is not believed, and 1 is taken.

Source: von Neumann, Kent, Bellinson, Hart, The mean square successive difference, Annals of Mathematical Statistics
12(2), 1941.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.model import NoiseModel, Sensor, sensor_model
from saga_fg.numerics import FloatArray, IntArray, Matching, gate, mahalanobis_of_pairs
from saga_fg.tracking.measurements import FrameMeasurements

ORDERS = (1, 2, 3)
STEP = 0.4  # s between detections that are compared: errors that last longer are shared by all of them
QUANTILE = 0.9
LEAST, MOST = 1 / 3, 10 / 3  # bounds of s
SHARED = (0.18, 0.28)  # s, from which differences are no longer believed, and are believed
UNKNOWN = 2.0  # s of gates, before it is known
FEWEST, PRIOR, LATEST = 15, 3, 300  # differences of an order: for an estimate, that s = 1 counts for, that are kept
ROUGHLY = 300  # differences, from which gates follow s
SETTLED = 10.0  # s from a sensor's first detections, after which s stays

_Detections = tuple[float, IntArray, FloatArray]  # time, s, tracks (n,) and positions (n, 2), m, of a frame


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """The noise of a sensor, as far as its detections tell it.

    scale    s: factor on the standard deviations of its model
    settled  whether s stays
    start    time of its first detections, s, NaN before
    seen     number of differences so far
    frames   the latest frames, oldest first, as far back as they are compared
    squares  by order, the latest squared differences in units of the model's noise
    """

    scale: float = 1.0
    settled: bool = False
    start: float = math.nan
    seen: int = 0
    frames: tuple[_Detections, ...] = ()
    squares: tuple[FloatArray, ...] = (np.empty(0),) * len(ORDERS)

    def observed(self, time: float, track: IntArray, position: FloatArray, R: FloatArray) -> SensorNoise:
        """Take in a frame at a time, s: positions (n, 2), m, of tracks (n,), with R (n, 2, 2) by the model."""
        if self.settled or not len(track) or (self.frames and time <= self.frames[-1][0]):
            return self
        start = time if math.isnan(self.start) else self.start
        if time > start + SETTLED:
            return SensorNoise(self.scale, settled=True, seen=self.seen)
        frames = (*self.frames, (time, track, position))
        compared = _apart(frames)
        common, rows, squares, seen = track, np.arange(len(track)), list(self.squares), 0
        columns = [position]
        for order, (_, tracks, places) in enumerate(compared[1:], 1):
            common, kept, before = np.intersect1d(common, tracks, assume_unique=True, return_indices=True)
            rows, columns = rows[kept], [*(column[kept] for column in columns), places[before]]
            found = _squares(np.array([at for at, _, _ in compared[: order + 1]]), np.stack(columns), R[rows])
            squares[order - 1] = np.concatenate([squares[order - 1], found])[-LATEST:]
            seen += len(found)
        needed = frames if len(compared) <= ORDERS[-1] else tuple(f for f in frames if f[0] >= compared[-1][0])
        return SensorNoise(_scale(squares), False, start, self.seen + seen, needed, tuple(squares))


UNMEASURED = SensorNoise()


def _apart(frames: Sequence[_Detections]) -> list[_Detections]:
    """The newest frame and those before it that are `STEP` and more from one another, as many as are compared."""
    found = [frames[-1]]
    for frame in reversed(frames[:-1]):
        if len(found) <= ORDERS[-1] and found[-1][0] - frame[0] >= STEP - 1e-6:
            found.append(frame)
    return found


def _squares(time: FloatArray, position: FloatArray, R: FloatArray) -> FloatArray:
    """(n,) squared divided differences, in units of R (n, 2, 2), of positions (k + 1, n, 2) at times (k + 1,)."""
    apart = time[:, None] - time[None, :]
    np.fill_diagonal(apart, 1.0)
    c = 1 / apart.prod(axis=1)
    c = c / np.sqrt((c**2).sum())
    D = np.einsum("k,knj->nj", c, position)
    return mahalanobis_of_pairs(D, R)[0]


def _scale(squares: list[FloatArray]) -> float:
    known = [each for each in squares if len(each) >= FEWEST]
    if not known:
        return 1.0
    variance = min(float(np.quantile(each, QUANTILE)) for each in known) / gate(QUANTILE)
    count = max(len(each) for each in known)
    s = math.exp(math.log(max(variance, 1e-12)) / 2 * count / (count + PRIOR))
    trust = min(max((s - SHARED[0]) / (SHARED[1] - SHARED[0]), 0.0), 1.0)
    return float(min(max(s, LEAST), MOST) ** trust)


def with_scale(measurements: FrameMeasurements, noise: SensorNoise) -> FrameMeasurements:
    """The measurements with the noise that was found, where it did not come with the detections."""
    free, s = measurements.by_model, noise.scale
    R, reported = measurements.R.copy(), measurements.covariance_scale.copy()
    R[free, :2, :2] *= max(s, 1.0) ** 2
    reported[free] *= min(s, 1.0)
    return replace(measurements, R=R, covariance_scale=reported)


def for_gates(measurements: FrameMeasurements, noise: SensorNoise) -> FrameMeasurements:
    """The measurements of `with_scale` as they are to be gated: with more noise as long as it is not known."""
    if noise.settled or noise.seen >= ROUGHLY:
        return measurements
    free, R = measurements.by_model, measurements.R.copy()
    R[free, :2, :2] *= UNKNOWN**2
    return replace(measurements, R=R)


def observed(
    noise: SensorNoise, measurements: FrameMeasurements, matching: Matching, track: IntArray, time: float
) -> SensorNoise:
    """Take in the measurements of a frame at `time`, s, as they were before `with_scale`.

    Measurements count that are matched beyond doubt and have the noise of the model. track (k,): of the matching
    """
    sure = (matching.share >= 1) & measurements.by_model[matching.detection]
    d = matching.detection[sure]
    return noise.observed(time, track[sure], measurements.boxes.position[d, :2], measurements.R[d, :2, :2])


def scaled_sensors(sensors: Mapping[str, Sensor], scales: Mapping[str, float]) -> dict[str, Sensor]:
    """The models with the noise of positions multiplied by s, for those of `scales`."""
    result = dict(sensors)
    for name, s in scales.items():
        model = sensor_model(sensors, name)
        result[name] = replace(model, noise={label: _scaled(each, s) for label, each in model.noise.items()})
    return result


def _scaled(noise: NoiseModel, s: float) -> NoiseModel:
    names = ("position", "range_noise", "bearing_noise")
    return replace(noise, **{name: s * getattr(noise, name) for name in names})
