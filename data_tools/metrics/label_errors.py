"""Errors pooled over scenes, consistency of their covariances, and errors of tracks at labelled objects.

The normalised estimation error squared (NEES) and the coverage of ellipses.

    nees = (x_hat - x)^T P^-1 (x_hat - x)        chi-squared with dim(x) degrees of freedom if P is right

so its mean is dim(x), and the share of samples with nees <= chi_square_quantile(p, dim) is p: the p-ellipse of the
estimate holds the truth with probability p.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.2.

Labels and tracks are paired frame by frame (`nearest_pairs`). If the detections are given, errors of position, velocity
and heading are those at labels that a detection matches: every tracker with the same detections is then evaluated on
the same labels, and its position errors compare with those of the detections. Covariances are evaluated on all pairs.

The velocity of a label is the difference of its positions `reach` frames before and after,

    v_k = (p_{k+r} - p_{k-r}) / (t_{k+r} - t_{k-r})

and unknown where the object has no label at either. A label is *moving* if its speed is at least `MOVING`, else parked.

A summary has root mean squares of the errors at labels, and the consistency of the covariances. The shares of errors
within the tracks' ellipses are meaningful for classes with enough objects and boxes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from data_tools.metrics.scene_boxes import SceneBoxes, nearest_pairs
from saga_fg.numerics import (
    BoolArray,
    Columns,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    chi_square_quantile,
    wrap_angle,
)
from saga_fg.types import Boxes, Scene


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Errors `values` (N,) in one unit. Every statistic of an empty sample is NaN."""

    values: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", checked("values", self.values, (None,)))

    @classmethod
    def known(cls, values: FloatArray) -> Self:
        """The values that are finite."""
        return cls(values[np.isfinite(values)])

    @classmethod
    def pool(cls, samples: Iterable[ErrorSample]) -> Self:
        """All values of all samples together."""
        return cls(np.concatenate([np.empty(0), *(sample.values for sample in samples)]))

    def __len__(self) -> int:
        return len(self.values)

    @property
    def rmse(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(np.mean(self.values**2))) if len(self) else float("nan")

    @property
    def mean(self) -> float:
        return float(np.mean(self.values)) if len(self) else float("nan")

    @property
    def median(self) -> float:
        return float(np.median(self.values)) if len(self) else float("nan")


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES (N,) of errors (N, d) under covariances (N, d, d); NaN for covariances unknown or not positive definite."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    eigenvalues = np.linalg.eigvalsh(np.where(known[:, None, None], covariance, 0.0))
    proper = eigenvalues[:, 0] > 1e-12 * np.maximum(eigenvalues[:, -1], np.finfo(np.float64).tiny)
    result = np.full(len(error), np.nan)
    solved = np.linalg.solve(covariance[proper], error[proper][..., None])[..., 0]
    result[proper] = np.einsum("ni,ni->n", error[proper], solved)
    return result


def coverage(nees_values: FloatArray, probability: float, dimension: int = 2) -> float:
    """Share of errors inside the ellipse of a `probability`; NaN without values."""
    if len(nees_values) == 0:
        return float("nan")
    return float(np.mean(nees_values <= chi_square_quantile(probability, dimension)))


def coverages(nees_values: FloatArray, probabilities: Sequence[float] = (0.5, 0.9, 0.99)) -> dict[float, float]:
    """`coverage` of horizontal positions for several probabilities."""
    return {p: coverage(nees_values, p) for p in probabilities}


GATE = 2.0  # m
MOVING = 1.0  # m/s


