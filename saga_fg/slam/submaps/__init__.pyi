from .graph import SolvedDrive, SubmapGraph, SubmapSettings
from .loop_selection import LoopSelection, select_loops
from .loops import LoopClosure, loop_factors

__all__ = [
    "LoopClosure",
    "LoopSelection",
    "SolvedDrive",
    "SubmapGraph",
    "SubmapSettings",
    "loop_factors",
    "select_loops",
]
