"""nuScenes from paths or URLs: the tables and files of detections are fetched, nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from data_tools.files.remote_files import local_copy, local_tree


@contextmanager
def local_nuscenes(
    dataroot: str, version: str, detections: Mapping[str, str]
) -> Iterator[tuple[Path, dict[str, Path]]]:
    """The folder that holds the tables, and the files of detections by sensor, for the length of the block.

    Raises `InputError` for what cannot be fetched.
    """
    with ExitStack() as stack:
        root = stack.enter_context(local_tree(dataroot, [f"{version}/*.json"]))
        yield root, {sensor: stack.enter_context(local_copy(url)) for sensor, url in detections.items()}
