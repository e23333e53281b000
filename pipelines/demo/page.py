"""The demo's page: one HTML file that needs no network, with the table, the picture and a player of the scene.

Objects are written as flat lists of numbers rounded to centimetres, relative to where the vehicle starts:

    moment: {"e": [x, y, yaw] of the vehicle, "g": [[x, y, length, width, yaw, visible], ...] true objects,
             "t": {method: [[x, y, length, width, yaw, id, coasting], ...]}}
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from pipelines.tracking import TrackedScene
from saga_fg.arrays import FloatArray
from saga_fg.boxes import Boxes
from saga_fg.geometry import yaw_of


def demo_page(
    columns: Sequence[str], rows: Sequence[Sequence[str]], picture: bytes, runs: Mapping[str, TrackedScene]
) -> str:
    """The page; `picture` is a PNG, `runs` are the same scene tracked with each method."""
    template = (files("pipelines.demo") / "page.html").read_text(encoding="utf-8")
    for mark, text in (
        ("<!--TABLE-->", _table(columns, rows)),
        ("<!--PICTURE-->", "data:image/png;base64," + base64.b64encode(picture).decode("ascii")),
        ("/*SCENE*/", json.dumps(_player_data(runs), separators=(",", ":")).replace("</", "<\\/")),
    ):
        template = template.replace(mark, text)
    return template


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _player_data(runs: Mapping[str, TrackedScene]) -> dict[str, Any]:
    scene = next(iter(runs.values())).scene
    origin = scene.world_T_ego[0, :2, 3]
    moments = []
    for k, pose in enumerate(scene.world_T_ego):
        truth = scene.ground_truth[k] if scene.ground_truth is not None else None
        tables = {method: run.tracks[k] for method, run in runs.items()}
        moments.append(
            {
                "e": _rounded([[*(pose[:2, 3] - origin), float(yaw_of(pose[:3, :3]))]])[0],
                "g": _rows(truth.boxes, origin, truth.visible[:, None]) if truth is not None else [],
                "t": {m: _rows(t.boxes, origin, np.stack([t.id, t.coasting], axis=1)) for m, t in tables.items()},
            }
        )
    times = (scene.timestamps - scene.timestamps[0]).round(3).tolist()
    return {"scene": scene.name, "methods": list(runs), "times": times, "moments": moments}


def _rows(boxes: Boxes, origin: FloatArray, more: Any) -> list[list[float]]:
    size = np.where(np.isfinite(boxes.size[:, :2]), boxes.size[:, :2], 1.0)
    columns = [boxes.position[:, :2] - origin, size, np.nan_to_num(boxes.yaw)[:, None], more]
    return _rounded(np.concatenate(columns, axis=1))


def _rounded(rows: Any) -> list[list[float]]:
    return [[int(x) if x == int(x) else x for x in row] for row in np.round(rows, 2).tolist()]
