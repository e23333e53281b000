"""Many scenes in parallel: on the cores of this machine or on a Ray cluster, with a manifest of the results."""

from pipelines.scale_out.pools import Job, LocalPool, Outcome, RayPool, SceneTask, new_pool, perform
from pipelines.scale_out.run import (
    Manifest,
    OutputFolder,
    Pool,
    Record,
    RunSummary,
    SmoothTask,
    TrackTask,
    file_name,
    run_scenes,
)

__all__ = [
    "Job",
    "LocalPool",
    "Manifest",
    "Outcome",
    "OutputFolder",
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
