"""Conformance of datasets and metrics that users bring; those of trackers' parts are in `saga_fg.conformance`.

from data_tools.conformance import check_dataset

check_dataset(Square(folder="recordings"))
"""

import copy
from dataclasses import replace

import numpy as np

from data_tools.datasets.source import DatasetSource, scene_digests
from data_tools.evaluation import Metric, own_figures
from data_tools.metrics import SceneBoxes
from saga_fg import Tracker
from saga_fg.conformance.parts import boxes, require, same
from saga_fg.parts import KINDS
from saga_fg.types import Annotations, Scene


def check_dataset(source: DatasetSource, scenes: int = 2) -> None:
    """Open recordings twice, read the first `scenes` of them, and track their first frames.

    A reading is the same each time, and there is ground truth where the dataset says that it has some. Raises
    `AssertionError`, or `InputError` for what the dataset itself refuses.
    """
    KINDS[DatasetSource].require("dataset", source)
    require(copy.deepcopy(source) == source, "expected a dataset whose copy is equal")
    with source.open(truth=source.has_truth) as opened, source.open() as again:
        names = tuple(opened.scenes)
        require(bool(names) and names == tuple(again.scenes), f"scenes: expected the same names twice, got {names}")
        for name in names[:scenes]:
            scene = opened.scene(name)
            require(isinstance(scene, Scene) and scene.name == name, f"scene({name!r}): expected a Scene of this name")
            require(scene_digests(scene) == scene_digests(again.scene(name)), f"scene({name!r}): reads otherwise again")
            require(scene.ground_truth is not None or not source.has_truth, f"scene({name!r}): expected ground truth")
            tracker = Tracker()
            for frame in scene.frames[:5]:
                tracker.step(frame)


def check_metric(metric: Metric) -> None:
    """Figures of tracks that are right, and of none; they do not depend on the names of the tracks."""
    moments = [Annotations(np.arange(4).astype(np.str_), boxes(4)) for _ in range(3)]
    scene = Scene("scene", np.arange(3.0), ground_truth=moments)
    right = SceneBoxes.of_annotations(moments)
    kinds = right, replace(right, id=np.char.add("other ", right.id)), right.select(np.arange(0))
    first, renamed, none = (next(iter(own_figures([(scene, found)], [metric]).values())) for found in kinds)
    require(
        bool(first) and first.keys() == none.keys(), "expected the same figures by name, NaN where there is no value"
    )
    values, expected = (np.nan_to_num(list(each.values())) for each in (renamed, first))
    same("figures of tracks with other names", values, expected, 1e-9)
