"""`python -m benchmarks synthetic`: MOTA, MOTP and identity switches over coupling, noise, occlusion and density.

Scenes are sampled from the interaction model (`benchmarks.sampled_scenes`), and tracked by

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
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.in_view_fit import fit_interactions_in_view
from benchmarks.sampled_scenes import LABEL, SceneSettings, sample_scene, sampled_config
from data_tools.datasets.source import names
from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval, SceneMetrics, difference, paired_bootstrap, ratio_of_sums, scene_metrics
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.config import TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.errors import InputError
from saga_fg.learning import fit_acceleration_noise_by_class, measured_trajectories
from saga_fg.model.edge_rules import Neighbours
from saga_fg.model.motion import ConstantVelocity
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.dataset import Scene
from saga_fg.types.labelled_objects import LabelledObjects

BASE = SceneSettings()
OCCLUDED = replace(BASE, spacing=2.5, hidden=0.4, hidden_for=3.0)
CELLS: Mapping[str, SceneSettings] = {
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


def _independent(settings: SceneSettings, scenes: Sequence[Scene]) -> TrackConfig:
    """Without edges, the noise fitted on scenes of the cell."""
    config = sampled_config(settings, ())
    objects = measured_trajectories(scenes, config.sensors)
    noise = fit_acceleration_noise_by_class(objects)
    return config.with_motions({label: ConstantVelocity(q) for label, q in noise.items()})


def _learned(settings: SceneSettings, scenes: Sequence[Scene]) -> TrackConfig:
    """Interactions and process noise fitted to the truth of some scenes of the cell; as kf where nothing is shared."""
    recordings = [
        LabelledObjects.of(scene).about_their_mean().until(LEARNED_SECONDS) for scene in scenes[:LEARNED_SCENES]
    ]
    fitted = fit_interactions_in_view(recordings, LABEL_NOISE, {DEFAULT: 1.0}, (TEMPLATE,), DEGREES)
    if not fitted.rules:
        return _independent(settings, scenes)
    motions = {label: ConstantVelocity(q) for label, q in fitted.acceleration_noise.items()}
    config = sampled_config(settings, fitted.rules).with_motions(motions)
    return replace(config, tracker=replace(config.tracker, explained_noise=fitted.explained_noise))


CONTENDERS: Mapping[str, Callable[[SceneSettings, Sequence[Scene]], TrackConfig]] = {
    KF: _independent,
    SAGA: lambda settings, scenes: sampled_config(settings),
    GRAPH: lambda settings, scenes: sampled_config(settings).with_association("graph"),
    LEARNED: _learned,
}
"""Contenders by name: a tracker for a cell, given scenes of the cell with other seeds to learn from."""

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
"""The two sums over scenes whose ratio is each figure; identity switches are per scene."""


@dataclass(frozen=True, eq=False)
class Cell:
    """The metrics of each contender on each scene of a cell, or of several cells put together."""

    name: str
    metrics: Mapping[str, Sequence[SceneMetrics]]

    def figure(self, contender: str, figure: str) -> float:
        """MOTA, MOTP in m, or identity switches a scene."""
        return float(ratio_of_sums(self._sums(contender, figure).sum(axis=0)))

    def change(self, contender: str, baseline: str, figure: str) -> Interval:
        """Change of a figure from the baseline's: difference of MOTA, relative change of MOTP and of switches."""
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


def bench_synthetic(
    seeds: Sequence[int],
    cells: Mapping[str, SceneSettings] | None = None,
    progress: Progress | None = None,
) -> tuple[Cell, ...]:
    """Track the scenes of `seeds`, sampled anew for every cell.

    Returns the cells, and after them the pools of all cells with interactions and of the dense and occluded ones, if
    there are any.
    """
    cells = CELLS if cells is None else cells
    measured = []
    for done, (name, settings) in enumerate(cells.items()):
        measured.append(_cell(name, settings, seeds))
        if progress is not None:
            progress(name, done + 1, len(cells))
    interacting = [cell for cell in measured if cells[cell.name].coupling > 0]
    dense = [cell for cell in measured if cell.name in DENSE]
    pools = {"all interacting": interacting, "both dense hidden": dense}
    return (*measured, *(_pooled(name, some) for name, some in pools.items() if some))


def _cell(name: str, settings: SceneSettings, seeds: Sequence[int]) -> Cell:
    to_learn_from = [sample_scene(settings, FIRST_FIT_SEED + k) for k in range(FIT_SCENES)]
    configs = {contender: make(settings, to_learn_from) for contender, make in CONTENDERS.items()}
    metrics: dict[str, list[SceneMetrics]] = {contender: [] for contender in configs}
    for seed in seeds:
        scene = sample_scene(settings, seed)
        assert scene.ground_truth is not None
        for contender, config in configs.items():
            tracks = track_scene(scene, config.new_tracker("saga")).tracks
            metrics[contender].append(scene_metrics(scene.ground_truth, tracks))
    return Cell(name, metrics)


def _pooled(name: str, cells: Sequence[Cell]) -> Cell:
    return Cell(name, {each: [m for cell in cells for m in cell.metrics[each]] for each in CONTENDERS})


def synthetic(
    seeds: Annotated[int, typer.Option("--seeds", min=2, help="Scenes of each cell.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    cells: Annotated[
        str | None, typer.Option("--cells", help="Names of cells, with commas between; all if left out.")
    ] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Independent objects, interactions, and graph matching over coupling, noise, occlusion and density.

    A cell of ten scenes takes two minutes of one core, half of it to learn interactions.

    \b
    Examples:
      python -m benchmarks synthetic
      python -m benchmarks synthetic --seeds 2 --cells 'base,no coupling' --json figures.json
    """
    chosen = dict(CELLS) if cells is None else {}
    for name in names("--cells", cells) if cells is not None else ():
        if name not in CELLS:
            raise InputError(f"--cells {name}: expected some of {', '.join(CELLS)}")
        chosen[name] = CELLS[name]
    with progress_bar(unit="cells") as progress:
        measured = bench_synthetic(range(seed, seed + seeds), chosen, progress)
    pairs = [(each, figure) for figure in FIGURES for each in CONTENDERS]
    values = FigureTable(
        f"{seeds} scenes a cell; MOTP in m, identity switches (IDS) a scene",
        ("cell", *(f"{figure} {each}" for each, figure in pairs)),
        tuple((part.name, *(cell(part.figure(*pair)) for pair in pairs)) for part in measured),
    )
    changes = FigureTable(
        "changes with 95 % intervals: MOTA as a difference, the others in %",
        ("cell", *(f"{figure}, {a} to {b}" for a, b, figure in COMPARISONS)),
        tuple((part.name, *(_interval(part, *each) for each in COMPARISONS)) for part in measured),
    )
    report([values, changes], {part.name: _as_json(part) for part in measured}, json_file)


def _interval(cell: Cell, contender: str, baseline: str, figure: str) -> str:
    change = cell.change(contender, baseline, figure)
    if figure == "MOTA":
        return f"{change.estimate:+.3f} ({change.low:+.3f} to {change.high:+.3f})"
    return percent(change, 0)


def _as_json(cell: Cell) -> dict[str, Any]:
    return {
        "figures": {each: {figure: cell.figure(each, figure) for figure in FIGURES} for each in CONTENDERS},
        "changes": {f"{figure}: {a} to {b}": cell.change(a, b, figure) for a, b, figure in COMPARISONS},
        "significantly_worse_than_kf": {each: cell.worse(each, KF) for each in CONTENDERS if each != KF},
    }
