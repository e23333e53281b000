from .graph import SolvedDrive, SubmapGraph, SubmapSettings
from .loops import LoopClosure, loop_factors

__all__ = ["LoopClosure", "SolvedDrive", "SubmapGraph", "SubmapSettings", "loop_factors"]
