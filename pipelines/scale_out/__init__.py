"""Many scenes in parallel: on the cores of this machine or on a Ray cluster, with a manifest of the results."""

from pipelines.scale_out.job import Job, Outcome, SceneTask, perform
from pipelines.scale_out.local_pool import LocalPool
from pipelines.scale_out.manifest import Manifest, Record, file_name
from pipelines.scale_out.ray_pool import RayPool
from pipelines.scale_out.run import Pool, RunSummary, run_scenes
from pipelines.scale_out.tasks import SmoothTask, TrackTask

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
    "perform",
    "run_scenes",
]
