"""The picture of docs/guides/heterogeneous-graphs.md: predictions over two seconds, cars alone and the full graph."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from data_tools.simulator.settings import scenario_settings
from data_tools.simulator.world import World, build_world, scene_from_world
from pipelines.config import TrackConfig, load_config
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks

HORIZON, MOMENT = 2.0, 5.0  # s: of the prediction, and when it is made
KIND, SEED, TITLE = "red-light", 500, "before a red light"
COLOURS = {"cars alone": "#1f77b4", "full graph": "#d62728"}


def cars_alone(config: TrackConfig) -> TrackConfig:
    """The configuration without the edges of lights, lines, cones and couplings."""
    edges = tuple(edge for edge in config.tracker.edges if isinstance(edge, Following | Neighbours))
    return replace(config, tracker=replace(config.tracker, edges=edges))


def before_a_red_light(world: World, time: float) -> StrArray:
    """Ids of vehicles within 100 m before a closed stop line."""
    history = world.history
    k = int(np.argmin(np.abs(history.time - time)))
    found = np.zeros(history.s.shape[1], dtype=np.bool_)
    for line in world.layout.stop_lines:
        if line.closed(time):
            ahead = line.s - history.s[k]
            found |= np.isin(history.lane[k], line.lanes) & (ahead > 0) & (ahead < 100.0)
    return np.array([f"vehicle-{number}" for number in np.flatnonzero(found & history.on_road[k])])


def predicted(scene: Scene, config: TrackConfig, row: int) -> Tracks:
    """The tracks `HORIZON` s after the moment `row` of a scene, from the frames up to it."""
    tracker = config.new_tracker("saga")
    for frame in scene.frames:
        if frame.timestamp <= scene.timestamps[row]:
            tracker.step(frame)
    return tracker.tracks(float(scene.timestamps[row]) + HORIZON)


def draw(axes: Any, boxes: Boxes, world_T_local: FloatArray, **style: Any) -> None:
    """Outlines of boxes."""
    local = boxes.transformed(inverse_transform(world_T_local))
    for corners in local.corners():
        axes.fill(*corners.T, **style)


def panel(axes: Any) -> None:
    """One scene: what is there, and where vehicles before the light are, and are predicted to be, two seconds later."""
    settings = replace(scenario_settings(KIND), duration=MOMENT + HORIZON + 1)
    world: World = build_world(settings, SEED)
    scene = scene_from_world(world, settings, SEED)
    row = round(MOMENT * settings.keyframe_rate)
    then = scene.ground_truth[row + round(HORIZON * settings.keyframe_rate)]  # type: ignore[index]
    now = scene.ground_truth[row]  # type: ignore[index]
    asked = np.isin(then.id, before_a_red_light(world, world.start + MOMENT))
    pose = scene.world_T_ego[row]
    draw(axes, now.boxes, pose, facecolor="#dddddd", edgecolor="none")
    draw(axes, then.boxes.select(asked), pose, facecolor="none", edgecolor="black", linewidth=1.2)
    full = load_config("heterogeneous")
    for name, config in (("cars alone", cars_alone(full)), ("full graph", full)):
        tracks = predicted(scene, config, row)
        truth = then.boxes.position[asked, None, :2]
        near = np.linalg.norm(tracks.boxes.position[:, :2] - truth, axis=-1).min(axis=0, initial=np.inf) < 6.0
        moving = near & np.isin(tracks.boxes.label, ("car", "truck", "bus"))
        draw(axes, tracks.boxes.select(moving), pose, facecolor="none", edgecolor=COLOURS[name], linewidth=1.2)
    local = inverse_transform(pose)
    if world.road_map is not None:
        for line in world.road_map.stop_lines:
            ends = line.ends @ local[:2, :2].T + local[:2, 3]
            axes.plot(*ends.T, color="#d62728", linewidth=3)
    axes.set(xlim=(-40, 60), ylim=(-13, 13), aspect="equal", ylabel="left, m")
    axes.set_title(TITLE, loc="left", fontsize=11)


def write_heterogeneous_picture(folder: Path) -> None:
    """`heterogeneous.png`."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axes = figure.subplots()
    panel(axes)
    axes.set_xlabel("ahead, m")
    handles = [
        Patch(facecolor="#dddddd", label="now"),
        Patch(facecolor="none", edgecolor="black", label="vehicles before the light, true, in 2 s"),
        *(Patch(facecolor="none", edgecolor=colour, label=f"predicted by {n}") for n, colour in COLOURS.items()),
        Line2D([], [], color="#d62728", linewidth=3, label="stop line"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(folder / "heterogeneous.png", dpi=110)


if __name__ == "__main__":
    write_heterogeneous_picture(Path(__file__).parent)
