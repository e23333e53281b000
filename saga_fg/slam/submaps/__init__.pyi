from .condensing import SolvedDrive, measurement_graph, solve_drive
from .graph import SubmapGraph, SubmapSettings
from .loops import LoopClosure, Loops, LoopSelection, loop_factors, select_loops

__all__ = [
    "LoopClosure",
    "LoopSelection",
    "Loops",
    "SolvedDrive",
    "SubmapGraph",
    "SubmapSettings",
    "loop_factors",
    "measurement_graph",
    "select_loops",
    "solve_drive",
]
