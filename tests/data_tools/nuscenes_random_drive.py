"""A random drive in the official nuScenes layout, with tracks to score: made for the parity test of the metrics.

Objects of all kinds wander round the vehicle, some beyond the range that is scored, some without a point for a while,
cycles among them in racks. Tracks follow them with noise, miss, lose and swap them; some are false; many scores repeat.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

VERSION = "v1.0-mini"
START = 1_500_000_000_000_000  # us
CATEGORIES = {
    "vehicle.car": "car",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "vehicle.truck": "truck",
    "vehicle.bus.rigid": "bus",
    "vehicle.bicycle": "bicycle",
    "vehicle.motorcycle": "motorcycle",
    "static_object.bicycle_rack": None,
    "movable_object.barrier": None,
}
Record = dict[str, Any]


def write_random_drive(root: Path, seed: int, scenes: int = 2, samples: int = 12, objects: int = 40) -> Path:
    """Write the tables and, as `result.json`, tracks; the split "drive" holds all scenes. Returns the result's path."""
    rng = np.random.default_rng(seed)
    tables: dict[str, list[Record]] = {name: [] for name in ("attribute", "visibility")}
    tables["category"] = [{"token": name, "name": name} for name in CATEGORIES]
    tables["sensor"] = [{"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"}]
    pose = {"translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]}
    tables["calibrated_sensor"] = [{"token": "lidar", "sensor_token": "lidar", "camera_intrinsic": [], **pose}]
    tables["log"] = [{"token": "log", "logfile": "drive", "location": "nowhere", "vehicle": "", "date_captured": ""}]
    tables["map"] = [{"token": "map", "filename": "maps/map.png", "category": "", "log_tokens": ["log"]}]
    for name in ("scene", "sample", "sample_data", "ego_pose", "instance", "sample_annotation"):
        tables[name] = []
    results: dict[str, list[Record]] = {}
    for number in range(scenes):
        _scene(f"scene-{number}", rng, tables, results, samples, objects)
    folder = root / VERSION
    folder.mkdir(parents=True)
    (root / "maps").mkdir()
    (root / "maps" / "map.png").touch()
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    (folder / "splits.json").write_text(json.dumps({"drive": [f"scene-{n}" for n in range(scenes)]}))
    meta = {f"use_{name}": False for name in ("camera", "lidar", "radar", "map", "external")}
    (root / "result.json").write_text(json.dumps({"meta": meta, "results": results}))
    return root / "result.json"


def _scene(
    scene: str,
    rng: np.random.Generator,
    tables: dict[str, list[Record]],
    results: dict[str, list[Record]],
    samples: int,
    objects: int,
) -> None:
    tokens = [f"{scene}-{k}" for k in range(samples)]
    times = START + np.cumsum(rng.integers(400_000, 600_000, samples))
    tables["scene"].append(
        {
            "token": scene,
            "name": scene,
            "description": "",
            "log_token": "log",
            "nbr_samples": samples,
            "first_sample_token": tokens[0],
            "last_sample_token": tokens[-1],
        }
    )
    vehicle = np.array([600.0, 1600.0]) + 3.0 * np.arange(samples)[:, None]
    kinds = rng.choice(list(CATEGORIES), objects)
    position = vehicle.mean(axis=0) + rng.uniform(-55, 55, (objects, 2))
    racks = position[kinds == "static_object.bicycle_rack"]
    if len(racks):  # some cycles stand in a rack
        parked = np.flatnonzero(np.isin(kinds, ["vehicle.bicycle", "vehicle.motorcycle"]) & (rng.random(objects) < 0.5))
        position[parked] = racks[rng.integers(len(racks), size=len(parked))] + rng.uniform(-2, 2, (len(parked), 2))
    speed = (
        rng.normal(0, 1, (objects, 2))
        * ~np.isin(kinds, ["static_object.bicycle_rack", "movable_object.barrier"])[:, None]
    )
    tables["instance"] += [{"token": f"{scene}-i{n}", "category_token": kind} for n, kind in enumerate(kinds)]
    track = [f"t{n}" for n in range(objects)]
    level = rng.choice([0.3, 0.5, 0.7, 0.9], objects)
    appearing, leaving = rng.integers(-3, samples // 2, objects), rng.integers(samples // 2, samples + 3, objects)
    for k, token in enumerate(tokens):
        at = {"token": token, "timestamp": int(times[k])}
        after = tokens[k + 1] if k + 1 < samples else ""
        tables["sample"].append({**at, "scene_token": scene, "next": after, "prev": tokens[k - 1] if k else ""})
        tables["sample_data"].append(
            {
                **at,
                "sample_token": token,
                "ego_pose_token": token,
                "calibrated_sensor_token": "lidar",
                "is_key_frame": True,
                "filename": "",
            }
        )
        tables["ego_pose"].append({**at, "translation": [*vehicle[k], 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]})
        position = position + 0.5 * speed
        results[token] = []
        for n, kind in enumerate(kinds):
            if not appearing[n] <= k <= leaving[n] or (kind == "vehicle.truck" and k % 4 == 2):
                continue  # a truck's annotations have gaps
            yaw = 0.1 * n
            shape = {"size": [2.0, 5.0, 2.0], "rotation": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]}
            tables["sample_annotation"].append(
                {
                    "token": f"{token}-{n}",
                    "sample_token": token,
                    "instance_token": f"{scene}-i{n}",
                    "translation": [*position[n], 1.0],
                    "num_lidar_pts": int(rng.integers(0, 5)),
                    "num_radar_pts": int(rng.integers(0, 2)),
                    "attribute_tokens": [],
                    "visibility_token": "",
                    "prev": "",
                    "next": "",
                    **shape,
                }
            )
            if rng.random() < 0.08:
                track[n] = f"{track[n]}x"
            if rng.random() < 0.85 and CATEGORIES[kind]:
                score = float(level[n]) if n % 2 else float(rng.random())
                results[token].append(
                    _box(token, track[n], CATEGORIES[kind], position[n] + rng.normal(0, 0.6, 2), score)
                )
        for n in range(6):
            if rng.random() < 0.7:
                label = ("car", "pedestrian", "trailer")[n % 3]
                where = position[rng.integers(objects)] + rng.normal(0, 2, 2)
                results[token].append(_box(token, f"false{n}", label, where, float(rng.random() * 0.6)))


def _box(sample: str, track: str, label: str, xy: np.ndarray, score: float) -> Record:
    return {
        "sample_token": sample,
        "translation": [float(xy[0]), float(xy[1]), 1.0],
        "size": [2.0, 5.0, 2.0],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0],
        "tracking_id": track,
        "tracking_name": label,
        "tracking_score": score,
    }
