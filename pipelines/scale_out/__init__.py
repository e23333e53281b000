"""Many scenes in parallel: on the cores of this machine or on a Ray cluster, with a manifest of the results."""

from pipelines.scale_out.job import Job, Manifest, Outcome, Record, SceneTask, file_name, perform
from pipelines.scale_out.pools import LocalPool, RayPool, new_pool
from pipelines.scale_out.run import Pool, RunSummary, SmoothTask, TrackTask, run_scenes

__all__ = [
    "Job",
    "LocalPool",
    "Manifest",
    "Outcome",
    "Pool",
    "RayPool",
    "Record",
    "RunSummary",
    "SceneTask",
    "SmoothTask",
    "TrackTask",
    "file_name",
    "new_pool",
    "perform",
    "run_scenes",
]
