"""Labels kept on disk until the attributes of their objects are final: an archive of arrays for each chunk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.smoothing.labelling import LabelColumns, LabelledStates
from pipelines.smoothing.object_summaries import ObjectSummaries
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.smoothing import Labels, SmoothingSettings, quality_of
from saga_fg.types.dataset import Scene

_FINAL = ("size", "score", "quality")  # columns that are known at the end


@dataclass(frozen=True, eq=False)
class _AttributeTable:
    """Columns of the final attributes of all objects, by ascending id."""

    id: IntArray
    size: FloatArray
    score: FloatArray
    turn: FloatArray  # of the headings, rad


class LabelSpool:
    """The labels of a recording, added chunk by chunk, and read back when it is over."""

    def __init__(self, folder: Path, name: str, settings: SmoothingSettings) -> None:
        folder.mkdir()
        self._folder, self._name, self._settings = folder, name, settings
        self._chunks = 0
        self._attributes: _AttributeTable | None = None

    def add(
        self,
        wanted: FloatArray,
        at: IntArray,
        labelled: LabelledStates,
        names: Mapping[int, int],
        signs: Mapping[int, float],
    ) -> None:
        """Add the labels at the times `wanted` (M,), s, which are the moments `at` (M,) of the states.

        names: the final id of each object; signs: -1 where its headings are half a turn off those before, else 1
        """
        spans = [labelled.states.at(moment) for moment in at.tolist()]
        rows = np.concatenate([np.empty(0, dtype=np.int64), *(np.arange(span.start, span.stop) for span in spans)])
        ids = labelled.states.id[rows].tolist()
        columns = replace(labelled.columns.select(rows), id=np.array([names[id_] for id_ in ids], dtype=np.int64))
        np.savez(
            self._folder / f"{self._chunks:06d}.npz",
            time=wanted,
            bounds=np.cumsum([0, *(span.stop - span.start for span in spans)]),
            sign=np.array([signs[id_] for id_ in ids], dtype=np.float64),
            **{name: column for name, column in vars(columns).items() if name not in _FINAL},
        )
        self._chunks += 1

    def finish(self, summaries: ObjectSummaries, prior: float) -> None:
        """Take the final attributes of all objects; prior: see `ObjectSummaries.attributes`."""
        ids = np.array(summaries.ids, dtype=np.int64)
        found = [summaries.attributes(id_, prior) for id_ in ids.tolist()]
        self._attributes = _AttributeTable(
            ids,
            np.array([each.size for each in found]).reshape(-1, 3),
            np.array([each.score for each in found]),
            np.array([np.pi * each.reversed for each in found]),
        )

    def labels(self) -> Iterator[tuple[Scene, tuple[Labels, ...]]]:
        """The labels, chunk by chunk: a part of the scene without frames or poses, and one table a moment."""
        assert self._attributes is not None, "the recording is not over"
        for number in range(self._chunks):
            with np.load(self._folder / f"{number:06d}.npz", allow_pickle=False) as columns:
                yield self._complete(dict(columns), self._attributes)

    def _complete(self, stored: dict[str, Any], attributes: _AttributeTable) -> tuple[Scene, tuple[Labels, ...]]:
        times, bounds, sign = (stored.pop(name) for name in ("time", "bounds", "sign"))
        at = np.searchsorted(attributes.id, stored["id"])
        score = attributes.score[at]
        quality = quality_of(score, stored["position_covariance"])
        stored["yaw"] = wrap_angle(stored["yaw"] + np.pi * (sign < 0) + attributes.turn[at])
        columns = LabelColumns(**stored, size=attributes.size[at], score=score, quality=quality)
        spans = zip(times.tolist(), pairwise(bounds.tolist()), strict=True)
        moments = tuple(columns.select(slice(a, b)).labels(time) for time, (a, b) in spans)
        return Scene(self._name, times, np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), ()), moments
