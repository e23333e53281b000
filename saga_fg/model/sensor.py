"""Sensor models: noise, score calibration, place on the vehicle, field of view; a camera above flat ground.

    z = H x + v,   v ~ N(0, R)
    R = s(score)^2 ( position^2 I + (range_noise r)^2 u u^T + (bearing_noise r)^2 n n^T )

with r the range from the sensor, u the line of sight, n across it, and s growing as the score falls. A radar also
measures the range rate u . velocity, with the variance (s(score) range_rate)^2. The meaning of a score depends on the
detector and the class; its calibration makes it a probability (Platt 1999),

    P(the detection is true) = 1 / (1 + exp(-(offset + slope logit(score)))).

The motion model does not depend on the sensor, so a new sensor is a few lines of configuration.

    (X, Y, 1) ~ H (u, v, 1),    inv(H) = K [r_1 r_2 t]

takes the pixel (u, v) where an object stands, the middle of the lower edge of its box, to its place (X, Y). K has the
focal length and the centre of the image, r_1, r_2 and t are columns of the pose of the world in the camera. With the
derivative J of the place by the pixel, a foot point of covariance s^2 I has the place's covariance s^2 J J^T, to first
order. A pixel is |J e_u| wide at the foot, and as high, as objects stand upright before the camera.

Source: Hartley and Zisserman, Multiple View Geometry, 2004, sections 8.1 and 5.2 (first-order propagation).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal, Protocol

import numpy as np

from saga_fg.errors import InputError, require_type
from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray, checked, distinct, wrap_angle, yaw_transform
from saga_fg.parts import part_kind
from saga_fg.settings import (
    Finite,
    Fraction,
    NonNegative,
    Positive,
    PositiveOrInf,
    Range,
    Settings,
    setting,
    settings_group,
)
from saga_fg.types import DEFAULT, LATEST, Boxes, Detections, Frame, class_values


@dataclass(frozen=True)
class FieldOfView(Settings):
    """The field of view of a sensor, in its own frame."""

    min_azimuth: Finite = setting(
        -np.pi, "smallest azimuth, from straight ahead, left positive, rad; misses beyond do not count"
    )
    max_azimuth: Finite = setting(
        np.pi, "largest azimuth, from straight ahead, left positive, rad; misses beyond do not count"
    )
    max_range: PositiveOrInf = setting(
        80.0,
        "largest range, m; misses beyond do not count; usual 40 to 120; higher: distant tracks die of misses sooner",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_azimuth < self.min_azimuth:
            raise InputError(
                f"max_azimuth: expected at least min_azimuth {self.min_azimuth:g}, got {self.max_azimuth:g}"
            )

    def holds(self, distance: FloatArray, azimuth: FloatArray) -> BoolArray:
        """Mask (N,) of places, m and rad, inside it; unknown ones (NaN) count as inside."""
        middle, half = (self.min_azimuth + self.max_azimuth) / 2, (self.max_azimuth - self.min_azimuth) / 2
        aside = np.abs(wrap_angle(azimuth - middle))
        return np.asarray(~(distance > self.max_range) & ~(aside > half + 1e-9))


@dataclass(frozen=True)
class Extrinsics(Settings):
    """Pose of the sensor on the vehicle, ego_T_sensor, for detections given in sensor coordinates."""

    x: Finite = setting(0.0, "position of the sensor ahead of the vehicle's origin, m; usual -2 to 4")
    y: Finite = setting(0.0, "position of the sensor to the left of the vehicle's origin, m; usual -1 to 1")
    z: Finite = setting(0.0, "position of the sensor above the vehicle's origin, m; usual 0 to 2.5")
    yaw: Finite = setting(0.0, "heading of the sensor in the vehicle's frame, rad; 0: ahead, higher: further left")

    @cached_property
    def ego_T_sensor(self) -> FloatArray:
        """(4, 4), read-only."""
        transform = yaw_transform(self.x, self.y, self.z, self.yaw)
        transform.flags.writeable = False
        return transform


MAX_MEASURED_SPEED = 150.0  # m/s; no road user is faster: measured velocities and range rates above are errors
MIN_PROBABILITY = 1e-3  # of a detection, and of its being none
_LARGEST_LOGIT = 50.0  # beyond, a probability is 0 or 1 to the last digit


@dataclass(frozen=True)
class NoiseModel(Settings):
    """Measurement noise of a sensor for one class: standard deviations."""

    position: Positive = setting(
        0.3, "standard deviation of a position in every direction, m; usual 0.05 to 0.5; higher: detections count less"
    )
    range_noise: NonNegative = setting(
        0.0, "standard deviation along the line of sight per m of range; usual 0 to 0.04"
    )
    bearing_noise: NonNegative = setting(
        0.0, "standard deviation across the line of sight per m of range, rad; usual 0 to 0.01"
    )
    velocity: Positive = setting(
        1.0, "standard deviation of a component of a measured velocity, m/s; higher: measured velocities count less"
    )
    range_rate: Positive = setting(
        0.5, "standard deviation of a measured range rate, m/s; usual 0.1 to 1; higher: range rates count less"
    )
    low_score_growth: NonNegative = setting(
        0.0, "growth of all deviations at low scores, by the factor 1 + growth * (1 - probability); usual 0 to 3"
    )
    reported_deviation_scale: Positive = setting(
        1.0, "factor on the standard deviation reported for a position; higher: wider reported ellipses"
    )
    reported_low_score_growth: Annotated[float, Range(-0.99)] = setting(
        0.0, "growth of the reported deviation at low scores, by 1 + growth * (1 - probability); above -1, 0: none"
    )
    position_bias: NonNegative = setting(
        0.0,
        "standard deviation of the error that all detections of an object share, m; in reports only; usual 0 to 0.3",
    )
    position_bias_growth: NonNegative = setting(
        0.0, "growth of position_bias at low scores, by the factor 1 + growth * (1 - probability); 0: none"
    )
    yaw: Positive = setting(0.2, "standard deviation of a measured heading, rad; higher: headings are smoothed more")
    height: Positive = setting(
        0.2, "standard deviation of the height of a centre, m; higher: heights are smoothed more"
    )


@dataclass(frozen=True)
class ScoreCalibration(Settings):
    """Calibration of the scores of a class: a straight line on the logit (Platt scaling)."""

    slope: NonNegative = setting(
        1.0, "slope of the logit of the probability over the logit of the score; below 1: scores are overconfident"
    )
    offset: Finite = setting(0.0, "logit of the probability at a score of one half; lower: detections are trusted less")


@part_kind("class model", "saga_fg.class_models")
class ClassModel(Protocol):
    """Evidence of a detector's boxes about the classes of their objects."""

    @property
    def classes(self) -> tuple[str, ...]:
        """The classes that it tells apart."""

    def likelihood(self, boxes: Boxes) -> FloatArray:
        """(n, C) chance of each box, of one of its classes, if the object is of each of its `classes` (C,)."""


