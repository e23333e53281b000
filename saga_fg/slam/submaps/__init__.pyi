from .between import LoopClosure, Loops, LoopSelection, drive_graph, loop_factors, select_loops
from .graph import SolvedDrive, SubmapGraph, SubmapSettings

__all__ = [
    "LoopClosure",
    "LoopSelection",
    "Loops",
    "SolvedDrive",
    "SubmapGraph",
    "SubmapSettings",
    "drive_graph",
    "loop_factors",
    "select_loops",
]
