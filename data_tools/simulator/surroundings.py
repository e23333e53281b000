"""What stands beside and between the lanes: parked vehicles, hedges, buildings. All as boxes in world coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.simulator.fleet import CAR, KINDS, TRUCK, VAN, draw_sizes
from data_tools.simulator.road import Road
from data_tools.simulator.settings import SurroundingSettings
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.boxes import Boxes

PARKING_WIDTH = 2.4  # m
PAVEMENT_WIDTH = 3.5  # m
SEGMENT = 8.0  # m, longest straight piece of a hedge


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Parked vehicles (labelled as such), things that only hide others, and the pavements (low, high offset d, m)."""

    parked: Boxes
    occluders: Boxes
    pavements: list[tuple[float, float]]


def draw_surroundings(
    road: Road,
    edges: tuple[float, float],
    hedge: float | None,
    window: tuple[float, float],
    walkable: tuple[bool, bool],
    settings: SurroundingSettings,
    rng: np.random.Generator,
) -> Surroundings:
    """Furnish the road between road s of `window`, m.

    edges     offsets d of the outermost lanes' outer borders, m: right (negative) and left (positive)
    hedge     offset of the hedge between the directions, or None
    walkable  whether there is parking and a pavement on the right, on the left
    """
    parked, occluders, pavements = [], [], []
    for side, edge, walk in zip((-1.0, 1.0), edges, walkable, strict=True):
        border = abs(edge) + 0.3
        if walk:
            if rng.random() < settings.parking_probability:
                parked.append(_parked(road, side * (border + PARKING_WIDTH / 2), side, window, settings, rng))
                border += PARKING_WIDTH
            inner, outer = side * (border + 0.9), side * (border + PAVEMENT_WIDTH - 0.9)
            pavements.append((min(inner, outer), max(inner, outer)))
        border += PAVEMENT_WIDTH
        depth = 10.0
        stretches = _stretches(window, settings.building_length, settings.building_gap, rng)
        occluders.append(_row(road, stretches, side * (border + depth / 2), depth, 9.0, "building"))
    if hedge is not None:
        stretches = _stretches(window, settings.hedge_length, settings.hedge_gap, rng)
        pieces = [
            piece
            for start, end in stretches
            for piece in np.lib.stride_tricks.sliding_window_view(
                np.linspace(start, end, int(np.ceil((end - start) / SEGMENT)) + 1), 2
            )
        ]
        occluders.append(_row(road, np.array(pieces), hedge, 1.0, settings.hedge_height, "hedge"))
    return Surroundings(Boxes.concatenate(parked), Boxes.concatenate(occluders), pavements)


def _stretches(
    window: tuple[float, float], length: tuple[float, float], gap: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Alternating stretches and gaps over the window: starts and ends (K, 2), m."""
    s, stretches = window[0] - rng.uniform(0, length[1]), []
    while s < window[1]:
        end = s + rng.uniform(*length)
        stretches.append((s, end))
        s = end + rng.uniform(*gap)
    return np.array(stretches)


def _row(road: Road, stretches: FloatArray, d: float, width: float, height: float, label: str) -> Boxes:
    middle = stretches.mean(axis=1)
    offset = np.full(len(middle), d)
    length = (stretches[:, 1] - stretches[:, 0]) * (1 - road.curvature_at(middle) * d)
    return _boxes(
        road, middle, offset, np.stack([length, np.full_like(length, width), np.full_like(length, height)], 1), label
    )


def _parked(
    road: Road,
    d: float,
    side: float,
    window: tuple[float, float],
    settings: SurroundingSettings,
    rng: np.random.Generator,
) -> Boxes:
    place = np.arange(window[0], window[1], 6.5)
    place = place[rng.random(len(place)) < settings.parking_occupancy]
    kind = rng.choice([CAR, VAN, TRUCK], size=len(place), p=[0.74, 0.2, 0.06])
    size = draw_sizes(kind, rng)
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
