from .between import LoopClosure, Loops, LoopSelection, Motion, drive_graph, loop_factors, select_loops
from .graph import SolvedDrive, SubmapGraph, SubmapSettings

__all__ = [
    "LoopClosure",
    "LoopSelection",
    "Loops",
    "Motion",
    "SolvedDrive",
    "SubmapGraph",
    "SubmapSettings",
    "drive_graph",
    "loop_factors",
    "select_loops",
]
