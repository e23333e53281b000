"""The class of a track, as a belief over the classes that sensors confuse.

    log b(c) = log P(c) + sum over detections of log L(c) + log N(log size; log m_c, s_c^2 I) + log N(speed; 0, v_c^2)
    L(c)     = sum over boxes k of  o_k A(z_k | c) / sum of o_k,      o = p / (1 - p)
    p        = sum of o_k / (1 + sum of o_k)

up to a constant. A(z | c) is the chance that a sensor reports an object of class c as z, the table `confusion` of its
model, in which a class without a row is reported rightly as often as the others; P(c) is the share of the class among
what the tables count. Boxes of confused classes in one place of a frame are one report with several labels: hypotheses
that exclude each other, with the odds o_k of their probabilities p_k. So they count for the existence of the object
together, p, and for each class by their share, L. Detections of successive frames are taken for independent; a class
never falls below `MIN_BELIEF`, so that a belief can always be changed.

Size and speed count once, as they are estimated now, since a detector's errors in them persist: m_c and s_c are the
typical size of the class (`ClassSettings.typical_size`), v_c the deviation of its speeds; a share `OUTLIERS` of objects
has any size. A class without a typical size takes that evidence from its whole group; objects that have never moved say
nothing by their speed.

Classes are of one group if a chain of confusions joins them. A detection may be of any track of its group, at the cost
-2 log sum_c b(c) L(c). Without tables there are no groups, and every track has the class of its detections.

A class model of a user's own (`saga_fg.model.sensor.ClassModel`) gives L for the boxes of its classes in place of A, by
all that they show.

Source: Pearl, Probabilistic Reasoning in Intelligent Systems, 1988, section 2.2.2: virtual evidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model import ClassModel, Sensor
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    common_numbers,
    distinct,
    of_classes,
)
from saga_fg.parts import new_part
from saga_fg.tracking.settings import ClassSettings
from saga_fg.types import DEFAULT, Boxes, class_settings

MIN_BELIEF = 1e-3  # of a class of the group
MIN_CONFUSION = 1e-3  # chance of any report within the group
OUTLIERS = 0.01  # share of objects of which no class is typical: of any size alike, over a factor e each way


@dataclass(frozen=True, eq=False)
class ConfusedClasses:
    """C classes that sensors confuse.

    classes    their names, sorted
    head       a class of each one's group, the same for all of it
    log_prior  (C,) of each class in its group
    tables     by sensor, (C, C) chance of each report (row) by true class (column), 0 between groups
    shape      (C, 4) logs of the typical length, width and height, and their deviation, NaN where the group has none
    speed      (C,) standard deviation of the speeds, m/s
    models     by sensor, class models of a user's own, None for none
    """

    classes: tuple[str, ...]
    head: Mapping[str, str]
    log_prior: FloatArray
    tables: Mapping[str, FloatArray]
    shape: FloatArray
    speed: FloatArray
    models: Mapping[str, ClassModel | None] = field(default_factory=dict)

    @classmethod
    def of(cls, sensors: Mapping[str, Sensor], settings: Mapping[str, ClassSettings]) -> ConfusedClasses:
        """The classes that the tables of these sensors confuse."""
        tables = {DEFAULT: {}, **{name: sensor.confusion for name, sensor in sensors.items()}}
        entries = [(c, z) for rows in tables.values() for c, row in rows.items() for z, n in row.items() if n > 0]
        models: dict[str, ClassModel | None] = {
            name: None
            if sensor.class_model is None
            else new_part(f"sensors.{name}.class_model", sensor.class_model, ClassModel)
            for name, sensor in sensors.items()
        }
        entries += [(model.classes[0], other) for model in models.values() if model for other in model.classes]
        classes = tuple(sorted({label for c, z in entries for label in (c, z) if c != z}))
        group, C = np.arange(len(classes)), len(classes)
        for i, j in ((classes.index(c), classes.index(z)) for c, z in entries if c in classes):
            group[group == group[j]] = group[i]
        alike = group[:, None] == group
        found = {}
        for name, rows in tables.items():
            A = np.reshape([[rows[c].get(z, 0.0) if c in rows else np.nan for c in classes] for z in classes], (C, C))
            A = A / A.sum(axis=0)
            right = np.nanmean(np.diagonal(A)) if np.isfinite(A).any() else 1.0
            usual = np.where(np.eye(C) > 0, right, (1 - right) / np.maximum(alike.sum(axis=0) - 1, 1))
            A = np.where(alike, np.maximum(np.where(np.isnan(A), usual, A), MIN_CONFUSION), 0.0)
            found[name] = A / A.sum(axis=0)
        totals = [[sum(rows[c].values()) for rows in tables.values() if c in rows] for c in classes]
        of_all = [n for own in totals for n in own]
        prior = np.array([np.mean(own or of_all or [1.0]) for own in totals])
        of_class = [class_settings(settings, ClassSettings, label) for label in classes]
        sizes = [each.typical_size for each in of_class]
        parts = [[np.nan] * 4 if s is None else [*np.log([s.length, s.width, s.height]), s.spread] for s in sizes]
        shape = np.reshape(parts, (C, 4))
        shape[alike @ np.isnan(shape[:, 0])] = np.nan
        speed = np.array([each.initial_speed_deviation for each in of_class])
        head = {label: classes[k] for label, k in zip(classes, group.tolist(), strict=True)}
        return cls(classes, head, np.log(prior / (alike @ prior)), found, shape, speed, models)

    def __len__(self) -> int:
        return len(self.classes)

    def numbers(self, *labels: StrArray) -> list[IntArray]:
        """Numbers (n,) of the groups of several arrays of labels (n,), of a class outside of all groups its own."""
        return common_numbers(*labels, alias=self.head)

    def alike(self, one: StrArray, other: StrArray) -> BoolArray:
        """(n,) which pairs of labels (n,) are of one class, or group."""
        a, b = self.numbers(one, other) if self.classes else (one, other)
        return np.asarray(a == b)

    def columns(self, label: StrArray) -> IntArray:
        """Columns (n,) of labels (n,), -1 for those outside of all groups."""
        names, index = distinct(label)
        known = [self.classes.index(name) if name in self.classes else -1 for name in names]
        return np.array(known, dtype=np.int64)[index]

    def likelihood(self, sensor: str, label: StrArray) -> FloatArray:
        """(n, C) chance of a report as each label (n,) by the true class; zeros outside of all groups."""
        if not self.classes:
            return np.empty((len(label), 0))
        column = self.columns(label)
        return np.where(column[:, None] >= 0, self.tables.get(sensor, self.tables[DEFAULT])[column], 0.0)

    def report_likelihood(self, sensor: str, boxes: Boxes) -> FloatArray:
        """(n, C) chance of boxes by the true class, by the class model of the sensor where it has one, else its table.

        Raises `InputError` for a model whose answer is not positive numbers of the right shape.
        """
        chance, model = self.likelihood(sensor, boxes.label), self.models.get(sensor, self.models.get(DEFAULT))
        rows = of_classes(boxes.label, model.classes).nonzero()[0] if model else ()
        if model and len(rows):
            where = f"sensors.{sensor}.class_model: likelihood"
            own = checked(where, model.likelihood(boxes.select(rows)), (len(rows), len(model.classes)))
            if own.min() < 0 or not own.any(axis=1).all():
                raise InputError(f"{where}: expected no negative chance, and one above 0 of each box")
            chance[np.ix_(rows, self.columns(np.array(model.classes)))] = own / own.max(axis=1, keepdims=True)
        return chance

    def initial(self, likelihood: FloatArray) -> FloatArray:
        """Log-beliefs (n, C) of new tracks by the likelihood (n, C) of their first detections; -inf between groups."""
        return self.updated(np.where(likelihood > 0, self.log_prior, -np.inf), likelihood)

    def updated(self, log_belief: FloatArray, likelihood: FloatArray) -> FloatArray:
        """Log-beliefs (n, C) after evidence of a likelihood (n, C), or of none of it outside of all groups."""
        if not self.classes:
            return log_belief
        with np.errstate(divide="ignore"):
            after = _normalised(log_belief + np.log(likelihood))
        return _normalised(np.where(np.isfinite(log_belief), np.maximum(after, np.log(MIN_BELIEF)), -np.inf))

    def report(self, log_belief: FloatArray) -> FloatArray:
        """Likelihood (n, C) of all detections together that led to log-beliefs (n, C)."""
        return np.exp(_normalised(log_belief - self.log_prior))

    def with_shape(
        self, log_belief: FloatArray, size: FloatArray, speed: FloatArray, variance: FloatArray
    ) -> FloatArray:
        """Log-beliefs (n, C) by size (n, 3), m, and speed (n,), m/s, with its variance (n,), too; NaN says nothing."""
        spread = self.shape[:, 3]
        apart = (np.log(size)[:, None] - self.shape[:, :3]) / spread[:, None]
        by_size = np.exp(-0.5 * (apart**2).sum(axis=2)) / (np.sqrt(2 * np.pi) * spread) ** 3
        by_size = np.log((1 - OUTLIERS) * by_size + OUTLIERS)
        S = self.speed**2 + variance[:, None]
        by_speed = -0.5 * (speed[:, None] ** 2 / S + np.log(S))
        return _normalised(log_belief + np.nan_to_num(by_size) + np.nan_to_num(by_speed))

    def log_evidence(self, log_belief: FloatArray, likelihood: FloatArray) -> FloatArray:
        """(n,) log of the chance of reports, sum_c b(c) L(c); 0 outside of all groups."""
        chance = (np.exp(log_belief) * likelihood).sum(axis=1)
        return np.log(np.where(likelihood.any(axis=1), chance, 1.0))

    def labels(self, log_belief: FloatArray, label: StrArray) -> StrArray:
        """The likeliest classes (n,) of tracks that had the classes `label` (n,), which stay where none is likelier."""
        column = self.columns(label)
        had = np.where(column >= 0, log_belief[np.arange(len(label)), column], np.inf)
        likelier = log_belief.max(axis=1, initial=-np.inf) > had + 1e-9
        return np.where(likelier, np.array(self.classes)[log_belief.argmax(axis=1)], label) if likelier.any() else label

    def certainty(self, log_belief: FloatArray) -> FloatArray:
        """(n,) probability of the likeliest class; 1 outside of all groups."""
        if not self.classes:
            return np.ones(len(log_belief))
        most = log_belief.max(axis=1)
        return np.where(np.isfinite(most), np.exp(most), 1.0)


NONE_CONFUSED = ConfusedClasses.of({}, {})


def _normalised(log_p: FloatArray) -> FloatArray:
    """Logs (n, C) of probabilities that sum to one in each row; rows of -inf stay."""
    most = log_p.max(axis=1, keepdims=True, initial=-np.inf)
    shifted = log_p - np.where(np.isfinite(most), most, 0.0)
    total = np.exp(shifted).sum(axis=1, keepdims=True)
    return np.asarray(shifted - np.log(np.where(total > 0, total, 1.0)))
