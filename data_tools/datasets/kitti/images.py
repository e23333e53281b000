"""The camera images of KITTI sequences, where they are there: image_02/NNNN/NNNNNN.png, of the left colour camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from data_tools.datasets.source import Images
from saga_fg.types.dataset import Scene

FOLDERS = {"image_02": "left", "image_03": "right"}


def kitti_images(root: Path, scenes: Mapping[str, Scene]) -> dict[str, Images]:
    """Return the images of each sequence by camera, one or None for each moment; sequences without any are left out."""
    found: dict[str, Images] = {}
    for name, scene in scenes.items():
        images: dict[str, list[Path | None]] = {}
        for folder, camera in FOLDERS.items():
            files = [root / folder / name / f"{k:06d}.png" for k in range(len(scene))]
            if any(there := [file.is_file() for file in files]):
                images[camera] = [file if is_there else None for file, is_there in zip(files, there, strict=True)]
                break  # the other eye sees the same
        if images:
            found[name] = images
    return found
