r"""Offsets of the sensors' clocks, from objects that two sensors have seen at about the same moment.

A sensor with the clock error o stamps a measurement of time t with t + o. Of an object with velocity v that two sensors
a and b have measured at z_a and z_b,

    (tau_a - tau_b) - (z_a - z_b)^T v / |v|^2  =  o_a - o_b + noise,
    variance  =  (u^T (R_a + R_b) u + s^2 u^T P_v u) / |v|^2,     u = v / |v|,

where tau are the timestamps as sent and s is the time between the two measurements. Positions and velocities are
those that the sensor itself has measured, the velocity from its earlier frames: nothing depends on tracks, which a
wrong clock spoils. Each frame is compared once with the latest frame of each other sensor; all
pairs of detections of one class are candidates that lie on a line along v, up to `WINDOW` s apart. False pairs scatter,
true ones agree: the estimate is the mean of the densest cluster, as a line over time where the clocks drift apart.

The offset of a sensor against the consensus is the median, weighted by record, of its offsets against all sensors,
itself (0) included. So of three sensors the one that is wrong is told from the others; of two, the one with the shorter
record is taken to be wrong, and a sensor in time is trusted before one that is not.

A frame that was left out for its time is compared like one that was used, without any influence on the tracks. A sensor
whose offset is steady, well known and worth it is corrected from then on: so one whose frames were left out comes back.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from saga_fg.numerics import BoolArray, FloatArray, StrArray
from saga_fg.tracking.clock import Clock, weighted_median
from saga_fg.tracking.measurements import FrameMeasurements

log = logging.getLogger(__name__)

WINDOW = 2.5  # s; candidates are up to this far apart along their velocity
MIN_SPEED = 2.0  # m/s; slower objects tell little, and errors of their velocity matter
SPEED_RATIO = 9.0  # squared speed by its variance, from which a velocity counts as known
ACROSS = 9.0  # squared deviations across the velocity
LONGEST_STEP, FASTEST = 1.0, 40.0  # s, m/s; objects are found again in a sensor's next frame up to these
BASELINE = 0.8  # s, over which velocities are measured
MAX_OBJECTS = 24  # of a frame
MAX_SAMPLES = 400  # of a pair of sensors
MAX_SENSORS = 12  # whose frames are compared
TRIM = 3.5  # deviations from the cluster, beyond which a sample is none of it
FEWEST = 25  # samples of an estimate that is used
SHORTEST = 2.0  # s of samples of an estimate that is used
OFTEN = 16  # samples from one estimate to the next
SUREST, SURE = 0.01, 0.03  # s; standard deviation of a small and a large offset that are used, at most
MIN_SHARE = 0.4  # of the samples, that have to agree
EMPTY: FloatArray = np.empty(0)
MIN_OFFSET = 0.03  # s; smaller offsets are left alone, since sensors also differ in where they see an object


@dataclass(frozen=True, eq=False)
class SeenObjects:
    """k objects in the latest frame of a sensor.

    sensor             its name
    stamp              its timestamp as sent, s
    label              (k,) classes
    position           (k, 2) as measured, world, m
    variance           (k,) of a coordinate, m^2
    velocity           (k, 2) between the anchor and the frame before this one, m/s, NaN where unknown
    velocity_variance  (k,) of a component, (m/s)^2
    anchor             (k, 2) earlier positions, m
    anchor_stamp       (k,) and their times on the sensor's clock, s
    compared           sensors whose frames it was compared with
    """

    sensor: str
    stamp: float
    label: StrArray
    position: FloatArray
    variance: FloatArray
    velocity: FloatArray
    velocity_variance: FloatArray
    anchor: FloatArray
    anchor_stamp: FloatArray
    compared: tuple[str, ...] = ()

    @classmethod
    def first_seen(
        cls, sensor: str, stamp: float, label: StrArray, position: FloatArray, variance: FloatArray
    ) -> SeenObjects:
        """Objects of which nothing is known from earlier frames."""
        k = len(label)
        unknown = np.full((k, 2), np.nan)
        return cls(
            sensor=sensor,
            stamp=stamp,
            label=label,
            position=position,
            variance=variance,
            velocity=unknown,
            velocity_variance=unknown[:, 0],
            anchor=position,
            anchor_stamp=np.full(k, stamp),
        )

    def after(self, before: SeenObjects) -> SeenObjects:
        """With the velocities of objects that are in the frame before as well."""
        interval = self.stamp - before.stamp
        if not 0 < interval <= LONGEST_STEP or len(self.label) == 0 or len(before.label) == 0:
            return self
        apart = np.hypot(*(self.position[:, None] - before.position[None]).transpose(2, 0, 1))
        apart[self.label[:, None] != before.label[None]] = np.inf
        j, rows = apart.argmin(axis=1), np.arange(len(apart))
        nearest = apart[rows, j]
        mutual = (apart.argmin(axis=0)[j] == rows) & (nearest <= FASTEST * interval)
        apart[rows, j] = np.inf
        i = (mutual & (apart.min(axis=1) > 2 * nearest)).nonzero()[0]
        j = j[i]
        age = before.stamp - before.anchor_stamp[j]
        far = before.position[j] - before.anchor[j]
        half = np.where(age > BASELINE, 0.5, 0.0)  # an old anchor moves on half the way
        velocity, of_velocity = self.velocity.copy(), self.velocity_variance.copy()
        anchor, anchor_stamp = self.anchor.copy(), self.anchor_stamp.copy()
        known = (age >= BASELINE / 3).nonzero()[0]
        velocity[i[known]] = far[known] / age[known, None]
        of_velocity[i[known]] = 2 * self.variance[i[known]] / age[known] ** 2
        anchor[i], anchor_stamp[i] = before.anchor[j] + half[:, None] * far, before.anchor_stamp[j] + half * age
        return replace(self, velocity=velocity, velocity_variance=of_velocity, anchor=anchor, anchor_stamp=anchor_stamp)


@dataclass(frozen=True)
class OffsetEstimate:
    """Offset of one clock against another, or against the consensus.

    offset        s; positive: its timestamps are too late
    deviation     its standard deviation, s
    drift         s in a second, and its standard deviation
    observations  shared observations it rests on
    agreed        whether most of the samples are among these
    steady        whether they are enough, too, and tell the offset well
    """

    offset: float
    deviation: float
    drift: float
    drift_deviation: float
    observations: int
    agreed: bool
    steady: bool


@dataclass(frozen=True, eq=False)
class PairSamples:
    """Samples of the offset of sensor `first` less that of sensor `second`.

    time, offset, variance  (n,) each, of the latest samples; s, s, s^2
    estimate                from most of them, None while there are too few
    fresh                   samples since that estimate
    """

    first: str
    second: str
    time: FloatArray
    offset: FloatArray
    variance: FloatArray
    estimate: OffsetEstimate | None = None
    fresh: int = 0

    def added(self, time: float, offset: FloatArray, variance: FloatArray) -> PairSamples:
        """With further samples, of one time."""
        n = len(offset)
        new = replace(
            self,
            time=np.concatenate([self.time, np.full(n, time)])[-MAX_SAMPLES:],
            offset=np.concatenate([self.offset, offset])[-MAX_SAMPLES:],
            variance=np.concatenate([self.variance, variance])[-MAX_SAMPLES:],
            fresh=self.fresh + n,
        )
        return replace(new, estimate=new.estimated(), fresh=0) if new.fresh >= OFTEN else new

    def estimated(self) -> OffsetEstimate | None:
        """The offset at the time of the latest sample; None without a cluster."""
        inside = _cluster(self.offset, self.variance)
        n = int(inside.sum())
        if n < 3:
            return None
        time, offset, weight = self.time[inside], self.offset[inside], 1 / self.variance[inside]
        total = weight.sum()
        centre, mean = (weight @ time) / total, (weight @ offset) / total
        s, latest = time - centre, time[-1]
        spread = weight @ s**2
        slope = (weight @ (s * offset)) / spread if spread > 0 else 0.0
        chi2 = weight @ (offset - mean - slope * s) ** 2
        factor = max(1.0, math.sqrt(chi2 / max(n - 2, 1)))
        deviation, of_slope = factor / math.sqrt(total), factor / math.sqrt(spread) if spread > 0 else math.inf
        drifts = abs(slope) > 4 * of_slope
        if drifts:
            mean, deviation = mean + slope * (latest - centre), math.hypot(deviation, of_slope * (latest - centre))
        agreed = n >= MIN_SHARE * len(self.offset)
        sure = deviation <= max(SUREST, min(abs(mean) / 10, SURE))
        steady = agreed and n >= FEWEST and time[-1] - time[0] >= SHORTEST and sure
        return OffsetEstimate(float(mean), float(deviation), float(slope), float(of_slope), n, agreed, bool(steady))

    @property
    def settled(self) -> bool:
        """Return True if further samples will not change much: there are enough that agree, or none do."""
        found = self.estimate
        return found is not None and (found.steady or (not found.agreed and len(self.offset) >= MAX_SAMPLES / 2))


@dataclass(frozen=True, eq=False)
class SharedObservations:
    """The latest frames of the sensors, and the samples of all pairs of them. A value: methods return a new one."""

    seen: tuple[SeenObjects, ...] = ()
    pairs: tuple[PairSamples, ...] = ()

    def with_frame(self, frame: SeenObjects, time: float) -> SharedObservations:
        """After a frame at a time of the tracker, s, which is compared with the latest one of each other sensor."""
        others, pairs = [], {(each.first, each.second): each for each in self.pairs}
        for other in self.seen:
            if other.sensor == frame.sensor:
                frame = frame.after(other)
        for other in self.seen:
            if other.sensor == frame.sensor:
                continue
            if frame.sensor not in other.compared:
                a, b = (frame, other) if frame.sensor < other.sensor else (other, frame)
                key = a.sensor, b.sensor
                known = pairs.get(key) or PairSamples(*key, EMPTY, EMPTY, EMPTY)
                offset, variance = _candidates(a, b, known)
                if len(offset):
                    pairs[key] = known.added(time, offset, variance)
                other = replace(other, compared=(*other.compared, frame.sensor))
                frame = replace(frame, compared=(*frame.compared, other.sensor))
            others.append(other)
        return SharedObservations((*others, frame)[-MAX_SENSORS:], tuple(pairs.values()))

    def without(self, sensor: str) -> SharedObservations:
        """Without what is known of a sensor, whose clock has changed."""
        pairs = tuple(each for each in self.pairs if sensor not in (each.first, each.second))
        return SharedObservations(tuple(each for each in self.seen if each.sensor != sensor), pairs)

    def estimates(self, records: Mapping[str, float]) -> dict[str, OffsetEstimate]:
        """The offset of each sensor against the consensus of those with these records."""
        against: dict[str, dict[str, OffsetEstimate]] = {}
        open_ = set()
        for pair in self.pairs:
            known, found = {pair.first, pair.second} <= records.keys(), pair.estimate
            if known and not pair.settled:
                open_ |= {pair.first, pair.second}
            if known and found is not None and found.agreed:
                against.setdefault(pair.first, {})[pair.second] = found
                opposite = replace(found, offset=-found.offset, drift=-found.drift)
                against.setdefault(pair.second, {})[pair.first] = opposite
        places = {sensor: place for place, sensor in enumerate(records)}
        weights = {s: (len(found), round(records[s], 1), -places[s], records[s]) for s, found in against.items()}
        estimates = {sensor: _consensus(sensor, found, weights) for sensor, found in against.items()}
        return {sensor: replace(e, steady=e.steady and sensor not in open_) for sensor, e in estimates.items()}


def _consensus(
    sensor: str, against: Mapping[str, OffsetEstimate], weights: Mapping[str, tuple[float, ...]]
) -> OffsetEstimate:
    """The median of the offsets against others, and that against itself, by the last of the `weights`, the record.

    Of two sensors the one of more weight is right: with more others to compare with, of a better record, heard first.
    """
    own = replace(min(against.values(), key=lambda each: each.deviation), offset=0.0, drift=0.0)
    if len(against) == 1:
        ((other, each),) = against.items()
        return each if weights[other] > weights[sensor] else own
    votes = [(each.offset, weights[other][-1]) for other, each in against.items()]
    median = weighted_median([*votes, (0.0, weights[sensor][-1])])
    return next((each for each in against.values() if each.offset == median), own)


def _candidates(a: SeenObjects, b: SeenObjects, known: PairSamples) -> tuple[FloatArray, FloatArray]:
    """Samples of the offset of sensor a less that of b, and their variances: of each object of `a` the best one."""
    moving_a, moving_b = _moving(a), _moving(b)
    velocity = np.where(moving_a[:, None, None], a.velocity[:, None], b.velocity[None])
    of_velocity = np.where(moving_a[:, None], a.velocity_variance[:, None], b.velocity_variance[None])
    possible = (a.label[:, None] == b.label[None]) & (moving_a[:, None] | moving_b[None])
    i, j = possible.nonzero()
    v, apart = velocity[i, j], a.position[i] - b.position[j]
    speed2 = (v**2).sum(axis=1)
    along = (apart * v).sum(axis=1) / speed2
    across2 = (apart[:, 0] * v[:, 1] - apart[:, 1] * v[:, 0]) ** 2 / speed2
    variance = a.variance[i] + b.variance[j] + along**2 * of_velocity[i, j]
    near = ((np.abs(along) <= WINDOW) & (across2 <= ACROSS * variance)).nonzero()[0]
    offset, variance = (a.stamp - b.stamp) - along[near], variance[near] / speed2[near]
    expected = known.estimate
    if expected is None or expected.observations < FEWEST:
        return offset, variance
    away = np.abs(offset - expected.offset)
    order = np.argsort(away, kind="stable")
    first = np.unique(i[near][order], return_index=True)[1]  # one object of b for each of a
    chosen = np.sort(order[first])
    return offset[chosen], variance[chosen]


def _moving(objects: SeenObjects) -> BoolArray:
    """(k,) objects whose velocity is known well enough to tell time by."""
    speed2 = (objects.velocity**2).sum(axis=1)
    return np.asarray((speed2 >= MIN_SPEED**2) & (speed2 >= SPEED_RATIO * objects.velocity_variance))


def _cluster(offset: FloatArray, variance: FloatArray) -> BoolArray:
    """(n,) samples of the densest cluster."""
    if len(offset) == 0:
        return np.zeros(0, dtype=bool)
    deviation = np.sqrt(variance)
    width = 4 * float(np.median(deviation))
    ordered = np.sort(offset)
    count = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    best = int(count.argmax())
    centre = float(np.median(ordered[best : best + count[best]]))
    inside = np.abs(offset - centre) <= TRIM * deviation
    for _ in range(3):
        if not inside.any():
            break
        weight = 1 / variance[inside]
        centre = float(weight @ offset[inside] / weight.sum())
        inside = np.abs(offset - centre) <= TRIM * deviation
    return np.asarray(inside)


@dataclass(frozen=True)
class SensorTime:
    """The clock of a sensor against the consensus of all.

    offset     s; positive: its timestamps are too late. By objects in common, else by the order of arrival
    deviation  its standard deviation, s
    drift      s in a second, 0 where unknown
    jitter     mean deviation of its steps from the usual one, s
    step       its usual time between two frames, s
    corrected  offset that is subtracted from its timestamps, s
    objects    shared observations that the offset rests on, 0 where it rests on the order of arrival
    verdict    whether its latest frame was used
    """

    offset: float
    deviation: float
    drift: float
    jitter: float
    step: float
    corrected: float
    objects: int
    verdict: Literal["used", "left out"]


def sensor_times(clock: Clock, shared: SharedObservations) -> dict[str, SensorTime]:
    """The clocks of all sensors with a usual step, by name."""
    known = [each for each in clock.sensors if each.step > 0]
    found = shared.estimates(clock.records())
    leads = {r.name: r.offset + (r.lead if r.doubt is None else r.doubt - clock.newest) for r in known}
    usual = weighted_median((leads[r.name], r.record) for r in known) if known else 0.0
    result = {}
    for each in known:
        estimate = found.get(each.name)
        if estimate is None:  # a frame may have arrived anywhere in a step
            values = leads[each.name] - usual, each.step / math.sqrt(12) + each.jitter, 0.0
        else:
            values = estimate.offset, estimate.deviation, estimate.drift
        count = 0 if estimate is None else estimate.observations
        used: Literal["used", "left out"] = "used" if each.doubt is None else "left out"
        result[each.name] = SensorTime(*values, each.jitter, each.step, each.offset, count, used)
    return result


def compared(
    clock: Clock, shared: SharedObservations, stamp: float, measurements: FrameMeasurements
) -> tuple[Clock, SharedObservations]:
    """Compare a frame with this timestamp, s, with those of the other sensors, and correct the clocks that are known.

    Nothing happens with a single sensor, and where positions depend on an estimated pose of the vehicle.
    """
    if len(clock.sensors) < 2 or measurements.relative is not None:
        return clock, shared
    d = np.argsort(-measurements.probability, kind="stable")[:MAX_OBJECTS]
    R, boxes = measurements.R[d], measurements.boxes
    variance = (R[:, 0, 0] + R[:, 1, 1]) / 2
    objects = SeenObjects.first_seen(measurements.name, stamp, boxes.label[d], boxes.position[d, :2], variance)
    now = shared.with_frame(objects, clock.elapsed)
    if all(a.estimate is b.estimate for a, b in zip(shared.pairs, now.pairs, strict=False)):
        return clock, now
    for name, found in now.estimates(clock.records()).items():
        own = clock.sensor(name)
        assert own is not None
        if found.steady and (own.offset != 0 or abs(found.offset) > max(MIN_OFFSET, 4 * found.deviation)):
            offset = round(found.offset, 6)
            if own.offset == 0:
                text = "the clock of %s is %+.3f s off (+- %.3f s), by %d objects in common: corrected from now on"
                log.warning(text, name, offset, found.deviation, found.observations)
            clock = clock.corrected(name, offset)
    return clock, now
