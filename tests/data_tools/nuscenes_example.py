"""A hand-written nuScenes of two scenes, small enough to know every number: the ground for the tests of its reader.

scene-0103 (mini_val) has samples a0 a1 a2 at 0, 0.5, 1.0 s after its start; scene-0061 (mini_train) has b0, b1. The
vehicle drives 5 m per sample along x, heading +90 degrees. A car (instance i-car) is annotated at every sample of
scene-0103, a pedestrian (i-ped) at a0 and a2, a barrier (i-barrier, not tracked) at a0.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

START = 1_600_000_000_000_000  # us
QUARTER_TURN = [0.7071067811865476, 0.0, 0.0, 0.7071067811865476]
VERSION = "v1.0-mini"
SAMPLES = {"scene-0103": ["a0", "a1", "a2"], "scene-0061": ["b0", "b1"]}

Tables = dict[str, list[dict[str, Any]]]


def tables() -> Tables:
    result: Tables = {
        "scene": [],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "sensor": [{"token": "s-lidar", "channel": "LIDAR_TOP"}, {"token": "s-cam", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [
            {"token": "c-lidar", "sensor_token": "s-lidar"},
            {"token": "c-cam", "sensor_token": "s-cam"},
        ],
        "category": [
            {"token": "k-car", "name": "vehicle.car"},
            {"token": "k-ped", "name": "human.pedestrian.child"},
            {"token": "k-barrier", "name": "movable_object.barrier"},
        ],
        "instance": [
            {"token": "i-car", "category_token": "k-car"},
            {"token": "i-ped", "category_token": "k-ped"},
            {"token": "i-barrier", "category_token": "k-barrier"},
        ],
        "sample_annotation": [
            annotation("a1", "i-car", [103.0, 50.0, 1.0], points=0),
            annotation("a0", "i-car", [100.0, 50.0, 1.0], points=7),
            annotation("a2", "i-car", [108.0, 52.0, 1.0], points=9),
            annotation("a0", "i-ped", [90.0, 40.0, 1.0], points=3),
            annotation("a2", "i-ped", [91.0, 40.0, 1.0], points=3),
            annotation("a0", "i-barrier", [80.0, 30.0, 1.0], points=2),
        ],
    }
    for scene, tokens in SAMPLES.items():
        result["scene"].append(
            {"token": scene, "name": scene, "first_sample_token": tokens[0], "nbr_samples": len(tokens)}
        )
        for k, token in enumerate(tokens):
            time = START + 500_000 * k
            after = tokens[k + 1] if k + 1 < len(tokens) else ""
            result["sample"].append({"token": token, "timestamp": time, "next": after, "scene_token": scene})
            for sensor, key, offset in (("lidar", True, 0), ("cam", True, 1), ("lidar", False, 2)):
                pose = f"p-{token}-{offset}"
                result["sample_data"].append(
                    {
                        "token": pose,
                        "sample_token": token,
                        "ego_pose_token": pose,
                        "calibrated_sensor_token": f"c-{sensor}",
                        "is_key_frame": key,
                    }
                )
                result["ego_pose"].append(
                    {"token": pose, "translation": [5.0 * k + offset, 0.0, 0.0], "rotation": QUARTER_TURN}
                )
    return result


def annotation(sample: str, instance: str, translation: list[float], points: int) -> dict[str, Any]:
    return {
        "token": f"{sample}-{instance}",
        "sample_token": sample,
        "instance_token": instance,
        "translation": translation,
        "size": [2.0, 4.0, 1.5],
        "rotation": QUARTER_TURN,
        "num_lidar_pts": points,
        "num_radar_pts": 0,
    }


def box(sample: str, **changes: Any) -> dict[str, Any]:
    """A detected car in the official format."""
    return {
        "sample_token": sample,
        "translation": [100.0, 50.0, 1.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": QUARTER_TURN,
        "velocity": [float("nan"), float("nan")],
        "detection_name": "car",
        "detection_score": 0.5,
        "attribute_name": "",
    } | changes


def results() -> dict[str, list[dict[str, Any]]]:
    """Detections of scene-0103: one car at a0, nothing at a1, a car and a cone at a2; none of scene-0061 but b0."""
    return {
        "a0": [box("a0")],
        "a1": [],
        "a2": [box("a2", velocity=[3.0, -1.0]), box("a2", detection_name="traffic_cone", detection_score=0.25)],
        "b0": [box("b0")],
    }


def write_tables(root: Path, content: Tables | None = None) -> Path:
    """Write the tables below `root`, which is returned as the dataroot."""
    folder = root / VERSION
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in (content or tables()).items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    return root


def write_results(path: Path, content: Any = None, meta: Any = None) -> Path:
    """Write a detection file and return its path."""
    meta = {"use_camera": False, "use_lidar": True} if meta is None else meta
    path.write_text(json.dumps({"meta": meta, "results": results() if content is None else content}))
    return path
