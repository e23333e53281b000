"""The picture of README.md: tracks of two methods at a moment of the demo, beside the true objects, from above."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.figures import new_figure, png
from pipelines.config import TrackConfig
from pipelines.demo import TITLES, Comparison, hardest_moment
from pipelines.report import scene_of_run
from pipelines.view import SceneView, draw_scene
from pipelines.view.scenes import EDGE, Arrows, Drawing, Lines, Pose, Solids
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_transform

ANGLE = np.linspace(0.0, 2 * np.pi, 64)
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=-1)
SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
DARKER = 0.8  # than in viewers, whose background is black
STEADY = 0.5  # m/s, below which no velocity is drawn
LEFT_OUT = "ego_path"  # the vehicle's way before and after the moment
STYLES: Mapping[str, dict[str, Any]] = {
    "seen": {"facecolor": "#cfcfcf", "edgecolor": "none"},
    "hidden": {"facecolor": "#f3dcc4", "edgecolor": "#b5651d", "hatch": "////", "linewidth": 0.5},
    "body": {"facecolor": "#1d2733", "edgecolor": "none"},
    "ellipses": {"linewidth": 0.8, "alpha": 0.5},
}
"""How solids of a layer are drawn; those of others are outlines in their own colour."""
Extent = tuple[float, float, float, float]


def write_birds_eye_picture(path: Path, comparison: Comparison, config: TrackConfig) -> None:
    """Draw the tracks of kf and saga at the moment with the most hidden objects."""
    scene, moment = hardest_moment(comparison)
    panels, name = {}, comparison.runs["kf"][scene].scene.name
    for method, rules in (("kf", ()), ("saga", config.tracker.edges)):
        shown = SceneView(scene_of_run({method: comparison.runs[method][scene]}, rules, config.sensors))
        panels[TITLES[method]] = [each for each in draw_scene(shown) if each.moment in (None, moment)]
    path.write_bytes(png(picture(panels, f"{name}/ego")))


def picture(panels: Mapping[str, Iterable[Drawing]], frame: str, extent: Extent = (-40.0, 70.0, -22.0, 22.0)) -> Any:
    """A matplotlib `Figure` with a panel for each title, one below the other.

    panels  drawings of one moment of a scene, in any order
    frame   the moving one, such as the vehicle's, about which the picture is drawn, its x to the right
    extent  in that frame: rear, front, right, left, m
    """
    rear, front, right, left = extent
    height = 12.0 * (left - right) / (front - rear)
    figure = new_figure(12.0, (height + 0.45) * len(panels) + 0.5)
    axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True, sharey=True))
    for ax, (title, drawings) in zip(axes, panels.items(), strict=True):
        ax.set(xlim=(rear, front), ylim=(right, left), aspect="equal", ylabel="left, m")
        ax.set_title(title, loc="left", fontsize=11)
        ax.grid(color="#e6e6e6", linewidth=0.6)
        ax.set_axisbelow(True)
        shown = [each for each in drawings if each.name != LEFT_OUT]
        poses = _poses(shown)
        for each in shown:
            _draw(ax, each, inverse_transform(poses[frame]) @ poses.get(each.frame, np.eye(4)))
    axes[-1].set_xlabel("ahead, m")
    figure.legend(handles=_legend(), loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    return figure


def _poses(drawings: Iterable[Drawing]) -> dict[str, FloatArray]:
    """The poses of all frames in the frame above them all."""
    poses: dict[str, FloatArray] = {}
    for each in sorted(drawings, key=lambda each: each.path):
        if isinstance(each.shape, Pose):
            poses[each.path] = poses.get(each.frame, np.eye(4)) @ each.shape.parent_T_child
    return poses


def _draw(ax: Any, drawing: Drawing, view_T_frame: FloatArray) -> None:
    layer, shape = drawing.name.rpartition("/")[2], drawing.shape

    def placed(points: FloatArray) -> FloatArray:
        return np.asarray(transform_points(view_T_frame, points)[:, :2])

    match shape:
        case Solids() if layer == "detections":
            ax.plot(*placed(shape.centre).T, "x", color="black", markersize=4, markeredgewidth=0.9, zorder=5)
        case Solids():
            scores = [float(score) for score in shape.facts.get("score", ["1"] * len(shape.centre))]
            for row, (centre, colour) in enumerate(zip(shape.centre, _colours(shape), strict=True)):
                outline = np.zeros((64 if shape.round else 4, 3))
                outline[:, :2] = (CIRCLE if shape.round else SQUARE) * shape.size[row, :2] / 2
                x, y, z = centre.tolist()
                ring = placed(transform_points(yaw_transform(x, y, z, float(shape.yaw[row])), outline))
                style = {
                    "facecolor": "none",
                    "edgecolor": colour,
                    "linewidth": 1.4,
                    "zorder": 2 if layer in STYLES else 6,
                }
                style["alpha"] = 0.3 + 0.7 * min(max(scores[row], 0.0), 1.0)
                ax.fill(*ring.T, **(style | STYLES.get(layer, {})))
                if layer == "boxes":
                    near: dict[str, Any] = {"xytext": (0, 7), "textcoords": "offset points", "annotation_clip": True}
                    ax.annotate(
                        shape.facts["id"][row], ring.mean(axis=0), fontsize=7, ha="center", color=colour, **near
                    )
        case Lines():
            for strip, colour in zip(shape.strips, _colours(shape), strict=False):
                ax.plot(*placed(strip).T, color=colour, linewidth=1.0, alpha=0.6, zorder=3)
        case Arrows():
            ends = zip(placed(shape.tail), placed(shape.tail + np.pad(shape.vector, ((0, 0), (0, 1)))), strict=True)
            for (tail, tip), colour in zip(ends, _colours(shape), strict=False):
                if np.hypot(*(tip - tail)) > STEADY:
                    arrow = {"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0}
                    ax.annotate("", tip, tail, arrowprops=arrow, annotation_clip=True)


def _colours(shape: Solids | Lines | Arrows) -> FloatArray:
    """The colour of each thing, (N, 3)."""
    count = len(shape.centre if isinstance(shape, Solids) else shape.strips if isinstance(shape, Lines) else shape.tail)
    return np.broadcast_to(DARKER * shape.colour / 255, (count, 3))


def _legend() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(label="own vehicle", **STYLES["body"]),
        Patch(label="true object, in view", **STYLES["seen"]),
        Patch(label="hidden", **STYLES["hidden"]),
        Line2D([], [], color="black", marker="x", linestyle="none", markersize=5, label="detection"),
        Line2D([], [], color="#1f77b4", linewidth=1.4, label="track, with its 90 % ellipse"),
        Line2D([], [], color=EDGE[0] / 255, label="edge of the graph"),
    ]
