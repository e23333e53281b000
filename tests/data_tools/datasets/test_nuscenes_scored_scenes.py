"""A result file beside its ground truth: what is read, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.datasets.nuscenes.source import read_scored_scenes
from data_tools.metrics import nuscenes_tracking_metrics
from saga_fg import InputError
from tests.data_tools.nuscenes_example import VERSION, annotation, box, tables, write_tables


def tracked(sample: str, track: str = "t", **changes: Any) -> dict[str, Any]:
    """A tracked car in the official format."""
    fields = {k: v for k, v in box(sample, velocity=[0.0, 0.0]).items() if not k.startswith(("detection", "attribute"))}
    return fields | {"tracking_id": track, "tracking_name": "car", "tracking_score": 0.5} | changes


def write(path: Path, results: dict[str, Any]) -> Path:
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results}))
    return path


def content_with_rack() -> dict[str, list[dict[str, Any]]]:
    content = tables()
    content["category"].append({"token": "k-rack", "name": "static_object.bicycle_rack"})
    content["instance"].append({"token": "i-rack", "category_token": "k-rack"})
    content["sample_annotation"].append(annotation("a1", "i-rack", [20.0, 3.0, 1.0], points=0))
    return content


def test_truth_tracks_and_racks_of_each_sample(tmp_path: Path) -> None:
    root = write_tables(tmp_path, content_with_rack())
    results = {"a0": [tracked("a0"), tracked("a0", "u")], "a1": [], "a2": [tracked("a2")], "b0": []}
    (scored,) = read_scored_scenes(write(tmp_path / "r.json", results), root, VERSION, ["scene-0103"]).values()
    scene = scored.tracking
    assert [len(truth) for truth in scored.scene.ground_truth or ()] == [2, 1, 2]  # seen or not
    assert np.diff(scene.timestamps) == pytest.approx([0.5, 0.5])
    assert scene.ego_position.tolist() == [[0.0, 0.0], [5.0, 0.0], [10.0, 0.0]]
    assert scene.truth.frame.tolist() == [0, 0, 2, 2]  # the car has no point at a1, the barrier is not tracked
    assert sorted(scene.truth.id.tolist()) == ["i-car", "i-car", "i-ped", "i-ped"]
    assert scene.found.frame.tolist() == [0, 0, 2]
    assert scene.found.id.tolist() == ["t", "u", "t"]
    assert [len(racks) for racks in scene.racks] == [0, 1, 0]
    rack = scene.racks[1]
    assert rack.position.tolist() == [[20.0, 3.0, 1.0]]
    assert rack.size.tolist() == [[4.0, 2.0, 1.5]]  # length, width, height
    assert rack.yaw == pytest.approx([np.pi / 2])
    assert nuscenes_tracking_metrics([scene]).overall.gt == 0  # all is further than 50 m from the vehicle


def test_a_missing_sample_is_refused(tmp_path: Path) -> None:
    root = write_tables(tmp_path)
    result = write(tmp_path / "r.json", {"a0": [], "a2": []})
    with pytest.raises(InputError, match=r"r\.json: expected every sample of scene scene-0103, a1 is missing"):
        read_scored_scenes(result, root, VERSION, ["scene-0103"])


def test_more_than_500_boxes_are_refused(tmp_path: Path) -> None:
    root = write_tables(tmp_path)
    results = {"a0": [tracked("a0", f"t{n}") for n in range(501)], "a1": [], "a2": []}
    with pytest.raises(InputError, match="sample a0: expected at most 500 boxes"):
        read_scored_scenes(write(tmp_path / "r.json", results), root, VERSION, ["scene-0103"])


def test_a_broken_rack_is_named(tmp_path: Path) -> None:
    content = content_with_rack()
    content["sample_annotation"][-1]["size"] = [2.0, -4.0, 1.5]
    root = write_tables(tmp_path, content)
    result = write(tmp_path / "r.json", {"a0": [], "a1": [], "a2": []})
    with pytest.raises(InputError, match=r"sample_annotation\.json: scene scene-0103: size"):
        read_scored_scenes(result, root, VERSION, ["scene-0103"])
