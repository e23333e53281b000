"""Optimisation of a pose graph, and its results as files.

poses.g2o         the graph with its optimised poses
covariances.csv   of each pose, relative to the first: id, then the upper triangle of (x, y, heading) or (rotation
                  vector, translation) in the pose's own frame, rad and m
errors.json       the error that each start led to, of the guess itself, and of the baselines where they were run
above.png         guess and optimum from above
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory, write_bytes, write_text
from data_tools.plots import paths_from_above, png
from data_tools.pose_graphs import write_g2o
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import OptimisedPoses, PoseGraph


def write_pose_graph(
    output: Path, graph: PoseGraph, optimised: OptimisedPoses, covariances: FloatArray, errors: dict[str, float]
) -> None:
    """Write the results of one graph to a folder, all or none of them.

    covariances: of its poses; errors: by name, as they shall be recorded
    """
    d = graph.dim
    with atomic_directory(output) as folder:
        write_g2o(folder / "poses.g2o", graph.at(optimised.world_T_pose))
        _write_covariances(folder / "covariances.csv", graph, covariances)
        write_figures(folder / "errors.json", {"best": optimised.start, **errors})
        paths = {"guess": graph.world_T_pose[:, :d, d], "optimised": optimised.world_T_pose[:, :d, d]}
        write_bytes(folder / "above.png", png(paths_from_above(paths)))


def _write_covariances(path: Path, graph: PoseGraph, covariances: FloatArray) -> None:
    upper = np.triu_indices(covariances.shape[1])
    names = ["id", *(f"P{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))]
    rows = [
        ",".join([str(id_), *(f"{x:.9g}" for x in covariance[upper])])
        for id_, covariance in zip(graph.ids.tolist(), covariances, strict=True)
    ]
    write_text(path, "\n".join([",".join(names), *rows]) + "\n")
