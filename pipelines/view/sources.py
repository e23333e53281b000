"""A result on disk as scenes in space, with the scans of their LiDAR where those are there."""

from __future__ import annotations

from pathlib import Path

from data_tools.datasets.source import DatasetSource
from pipelines.report.results import shown_results
from pipelines.view.scenes import SceneView


def result_view(source: DatasetSource, result: Path, spacing: float) -> list[SceneView]:
    """The scenes of the result of any tracker; points are thinned to `spacing` m, 0 leaves them out.

    Raises `InputError` for missing or broken files, and for a result that does not fit the dataset.
    """
    results = shown_results(source, result, source.read_results(result))
    scans = source.scans([each.scene.name for each in results.scenes]) if spacing else {}
    return [SceneView(each, scans.get(each.scene.name), spacing) for each in results.scenes]
