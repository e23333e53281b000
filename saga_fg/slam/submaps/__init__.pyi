from .graph import SubmapGraph
from .loop_selection import LoopSelection, select_loops
from .loops import LoopClosure, Loops, loop_factors
from .settings import SubmapSettings
from .whole_drive import SolvedDrive, measurement_graph, solve_drive

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