@part_kind("sensor model", "saga_fg.sensors")
@dataclass(frozen=True)
class Sensor(Settings):
    """Model of a sensor and its detector."""

    noise: Mapping[str, NoiseModel] = settings_group(
        lambda: {DEFAULT: NoiseModel()}, "measurement noise by class; the entry named default serves all others"
    )
    calibrate_noise: bool = setting(
        False,
        "true: scale the noise of positions, by class and range, by what successive detections say, from 1/3 to 10/3",
    )
    use_velocity: bool = setting(True, "use velocities and range rates, where they are measured")
    detection_probability: Fraction = setting(
        0.9, "probability that a visible object in the field of view is detected; higher: misses count more"
    )
    class_detection_probability: Mapping[str, Fraction] = settings_group(
        dict, "detection probability by class, where it differs; usual 0.5 to 0.95; higher: misses count more"
    )
    score: Literal["probability", "logit"] = setting("probability", "meaning of the detector's scores")
    calibration: Mapping[str, ScoreCalibration] = settings_group(
        lambda: {DEFAULT: ScoreCalibration()},
        "calibration of the scores by class; the entry named default serves all others",
    )
    confusion: Mapping[str, Mapping[str, NonNegative]] = settings_group(
        dict,
        "by true class, how many of its detections are reported as each class, counts or shares; {}: none is confused",
    )
    class_model: str | ClassModel | None = setting(
        None, "your own class model, in place of confusion, MODULE:NAME or {kind: MODULE:NAME, ...settings}; null: none"
    )
    colour_accuracy: Fraction = setting(
        0.9, "probability that the reported colour of a traffic light is right; higher: beliefs change faster"
    )
    clutter_area: PositiveOrInf | None = setting(
        None, "area over which false detections spread, m^2; null: that of `tracker.association`"
    )
    initiation: Literal["alone", "confirmed"] = setting(
        "alone",
        "new tracks count at once (alone), or (confirmed) once another sensor has detected them, and after three "
        "detections where no sensor of the first kind looks",
    )
    field_of_view: FieldOfView = settings_group(FieldOfView, "where the sensor can detect")
    extrinsics: Extrinsics = settings_group(Extrinsics, "pose on the vehicle, for detections in sensor coordinates")
    time_offset: Annotated[float, Range(-LATEST, LATEST)] = setting(
        0.0, "added to the sensor's timestamps to get the time of measurement, s; usual -0.1 to 0"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for label, reported in self.confusion.items():
            if not reported.get(label, 0.0) > 0:
                raise InputError(
                    f"confusion.{label}: expected a share above 0 of {label} itself, got {dict(reported)!r}"
                )

    def logit(self, score: FloatArray) -> FloatArray:
        """The logits (N,) of the detector's own scores, before calibration; of probabilities in [0.001, 0.999]."""
        if self.score == "probability":
            p = np.asarray(score, dtype=np.float64).clip(MIN_PROBABILITY, 1 - MIN_PROBABILITY)
            return np.asarray(np.log(p / (1 - p)))
        return np.asarray(score, dtype=np.float64).clip(-_LARGEST_LOGIT, _LARGEST_LOGIT)

    def probability(self, score: FloatArray, label: StrArray) -> FloatArray:
        """The detector's scores (N,) of objects of these classes (N,) as probabilities in [0.001, 0.999]."""
        return self.calibrated(self.logit(score), label)

    def calibrated(self, logit: FloatArray, label: StrArray) -> FloatArray:
        """The probabilities (N,) of scores with these logits (N,) before calibration."""
        slope, offset = class_values(self.calibration, ScoreCalibration, label, "slope", "offset")
        p = 1 / (1 + np.exp(-(offset + slope * logit).clip(-50, 50)))
        return np.asarray(p.clip(MIN_PROBABILITY, 1 - MIN_PROBABILITY))

    def detection_chance(self, label: StrArray) -> FloatArray:
        """(N,) chance that a visible object of each class in the field of view is detected."""
        occurring, index = distinct(label)
        chance = [self.class_detection_probability.get(c, self.detection_probability) for c in occurring]
        return np.array(chance, dtype=np.float64)[index]

    def deviations(self, label: StrArray, *names: str) -> FloatArray:
        """(k, N) the noise parameters of these names, of the class of each label (N,)."""
        return class_values(self.noise, NoiseModel, label, *names)

    def position_covariance(
        self, label: StrArray, position: FloatArray, probability: FloatArray, origin: FloatArray
    ) -> FloatArray:
        """R (N, 2, 2), m^2, of positions (N, 2) seen from `origin` (2,), the sensor's place, all in one frame.

        Where each has an origin (N, 2) of its own that is the position itself, range and bearing add no noise.
        """
        return self._covariance(label, position - origin, probability, np.full((len(label), 2, 2), np.nan))[:, :2, :2]

    def detection_covariance(
        self, detections: Detections, origin: FloatArray | None, probability: FloatArray | None = None
    ) -> FloatArray:
        """R (N, 4, 4) of positions, m^2, and velocities, (m/s)^2, in the world; origin (2,): the sensor's place.

        Without a place of the sensor (None) the range is unknown, and its part of the noise is left out. A covariance
        that came with the detection is taken as it is. probability (N,): of the scores, where it is known already.
        """
        label, position = detections.boxes.label, detections.boxes.position[:, :2]
        probability = self.probability(detections.score, label) if probability is None else probability
        offset = position - (position if origin is None else origin)
        return self._covariance(label, offset, probability, detections.position_covariance)

    def _covariance(
        self, label: StrArray, offset: FloatArray, probability: FloatArray, reported: FloatArray
    ) -> FloatArray:
        """R (N, 4, 4) at offsets (N, 2) from the sensor; `reported` (N, 2, 2) of positions, where finite."""
        names = "position", "range_noise", "bearing_noise", "velocity", "low_score_growth"
        own, along, across, velocity, growth = self.deviations(label, *names)
        factor, (x, y), R = (1 + growth * (1 - probability)) ** 2, offset.T, np.zeros((len(label), 4, 4))
        isotropic, ray = factor * (own**2 + across**2 * (x * x + y * y)), factor * (along**2 - across**2)
        R[:, 0, 0], R[:, 1, 1] = isotropic + ray * (x * x), isotropic + ray * (y * y)
        R[:, 0, 1] = R[:, 1, 0] = ray * (x * y)
        R[:, 2, 2] = R[:, 3, 3] = factor * velocity**2
        known = np.isfinite(reported[:, 0, 0])
        R[known, :2, :2] = reported[known]
        return R

    def range_rate_variance(self, label: StrArray, probability: FloatArray) -> FloatArray:
        """(N,), (m/s)^2."""
        deviation, low_score_growth = self.deviations(label, "range_rate", "low_score_growth")
        return np.asarray((deviation * (1 + low_score_growth * (1 - probability))) ** 2)

    def covariance_calibration(self, label: StrArray, probability: FloatArray) -> tuple[FloatArray, FloatArray]:
        """For reported covariances of positions (N,): the factor on deviations, and the deviation of the bias, m."""
        scale, bias, scale_growth, bias_growth = self.deviations(
            label, "reported_deviation_scale", "position_bias", "reported_low_score_growth", "position_bias_growth"
        )
        doubt = 1 - probability
        return scale * (1 + scale_growth * doubt), bias * (1 + bias_growth * doubt)

    def measured_at(self, frame: Frame) -> float:
        """Time at which a frame of this sensor was measured, s."""
        return frame.timestamp + self.time_offset

    def in_world(self, frame: Frame) -> Detections:
        """The detections of a frame of this sensor, in world coordinates; `InputError` where the pose is unknown."""
        if frame.coordinates == "world":
            return frame.detections
        if frame.world_T_ego is None:
            raise InputError("world_T_ego: expected a pose, since nothing estimates it (tracker.ego.estimated)")
        ego_T_source = self.extrinsics.ego_T_sensor if frame.coordinates == "sensor" else np.eye(4)
        return frame.detections.transformed(frame.world_T_ego @ ego_T_source)

    def origin(self, frame: Frame) -> FloatArray | None:
        """Place of the sensor (2,), world, m; None where the pose is unknown."""
        pose = frame.world_T_ego
        return None if pose is None else np.asarray((pose @ self.extrinsics.ego_T_sensor)[:2, 3])

    def sees(self, position: FloatArray, world_T_ego: FloatArray | None) -> BoolArray:
        """Mask (N,) of positions (N, 2), world, in the field of view; all where the pose is unknown."""
        return self.field_of_view.holds(*self.polar(position, world_T_ego))

    def polar(self, position: FloatArray, world_T_ego: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Range (N,), m, and azimuth (N,), rad, of positions (N, 2), world, NaN where the pose is unknown."""
        if world_T_ego is None:
            return np.full(len(position), np.nan), np.full(len(position), np.nan)
        world_T_sensor = world_T_ego @ self.extrinsics.ego_T_sensor
        R = world_T_sensor[:3, :3]
        local = position @ R[:2, :2] - (world_T_sensor[:3, 3] @ R)[:2]
        return np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])


def checked_sensors(sensors: Mapping[str, Sensor] | None) -> dict[str, Sensor]:
    """Models of sensors by name, as a dictionary of its own; raises `InputError` for what is none."""
    if sensors is not None:
        require_type("sensors", sensors, Mapping)
    found = dict(sensors or {})
    for name, sensor in found.items():
        require_type(f"sensors.{name}", sensor, Sensor)
    return found


def sensor_model(sensors: Mapping[str, Sensor], name: str) -> Sensor:
    """The model of a sensor: its own, else the one named default, else the plain one."""
    return sensors.get(name) or sensors.get(DEFAULT) or Sensor()


FARTHEST = 1e4  # m; the ground beyond is at the horizon
_BELOW = 1e4  # px down, where the ground is in every image that shows some
_LEAST_DEVIATION = 1.0  # px of a foot point
_LARGEST_CONDITION = 1e15  # of a homography, from which its inverse has no digit left


@dataclass(frozen=True)
class GroundCamera(Settings):
    """A camera that stands still above flat ground, by a homography or by its lens and pose.

    The world has x ahead of the camera at yaw 0, y to the left and z up; its ground is z = 0.
    """

    homography: tuple[tuple[float, float, float], ...] | None = setting(
        None, "three rows of the homography from pixels to places on the ground, m; null: by focal length and pose"
    )
    focal_length: Positive = setting(1000.0, "focal length, px")
    centre: tuple[float, float] = setting((960.0, 540.0), "principal point (u, v), px; usual: the middle of the image")
    x: Finite = setting(0.0, "place of the camera, m")
    y: Finite = setting(0.0, "place of the camera, m")
    height: Positive = setting(5.0, "height of the camera above the ground, m")
    yaw: Finite = setting(0.0, "direction of view about z, from x towards y, rad")
    pitch: Finite = setting(0.2, "angle of the view below the horizon, rad; higher: looks further down")
    roll: Finite = setting(0.0, "angle about the direction of view, rad; higher: the camera turns clockwise")
    deviation: Positive = setting(
        0.05, "standard deviation of a foot point as a share of the height of its box; usual 0.02 to 0.1"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.ground_H_image

    @cached_property
    def ground_H_image(self) -> FloatArray:
        """H (3, 3), of which (0, 0, 1) H (u, v, 1) is above 0 where the pixel shows the ground."""
        if self.homography is not None:
            H = _invertible(checked("homography", self.homography, (3, 3)))
            return np.asarray(H * np.sign(H[2] @ [0.0, _BELOW, 1.0]))
        down, side = (
            np.array([np.cos(self.pitch), np.sin(self.pitch)]),
            np.array([np.cos(self.roll), np.sin(self.roll)]),
        )
        level = np.array([[0.0, -1.0, 0.0], [-down[1], 0.0, -down[0]], [down[0], 0.0, -down[1]]])
        turned = np.array([[side[0], side[1], 0.0], [-side[1], side[0], 0.0], [0.0, 0.0, 1.0]])
        camera_R_world = turned @ level @ yaw_transform(0.0, 0.0, 0.0, self.yaw)[:3, :3].T
        K = np.array([[self.focal_length, 0, self.centre[0]], [0, self.focal_length, self.centre[1]], [0, 0, 1]])
        with np.errstate(over="ignore", invalid="ignore"):
            t = -camera_R_world @ [self.x, self.y, self.height]
            image_H_ground = K @ np.column_stack([camera_R_world[:, :2], t])
        return np.asarray(np.linalg.inv(_invertible(image_H_ground)))

    def places(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (n, 2) on the ground at pixels (n, 2), m, NaN beyond the horizon, and their derivatives (n, 2, 2)."""
        h = np.column_stack([pixels, np.ones(len(pixels))]) @ self.ground_H_image.T
        with np.errstate(divide="ignore", invalid="ignore"):
            place = h[:, :2] / np.where(h[:, 2:] > 0, h[:, 2:], np.nan)
            place[~(np.hypot(*place.T) < FARTHEST)] = np.nan
            J = (self.ground_H_image[:2, :2] - place[:, :, None] * self.ground_H_image[2, :2]) / h[:, 2, None, None]
        return place, J

    def detections(self, xyxy: FloatArray, score: FloatArray, label: StrArray) -> tuple[Detections, IntArray]:
        """Image boxes (n, 4), px, that stand on the ground, as detections in the world, and their rows (k,).

        Raises `InputError` for boxes that are no boxes, naming the row.
        """
        xyxy = checked("xyxy", xyxy, (len(label), 4))
        extent = xyxy[:, 2:] - xyxy[:, :2]
        if (extent <= 0).any():
            row = int(np.argmax((extent <= 0).any(axis=1)))
            raise InputError(f"xyxy[{row}]: expected left < right and top < bottom, got {xyxy[row].tolist()}")
        place, J = self.places(np.column_stack([xyxy[:, [0, 2]].mean(axis=1), xyxy[:, 3]]))
        rows = np.flatnonzero(np.isfinite(place[:, 0]))
        place, J = place[rows], J[rows]
        width, height = (extent[rows] * np.hypot(*J[:, :, 0].T)[:, None]).T
        sigma = np.maximum(self.deviation * extent[rows, 1], _LEAST_DEVIATION)
        P = sigma[:, None, None] ** 2 * J @ np.swapaxes(J, 1, 2)
        boxes = Boxes.of(label[rows], np.column_stack([place, height / 2]), np.column_stack([width, width, height]))
        return Detections(boxes, score[rows], position_covariance=P), rows

    def image_boxes(self, boxes: Boxes) -> FloatArray:
        """The image boxes (n, 4), px, of objects in the world; NaN for those behind the camera or of unknown size."""
        h = np.column_stack([boxes.position[:, :2], np.ones(len(boxes))]) @ np.linalg.inv(self.ground_H_image).T
        foot = h[:, :2] / np.where(h[:, 2:] > 0, h[:, 2:], np.nan)
        _, J = self.places(foot)
        width, height = boxes.size[:, 1:].T / np.hypot(*J[:, :, 0].T)
        left, low = foot[:, 0] - width / 2, foot[:, 1]
        return np.column_stack([left, low - height, left + width, low])


def _invertible(H: FloatArray) -> FloatArray:
    """A homography (3, 3). Raises `InputError` for one that is singular in double precision."""
    if not (np.isfinite(H).all() and np.linalg.cond(H) < _LARGEST_CONDITION):
        raise InputError("expected a camera that sees the ground, by a homography that can be inverted")
    return H
