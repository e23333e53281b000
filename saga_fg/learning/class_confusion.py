"""Which classes a sensor confuses, and the typical sizes of these, from matches to the truth.

    n_cz = sum of the probabilities of detections of class z that are of objects of class c

Detections are matched to objects of their own class first, then those that are left to objects that are left, of any
class, within half the gate: reports of another class *in place of* the right one. A detection that is left *beside* one
of the right class says something else: the detector has an output for every class, and reports one object as several.
Each class of such a detector is tracked by itself, with what it says of the class; on recordings, beliefs made these
worse. So a sensor confuses classes only if more of its detections stand in place of the right one than beside it, those
that are a share `MIN_SHARE` of the detections of a class at least.

Rows are counts, which tell how frequent the classes are as well (`saga_fg.tracking.class_belief`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np

from saga_fg.learning.labelled_scene import GATE, match_to_truth
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.assignment import assign
from saga_fg.tracking.class_belief import ConfusedClasses
from saga_fg.tracking.settings import TypicalSize
from saga_fg.types.dataset import Scene

MIN_DETECTIONS = 20.0  # expected detections of a class, for a row or a size of its own
MIN_SHARE = 0.02  # share of the detections of a class below which those of another one are chance
MIN_SPREAD = 0.05  # of sizes, relative; objects in other recordings differ by more than a few do in these


def learn_confusion(scenes: Iterable[Scene], sensors: Mapping[str, Sensor]) -> dict[str, dict[str, dict[str, float]]]:
    """Sensor -> true class -> reported class -> expected number; a sensor that confuses nothing has no rows.

    Raises `InputError` for a scene without ground truth.
    """
    instead: dict[str, dict[tuple[str, str], float]] = defaultdict(lambda: defaultdict(float))
    beside: dict[str, float] = defaultdict(float)
    for scene in scenes:
        for matched in match_to_truth(scene, sensors):
            boxes, truth, name = matched.detections.boxes, matched.annotations.boxes, matched.frame.sensor
            p = sensor_model(sensors, name).probability(matched.detections.score, boxes.label)
            free, missed = np.ones(len(boxes), dtype=bool), np.ones(len(truth), dtype=bool)
            free[matched.detection], missed[matched.truth] = False, False
            distance = np.hypot(*np.moveaxis(boxes.position[:, None, :2] - truth.position[None, :, :2], -1, 0))
            near = (distance < GATE / 2) & free[:, None] & (boxes.label[:, None] != truth.label)
            d, t = assign(distance, near & missed, unmatched=GATE)
            near[d] = False
            beside[name] += float(p[(near & ~missed).any(axis=1)].sum())
            d, t = np.append(matched.detection, d), np.append(matched.truth, t)
            for c, z, chance in zip(truth.label[t].tolist(), boxes.label[d].tolist(), p[d].tolist(), strict=True):
                instead[name][c, z] += chance
    return {name: _rows(counts, beside[name]) for name, counts in instead.items()}


def _rows(instead: Mapping[tuple[str, str], float], beside: float) -> dict[str, dict[str, float]]:
    """The rows of one sensor; beside: expected number of its detections beside one of another class."""
    total = {c: sum(n for (d, _), n in instead.items() if d == c) for c, _ in instead}
    known = [c for c in sorted(total) if total[c] >= MIN_DETECTIONS and instead[c, c] > 0]
    pairs = [(c, z) for c, z in instead if c in known and c != z and instead[c, z] >= MIN_SHARE * total[c]]
    if sum(instead[pair] for pair in pairs) <= beside:
        return {}
    mixed = [c for c in known if any(c in pair for pair in pairs)]
    return {c: {z: round(instead[c, z], 1) for z in sorted(total) if z == c or (c, z) in pairs} for c in mixed}


def learn_sizes(scenes: Iterable[Scene], sensors: Mapping[str, Sensor]) -> dict[str, TypicalSize]:
    """The sizes of the detections of each class that these sensors confuse, of an object of that class.

    Raises `InputError` for a scene without ground truth.
    """
    confused = ConfusedClasses.of(sensors, {})
    found: dict[str, list[FloatArray]] = {label: [np.empty((0, 3))] for label in confused.classes}
    for matched in (each for scene in scenes if len(confused) for each in match_to_truth(scene, sensors)):
        for name in found:
            rows = matched.detection[matched.annotations.boxes.label[matched.truth] == name]
            found[name].append(np.log(matched.detections.boxes.size[rows]))
    sizes = {}
    for name, parts in found.items():
        logs = np.concatenate(parts)
        logs = logs[np.isfinite(logs).all(axis=1)]
        if len(logs) >= MIN_DETECTIONS:
            length, width, height = np.exp(np.median(logs, axis=0)).tolist()
            sizes[name] = TypicalSize(length, width, height, max(float(np.sqrt(logs.var(axis=0).mean())), MIN_SPREAD))
    return sizes
