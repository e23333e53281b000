"""Labelled objects of a recording, detections matched to them, samples from these, and gaps made in it.

The labelled objects of a recording over its moments, and which detections are of which object.

A detection is of the nearest labelled object, of its class, if that is within `REACH`. So a duplicate beside the
neighbour of a hidden object is the neighbour's.

Match the detections of a recording to the true objects: one to one, by least distances, within a gate.

True positions between two annotated times are interpolated. An object was in view where the annotations call it
visible.

A gap lasts from the last moment with a detection before it to the first moment with one after it. An object *moves* if
it travels faster than `MOVING` over the gap.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from saga_fg.errors import InputError
from saga_fg.learning.process_noise import MeasuredTrajectory
from saga_fg.model import Sensor, sensor_model
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, assign, wrap_angle
from saga_fg.tracking import ConfusedClasses
from saga_fg.types import Annotations, Boxes, Detections, Frame, LabelledObjects, Scene

REACH = 2.0  # m, from an object to its detections
MIN_STEP = 0.05  # s, between two detections of an object


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """N objects at the K moments of a scene, NaN where they are not labelled.

    id, label (N,); position (K, N, 2), m, world; detected (K, N) whether some detection is of the object
    velocity  (K, N, 2), m/s, world, by differences of positions where the labels have none; yaw (K, N), rad
    owner     for each frame, the object (D,) that each detection is of, whatever its class; -1: none
    boxes     for each frame, its detections in the world
    """

    scene: Scene
    id: StrArray
    label: StrArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    detected: BoolArray
    owner: tuple[IntArray, ...]
    boxes: tuple[Boxes, ...]

    @classmethod
    def from_scene(cls, scene: Scene, sensors: Mapping[str, Sensor]) -> LabelledScene:
        """Raises `InputError` for a scene without ground truth or detections."""
        if scene.ground_truth is None or not scene.frames:
            missing = "detections" if scene.ground_truth is not None else "ground truth"
            raise InputError(f"scene {scene.name}: expected {missing} to find gaps in, there are none")
        truth = scene.ground_truth
        objects = LabelledObjects.from_scene(scene)
        rows = [np.searchsorted(objects.id, moment.id) for moment in truth]
        detected = np.zeros((len(truth), len(objects.id)), dtype=np.bool_)
        owners, found = [], []
        for frame in scene.frames:
            k = int(np.argmin(np.abs(scene.timestamps - frame.timestamp)))
            boxes = sensor_model(sensors, frame.sensor).in_world(frame).boxes
            distance = _distances(boxes, truth[k], frame.timestamp - float(scene.timestamps[k]))
            owners.append(_nearest(distance, rows[k]))
            found.append(boxes)
            distance[boxes.label[:, None] != truth[k].boxes.label] = np.inf
            same = _nearest(distance, rows[k])
            detected[k, same[same >= 0]] = True
        position, velocity = objects.position, objects.velocity
        velocity = np.where(np.isfinite(velocity), velocity, _differences(position, scene.timestamps))
        about = objects.id, objects.label, position, velocity, objects.heading
        return cls(scene, *about, detected, tuple(owners), tuple(found))

    def frames_without(self, row: IntArray, start: FloatArray, stop: FloatArray) -> list[Frame]:
        """The frames without the detections of objects `row` (W,) after `start` and before `stop` (W,), s."""
        kept = []
        for frame, owner in zip(self.scene.frames, self.owner, strict=True):
            hidden = row[(start < frame.timestamp - 1e-6) & (frame.timestamp + 1e-6 < stop)]
            gone = np.isin(owner, hidden)
            kept.append(replace(frame, detections=frame.detections.select(~gone)) if gone.any() else frame)
        return kept


def _differences(position: FloatArray, time: FloatArray) -> FloatArray:
    """(K, N, 2) m/s from the moment before, or to the one after where that is not labelled."""
    step = np.diff(position, axis=0) / np.diff(time)[:, None, None]
    nothing = np.full((1, *position.shape[1:]), np.nan)
    before, after = np.concatenate([nothing, step]), np.concatenate([step, nothing])
    return np.where(np.isfinite(before), before, after)


def _distances(boxes: Boxes, truth: Annotations, elapsed: float) -> FloatArray:
    """(D, M), m, from detections to labelled objects, moved on by `elapsed` s."""
    there = truth.boxes.position[:, :2] + np.nan_to_num(truth.boxes.velocity) * elapsed
    offset = boxes.position[:, None, :2] - there
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))


def _nearest(distance: FloatArray, rows: IntArray) -> IntArray:
    """(D,) the object of `rows` (M,) that is nearest to each detection, -1 where none is within reach."""
    if distance.shape[1] == 0:
        return np.full(len(distance), -1, dtype=np.int64)
    nearest = distance.argmin(axis=1)
    within = distance[np.arange(len(distance)), nearest] <= REACH
    return np.where(within, rows[nearest], -1)


@dataclass(frozen=True, eq=False)
class SampledDetections(Columns):
    """N detections; what is not known is NaN.

    label, logit         (N,)    class; logit of the detector's score
    range, azimuth       (N,)    from the sensor, m and rad from straight ahead
    true                 (N,)    whether it is of an object
    along, across        (N,)    error of the position along and across the line of sight, m
    velocity             (N, 2)  error, m/s
    yaw, height          (N,)    error, rad (half a turn counts as none) and m
    """

    label: StrArray
    logit: FloatArray
    range: FloatArray
    azimuth: FloatArray
    true: BoolArray
    along: FloatArray
    across: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    height: FloatArray

    @classmethod
    def without_errors(
        cls, label: StrArray, logit: FloatArray, distance: FloatArray, azimuth: FloatArray, true: BoolArray
    ) -> SampledDetections:
        """Detections whose errors are not known."""
        nan = np.full(len(label), np.nan)
        return cls(
            label=label,
            logit=logit,
            range=distance,
            azimuth=azimuth,
            true=true,
            along=nan,
            across=nan,
            velocity=np.column_stack([nan, nan]),
            yaw=nan,
            height=nan,
        )


@dataclass(frozen=True, eq=False)
class SampledObjects(Columns):
    """M objects in view of a frame: class, range (m) and azimuth (rad) from the sensor, whether it was detected."""

    label: StrArray
    range: FloatArray
    azimuth: FloatArray
    detected: BoolArray

    @classmethod
    def empty(cls) -> SampledObjects:
        return cls(np.empty(0, dtype=np.str_), np.empty(0), np.empty(0), np.empty(0, dtype=bool))


class DetectionSample(NamedTuple):
    """Detections of one sensor, and the objects that it could detect."""

    detections: SampledDetections
    objects: SampledObjects

    @classmethod
    def pool(cls, parts: Sequence[DetectionSample]) -> DetectionSample:
        """One sample of all parts, of which there is at least one."""
        detections, objects = zip(*parts, strict=True)
        return cls(SampledDetections.concatenate(detections), SampledObjects.concatenate(objects))


GATE = 4.0  # m; poor sensors err by metres, and the fits allow for wrong matches


@dataclass(frozen=True, eq=False)
class MatchedFrame:
    """A frame in world coordinates with the truth at its time; detection[k] is of the object truth[k].

    origin (2,): place of the sensor, None where the pose is unknown
    """

    frame: Frame
    detections: Detections
    origin: FloatArray | None
    annotations: Annotations
    detection: IntArray
    truth: IntArray


def match_to_truth(scene: Scene, sensors: Mapping[str, Sensor], gate: float = GATE) -> Iterator[MatchedFrame]:
    """The frames between the first and the last annotated moment, matched class by class within `gate`, m.

    Of classes that the sensors confuse, also across classes within half of it.
    Raises `InputError` for a scene without ground truth.
    """
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth")
    confused = ConfusedClasses.of(sensors, {})
    for frame in scene.frames:
        sensor = sensor_model(sensors, frame.sensor)
        time = sensor.measured_at(frame)
        k = int(np.searchsorted(scene.timestamps, time - 1e-6))
        if k >= len(scene) or (k == 0 and time < scene.timestamps[0] - 1e-6):
            continue
        annotations = _truth_at(scene, k, time)
        detections = sensor.in_world(frame)
        boxes, truth = detections.boxes, annotations.boxes
        distance = np.hypot(*np.moveaxis(boxes.position[:, None, :2] - truth.position[None, :, :2], -1, 0))
        group, true_group = confused.numbers(boxes.label, truth.label)
        same, akin = boxes.label[:, None] == truth.label, group[:, None] == true_group
        possible = distance < np.where(same, gate, gate / 2 * akin)
        yield MatchedFrame(
            frame, detections, sensor.origin(frame), annotations, *assign(distance, possible, unmatched=gate)
        )


def sample_with_truth(scenes: Iterable[Scene], sensors: Mapping[str, Sensor]) -> dict[str, DetectionSample]:
    """A sample of each sensor of annotated scenes. Raises `InputError` for a scene without ground truth."""
    parts: dict[str, list[DetectionSample]] = {}
    for scene in scenes:
        for matched in match_to_truth(scene, sensors):
            sensor = sensor_model(sensors, matched.frame.sensor)
            parts.setdefault(matched.frame.sensor, []).append(_sample(matched, sensor))
    return {name: DetectionSample.pool(part) for name, part in parts.items()}


def measured_trajectories(
    scenes: Iterable[Scene], sensors: Mapping[str, Sensor]
) -> dict[str, list[MeasuredTrajectory]]:
    """Class -> the measured positions and headings of each of its objects, by the nearest detection of the class within
    `REACH`.

    Of detections of one object closer in time than `MIN_STEP` only the first is taken. Their covariances are those of
    the sensors' models. Raises `InputError` for a scene without ground truth.
    """
    found: dict[str, list[MeasuredTrajectory]] = {}
    for scene in scenes:
        objects: dict[tuple[str, str], list[tuple[float, FloatArray, FloatArray, float, float]]] = {}
        for matched in match_to_truth(scene, sensors, REACH):
            truth, sensor = matched.annotations, sensor_model(sensors, matched.frame.sensor)
            time = sensor.measured_at(matched.frame)
            boxes = matched.detections.boxes
            R = sensor.detection_covariance(matched.detections, matched.origin)[:, :2, :2]
            (yaw_noise,) = sensor.deviations(boxes.label, "yaw")
            for j, i in zip(matched.detection.tolist(), matched.truth.tolist(), strict=True):
                rows = objects.setdefault((str(truth.boxes.label[i]), str(truth.id[i])), [])
                if not rows or time - rows[-1][0] >= MIN_STEP:
                    rows.append((time, boxes.position[j, :2], R[j], boxes.yaw[j], yaw_noise[j]))
        for (label, _), rows in objects.items():
            found.setdefault(label, []).append(MeasuredTrajectory(*map(np.array, zip(*rows, strict=True))))
    return found


def _sample(matched: MatchedFrame, sensor: Sensor) -> DetectionSample:
    boxes, truth = matched.detections.boxes, matched.annotations.boxes
    n, d, t = len(boxes), matched.detection, matched.truth
    pose = matched.frame.world_T_ego
    distance, azimuth = sensor.polar(boxes.position[:, :2], pose)
    sight = boxes.position[d, :2] - (np.nan if matched.origin is None else matched.origin)
    u = sight / np.maximum(distance[d], 1e-9)[:, None]
    error = boxes.position[d] - truth.position[t]
    true, detected = np.zeros(n, dtype=bool), np.zeros(len(truth), dtype=bool)
    true[d], detected[t] = True, True
    detections = SampledDetections.without_errors(
        boxes.label, sensor.logit(matched.detections.score), distance, azimuth, true
    )
    errors = {
        "along": (error[:, :2] * u).sum(axis=1),
        "across": error[:, 1] * u[:, 0] - error[:, 0] * u[:, 1],
        "velocity": boxes.velocity[d] - truth.velocity[t],
        "yaw": wrap_angle(2 * (boxes.yaw[d] - truth.yaw[t])) / 2,
        "height": error[:, 2],
    }
    for name, values in errors.items():
        column = np.full((n, *values.shape[1:]), np.nan)
        column[d] = values
        errors[name] = column
    objects = SampledObjects(truth.label, *sensor.polar(truth.position[:, :2], pose), detected)
    return DetectionSample(replace(detections, **errors), objects.select(matched.annotations.visible))


def _truth_at(scene: Scene, k: int, time: float) -> Annotations:
    """The true objects at a time between moments k - 1 and k."""
    assert scene.ground_truth is not None
    after = scene.ground_truth[k]
    if k == 0 or time >= scene.timestamps[k]:
        return after
    before = scene.ground_truth[k - 1]
    share = (scene.timestamps[k] - time) / (scene.timestamps[k] - scene.timestamps[k - 1])
    _, new, old = np.intersect1d(after.id, before.id, return_indices=True)
    position = after.boxes.position.copy()
    position[new] += share * (before.boxes.position[old] - position[new])
    return replace(after, boxes=replace(after.boxes, position=position))


MOVING = 0.5  # m/s
LONGEST = 6.0  # s, of all gaps
LENGTHS = (1.0, 2.0, 3.0, 5.0)  # s: made gaps
FOLLOWED, FOLLOWED_SHARE = 1.5, 0.8  # s before a made gap, and the share of its moments with a detection
SPACING = 20.0  # m between objects that are hidden at the same time
STARTS = 0.5  # s between moments at which a made gap may start
TRIALS = 4000  # of a pass: windows that are tried


@dataclass(frozen=True)
class Gap:
    """One object without detections after moment `start`, its last with one, until moment `stop`.

    row       of the object in the `LabelledScene`
    length    s: of a real gap from `start` to `stop`, of a made one as wanted, from `start` to the last moment without
    run       0 for real gaps, the number of the pass for made ones
    """

    row: int
    start: int
    stop: int
    length: float
    moving: bool
    run: int = 0


def reached(time: FloatArray, gap: Gap) -> dict[float, int]:
    """The moments of a gap at which the lengths that it reaches end; time (K,) of all moments."""
    period = float(np.median(np.diff(time)))
    since = time[gap.start + 1 : gap.stop] - time[gap.start]
    found = {}
    for length in LENGTHS if len(since) else ():
        k = int(np.argmin(np.abs(since - length)))
        if abs(since[k] - length) < 0.6 * period:
            found[length] = gap.start + 1 + k
    return found


def made_gaps(
    labelled: LabelledScene,
    passes: int,
    seed: int,
    lengths: Sequence[float] = LENGTHS,
    chosen: Callable[[Gap], bool] | None = None,
) -> list[Gap]:
    """Windows in which objects can be hidden: well followed before, labelled throughout, detected at the end.

    chosen  the windows that count, all if not given

    In one pass an object may be hidden several times; objects that are hidden at the same time are `SPACING` apart.
    """
    time = labelled.scene.timestamps
    if len(time) < 3:
        return []
    rng = np.random.default_rng([seed, zlib.crc32(labelled.scene.name.encode())])
    possible = [gap for gap in windows(labelled, rng, lengths) if chosen is None or chosen(gap)]
    gaps: list[Gap] = []
    for number in range(1, passes + 1):
        order = rng.permutation(len(possible))
        order = order[np.argsort([not possible[k].moving for k in order], kind="stable")]  # these are fewer
        taken = _Taken(labelled)
        for k in order[:TRIALS].tolist():
            if taken.free(possible[k]):
                taken.add(possible[k])
                gaps.append(replace(possible[k], run=number))
    return gaps


def windows(labelled: LabelledScene, rng: np.random.Generator, lengths: Sequence[float]) -> list[Gap]:
    """All gaps that are possible, by row and every `STARTS` s; a length is chosen at random for each."""
    time, found = labelled.scene.timestamps, []
    period = float(np.median(np.diff(time)))
    known = np.isfinite(labelled.position[..., 0])
    until = {length: _ends(time, length) for length in lengths}
    before = np.searchsorted(time, time - FOLLOWED - period / 4)
    stride = max(1, round(STARTS / period))
    counts = np.concatenate([np.zeros((1, len(labelled.id)), dtype=np.int64), labelled.detected.cumsum(axis=0)])
    named = np.concatenate([np.zeros((1, len(labelled.id)), dtype=np.int64), known.cumsum(axis=0)])
    for start in range(int(rng.integers(stride)), len(time), stride):
        if time[start] - time[0] < FOLLOWED - period / 2:
            continue
        first = int(before[start])
        hits = counts[start + 1] - counts[first]
        followed = labelled.detected[start] & (hits >= FOLLOWED_SHARE * (start + 1 - first))
        possible: dict[int, list[tuple[float, int]]] = {}
        for length in lengths:
            stop = int(until[length][start]) + 1
            if stop < len(time) and abs(time[stop - 1] - time[start] - length) < 0.6 * period:
                whole = named[stop + 1] - named[start] == stop + 1 - start
                for row in np.flatnonzero(followed & whole & labelled.detected[stop]).tolist():
                    possible.setdefault(row, []).append((length, stop))
        for row, choices in possible.items():
            length, stop = choices[int(rng.integers(len(choices)))]
            found.append(Gap(row, start, stop, length, is_moving(labelled, row, start, stop)))
    return found


def _ends(time: FloatArray, length: float) -> FloatArray:
    """(K,) the moment nearest to `length` s after each."""
    after = np.clip(np.searchsorted(time, time + length), 1, len(time) - 1)
    nearer = np.abs(time[after - 1] - time - length) < np.abs(time[after] - time - length)
    return np.asarray(after - nearer)


class _Taken:
    """The windows of one pass."""

    def __init__(self, labelled: LabelledScene) -> None:
        self._labelled = labelled
        self._windows: list[tuple[int, int, int]] = []

    def add(self, gap: Gap) -> None:
        self._windows.append((gap.row, gap.start, gap.stop))

    def free(self, gap: Gap) -> bool:
        """Return True if no window of the object, or of one near it, is in the way."""
        if not self._windows:
            return True
        time, position = self._labelled.scene.timestamps, self._labelled.position
        row, start, stop = np.array(self._windows).T
        apart = np.maximum(time[start] - time[gap.stop], time[gap.start] - time[stop])
        if (apart[row == gap.row] < FOLLOWED).any():
            return False
        near: BoolArray = np.zeros(len(row), dtype=np.bool_)
        for at in (np.maximum(start, gap.start), np.minimum(stop, gap.stop)):
            at = np.clip(at, gap.start, gap.stop)
            offset = position[at, row] - position[at, gap.row]
            near |= ~(np.hypot(offset[:, 0], offset[:, 1]) >= SPACING)
        return not ((apart < FOLLOWED) & (row != gap.row) & near).any()


def is_moving(labelled: LabelledScene, row: int, start: int, stop: int) -> bool:
    a, b = labelled.position[[start, stop], row]
    elapsed = float(labelled.scene.timestamps[stop] - labelled.scene.timestamps[start])
    return bool(np.hypot(*(b - a)) > MOVING * elapsed)
