"""The pictures of docs/concepts.md: a queue that brakes while one of its cars is hidden, by the tracker itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle

from saga_fg import Detection, Detections, Frame, Tracker, TrackerSettings
from saga_fg.model.edge_rules import EdgeRule, Following
from saga_fg.model.interactions import SharedVelocity
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking import ClassSettings
from saga_fg.types.by_class import DEFAULT

CARS, PERIOD, HIDDEN_FROM, BRAKING_FROM, END = 4, 0.1, 4.0, 4.2, 6.0  # s
HIDDEN = 2  # this car, counted from the leader
ELLIPSE_95 = 5.991  # 95 % quantile of the chi-square distribution with 2 degrees of freedom


@dataclass(frozen=True, eq=False)
class Follow:
    """Estimates of the hidden car along the road at times (k,), s, by one method: error and deviation (k,), m."""

    tracker: Tracker
    time: FloatArray
    error: FloatArray
    sigma: FloatArray


def queue_at(time: float) -> FloatArray:
    """Positions (CARS,) along the road, m, of cars at 12 m/s, 11 m apart, that brake together at 3 m/s^2."""
    braking = max(0.0, time - BRAKING_FROM)
    return np.asarray(12 * time - 1.5 * braking**2 - 11.0 * np.arange(CARS))


def follow(rules: tuple[EdgeRule, ...]) -> Follow:
    """Track the queue; the noise of the detections has a fixed seed."""
    rng = np.random.default_rng(0)
    tracker = Tracker(TrackerSettings({DEFAULT: ClassSettings(max_deviation=np.inf)}, edges=rules))
    rows = []
    for time in np.arange(0, END, PERIOD):
        places = queue_at(time)
        seen = [n for n in range(CARS) if n != HIDDEN or time < HIDDEN_FROM]
        noisy = {n: np.array([places[n], 0.0]) + rng.normal(0, 0.15, 2) for n in range(CARS)}
        cars = [Detection("car", (*noisy[n], 0.8), (4.5, 1.8, 1.5), score=0.95) for n in seen]
        tracks = tracker.step(Frame(float(time), "lidar", Detections.of(cars)))
        for track in tracks:
            if track.id == HIDDEN + 1:
                rows.append((time, track.position[0] - places[HIDDEN], track.position_covariance[0, 0] ** 0.5))
    return Follow(tracker, *np.array(rows).T)


def error_picture(alone: Follow, coupled: Follow) -> Figure:
    """Error of the hidden car with its band of two standard deviations, without and with the graph."""
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for panel, run, title in zip(
        axes, (alone, coupled), ("each object alone (kf)", "coupled by the graph (saga)"), strict=True
    ):
        panel.fill_between(
            run.time, -2 * run.sigma, 2 * run.sigma, color="#1f77b4", alpha=0.2, label="±2 standard deviations"
        )
        panel.plot(run.time, run.error, color="#d62728", label="error of the hidden car")
        panel.axvline(HIDDEN_FROM, color="grey", linestyle=":")
        panel.axvline(BRAKING_FROM, color="grey", linestyle="--")
        panel.set(title=title, xlabel="time, s", xlim=(3, END))
    axes[0].set_ylabel("along the road, m")
    axes[0].legend(loc="lower left", frameon=False)
    return figure


def graph_picture(run: Follow) -> Figure:
    """The scene graph of the last interval: estimates with their 95 % ellipses, and who influences whom."""
    tracks = run.tracker.tracks(run.time[-1])
    graph = run.tracker.graph
    assert graph is not None
    place = {track.id: track.position for track in tracks}
    figure = Figure(figsize=(8, 2.2), layout="constrained")
    axes = figure.subplots()
    for track in tracks:
        x, y, _ = track.position
        axes.add_patch(
            Rectangle(
                (x - 2.25, y - 0.9),
                4.5,
                1.8,
                facecolor="none",
                edgecolor="#1f77b4",
                linestyle="--" if track.coasting else "-",
            )
        )
        values, vectors = np.linalg.eigh(track.position_covariance)
        width, height = 2 * np.sqrt(ELLIPSE_95 * values)
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        axes.add_patch(Ellipse((x, y), width, height, angle=angle, color="#1f77b4", alpha=0.25))
        axes.text(x, y + 1.5, f"{track.id}{', hidden' if track.coasting else ''}", ha="center")
    for edges in graph.edges:
        for target, source, rate in zip(graph.nodes[edges.target], graph.nodes[edges.source], edges.rate, strict=True):
            arrow = {"arrowstyle": "->", "color": "#d62728", "connectionstyle": "arc3,rad=0.35", "lw": 1 + 2 * rate}
            axes.annotate("", place[int(target)][:2], place[int(source)][:2], arrowprops=arrow)
    xs = [x for x, _, _ in place.values()]
    axes.set(xlim=(min(xs) - 6, max(xs) + 6), ylim=(-4, 4), xlabel="along the road, m", ylabel="m", aspect="equal")
    return figure


def write_concept_pictures(folder: Path) -> None:
    """`hidden_car.png` and `scene_graph.png`."""
    rule = Following(interaction=SharedVelocity(along_heading=True), rate=1.5)
    alone, coupled = follow(()), follow((rule,))
    error_picture(alone, coupled).savefig(folder / "hidden_car.png", dpi=120)
    graph_picture(coupled).savefig(folder / "scene_graph.png", dpi=120)
