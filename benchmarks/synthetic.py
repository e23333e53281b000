"""The paper's claim on synthetic data: MOTA, MOTP and identity switches over coupling, noise, occlusion and density.

Scenes are drawn from the interaction model (`benchmarks.drawn_scenes`), and tracked by

    kf       independent objects, with the process noise that is the most likely one on scenes of other seeds
    saga     the true interactions and the true process noise, matched by the Hungarian algorithm
    graph    the same, matched as a graph
    learned  as saga, with interactions and process noise learned from how objects move in those other scenes

Each cell changes one thing about the base scene; the dense cells change several. Intervals are of a paired bootstrap
over scenes. The claim is that of Sani et al. (SAGA-KF, ICPR 2024), the scenes are ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.drawn_scenes import LABEL, DrawnSettings, drawn_config, drawn_scene
from benchmarks.in_view_fit import fit_interactions_in_view
from data_tools.metrics import Interval, SceneMetrics, difference, paired_bootstrap, ratio_of_sums, scene_metrics
from pipelines.config import TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.learning import Trajectories, fit_acceleration_noise_by_class, measured_trajectories
from saga_fg.model.edge_rules import Neighbours
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.dataset import Scene

BASE = DrawnSettings()
OCCLUDED = replace(BASE, spacing=2.5, hidden=0.4, hidden_for=3.0)
CELLS: Mapping[str, DrawnSettings] = {
    "base": BASE,
    "no coupling": replace(BASE, coupling=0.0),
    "weak coupling": replace(BASE, coupling=1.0),
    "strong coupling": replace(BASE, coupling=4.0),
    "little noise": replace(BASE, noise=0.15),
    "much noise": replace(BASE, noise=0.6),
    "nobody hidden": replace(BASE, hidden=0.0),
    "often hidden": replace(BASE, hidden=0.4),
    "sparse": replace(BASE, spacing=8.0),
    "dense": replace(BASE, spacing=2.5),
    "dense hidden": replace(OCCLUDED, coupling=4.0, acceleration_noise=1.0),
    "dense hidden lively": replace(OCCLUDED, coupling=8.0, acceleration_noise=2.0),
}
DENSE = ("dense hidden", "dense hidden lively")
KF, SAGA, GRAPH, LEARNED = "kf", "saga", "graph", "learned"
FIGURES = ("MOTA", "MOTP", "IDS")
FIT_SCENES, FIRST_FIT_SEED = 4, 10_000
LEARNED_SCENES, LEARNED_SECONDS = 2, 8.0  # of them that interactions are learned from, and how much of each
LABEL_NOISE = 0.005  # standard deviation of the true positions, which are exact, for the sake of the filter, m
TEMPLATE = Neighbours(
    rate=0.7, distance_scale=10.0, heading_scale=1.0, speed_scale=1.5, max_distance=30.0, max_degree=8, classes=(LABEL,)
)
"""From where interactions are learned: no value is a true one, and more objects may interact than do."""
DEGREES = (3, 5)  # numbers of edges a node may have, tried in place of the template's

Sums = Callable[[SceneMetrics], tuple[float, float]]


def _independent(settings: DrawnSettings, scenes: Sequence[Scene]) -> TrackConfig:
    """Without edges, the noise fitted on scenes of the cell."""
    config = drawn_config(settings, ())
    objects = measured_trajectories(scenes, config.sensors)
    return config.with_acceleration_noise(fit_acceleration_noise_by_class(objects))


def _learned(settings: DrawnSettings, scenes: Sequence[Scene]) -> TrackConfig:
    """Interactions and process noise fitted to the truth of some scenes of the cell; as kf where nothing is shared."""
    recordings = [Trajectories.of_truth(scene).until(LEARNED_SECONDS) for scene in scenes[:LEARNED_SCENES]]
    fitted = fit_interactions_in_view(recordings, LABEL_NOISE, {DEFAULT: 1.0}, (TEMPLATE,), DEGREES)
    if not fitted.rules:
        return _independent(settings, scenes)
    config = drawn_config(settings, fitted.rules).with_acceleration_noise(fitted.acceleration_noise)
    return replace(config, tracker=replace(config.tracker, explained_noise=fitted.explained_noise))


CONTENDERS: Mapping[str, Callable[[DrawnSettings, Sequence[Scene]], TrackConfig]] = {
    KF: _independent,
    SAGA: lambda settings, scenes: drawn_config(settings),
    GRAPH: lambda settings, scenes: drawn_config(settings).with_association("graph"),
    LEARNED: _learned,
}
"""How each contender tracks a cell, given scenes of it, of other seeds, to learn from."""

COMPARISONS = (
    *((SAGA, KF, figure) for figure in FIGURES),
    *((GRAPH, KF, figure) for figure in FIGURES),
    (GRAPH, SAGA, "IDS"),
    *((LEARNED, each, figure) for each in (KF, SAGA) for figure in FIGURES),
)
"""Contender, what it is compared with, and the figure."""

SUMS: Mapping[str, Sums] = {
    "MOTA": lambda m: m.mota_sums,
    "MOTP": lambda m: (float(m.position.values.sum()), float(len(m.position))),
    "IDS": lambda m: (float(m.switches), 1.0),
}
"""Of each figure, the sums over scenes whose ratio it is; identity switches are per scene."""


@dataclass(frozen=True, eq=False)
class Cell:
    """The metrics of each contender on each scene of a cell, or of several cells put together."""

    name: str
    metrics: Mapping[str, Sequence[SceneMetrics]]

    def figure(self, contender: str, figure: str) -> float:
        """MOTA, MOTP in m, or identity switches a scene."""
        return float(ratio_of_sums(self._sums(contender, figure).sum(axis=0)))

    def change(self, contender: str, baseline: str, figure: str) -> Interval:
        """Of a figure from the baseline's: a difference of MOTA, a relative change of MOTP and of switches."""
        a, b = self._sums(contender, figure), self._sums(baseline, figure)
        if figure == "MOTA":
            return paired_bootstrap(a, b, ratio_of_sums, difference)
        return paired_bootstrap(a, b, ratio_of_sums)

    def worse(self, contender: str, baseline: str) -> tuple[str, ...]:
        """The figures in which the contender is significantly worse."""
        changes = {figure: self.change(contender, baseline, figure) for figure in FIGURES}
        return tuple(f for f, change in changes.items() if (change.high < 0 if f == "MOTA" else change.low > 0))

    def _sums(self, contender: str, figure: str) -> FloatArray:
        return np.array([SUMS[figure](m) for m in self.metrics[contender]])


