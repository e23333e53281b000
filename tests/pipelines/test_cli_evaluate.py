"""`saga-fg evaluate`: figures of results, as tables and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from nuscenes_random_drive import VERSION, write_random_drive
from typer.testing import CliRunner, Result

from data_tools.metrics import nuscenes_tracking_metrics
from data_tools.nuscenes import read_scored_scenes
from pipelines.cli import app


def evaluate(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random drive in the nuScenes layout, with tracks in result.json."""
    root = tmp_path_factory.mktemp("random") / "drive"
    write_random_drive(root, seed=0)
    return root


def test_nuscenes_figures_are_those_of_the_metrics(drive: Path, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    result = evaluate("nuscenes", drive / "result.json", "--dataroot", drive, "--split", "drive", "--json", file)
    assert result.exit_code == 0, result.output
    metrics = nuscenes_tracking_metrics(list(read_scored_scenes(drive / "result.json", drive, VERSION).values()))
    figures = json.loads(file.read_text())
    assert figures["scenes"] == ["scene-0", "scene-1"]
    assert figures["overall"]["amota"] == metrics.overall.amota
    assert figures["per_class"]["car"]["ids"] == metrics.per_class["car"].ids
    assert figures["per_class"]["trailer"]["amota"] is None  # there is none
    row = next(line for line in result.stdout.splitlines() if "overall" in line)
    assert f"{metrics.overall.amota:.3f}" in row
    assert f"{metrics.overall.amotp:.3f}" in row


def test_some_scenes_alone(drive: Path, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    result = evaluate("nuscenes", drive / "result.json", "--dataroot", drive, "--scenes", "scene-1", "--json", file)
    assert result.exit_code == 0, result.output
    assert json.loads(file.read_text())["scenes"] == ["scene-1"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--split", "drive", "--scenes", "scene-0"), "either --split NAME or --scenes"),
        ((), "either --split NAME or --scenes"),
        (("--split", "dribe"), "did you mean 'drive'"),
        (("--split", "drive", "--json", "/nowhere/f.json"), "not writable"),
    ],
)
def test_mistakes_are_one_line(drive: Path, arguments: tuple[str, ...], expected: str) -> None:
    result = evaluate("nuscenes", drive / "result.json", "--dataroot", drive, *arguments)
    assert result.exit_code == 2
    assert expected in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_result_that_lacks_a_sample_is_refused(drive: Path, tmp_path: Path) -> None:
    content = json.loads((drive / "result.json").read_text())
    del content["results"]["scene-0-3"]
    (tmp_path / "short.json").write_text(json.dumps(content))
    result = evaluate("nuscenes", tmp_path / "short.json", "--dataroot", drive, "--split", "drive")
    assert result.exit_code == 2
    assert "scene-0-3 is missing" in result.stderr
