from .between import LoopClosure, Loops, LoopSelection, loop_factors, select_loops
from .graph import SolvedDrive, SubmapGraph, SubmapSettings

__all__ = [
    "LoopClosure",
    "LoopSelection",
    "Loops",
    "SolvedDrive",
    "SubmapGraph",
    "SubmapSettings",
    "loop_factors",
    "select_loops",
]
