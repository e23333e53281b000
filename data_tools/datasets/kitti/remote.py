"""KITTI tracking from paths or URLs: of a remote dataset, only the files of the chosen sequences are fetched."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager

from data_tools.datasets.kitti.dataset import KittiTracking
from data_tools.datasets.kitti.detections import CLASS_CODES
from data_tools.files.remote_files import local_tree


@contextmanager
def local_kitti(
    dataroot: str, detections: str | None = None, sequences: Collection[str] | None = None, ground_truth: bool = False
) -> Iterator[KittiTracking]:
    """The sequences (None: all), for the length of the block; the folders of `KittiTracking` by path or URL.

    Raises `InputError` as `KittiTracking` does, naming the URL, and for what cannot be fetched.
    """
    names = ["*"] if sequences is None else list(dict.fromkeys(sequences))
    folders = ("oxts", "calib", *(["label_02"] * ground_truth))
    files = [f"{root}{folder}/{name}.txt" for root in ("training/", "") for folder in folders for name in names]
    found = [f"{label}/{name}.txt" for label in CLASS_CODES for name in names]
    with ExitStack() as stack:
        root = stack.enter_context(local_tree(dataroot, files))
        boxes = None if detections is None else stack.enter_context(local_tree(detections, found))
        yield KittiTracking(root, boxes, sequences, ground_truth)
