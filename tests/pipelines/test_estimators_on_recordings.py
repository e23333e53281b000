"""Without bounds, iSAM2 tracks recordings as the joint Kalman filter does, and interactions are its factors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recording_sets import recording_set
from pipelines.config import load_config
from saga_fg.estimators import GraphFilter
from saga_fg.model.discretisation import Transition


@pytest.mark.parametrize(("name", "scene", "count"), [("megvii", "scene-0655", 20), ("kitti", "0011", 30)])
def test_isam2_gives_the_tracks_of_kalman(recordings: Path, name: str, scene: str, count: int) -> None:
    chosen = recording_set(name, recordings, 1)
    config = load_config(chosen.family)
    exact = replace(config.tracker, tolerance=0.0, max_component=None)
    trackers = [
        replace(config, tracker=replace(exact, estimator=estimator)).new_tracker("saga")
        for estimator in ("kalman", "isam2")
    ]
    for frame in list(chosen.dataset.scene(scene).frames)[:count]:
        for tracker in trackers:
            tracker.step(frame)
        expected, found = (tracker.tracks(frame.timestamp) for tracker in trackers)
        assert expected.id.tolist() == found.id.tolist()
        np.testing.assert_allclose(found.boxes.position, expected.boxes.position, rtol=0, atol=1e-9)


def test_every_edge_of_a_frame_is_a_factor_of_isam2(recordings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the states of three or more nodes and epochs; no variable is larger than the state of one node."""
    predict, frames = GraphFilter.predict, list[tuple[int, int, int]]()

    def traced(self: GraphFilter, transition: Transition) -> None:
        predict(self, transition)
        edges = {
            (i, j)
            for F in transition.F
            for i, j, block in zip(transition.nodes[F.target], transition.nodes[F.source], F.values, strict=True)
            if i != j and block.any()
        }
        if transition.dt == 0 or not edges:
            return
        isam = self._smoother._ready().isam
        held = isam.getFactorsUnsafe()
        factors = [set(held.at(slot).keys()) for slot in range(held.size()) if held.exists(slot)]
        earlier, now = (epoch.keys for epoch in self._window.epochs[-2:])
        found = sum(any({now[i], earlier[i], earlier[j]} <= keys for keys in factors) for i, j in edges)
        frames.append((len(edges), found, sum(len(keys) >= 3 for keys in factors)))
        assert max(isam.getDelta().at(key).size for keys in factors for key in keys) <= transition.graph.dims.max()

    monkeypatch.setattr(GraphFilter, "predict", traced)
    chosen, config = recording_set("kitti", recordings, 1), load_config("kitti")
    tracker = replace(config, tracker=replace(config.tracker, estimator="isam2")).new_tracker("saga")
    for frame in chosen.dataset.scene("0011").frames:
        tracker.step(frame)
    edges, found, wide = np.sum(frames, axis=0)
    print(f"{len(frames)} frames with {edges} edges, {found} of them factors of iSAM2; {wide} of three or more in all")
    assert found == edges
    assert len(frames) > 200
    assert wide > 600
