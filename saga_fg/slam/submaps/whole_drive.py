"""All measurements of a drive in one graph, nothing condensed, and its solution."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factors import SolverSettings
from saga_fg.estimators.batch_solver import BatchSolver
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.graph import FactorProvider, SceneFactorGraph, ask_all
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LandmarkObservations, MeasuredMotion, pose_key
from saga_fg.slam.submaps.loop_selection import LoopSelection, Motion
from saga_fg.slam.submaps.loops import Loops
from saga_fg.types.landmark import Landmark

_SOLVER = SolverSettings(tolerance=1e-4, max_iterations=30)


@dataclass(frozen=True, eq=False)
class SolvedDrive:
    """Everything solved together: N poses (N, 4, 4), and the landmarks seen often enough.

    solution: of the whole graph, with all variables; graph: that, at its solution; loops: which of those that came are
    in it, and with what deviations of odometry
    """

    world_T_pose: FloatArray
    landmarks: list[Landmark]
    solution: GraphSolution
    graph: SceneFactorGraph
    loops: LoopSelection

    @cached_property
    def covariances(self) -> FloatArray:
        """Covariances (N, 6, 6) of the poses, (rotation, translation) in the frame of each."""
        return np.array([self.solution.marginal(pose_key(k)) for k in range(len(self.world_T_pose))])


def measurement_graph(
    times: Sequence[float],
    motions: Sequence[Motion],
    world_T_pose: FloatArray,
    landmarks: LandmarkObservations,
    loops: Loops,
    others: Callable[[int], Iterable[FactorProvider]] = lambda epoch: (),
) -> SceneFactorGraph:
    """The graph of all measurements of N keyframes, with poses (N, 4, 4) to begin with.

    motions: the prior of the first pose, then from each to the next; others: providers asked at an epoch
    """
    graph = SceneFactorGraph()
    for k, (time, motion, pose) in enumerate(zip(times, motions, world_T_pose, strict=True)):
        graph.advance(time)
        ask_all([MeasuredMotion(*motion, pose), landmarks, loops, *others(k)], graph)
    return graph


def solve_drive(
    graph: SceneFactorGraph, landmarks: LandmarkObservations, confirm_after: int, loops: LoopSelection
) -> SolvedDrive:
    """Solve a graph of `measurement_graph`; landmarks are taken as certain after so many observations."""
    solver = BatchSolver(graph=graph, settings=_SOLVER)
    solution, solved = solver.solve(), solver.graph()
    poses = [solution.values.atPose3(pose_key(k)).matrix() for k in range(graph.epoch + 1)]
    return SolvedDrive(np.array(poses), landmarks.landmarks(solution, confirm_after), solution, solved, loops)
