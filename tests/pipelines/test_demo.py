"""The demonstration: methods on the same scenes, a picture and a page that needs no network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.demo import METHODS, Comparison, compare, comparison_table, hardest_moment, run_demo
from pipelines.report import scene_of_run
from pipelines.report.scenes import latest_detections
from pipelines.view import SceneView, draw_scene, picture
from saga_fg import InputError, Scene
from saga_fg.numerics.geometry import inverse_transform, transform_points

SHORT = SimulatorSettings(duration=3.0, warm_up=5.0)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return compare(SimulatedTraffic(SHORT, scenes=2, seed=1), load_config("simulated"), METHODS)


def test_all_methods_see_the_same_scenes(comparison: Comparison) -> None:
    assert tuple(comparison.runs) == METHODS
    assert len({tuple(run.scene.name for run in runs) for runs in comparison.runs.values()}) == 1
    objects = {m.objects for m in comparison.metrics.values()}
    assert len(objects) == 1
    assert objects.pop() > 100
    for runs in comparison.runs.values():
        for run in runs:
            assert len(run.tracks) == len(run.scene)
            assert run.frames == sum(frame.timestamp <= run.scene.timestamps[-1] for frame in run.scene.frames)


def test_the_table_has_a_row_for_each_method(comparison: Comparison) -> None:
    table = comparison_table(comparison, "title")
    assert [row[0] for row in table.rows] == list(METHODS)
    assert all(len(row) == len(table.columns) for row in table.rows)
    assert float(table.rows[2][1]) == pytest.approx(comparison.metrics["saga"].position.rmse, abs=5e-4)


def test_a_scene_without_ground_truth_cannot_be_compared() -> None:
    class Blind:
        scenes = ("a",)

        def scene(self, name: str) -> Scene:
            return Scene(name, np.zeros(1), np.eye(4)[None], ("",), [])

    with pytest.raises(InputError, match="scene a: expected ground truth"):
        compare(Blind(), load_config("file"), METHODS)


def test_the_moment_shown_has_the_most_moving_hidden_objects(comparison: Comparison) -> None:
    scene_row, moment = hardest_moment(comparison)
    run = comparison.runs["saga"][scene_row]
    assert run.scene.ground_truth is not None

    def hidden(scene: Scene, k: int) -> int:
        assert scene.ground_truth is not None
        truth = scene.ground_truth[k]
        near = np.hypot(*(truth.boxes.position[:, :2] - scene.world_T_ego[k, :2, 3]).T) < 40
        return int((~truth.visible & near & (np.hypot(*truth.boxes.velocity.T) > 0.5)).sum())

    scenes = [run.scene for run in comparison.runs["saga"]]
    assert hidden(run.scene, moment) == max(hidden(scene, k) for scene in scenes for k in range(len(scene)))


def test_the_picture_shows_a_moment_in_the_vehicles_frame(comparison: Comparison) -> None:
    run, k = comparison.runs["saga"][0], 10
    report = scene_of_run({"saga": run}, (), {})
    drawings = [each for each in draw_scene(SceneView(report)) if each.moment in (None, k)]
    figure = picture({"one": drawings}, f"{run.scene.name}/ego")
    (ax,) = figure.axes
    assert ax.get_title(loc="left") == "one"
    assert run.scene.ground_truth is not None
    assert len(ax.patches) == 1 + len(run.scene.ground_truth[k]) + 2 * len(run.tracks[k])  # with the vehicle, ellipses
    places = transform_points(inverse_transform(run.scene.world_T_ego[k]), run.tracks[k].boxes.position)[:, :2]
    outlines = [patch.get_xy()[:4].mean(axis=0) for patch in ax.patches if len(patch.get_xy()) == 5]
    gaps = np.linalg.norm(places[:, None] - np.array(outlines), axis=2)
    np.testing.assert_allclose(gaps.min(axis=1), 0.0, atol=1e-6)
    detections, _ = latest_detections(run.scene, {})
    (crosses,) = (line for line in ax.lines if line.get_marker() == "x")
    assert len(crosses.get_xdata()) == len(detections[k])
    np.testing.assert_allclose(ax.patches[0].get_xy().mean(axis=0), [1.4, 0.0], atol=0.5)


def test_the_demo_writes_a_picture_and_a_page(tmp_path: Path) -> None:
    result = run_demo(tmp_path / "out", load_config("simulated"), SHORT, scenes=1)
    assert result.picture.read_bytes().startswith(b"\x89PNG\r\n")
    assert result.page.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["birds_eye.png", "index.html"]


def test_the_command_prints_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.cli.start.scenario_settings", lambda scenario: SHORT)
    result = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["demo", "--output", str(tmp_path / "out"), "--scenes", "1"])
    assert result.exit_code == 0, result.output
    for text in ("occluded position RMSE, m", "ms per frame", *METHODS, "picture: ", "page: "):
        assert text in result.stdout
