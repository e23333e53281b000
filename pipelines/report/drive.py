"""The page of a run of SLAM: path over map, drift along the way, errors, loops, and where scans left a motion open."""

import base64
import html
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.figures import FigureTable, cell, new_figure, png
from data_tools.files import parsed_json, read_bytes
from data_tools.pose_graphs import read_g2o
from data_tools.trajectories import Trajectory, absolute_errors, matched, read_tum_poses
from pipelines.report.page import page_part, table_html
from saga_fg.errors import InputError, error_context
from saga_fg.slam.pose_graph.graph import trusted

_PATHS = ("odometry", "online", "trajectory")
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{title}</title><style>{style} img {{ max-width: 100%; }}</style></head>
<body><header><h1>{title}</h1><ul class="facts">{facts}</ul></header><main>{pictures}{tables}</main></body></html>
"""


def drive_page(folder: Path) -> str:
    """Return the HTML text for the output folder of `saga-fg slam scans`. Raises `InputError` for another one."""
    if not (folder / "metrics.json").is_file() or not (folder / "trajectory.tum").is_file():
        raise InputError(f"{folder}: expected metrics.json and trajectory.tum, as `saga-fg slam scans` writes")
    figures = parsed_json(read_bytes(folder / "metrics.json"), str(folder / "metrics.json"))
    paths = {name: read_tum_poses(file) for name in _PATHS if (file := folder / f"{name}.tum").is_file()}
    pictures = {"Map and path": read_bytes(folder / "above.png")} if (folder / "above.png").is_file() else {}
    if (folder / "reference.tum").is_file():
        pictures["Drift"] = _drift(paths, read_tum_poses(folder / "reference.tum"))
    loops = _loops(folder)
    with error_context(f"{folder}: metrics.json"):
        try:
            tables = [_errors(figures), loops, _open_motions(figures)]
            facts = [f"{figures[name]} {name}" for name in ("keyframes", "submaps", "loops")]
            facts += [f"{figures['false_loops']} loops left out as false", *figures["misfits"].values()]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"expected the figures of a run: {error!r}") from error
    return _PAGE.format(
        title=html.escape(f"SLAM: {folder.resolve().name}"),
        style=page_part("page.css"),
        facts="".join(f"<li>{html.escape(str(fact))}</li>" for fact in facts),
        pictures="".join(
            f'<figure><figcaption>{name}</figcaption><img alt="{name}" '
            f'src="data:image/png;base64,{base64.b64encode(picture).decode("ascii")}"></figure>'
            for name, picture in pictures.items()
        ),
        tables="".join(table_html(table) for table in tables if table.rows),
    )


def _drift(paths: Mapping[str, Trajectory], reference: Trajectory) -> bytes:
    """How far each path is off the recording's own, both beginning as one, along the way."""
    figure = new_figure(8.0, 3.2)
    ax = figure.subplots()
    for name, path in paths.items():
        estimate, truth = matched(path, reference)
        ax.plot(truth.path_length, absolute_errors(estimate, truth, "start"), label=name)
    ax.set(xlabel="way, m", ylabel="off the recording's path, m", ylim=(0, None))
    ax.legend()
    return png(figure)


def _errors(figures: Mapping[str, Any]) -> FigureTable:
    columns = ("ATE, m", "end, m", "RPE, m", "RPE, deg", "over, m")
    named = {name: figures[name] for name in (*_PATHS, "without_objects") if name in figures}
    keys = ("ate", "end_error", "relative_translation", "relative_rotation", "relative_distance")
    rows = []
    for name, errors in named.items():
        ate, end, shift, turn, far = (np.nan if errors[key] is None else float(errors[key]) for key in keys)
        over = cell(far, 0)
        rows.append((name.replace("_", " "), *map(cell, (ate, end, shift, math.degrees(turn))), over))
    return FigureTable("Errors against the recording", ("path", *columns), tuple(rows))


def _loops(folder: Path) -> FigureTable:
    """The loops in the solution, with the distance between their ends."""
    rows: list[tuple[str, ...]] = []
    if (folder / "graph.g2o").is_file():
        graph = read_g2o(folder / "graph.g2o")
        far = np.linalg.norm(graph.first_T_second[:, :3, 3], axis=1)
        rows = [
            (str(graph.ids[graph.first[k]]), str(graph.ids[graph.second[k]]), cell(float(far[k])))
            for k in np.flatnonzero(~trusted(graph)).tolist()
        ]
    return FigureTable("Loops", ("keyframe", "and keyframe", "apart, m"), tuple(rows))


def _open_motions(figures: Mapping[str, Any]) -> FigureTable:
    rows = [
        (f"{span['first']} to {span['last']}", cell(span["until"] - span["from"], 1), ", ".join(span["motions"]))
        for span in figures["degenerate"]
    ]
    return FigureTable("Scans that left a motion open", ("scans", "lasting, s", "motions"), tuple(rows))
