"""A view as a file of rerun and as one of MCAP: opened again, both hold the same entities."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.report import scene_of_run
from pipelines.tracking import track_scene
from pipelines.view import SceneView, draw_scene, write_view
from tests.pipelines.test_view import read_back as read_rrd
from tests.pipelines.test_view_mcap import read_back as read_mcap
from tests.pipelines.test_view_mcap import xyz

NAME = "scene-0001"
BOXES = ("saga/boxes", "truth/seen", "truth/hidden")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    """Both files of one view, read back: of rerun by entity, of MCAP by topic."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra [view])")
    pytest.importorskip("mcap_protobuf", reason="mcap is not installed (extra [mcap])")
    config = load_config("simulated")
    scene = SimulatedTraffic(SimulatorSettings(duration=1.5, warm_up=5.0), scenes=1, seed=2).scene(NAME)
    shown = scene_of_run({"saga": track_scene(scene, config.new_tracker("saga"))}, config.tracker.edges, config.sensors)
    folder: Path = tmp_path_factory.mktemp("views")
    for suffix in (".rrd", ".mcap"):
        write_view(folder / f"a{suffix}", "a", [NAME], draw_scene(SceneView(shown)))
    return read_rrd(folder / "a.rrd"), read_mcap(folder / "a.mcap")


def test_the_trees_are_the_same(files) -> None:
    of_rerun, of_mcap = files
    drawn = {path for path in of_rerun if path.startswith(f"/{NAME}/")}
    assert drawn == set(of_mcap)
    assert {f"/{NAME}/{name}" for name in BOXES} <= drawn


@pytest.mark.parametrize("name", BOXES)
def test_boxes_are_the_same_at_every_time(files, name: str) -> None:
    of_rerun, of_mcap = files[0][f"/{NAME}/{name}"], files[1][f"/{NAME}/{name}"]
    centres = {round(time, 6): value for time, value in of_rerun["Boxes3D:centers"].items()}
    halves = {round(time, 6): value for time, value in of_rerun["Boxes3D:half_sizes"].items()}
    labels = {round(time, 6): value for time, value in of_rerun.get("Boxes3D:labels", {}).items()}
    assert list(centres) == [each.time / 1e9 for each in of_mcap]
    for each in of_mcap:
        cubes = [cube for entity in each.content.entities for cube in entity.cubes]
        time = each.time / 1e9
        assert len(cubes) == len(centres[time])
        if cubes:
            np.testing.assert_allclose([xyz(cube.pose.position) for cube in cubes], centres[time], atol=1e-3)
            np.testing.assert_allclose([xyz(cube.size) for cube in cubes], 2 * np.array(halves[time]), atol=1e-3)
            texts = [text.text for entity in each.content.entities for text in entity.texts]
            assert texts == list(labels[time])


@pytest.mark.parametrize("name", ["saga/edges", "saga/trajectories"])
def test_lines_are_the_same_at_every_time(files, name: str) -> None:
    of_rerun, of_mcap = files[0][f"/{NAME}/{name}"], files[1][f"/{NAME}/{name}"]
    strips = {round(time, 6): value for time, value in of_rerun["LineStrips3D:strips"].items()}
    assert any(len(value) for value in strips.values())
    for each in of_mcap:
        lines = [line for entity in each.content.entities for line in entity.lines]
        for line, strip in zip(lines, strips[each.time / 1e9], strict=True):
            np.testing.assert_allclose([xyz(point) for point in line.points], strip, atol=1e-3)
