"""The noise of a sensor of which nothing is known, by class and range, told by its own successive detections.

No ground truth is needed. A divided difference of order k of an object's k + 1 detections z_j at times t_j, `STEP`
apart, is free of all motion along a polynomial of degree k - 1 in time. What is left is noise, of a known share of the
variance of a detection:

    D_k = sum over j of c_j z_j,   c_j = product over i /= j of 1 / (t_j - t_i),   cov D_k = R sum over j of c_j^2
    s^2 = least over k = 1, 2, 3 of the 90 % quantile of ( D_k^T R^-1 D_k / sum of c_j^2 ) / chi^2_2(90 %)

with R the noise by the sensor's model. Orders that motion is still part of are larger, so that the first alone never
raises s; until there are others, those of successive frames do, of second order, in which hardly any motion
is. The quantile is that up to which ellipses are meant to hold. The s of a class is drawn to that of all
classes, as if they had `OF_GROUP` differences in it, that of a band of range to its class, and s^2 = a^2 + (g r)^2 is
fitted to the bands. Until there are enough differences, gates are those of `UNKNOWN` times its noise: with too small
ones a tracker would only see the small errors.

More noise than the model says widens gates and slows the filter (factor max(s, 1) on the deviations R). Less noise
narrows the reported ellipses alone (min(s, 1), `saga_fg.tracking.track_life`): errors that all detections of an object
share do not show in differences, and a filter that believes too much loses objects. Where these detections differ
by less than a detector errs, their errors are mostly shared: such an s is not believed, and 1 is taken.

Source: von Neumann, Kent, Bellinson, Hart, The mean square successive difference, Annals of Mathematical Statistics
12(2), 1941.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import nnls

from saga_fg.model import NoiseModel, Sensor, sensor_model
from saga_fg.numerics import FloatArray, IntArray, Matching, StrArray, distinct, gate, mahalanobis_of_pairs
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.types import DEFAULT, class_settings

ORDERS = (1, 2, 3)
STEP = 0.4  # s between detections that are compared: errors that last longer are shared by all of them
QUANTILE = 0.9
LEAST, MOST = 1 / 3, 10 / 3  # bounds of s
SHARED = (0.18, 0.28)  # s, from which differences are no longer believed, and are believed
UNKNOWN = 2.0  # s of gates, before it is known
FEWEST, LATEST = 15, 300  # differences of an order: for an estimate, that are kept of a class and a band
PRIOR, OF_GROUP = 3, 30  # differences that s = 1 counts for, and that the s of the whole counts for in a part
ROUGHLY = 300  # differences, from which gates follow s
SETTLED = 10.0  # s from a sensor's first detections, after which s stays
BANDS = (20.0, 40.0)  # m, limits of the bands of range
MIDDLES = np.array([12.0, 30.0, 55.0])  # m, ranges that stand for the bands

_Detections = tuple[float, IntArray, FloatArray]  # time, s, tracks (n,) and positions (n, 2), m, of a frame
_Squares = tuple[FloatArray, ...]  # by order, the latest squared differences in units of the model's noise


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """The noise of a sensor, as far as its detections tell it.

    scale    s of all of them: factor on the standard deviations of its model
    growing  by class, (a, g) of s^2 = a^2 + (g r)^2 at the range r, m
    settled  whether these stay
    start    time of its first detections, s, NaN before
    seen     number of differences so far
    frames   the latest frames, oldest first, as far back as they are compared
    squares  by class and band of range
    quick    of all, the latest squared differences of successive frames that are less than `STEP` apart
    """

    scale: float = 1.0
    growing: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    settled: bool = False
    start: float = math.nan
    seen: int = 0
    frames: tuple[_Detections, ...] = ()
    squares: Mapping[tuple[str, int], _Squares] = field(default_factory=dict)
    quick: FloatArray = field(default_factory=lambda: np.empty(0))

    def observed(
        self, time: float, track: IntArray, position: FloatArray, R: FloatArray, label: StrArray, distance: FloatArray
    ) -> SensorNoise:
        """Take in a frame at a time, s: positions (n, 2), m, of tracks (n,), with R (n, 2, 2) by the model.

        label (n,): their classes; distance (n,): from the sensor, m, 0 where unknown
        """
        if self.settled or not len(track) or (self.frames and time <= self.frames[-1][0]):
            return self
        start = time if math.isnan(self.start) else self.start
        if time > start + SETTLED:
            return SensorNoise(self.scale, self.growing, settled=True, seen=self.seen)
        frames = (*self.frames, (time, track, position))
        compared = _apart(frames)
        band = np.searchsorted(BANDS, distance)
        squares, seen = dict(self.squares), 0
        for order, (rows, found) in enumerate(_differences(compared, R), 1):
            seen += len(found)
            for group in set(zip(label[rows].tolist(), band[rows].tolist(), strict=True)):
                mine = (label[rows] == group[0]) & (band[rows] == group[1])
                known = list(squares.get(group, (np.empty(0),) * len(ORDERS)))
                known[order - 1] = np.concatenate([known[order - 1], found[mine]])[-LATEST:]
                squares[group] = tuple(known)
        needed = frames if len(compared) <= ORDERS[-1] else tuple(f for f in frames if f[0] >= compared[-1][0])
        quick, least = self.quick, 1.0
        if len(frames) > 2 and time - frames[-3][0] < 2 * STEP - 1e-6:
            *_, (_, found) = _differences(frames[:-4:-1], R)
            quick = np.concatenate([quick, found])[-LATEST:]
        if len(quick) >= FEWEST:
            least = min(max(math.sqrt(float(np.quantile(quick, QUANTILE)) / gate(QUANTILE)), 1.0), MOST)
        scale = _scale(list(squares.values()), least, PRIOR)
        return SensorNoise(scale, _growing(squares, scale), False, start, self.seen + seen, needed, squares, quick)

    def scales(self, label: StrArray, distance: FloatArray) -> FloatArray:
        """(n,) s of detections of these classes (n,) at these distances (n,) from the sensor, m."""
        occurring, index = distinct(label)
        a, g = np.array([self.growing.get(each, (self.scale, 0.0)) for each in occurring]).reshape(-1, 2)[index].T
        return np.asarray(np.minimum(np.hypot(a, g * distance), MOST))


UNMEASURED = SensorNoise()


def _apart(frames: Sequence[_Detections]) -> list[_Detections]:
    """The newest frame and those before it that are `STEP` and more from one another, as many as are compared."""
    found = [frames[-1]]
    for frame in reversed(frames[:-1]):
        if len(found) <= ORDERS[-1] and found[-1][0] - frame[0] >= STEP - 1e-6:
            found.append(frame)
    return found


def _differences(frames: Sequence[_Detections], R: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
    """By order, the rows (k,) of the first frame that all frames have tracks of, and their squares (k,) by R."""
    _, common, position = frames[0]
    rows, columns = np.arange(len(common)), [position]
    for order, (_, tracks, places) in enumerate(frames[1:], 1):
        common, kept, before = np.intersect1d(common, tracks, assume_unique=True, return_indices=True)
        rows, columns = rows[kept], [*(column[kept] for column in columns), places[before]]
        yield rows, _squares(np.array([at for at, _, _ in frames[: order + 1]]), np.stack(columns), R[rows])


def _squares(time: FloatArray, position: FloatArray, R: FloatArray) -> FloatArray:
    """(n,) squared divided differences, in units of R (n, 2, 2), of positions (k + 1, n, 2) at times (k + 1,)."""
    apart = time[:, None] - time[None, :]
    np.fill_diagonal(apart, 1.0)
    c = 1 / apart.prod(axis=1)
    c = c / np.sqrt((c**2).sum())
    D = np.einsum("k,knj->nj", c, position)
    return mahalanobis_of_pairs(D, R)[0]


def _scale(parts: Sequence[_Squares], whole: float, prior: float) -> float:
    """The s of some groups together; whole: that of more of them, which counts for `prior` differences."""
    orders = [np.concatenate(each) for each in zip(*parts, strict=True)]
    known = [each for each in orders if len(each) >= FEWEST]
    if not known:
        return whole
    variance = min(float(np.quantile(each, QUANTILE)) for each in known) / gate(QUANTILE)
    if all(len(each) < FEWEST for each in orders[1:]):  # what is larger then may be motion
        variance = min(variance, whole**2)
    count = max(len(each) for each in known)
    s = math.exp((math.log(max(variance, 1e-12)) / 2 * count + math.log(whole) * prior) / (count + prior))
    trust = min(max((s - SHARED[0]) / (SHARED[1] - SHARED[0]), 0.0), 1.0)
    return float(min(max(s, LEAST), MOST) ** trust * whole ** (1 - trust))


def _growing(squares: Mapping[tuple[str, int], _Squares], whole: float) -> dict[str, tuple[float, float]]:
    """(a, g) by class, closest to the s of its bands, with a from `LEAST` on."""
    found = {}
    for label in sorted({label for label, _ in squares}):
        bands = {band: each for (of, band), each in squares.items() if of == label}
        s = _scale(list(bands.values()), whole, OF_GROUP)
        if len(bands) == 1:  # all near, or at unknown distances
            found[label] = s, 0.0
            continue
        by_band = [_scale([bands[k]], s, OF_GROUP) if k in bands else s for k in range(len(MIDDLES))]
        above, g2 = nnls(np.column_stack([np.ones(len(MIDDLES)), MIDDLES**2]), np.square(by_band) - LEAST**2)[0]
        found[label] = math.sqrt(LEAST**2 + above), math.sqrt(g2)
    return found


def with_found_noise(measurements: FrameMeasurements, noise: SensorNoise) -> FrameMeasurements:
    """The measurements with the noise that was found, where it did not come with the detections."""
    free = measurements.by_model
    s = noise.scales(measurements.boxes.label[free], measurements.distance[free])
    R, reported = measurements.R.copy(), measurements.covariance_scale.copy()
    R[free, :2, :2] *= np.maximum(s, 1.0)[:, None, None] ** 2
    reported[free] *= np.minimum(s, 1.0)
    return replace(measurements, R=R, covariance_scale=reported)


def for_gates(measurements: FrameMeasurements, noise: SensorNoise) -> FrameMeasurements:
    """The measurements of `with_found_noise` as they are to be gated: with more noise as long as it is not known."""
    if noise.settled or noise.seen >= ROUGHLY:
        return measurements
    free, R = measurements.by_model, measurements.R.copy()
    R[free, :2, :2] *= UNKNOWN**2
    return replace(measurements, R=R)


def noise_after(
    noise: SensorNoise, measurements: FrameMeasurements, matching: Matching, track: IntArray, time: float
) -> SensorNoise:
    """Take in the measurements of a frame at `time`, s, as they were before `with_found_noise`.

    Measurements count that are matched beyond doubt and have the noise of the model. track (k,): of the matching
    """
    sure = (matching.share >= 1) & measurements.by_model[matching.detection]
    d = matching.detection[sure]
    boxes, R = measurements.boxes.select(d), measurements.R[d, :2, :2]
    return noise.observed(time, track[sure], boxes.position[:, :2], R, boxes.label, measurements.distance[d])


def scaled_sensors(sensors: Mapping[str, Sensor], found: Mapping[str, SensorNoise]) -> dict[str, Sensor]:
    """The models with the noise of positions that was found."""
    result = dict(sensors)
    for name, noise in found.items():
        model = sensor_model(sensors, name)
        grown = dict.fromkeys([DEFAULT, *model.noise], (noise.scale, 0.0)) | dict(noise.growing)
        by_class = {label: _scaled(class_settings(model.noise, NoiseModel, label), *s) for label, s in grown.items()}
        result[name] = replace(model, noise=by_class)
    return result


def _scaled(noise: NoiseModel, a: float, g: float) -> NoiseModel:
    along, across = (math.hypot(a * each, g * noise.position) for each in (noise.range_noise, noise.bearing_noise))
    return replace(noise, position=a * noise.position, range_noise=along, bearing_noise=across)