@dataclass(frozen=True, eq=False)
class SyntheticResult:
    """The cells, and two pools of them: all with interactions, and the dense and occluded ones."""

    cells: tuple[Cell, ...]
    interacting: Cell
    dense: Cell


def synthetic(
    seeds: Sequence[int],
    cells: Mapping[str, DrawnSettings] | None = None,
    progress: Progress | None = None,
) -> SyntheticResult:
    """Track the scenes of `seeds`, drawn anew for every cell."""
    cells = CELLS if cells is None else cells
    measured = []
    for done, (name, settings) in enumerate(cells.items()):
        measured.append(_cell(name, settings, seeds))
        if progress is not None:
            progress(name, done + 1, len(cells))
    interacting = [cell for cell in measured if cells[cell.name].coupling > 0]
    dense = [cell for cell in measured if cell.name in DENSE]
    return SyntheticResult(
        tuple(measured), _pooled("all interacting", interacting), _pooled("both dense hidden", dense)
    )


def _cell(name: str, settings: DrawnSettings, seeds: Sequence[int]) -> Cell:
    to_learn_from = [drawn_scene(settings, FIRST_FIT_SEED + k) for k in range(FIT_SCENES)]
    configs = {contender: make(settings, to_learn_from) for contender, make in CONTENDERS.items()}
    metrics: dict[str, list[SceneMetrics]] = {contender: [] for contender in configs}
    for seed in seeds:
        scene = drawn_scene(settings, seed)
        assert scene.ground_truth is not None
        for contender, config in configs.items():
            tracks = track_scene(scene, config.new_tracker("saga")).tracks
            metrics[contender].append(scene_metrics(scene.ground_truth, tracks))
    return Cell(name, metrics)


def _pooled(name: str, cells: Sequence[Cell]) -> Cell:
    return Cell(name, {each: [m for cell in cells for m in cell.metrics[each]] for each in CONTENDERS})
