"""Labels as KITTI's `label_02`: the text of ground truth, a file a sequence, without scores."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from data_tools.datasets.kitti import KittiTracking, kitti_result_text
from data_tools.files.atomic_files import atomic_directory
from data_tools.files.located import located
from saga_fg.smoothing import Labels
from saga_fg.types.dataset import Scene


def write_kitti_labels(
    directory: str | Path, dataset: KittiTracking, scenes: Iterable[tuple[Scene, Sequence[Labels]]]
) -> None:
    """Write directory/NNNN.txt for some sequences; the files appear when all is done.

    Boxes that do not show in the image are left out. Raises `InputError` for a directory that is not writable, a size
    or heading that is unknown, a class KITTI does not have.
    """
    with atomic_directory(directory) as folder:
        for scene, moments in scenes:
            tracks = [moment.tracks for moment in moments]
            with located(f"{directory}: sequence {scene.name}"):
                text = kitti_result_text(scene, tracks, dataset.calibration(scene.name), with_score=False)
            (folder / f"{scene.name}.txt").write_text(text, encoding="utf-8")
