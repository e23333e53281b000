"""Static objects beside and between the lanes, as boxes in world coordinates: parked cars, hedges, buildings, cones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.simulator.fleet import CAR, KINDS, TRUCK, VAN, sample_sizes
from data_tools.simulator.lanes import Lanes
from data_tools.simulator.road import Road
from data_tools.simulator.scene_layout import SceneLayout
from data_tools.simulator.settings import SurroundingSettings
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.boxes import Boxes

_HEDGE_LENGTH = (4.0, 14.0)  # length of a hedge, m
_HEDGE_GAP = (5.0, 18.0)  # gap between hedges, m
_HEDGE_HEIGHT = 2.2  # height of a hedge, m
_BUILDING_LENGTH = (10.0, 30.0)  # length of a building, m
_BUILDING_GAP = (2.0, 25.0)  # gap between buildings, m
PARKING_WIDTH = 2.4  # m
PAVEMENT_WIDTH = 3.5  # m
SEGMENT = 8.0  # m, longest straight segment of a hedge
CONE = (0.45, 0.45, 0.75)  # length, width, height, m
CONE_DEVIATION = 0.1  # standard deviation of a cone's position, m
CONE_ROW = (25.0, 50.0)  # length of the row of cones behind the taper, m
CONE_SPACING = 4.0  # distance between cones, m
PARKING_OCCUPANCY = 0.5  # share of parking places taken


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Parked vehicles, objects that only hide others, and pavements (lowest and highest offset d, m)."""

    parked: Boxes
    occluders: Boxes
    pavements: list[tuple[float, float]]


def sample_surroundings(
    layout: SceneLayout, window: tuple[float, float], settings: SurroundingSettings, rng: np.random.Generator
) -> Surroundings:
    """Random surroundings of the road for s within `window`, m; no parking and no pavement beside an ending lane."""
    road, parked, occluders, pavements = layout.lanes.road, [], [], []
    for side, offset in zip((-1.0, 1.0), layout.borders, strict=True):
        border = abs(offset) + 0.3
        if side > 0 or layout.lanes.ending < 0:
            if rng.random() < settings.parking_probability:
                parked.append(_parked(road, side * (border + PARKING_WIDTH / 2), side, window, rng))
                border += PARKING_WIDTH
            inner, outer = side * (border + 0.9), side * (border + PAVEMENT_WIDTH - 0.9)
            pavements.append((min(inner, outer), max(inner, outer)))
        border += PAVEMENT_WIDTH
        depth = 10.0
        intervals = _intervals(window, _BUILDING_LENGTH, _BUILDING_GAP, rng)
        occluders.append(_row(road, intervals, side * (border + depth / 2), depth, 9.0, "building"))
    if layout.hedge is not None:
        intervals = _intervals(window, _HEDGE_LENGTH, _HEDGE_GAP, rng)
        pieces = [
            piece
            for start, end in intervals
            for piece in np.lib.stride_tricks.sliding_window_view(
                np.linspace(start, end, int(np.ceil((end - start) / SEGMENT)) + 1), 2
            )
        ]
        occluders.append(_row(road, np.array(pieces), layout.hedge, 1.0, _HEDGE_HEIGHT, "hedge"))
    return Surroundings(Boxes.concatenate(parked), Boxes.concatenate(occluders), pavements)


def sample_cones(lanes: Lanes, rng: np.random.Generator) -> Boxes:
    """Cones that close the ending lane: a taper to its inner border, then a row along it; none for an open lane."""
    if lanes.taper == 0:
        return Boxes.empty()
    inner = (lanes.offset[lanes.ending] + lanes.offset[lanes.adjacent]) / 2
    outer = 2 * lanes.offset[lanes.ending] - inner
    end = lanes.end + rng.uniform(*CONE_ROW)
    s = np.arange(lanes.end - lanes.taper, end, CONE_SPACING)
    d = np.interp(s, [lanes.end - lanes.taper, lanes.end], [outer, inner])
    n = len(s)
    horizontal = lanes.road.position(s, d) + CONE_DEVIATION * rng.standard_normal((n, 2))
    position = np.column_stack([horizontal, np.full(n, CONE[2] / 2)])
    size = np.tile(np.array(CONE), (n, 1))
    return Boxes(np.full(n, "traffic_cone"), position, size, np.zeros(n), np.zeros((n, 2)))


def _intervals(
    window: tuple[float, float], length: tuple[float, float], gap: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Random intervals over the window, separated by gaps: starts and ends (K, 2), m."""
    s, intervals = window[0] - rng.uniform(0, length[1]), []
    while s < window[1]:
        end = s + rng.uniform(*length)
        intervals.append((s, end))
        s = end + rng.uniform(*gap)
    return np.array(intervals)


def _row(road: Road, intervals: FloatArray, d: float, width: float, height: float, label: str) -> Boxes:
    middle = intervals.mean(axis=1)
    offset = np.full(len(middle), d)
    length = (intervals[:, 1] - intervals[:, 0]) * (1 - road.curvature_at(middle) * d)
    return _boxes(
        road, middle, offset, np.stack([length, np.full_like(length, width), np.full_like(length, height)], 1), label
    )


def _parked(
    road: Road,
    d: float,
    side: float,
    window: tuple[float, float],
    rng: np.random.Generator,
) -> Boxes:
    place = np.arange(window[0], window[1], 6.5)
    place = place[rng.random(len(place)) < PARKING_OCCUPANCY]
    kind = rng.choice([CAR, VAN, TRUCK], size=len(place), p=[0.74, 0.2, 0.06])
    size = sample_sizes(kind, rng)
    trucks = np.flatnonzero(kind == TRUCK)
    clear = np.ones(len(place), dtype=np.bool_)
    for row in trucks:  # a truck takes the neighbouring places too
        near = np.abs(place - place[row]) < 6.5 + size[row, 0] / 2
        clear &= ~near | (np.arange(len(place)) == row)
    label = np.array([k.label for k in KINDS])[kind]
    offset = d + rng.uniform(-0.15, 0.15, len(place))
    boxes = _boxes(road, place, offset, size, label)
    yaw = boxes.yaw + (np.pi if side > 0 else 0.0) + rng.normal(0, 0.02, len(place))
    return Boxes(boxes.label, boxes.position, boxes.size, yaw, boxes.velocity).select(clear)


def _boxes(road: Road, s: FloatArray, d: FloatArray, size: FloatArray, label: object) -> Boxes:
    position = np.column_stack([road.position(s, d), size[:, 2] / 2])
    return Boxes(np.broadcast_to(np.asarray(label), len(s)), position, size, road.heading_at(s), np.zeros((len(s), 2)))
