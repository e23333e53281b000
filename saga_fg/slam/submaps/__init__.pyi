from .graph import SolvedDrive, SubmapGraph, SubmapSettings
from .loops import LoopClosure, Loops, LoopSelection, loop_factors, select_loops

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
