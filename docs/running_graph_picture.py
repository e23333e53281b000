"""The pictures of the running graph: `running_graph.png` of a window, `explained_graph.png` of a tracker at work."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from benchmarks.sampled_traffic import SampledTraffic, providers, sample_traffic
from data_tools.plots import running_graph_picture
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.explaining import graph_picture
from saga_fg import Tracker
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import EGO_POSE, LANDMARK, Additions, GraphView, NewVariable
from saga_fg.tracking import Journal
from saga_fg.tracking.journal import GraphRecord

SEED = 63
POST = np.array([18.0, 9.0])


class Post:
    """A post beside the road, seen in range and bearing from every pose."""

    name = "landmarks"

    def __init__(self, scene: SampledTraffic) -> None:
        self.scene = scene

    def factors(self, view: GraphView) -> Additions:
        pose, key = self.scene.frames[view.epoch].pose, view.key(LANDMARK, 1, static=True)
        bearing, distance = pose.bearing(POST).theta(), pose.range(POST)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.02, 0.1]))
        seen = gtsam.BearingRangeFactor2D(view.key(EGO_POSE, 0), key, gtsam.Rot2(bearing), distance, noise)
        new = [] if view.static(LANDMARK) else [NewVariable(LANDMARK, 1, POST, static=True, label="post")]
        return Additions(new, [seen])


def write_running_graph_pictures(folder: Path) -> None:
    """Both pictures."""
    scene = sample_traffic(np.random.default_rng(SEED), frames=5, cars=2, pedestrians=3, intervals=(0.6,))
    smoother = IncrementalSmoother([*providers(scene), Post(scene)], lag=0.5)
    for moment in scene.frames:
        smoother.step(moment.time)
    record = GraphRecord()
    record.add(smoother.graph(), covariance=smoother.covariance)
    title = f"the running graph at {smoother.time:.2f} s, lag 0.5 s"
    graph = {"nodes": record.nodes, "factors": record.factors}
    running_graph_picture(graph, title).savefig(folder / "running_graph.png", dpi=110)

    traffic = SimulatedTraffic(SimulatorSettings(duration=4.0, warm_up=20.0), scenes=1, seed=1).scene("scene-0001")
    config, events = load_config("simulated").of_method("saga"), []
    observer = Journal(config.tracker, events.append)
    tracker = Tracker(config.tracker, config.sensors, observer=observer)
    for frame in traffic.frames:
        tracker.step(frame)
    graphs = {traffic.name: [event for event in events if event["event"] == "graph"]}
    graph_picture(graphs, None, 1.8).savefig(folder / "explained_graph.png", dpi=110)


if __name__ == "__main__":
    write_running_graph_pictures(Path(__file__).parent)
