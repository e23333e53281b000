"""KITTI tracking from paths or URLs: of a remote dataset, only the files of the chosen sequences are fetched."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager

from data_tools.datasets.kitti.dataset import KittiTracking
from data_tools.datasets.kitti.detections import CLASS_CODES
from data_tools.files.remote_files import local_tree

_FOLDERS = ("oxts", "calib")


@contextmanager
def local_kitti(dataroot: str, detections: str, sequences: Collection[str] | None = None) -> Iterator[KittiTracking]:
    """The sequences (None: all) with their detections, for the length of the block; folders by path or URL.

    Raises `InputError` as `KittiTracking` does, naming the URL, and for what cannot be fetched.
    """
    names = ["*"] if sequences is None else list(dict.fromkeys(sequences))
    files = [f"{root}{folder}/{name}.txt" for root in ("training/", "") for folder in _FOLDERS for name in names]
    found = [f"{label}/{name}.txt" for label in CLASS_CODES for name in names]
    with local_tree(dataroot, files) as root, local_tree(detections, found) as boxes:
        yield KittiTracking(root, boxes, sequences)