@dataclass(frozen=True, eq=False)
class LabelErrors(Columns):
    """N labels, each (N,); NaN where there is no track, no detection, or where a quantity is unknown.

    label      class
    object     number of the object, from 0
    speed      of the label, m/s
    matched    True where a detection matches it; True for all if no detections are given
    detection  error of that detection's position, m
    position, velocity, heading  errors of the track, m, m/s, rad in [0, pi]
    nees       normalised squared error of the track's position, 2 degrees of freedom
    """

    label: StrArray
    object: IntArray
    speed: FloatArray
    matched: BoolArray
    detection: FloatArray
    position: FloatArray
    velocity: FloatArray
    heading: FloatArray
    nees: FloatArray

    @classmethod
    def pool(cls, scenes: Iterable[Self]) -> Self:
        """The labels of all scenes; objects of different scenes get different numbers."""
        parts, first = [], 0
        for scene in scenes:
            parts.append(replace(scene, object=scene.object + first))
            first += int(scene.object.max(initial=-1)) + 1
        return cls.concatenate(parts)

    @property
    def tracked(self) -> BoolArray:
        """(N,) True for labels with a track."""
        return np.isfinite(self.position)

    @property
    def moving(self) -> BoolArray:
        """(N,) True for moving labels, False for unknown speed."""
        return np.asarray(self.speed >= MOVING)

    def sample(self, name: str, rows: BoolArray | None = None) -> ErrorSample:
        """The known errors `name` of matched labels with a track, limited to the mask `rows` (N,) if given."""
        chosen = self.matched & self.tracked
        return ErrorSample.known(getattr(self, name)[chosen if rows is None else chosen & rows])


def label_errors(
    truth: SceneBoxes,
    found: SceneBoxes,
    velocity: FloatArray,
    detections: tuple[IntArray, Boxes] | None = None,
    gate: float = GATE,
) -> LabelErrors:
    """The errors of `found` at the labels `truth` (N) of one scene, whose velocities (N, 2) are given.

    detections  (frame (M,), boxes (M)): the input of the tracker
    gate        largest distance of a label and its track or detection, m
    """
    n = len(truth)
    columns: dict[str, Any] = {
        name: np.full(n, np.nan) for name in ("detection", "position", "velocity", "heading", "nees")
    }
    placed = truth.frame, truth.boxes
    row, column, distance = nearest_pairs(placed, (found.frame, found.boxes), gate)
    a, b = truth.boxes.select(row), found.boxes.select(column)
    columns["position"][row] = distance
    columns["velocity"][row] = np.linalg.norm(b.velocity - velocity[row], axis=1)
    columns["heading"][row] = np.abs(wrap_angle(b.yaw - a.yaw))
    columns["nees"][row] = nees((b.position - a.position)[:, :2], found.position_covariance[column])
    matched = np.ones(n, dtype=np.bool_)
    if detections is not None:
        row, _, distance = nearest_pairs(placed, detections, gate)
        columns["detection"][row] = distance
        matched = np.isfinite(columns["detection"])
    _, number = np.unique(truth.id, return_inverse=True)
    return LabelErrors(truth.boxes.label, number, np.linalg.norm(velocity, axis=1), matched, **columns)


def label_velocities(truth: SceneBoxes, timestamps: FloatArray, reach: int) -> FloatArray:
    """Velocities (N, 2), m/s, of labels over `reach` frames to either side; NaN where these have no label.

    timestamps  (K,) of the frames, s
    """
    _, number = np.unique(truth.id, return_inverse=True)
    stride = len(timestamps) + 2 * reach
    key = number * stride + truth.frame + reach
    order = np.argsort(key)
    before, after = (_rows_of(key[order], key + step) for step in (-reach, reach))
    known = (before >= 0) & (after >= 0)
    first, last = order[before[known]], order[after[known]]
    velocity = np.full((len(truth), 2), np.nan)
    elapsed = timestamps[truth.frame[last]] - timestamps[truth.frame[first]]
    velocity[known] = (truth.boxes.position[last, :2] - truth.boxes.position[first, :2]) / elapsed[:, None]
    return velocity


def _rows_of(keys: IntArray, wanted: IntArray) -> IntArray:
    """Row of each wanted key among the sorted keys, -1 if missing."""
    at = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    return np.where(keys[at] == wanted, at, -1) if len(keys) else np.empty(0, dtype=np.int64)


