"""The figures of the estimators' benchmark: rows, how cost grows, and what is to be reached."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.flocks import Kind

FROM = 50  # nodes from which the growth of cost is fitted: below, calls cost more than numbers


@dataclass(frozen=True)
class Row:
    """One contender in one case.

    milliseconds      median a frame (of a whole recording for the batch smoothers)
    ratio             to the baseline's; NaN where that was not measured
    largest_error     of a mean against the reference, standard deviations; average_error: mean of them
    covariance_error  largest relative difference of a node's covariance, Frobenius
    anees             mean normalised squared error of the estimates: 1 if covariances are right
    memory            of the estimator's state, MB; NaN where it is not ours
    band              that holds the ANEES with 99 %, where its samples are independent
    """

    case: str
    graph: Kind
    nodes: int
    contender: str
    milliseconds: float
    ratio: float
    largest_error: float = math.nan
    average_error: float = math.nan
    covariance_error: float = math.nan
    anees: float = math.nan
    memory: float = math.nan
    band: tuple[float, float] = (math.nan, math.nan)


@dataclass(frozen=True)
class Soak:
    """An endurance run.

    milliseconds  a frame, over its last tenth: of a young filter, and of the one that went all the way
    memory        resident, MB, over its second tenth and over its last
    """

    contender: str
    graph: Kind
    nodes: int
    frames: int
    milliseconds: tuple[float, float]
    memory: tuple[float, float]


@dataclass(frozen=True)
class Criterion:
    """A figure to reach: `value` at most `limit`; NaN where its case was not measured."""

    name: str
    value: float
    limit: float

    @property
    def reached(self) -> bool | None:
        """None where it was not measured."""
        return None if math.isnan(self.value) else self.value <= self.limit


def exponents(rows: Sequence[Row]) -> dict[str, float]:
    """Exponent of the cost over the number of nodes, for each contender and graph measured at three sizes or more."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        if row.case != "batch" and row.nodes >= FROM:
            curves.setdefault(f"{row.contender}, {row.graph}", []).append((row.nodes, row.milliseconds))
    return {
        name: float(np.polyfit(np.log([n for n, _ in points]), np.log([ms for _, ms in points]), 1)[0])
        for name, points in curves.items()
        if len(points) >= 3
    }


def criteria(rows: Sequence[Row], soaks: Sequence[Soak]) -> tuple[Criterion, ...]:
    """Limits to reach on two cores, as ratios within one run."""
    table = {(row.case, row.graph, row.nodes, row.contender): row for row in rows}
    nothing = Row("", "connected", 0, "", math.nan, math.nan)

    def of(case: str, graph: Kind, nodes: int, contender: str) -> Row:
        return table.get((case, graph, nodes, contender), nothing)

    batch = {row.graph: row for row in rows if row.case == "batch" and row.contender == "batch"}
    exact, bounded = (of("filter", "connected", 1000, name) for name in ("kalman", "kalman, bounded"))
    few, many = (of("filter", "components", n, "kalman").milliseconds for n in (300, 1000))
    found = [
        Criterion("kalman / textbook, connected, 100", of("filter", "connected", 100, "kalman").ratio, 0.40),
        Criterion("kalman / textbook, connected, 300", of("filter", "connected", 300, "kalman").ratio, 0.25),
        Criterion("kalman / textbook, components, 100", of("filter", "components", 100, "kalman").ratio, 0.05),
        Criterion("kalman, components, 1000 / 300 nodes", many / few, 3.6),
        Criterion("bounded / exact, connected, 1000", bounded.milliseconds / exact.milliseconds, 0.05),
        Criterion("bounded, connected, 1000: mean error, sigma", bounded.average_error, 0.03),
        Criterion("bounded, connected, 1000: ANEES off by", abs(bounded.anees / exact.anees - 1), 0.05),
        Criterion("isam2 / textbook, components, 100", of("filter", "components", 100, "isam2").ratio, 0.5),
        Criterion("isam2 / textbook, connected, 100", of("filter", "connected", 100, "isam2").ratio, 4.0),
        Criterion("fixed-lag / GTSAM, components, 100", of("fixed lag", "components", 100, "fixed-lag").ratio, 0.7),
        Criterion("fixed-lag / GTSAM, connected, 100", of("fixed lag", "connected", 100, "fixed-lag").ratio, 0.3),
        Criterion("batch / textbook, components", batch.get("components", nothing).ratio, 0.5),
        Criterion("batch / textbook, connected", batch.get("connected", nothing).ratio, 2.0),
    ]
    for kind in ("components", "connected"):
        driver = of("running graph", kind, 100, "intelligent driver").ratio
        found.append(Criterion(f"intelligent drivers / linear, {kind}, 100", driver, 3.0))
    for row in rows:
        if row.case == "nonlinear":
            low, high = row.band
            off = abs(row.anees - (low + high) / 2) / (high - low)
            found.append(Criterion(f"nonlinear, {row.contender}: NEES from the middle of its band", off, 0.5))
    for soak in soaks:
        name = f"{soak.contender}, {soak.graph}, {soak.frames} frames"
        found.append(Criterion(f"{name}: time, old / young", soak.milliseconds[1] / soak.milliseconds[0], 1.05))
        found.append(Criterion(f"{name}: memory, end / start", soak.memory[1] / soak.memory[0], 1.05))
    return tuple(found)
