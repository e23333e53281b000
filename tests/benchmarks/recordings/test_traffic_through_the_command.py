"""Recorded traffic through the command and the benchmarks, on a crossing written by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.recording_sets import recording_set
from benchmarks.recordings.sources import Ngsim
from data_tools.datasets.parts import scene_digests
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.learning import scenes_to_learn_from
from pipelines.tracking import track_scene
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


def test_a_set_of_the_benchmarks_is_scored_at_every_moment(data: Path) -> None:
    recordings = recording_set("ngsim", data, 1)
    config = load_config(recordings.family)
    runs = {name: track_scene(recordings.dataset.scene(name), config.new_tracker("kf")) for name in ("A",)}
    assert recordings.score(runs).figures_of([0])["IDS"] == 0


def test_what_is_given_of_the_road_is_part_of_the_digest(data: Path) -> None:
    digests = []
    for road in ("signals", "map", "none"):
        source = Ngsim(dataroot=str(data / "ngsim"), road=road)  # type: ignore[arg-type]
        with source.open() as dataset:
            digests.append(scene_digests(dataset.scene("A")))
    assert len({each["moments"] for each in digests}) == 2
    assert len({each["lidar"] for each in digests}) == 2
