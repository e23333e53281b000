"""Many scenes in parallel: on the cores of this machine or on a Ray cluster, with a manifest of what was done."""

from pipelines.scale_out.inputs import DetectionFileInput, HeldScene, KittiInput, SimulatedInput
from pipelines.scale_out.job import Job, OpenedInput, Outcome, SceneInput, SceneTask, perform
from pipelines.scale_out.local_pool import LocalPool
from pipelines.scale_out.manifest import Manifest, Record, file_name
from pipelines.scale_out.ray_pool import RayPool
from pipelines.scale_out.run import Pool, Report, run_scenes
from pipelines.scale_out.smoothing import SmoothTask
from pipelines.scale_out.tracking import TrackTask

__all__ = [
    "DetectionFileInput",
    "HeldScene",
    "Job",
    "KittiInput",
    "LocalPool",
    "Manifest",
    "OpenedInput",
    "Outcome",
    "Pool",
    "RayPool",
    "Record",
    "Report",
    "SceneInput",
    "SceneTask",
    "SimulatedInput",
    "SmoothTask",
    "TrackTask",
    "file_name",
    "perform",
    "run_scenes",
]
