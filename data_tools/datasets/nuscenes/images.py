"""The camera images of nuScenes keyframes, where their files are there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from data_tools.datasets.nuscenes.scans import file_below
from data_tools.datasets.nuscenes.tables import read_table
from data_tools.datasets.source import Images
from saga_fg.types.dataset import Scene

FRONT_FIRST = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT")


def nuscenes_images(dataroot: Path, folder: Path, scenes: Mapping[str, Scene]) -> dict[str, Images]:
    """Return the images of each scene by camera, one or None for each moment; scenes without any are left out.

    Raises `InputError` for broken tables, and for names of files outside the dataroot.
    """
    if not any((dataroot / "samples" / camera).is_dir() for camera in FRONT_FIRST):
        return {}
    channels = dict(read_table(folder, "sensor", ("token", "channel")))
    cameras = {
        token: channels[sensor]
        for token, sensor in read_table(folder, "calibrated_sensor", ("token", "sensor_token"))
        if channels.get(sensor) in FRONT_FIRST
    }
    wanted = {token: (name, k) for name, scene in scenes.items() for k, token in enumerate(scene.tokens)}
    found: dict[str, dict[str, list[Path | None]]] = {}
    fields = ("sample_token", "calibrated_sensor_token", "is_key_frame", "filename")
    for sample, mounted, key, name in read_table(folder, "sample_data", fields):
        if key and mounted in cameras and sample in wanted:
            file = file_below(dataroot, folder, sample, name)
            if file.is_file():
                scene, k = wanted[sample]
                of_scene = found.setdefault(scene, {})
                of_scene.setdefault(cameras[mounted], [None] * len(scenes[scene]))[k] = file
    return {name: {camera: each[camera] for camera in FRONT_FIRST if camera in each} for name, each in found.items()}
