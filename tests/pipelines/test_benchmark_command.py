"""`saga-fg benchmark`: figures, a page and a submission from one command that goes on where it was."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from pipelines.scale_out import TrackTask
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset
from tests.data_tools.kitti_example import write_sequence
from tests.pipelines.command import done, saga_fg
from tests.pipelines.scale_out_example import InThisProcess


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.cli.track.new_pool", lambda *_: InThisProcess())


@pytest.fixture(scope="module")
def nuscenes(tmp_path_factory: pytest.TempPathFactory) -> list[str | Path]:
    """Options of four short simulated scenes."""
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "short.yaml").write_text("duration: 3.0\nwarm_up: 3.0\n")
    done("simulate", "-o", folder / "data", "--scenes", "4", "--config", folder / "short.yaml")
    detections = f"lidar={folder / 'data' / 'detections' / 'lidar.json'}"
    return ["nuscenes", "--dataroot", folder / "data", "--detections", detections, "--split", "all"]


def test_the_figures_are_those_of_evaluate(nuscenes, tmp_path):
    run = tmp_path / "run"
    result = done("benchmark", *nuscenes, "--output", run)
    assert "4 scenes: 4 done" in result.output
    assert "AMOTA" in result.output
    figures = json.loads((run / "figures.json").read_text())
    assert figures["method"] == "saga"
    done("evaluate", *nuscenes, run / "tracks.json", "--json", tmp_path / "evaluated.json")
    assert figures["figures"] == json.loads((tmp_path / "evaluated.json").read_text())
    page = (run / "report.html").read_text()
    assert "The player shows 3 of 4 scenes." in page
    with zipfile.ZipFile(run / "submission.zip") as archive:
        assert archive.namelist() == ["tracks.json"]
        assert archive.read("tracks.json") == (run / "tracks.json").read_bytes()
    submission = (run / "submission.zip").read_bytes()
    again = saga_fg("benchmark", *nuscenes, "--output", run)
    assert "0 done, 4 unchanged" in again.output
    assert json.loads((run / "figures.json").read_text()) == figures
    assert (run / "submission.zip").read_bytes() == submission


def test_a_run_that_was_stopped_goes_on(nuscenes, tmp_path, monkeypatch):
    run_of_task = TrackTask.run

    def run(task: TrackTask, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        if name == "scene-0003":
            raise InputError("bad weather")
        return run_of_task(task, name, dataset, folder)

    with monkeypatch.context() as broken:
        broken.setattr(TrackTask, "run", run)
        result = saga_fg("benchmark", *nuscenes, "--output", tmp_path / "run", "--method", "kf")
    assert result.exit_code == 1
    assert "failed: scene-0003: bad weather" in result.output
    assert not (tmp_path / "run" / "figures.json").exists()
    assert not (tmp_path / "run" / "submission.zip").exists()
    result = done("benchmark", *nuscenes, "--output", tmp_path / "run", "--method", "kf")
    assert "1 done, 3 unchanged" in result.output
    assert (tmp_path / "run" / "figures.json").exists()


def test_a_test_split_has_a_submission_alone(nuscenes, tmp_path):
    done("benchmark", *nuscenes, "--output", tmp_path / "run", "--without-truth")
    assert (tmp_path / "run" / "submission.zip").exists()
    assert not (tmp_path / "run" / "figures.json").exists()


def test_kitti(tmp_path):
    root, run = write_sequence(tmp_path / "kitti"), tmp_path / "run"
    result = done("benchmark", "kitti", "--dataroot", root, "--detections", root / "found", "--output", run)
    assert "sAMOTA" in result.output
    with zipfile.ZipFile(run / "submission.zip") as archive:
        assert archive.namelist() == ["0007.txt"]
    assert json.loads((run / "figures.json").read_text())["figures"]["sequences"] == ["0007"]
    assert "KITTI 3D tracking metrics" in (run / "report.html").read_text()


def test_a_dataset_without_official_results(tmp_path):
    result = saga_fg("benchmark", "simulated", "--output", tmp_path / "run")
    assert result.exit_code != 0
    assert "expected a dataset with official results" in " ".join(result.output.split())
    shown = saga_fg("benchmark", "--help").output
    assert all(name in shown for name in ("nuscenes", "kitti", "argoverse2"))
    assert "simulated" not in shown
