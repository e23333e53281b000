from .graph import AnchorLoop, SolvedDrive, SubmapGraph, SubmapSettings

__all__ = ["AnchorLoop", "SolvedDrive", "SubmapGraph", "SubmapSettings"]
