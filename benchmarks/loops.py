"""False loop closures: how far poses are from the optimum without them, beside GTSAM's graduated non-convexity."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.pose_graphs import with_false_loops
from pipelines.slam.pose_graph_baselines import graduated
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.slam.pose_graph import PoseGraph, consensus, optimise_poses


@dataclass(frozen=True)
class LoopsRow:
    """share: false loops for each true one; off: RMS distance from the clean optimum, m; lost: true loops rejected;
    taken: false ones kept; seconds.
    """

    graph: str
    share: float
    seed: int
    contender: str
    off: float
    lost: int
    taken: int
    seconds: float


def bench_loops(
    name: str, graph: PoseGraph, shares: Sequence[float], seeds: int, gtsam_too: bool, progress: Progress | None = None
) -> list[LoopsRow]:
    """Rows by share, seed and contender."""
    clean = optimise_poses(graph).world_T_pose
    rows, total = [], len(shares) * seeds
    for done, (share, seed) in enumerate((share, seed) for share in shares for seed in range(seeds)):
        spoilt = with_false_loops(graph, share, seed)
        began = time.perf_counter()
        agreed = consensus(spoilt)
        poses = optimise_poses(agreed.graph).world_T_pose
        rows.append(_row(name, share, seed, "saga-fg", poses, clean, agreed.kept, graph, began))
        if gtsam_too:
            began = time.perf_counter()
            poses, kept = graduated(spoilt)
            rows.append(_row(name, share, seed, "GTSAM GNC", poses, clean, kept, graph, began))
        if progress is not None:
            progress(name, done + 1, total)
    return rows


def _row(
    name: str,
    share: float,
    seed: int,
    contender: str,
    poses: FloatArray,
    clean: FloatArray,
    kept: BoolArray,
    graph: PoseGraph,
    began: float,
) -> LoopsRow:
    seconds, d, true = time.perf_counter() - began, graph.dim, len(graph.first)
    off = float(np.sqrt(np.mean(np.sum((poses - clean)[:, :d, d] ** 2, axis=1))))
    return LoopsRow(name, share, seed, contender, off, int((~kept[:true]).sum()), int(kept[true:].sum()), seconds)
