"""Offsets of the sensors' clocks as a piece of configuration: what `--learn-offsets` writes.

The offsets of several scenes are joined by their weights, with a deviation that allows for scenes that differ:

    o = sum_k o_k / s_k^2 / sum_k 1 / s_k^2,   s^2 = max(1, chi^2 / (n - 1)) / sum_k 1 / s_k^2
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import yaml

from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.tracking import SensorTime

DIGITS = 4


def offset_fragment(
    scenes: Iterable[Mapping[str, SensorTime]], sensors: Mapping[str, Sensor], origin: str
) -> tuple[str, dict[str, float]]:
    """The YAML text for `--config`, and the new `time_offset` (s) of each sensor that shares objects with others.

    scenes: clocks of the sensors in each; sensors: their models so far; origin: what it was learned from
    """
    found: dict[str, list[SensorTime]] = {}
    for clocks in scenes:
        for name, each in clocks.items():
            if each.objects:
                found.setdefault(name, []).append(each)
    offsets, comments = {}, []
    for name, parts in sorted(found.items()):
        offset, deviation = _joined(parts)
        offsets[name] = round(sensor_model(sensors, name).time_offset - offset, DIGITS)
        objects = sum(each.objects for each in parts)
        comments.append(f"# {name}: {-offset:+.4f} s, deviation {deviation:.4f} s, from {objects} objects in common\n")
    data = {"sensors": {name: {"time_offset": offset} for name, offset in offsets.items()}}
    head = f"# Offsets of clocks, learned from {origin}; pass it to --config.\n"
    return head + "".join(comments) + str(yaml.safe_dump(data, sort_keys=False)), offsets


def _joined(parts: list[SensorTime]) -> tuple[float, float]:
    """Weighted mean of the offsets of one sensor, s, and its standard deviation."""
    weights = [1 / each.deviation**2 for each in parts]
    total = sum(weights)
    mean = sum(w * each.offset for w, each in zip(weights, parts, strict=True)) / total
    chi2 = sum(w * (each.offset - mean) ** 2 for w, each in zip(weights, parts, strict=True))
    return mean, math.sqrt(max(1.0, chi2 / max(len(parts) - 1, 1)) / total)
