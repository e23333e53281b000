"""Recorded traffic through the command and the benchmarks, on a crossing written by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.recordings.sources import Ngsim
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.learning import scenes_to_learn_from
from tests.benchmarks.recordings.ngsim_example import crossing, rows, write_ngsim

NGSIM = "benchmarks.recordings:Ngsim"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    (tmp_path / "ngsim").mkdir()
    write_ngsim(tmp_path / "ngsim", rows(steps=20), {"A": crossing()})
    return tmp_path


def test_track_and_evaluate(data: Path) -> None:
    root, tracks = str(data / "ngsim"), str(data / "tracks.csv")
    run = CliRunner().invoke(app, ["track", NGSIM, "--dataroot", root, "--output", tracks])
    assert run.exit_code == 0, run.output
    assert "1 scene, 20 frames" in run.output
    run = CliRunner().invoke(app, ["evaluate", NGSIM, tracks, "--dataroot", root])
    assert run.exit_code == 0, run.output
    assert "MOTA" in run.output


def test_scenes_to_learn_from_have_the_carrier_as_well(data: Path) -> None:
    source = Ngsim(dataroot=str(data / "ngsim"), viewpoint="1")
    scene = scenes_to_learn_from(source, load_config("traffic"), with_truth=True)["A"]
    assert scene.ground_truth is not None
    ids = [name for moment in scene.ground_truth for name in moment.id.tolist()]
    assert [ids.count(name) for name in ("1", "2", "3")] == [20, 20, 15]
    assert [len(frame) for frame in scene.frames] == [len(moment) for moment in scene.ground_truth]
    assert {frame.sensor for frame in scene.frames} == {"lidar"}