FEWEST_OBJECTS, FEWEST_BOXES = 20, 500
BANDS = {0.5: (0.4, 0.6), 0.9: (0.85, 0.95), 0.99: (0.96, 1.0)}
OVERALL = "overall"


@dataclass(frozen=True)
class ErrorSummary:
    """Figures of one class, NaN where undefined.

    labels, tracked      matched labels, and those of them with a track
    position, detection  RMSE of tracks and of detections on the same labels, m
    velocity, velocity_parked, velocity_moving   RMSE, m/s, of known velocities
    velocity_unknown     labels of known velocity whose track has none
    heading              RMSE, rad; flipped: share of headings off by more than 90 degrees
    """

    labels: int
    tracked: int
    position: float
    detection: float
    velocity: float
    velocity_parked: float
    velocity_moving: float
    velocity_unknown: int
    heading: float
    flipped: float


@dataclass(frozen=True)
class EllipseCoverage:
    """Consistency of the covariances of one class.

    objects, boxes  that have a track with a covariance
    anees           mean NEES over its 2 degrees of freedom: 1 if the covariances are right
    median_nees     over that of the chi-square distribution
    coverage        share of the errors within the ellipse, by its probability
    """

    objects: int
    boxes: int
    anees: float
    median_nees: float
    coverage: Mapping[float, float]

    @property
    def enough_data(self) -> bool:
        """True with enough objects and boxes for a conclusion."""
        return self.objects >= FEWEST_OBJECTS and self.boxes >= FEWEST_BOXES

    @property
    def consistent(self) -> bool:
        """True if each share is within its band."""
        return all(low <= self.coverage[p] <= high for p, (low, high) in BANDS.items())


def error_summary(errors: LabelErrors) -> ErrorSummary:
    """Summarise errors."""
    heading = errors.sample("heading").values
    moving = errors.moving
    tracked = errors.matched & errors.tracked
    return ErrorSummary(
        labels=int(errors.matched.sum()),
        tracked=int(tracked.sum()),
        position=errors.sample("position").rmse,
        detection=errors.sample("detection").rmse,
        velocity=errors.sample("velocity").rmse,
        velocity_parked=errors.sample("velocity", ~moving).rmse,
        velocity_moving=errors.sample("velocity", moving).rmse,
        velocity_unknown=int((tracked & np.isfinite(errors.speed) & np.isnan(errors.velocity)).sum()),
        heading=errors.sample("heading").rmse,
        flipped=float(np.mean(heading > np.pi / 2)) if len(heading) else float("nan"),
    )


def calibration(errors: LabelErrors) -> EllipseCoverage:
    """Compare errors with their covariances."""
    known = np.isfinite(errors.nees)
    values = errors.nees[known]
    return EllipseCoverage(
        objects=len(np.unique(errors.object[known])),
        boxes=len(values),
        anees=float(values.mean() / 2) if len(values) else float("nan"),
        median_nees=float(np.median(values) / (2 * np.log(2))) if len(values) else float("nan"),
        coverage=coverages(values, tuple(BANDS)),
    )


def errors_by_class(errors: LabelErrors) -> dict[str, LabelErrors]:
    """The errors of each class with labels, preceded by those of all classes."""
    labels = np.unique(errors.label).tolist()
    return {OVERALL: errors, **{label: errors.select(errors.label == label) for label in labels}}


PlacedBoxes = tuple[IntArray, Boxes]
"""(moment (N,), boxes (N))"""


def placed_detections(scene: Scene) -> PlacedBoxes:
    """The boxes of all frames that were taken at a moment of the scene, in the frames' coordinates (world)."""
    moment_of = {time: k for k, time in enumerate(scene.timestamps.tolist())}
    frames = [(moment_of[frame.timestamp], frame) for frame in scene.frames if frame.timestamp in moment_of]
    moment = np.repeat(np.array([k for k, _ in frames], dtype=np.int64), [len(frame) for _, frame in frames])
    return moment, Boxes.concatenate([frame.detections.boxes for _, frame in frames])
