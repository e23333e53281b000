"""`saga-fg evaluate` and `saga-fg demo`. `saga-fg evaluate`: figures of results, as tables and as JSON."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from data_tools.datasets.nuscenes import read_scored_scenes
from data_tools.metrics import SceneMetrics, nuscenes_tracking_metrics
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.demo import METHODS, Comparison, compare, hardest_moment
from saga_fg import InputError, Scene
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_random_drive import VERSION, write_random_drive
from tests.pipelines.command import done, refused


def evaluate(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random drive in the nuScenes layout, with tracks in result.json."""
    root = tmp_path_factory.mktemp("random") / "drive"
    write_random_drive(root, seed=0)
    return root


def test_nuscenes_figures_are_those_of_the_metrics(drive, tmp_path):
    file = tmp_path / "figures.json"
    result = done(
        "evaluate",
        "nuscenes",
        drive / "result.json",
        "--dataroot",
        drive,
        "--split",
        "drive",
        "--json",
        file,
    )
    metrics = nuscenes_tracking_metrics(
        [each.tracking for each in read_scored_scenes(drive / "result.json", drive, VERSION).values()]
    )
    figures = json.loads(file.read_text())
    assert figures["scenes"] == ["scene-0", "scene-1"]
    assert figures["overall"]["amota"] == metrics.overall.amota
    assert figures["per_class"]["car"]["ids"] == metrics.per_class["car"].ids
    assert figures["per_class"]["trailer"]["amota"] is None  # there is none
    row = next(line for line in result.stdout.splitlines() if "overall" in line)
    assert f"{metrics.overall.amota:.3f}" in row
    assert f"{metrics.overall.amotp:.3f}" in row


def test_figures_that_cannot_be_written_are_one_line(drive):
    options = ("--dataroot", drive, "--split", "drive", "--json", "/nowhere/f.json")
    said = refused("evaluate", "nuscenes", drive / "result.json", *options)
    assert "not writable" in said
    assert len(said.splitlines()) == 1


def test_nuscenes_hota_and_errors_on_the_labels_that_detections_match(tmp_path):
    pytest.importorskip("trackeval")
    data, tracks, file = tmp_path / "data", tmp_path / "tracks.json", tmp_path / "figures.json"
    (tmp_path / "short.yaml").write_text("duration: 6.0\nwarm_up: 5.0\n")
    lidar = f"lidar={data / 'detections' / 'lidar.json'}"
    of_data = ("--dataroot", data, "--split", "all", "--detections", lidar)
    for command in (
        ("simulate", "-o", data, "--scenes", "1", "--config", tmp_path / "short.yaml"),
        ("track", "nuscenes", *of_data, "-o", tracks),
        ("evaluate", "nuscenes", tracks, *of_data, "--hota", "--json", file),
    ):
        result = done(*command)
    figures = json.loads(file.read_text())
    overall = figures["errors"]["overall"]
    assert 0 < overall["tracked"] <= overall["labels"]
    assert 0 < overall["position"] < 1
    assert 0 < overall["detection"] < 1
    assert 0 < figures["calibration"]["overall"]["coverage"]["0.9"] <= 1
    assert figures["hota"]["car"]["2D"]["hota"] >= figures["hota"]["car"]["3D"]["hota"] > 0.2
    assert "HOTA, CLEAR and Identity" in result.stdout


def test_kitti_labels_as_results_are_perfect(tmp_path):
    root, results, file = write_sequence(tmp_path / "kitti"), tmp_path / "results", tmp_path / "figures.json"
    results.mkdir()
    labels = (root / "training" / "label_02" / "0007.txt").read_text().splitlines()
    (results / "0007.txt").write_text("".join(f"{line} 0.9\n" for line in labels if "DontCare" not in line))
    result = done("evaluate", "kitti", results, "--dataroot", root, "--json", file)
    figures = json.loads(file.read_text())
    assert figures["sequences"] == ["0007"]
    assert set(figures["per_class"]) == {"car"}  # a sitting person is none that counts
    assert set(figures["per_class"]["car"]) == {"0.25", "0.5", "0.7"}
    assert figures["per_class"]["car"]["0.7"]["mota"] == 1.0
    assert figures["errors"]["car"]["position"] == 0.0
    assert figures["errors"]["car"]["velocity"] is None
    assert figures["calibration"]["car"]["boxes"] == 0
    assert "Calibration" not in result.stdout


def test_simulated_scenes_are_judged_at_every_moment(tmp_path):
    file = tmp_path / "figures.json"
    (tmp_path / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    arguments = ("--scenes", "1", "--seed", "3", "--simulator", tmp_path / "short.yaml", "--method", "kf")
    done("evaluate", "simulated", *arguments, "--json", file)
    figures = json.loads(file.read_text())
    overall = figures["tracking"]["overall"]
    assert overall["objects"] > 100
    assert overall["objects"] == sum(f["objects"] for name, f in figures["tracking"].items() if name != "overall")
    assert overall["objects"] == figures["errors"]["overall"]["labels"]
    assert 0 < overall["position_rmse"] < 1
    assert figures["calibration"]["overall"]["boxes"] > 50
    assert figures["innovations"]["car"]["matches"] > 50
    assert 0.2 < figures["innovations"]["car"]["nis"] < 5


# The demonstration: methods on the same scenes, and a page that needs no network

SHORT = SimulatorSettings(duration=3.0, warm_up=5.0)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return compare(SimulatedTraffic(SHORT, scenes=2, seed=1), load_config("simulated"), METHODS)


def test_a_track_on_a_hidden_object_is_neither_right_nor_wrong(tmp_path):
    """One car is seen all the time, the other is hidden from the fifth moment on; a ghost stands apart."""
    names = np.array(["a", "b"])
    truth, tracks = ["timestamp,id,label,x,y,visible"], ["timestamp,id,label,x,y,score"]
    for k in range(10):
        for name, y in zip(names, (0, 20), strict=True):
            truth.append(f"{k},{name},car,{8 * k},{y},{int(name == 'a' or k < 5)}")
            tracks.append(f"{k},{name},car,{8 * k},{y},0.9")
    files = [tmp_path / f"{name}.csv" for name in ("tracks", "truth")]
    for ghost, wrong in ((False, 0), (True, 10)):
        rows = [*tracks, *(f"{k},ghost,car,{8 * k},60,0.9" for k in range(10) if ghost)]
        files[0].write_text("\n".join(rows) + "\n")
        files[1].write_text("\n".join(truth) + "\n")
        done("evaluate", "file", files[0], "--truth", files[1], "--hota", "--json", tmp_path / "figures.json")
        figures = json.loads((tmp_path / "figures.json").read_text())
        hota = figures["hota"]["car"]["centre"]
        assert (hota["fp"], hota["fn"], hota["ids"]) == (wrong, 0, 0)
        assert hota["hota"] == pytest.approx(1.0) if not ghost else hota["hota"] < 1
        assert figures["sweep"]["car"]["fp"] == wrong


def test_all_methods_see_the_same_scenes(comparison):
    assert tuple(comparison.runs) == METHODS
    assert len({tuple(run.scene.name for run in runs) for runs in comparison.runs.values()}) == 1
    objects = {m.objects for m in comparison.metrics.values()}
    assert len(objects) == 1
    assert objects.pop() > 100
    for runs in comparison.runs.values():
        for run in runs:
            assert len(run.tracks) == len(run.scene)
            assert run.frames == sum(frame.timestamp <= run.scene.timestamps[-1] for frame in run.scene.frames)


def test_a_scene_without_ground_truth_cannot_be_compared():
    class Blind:
        scenes = ("a",)

        def scene(self, name: str) -> Scene:
            return Scene(name, np.zeros(1), np.eye(4)[None], ("",), [])

    with pytest.raises(InputError, match="scene a: expected ground truth"):
        compare(Blind(), load_config("file"), METHODS)


def test_the_moment_shown_has_the_most_moving_hidden_objects(comparison):
    scene_row, moment = hardest_moment(comparison)
    run = comparison.runs["saga"][scene_row]
    assert run.scene.ground_truth is not None

    def hidden(scene: Scene, k: int) -> int:
        truth = scene.ground_truth[k]
        near = np.hypot(*(truth.boxes.position[:, :2] - scene.world_T_ego[k, :2, 3]).T) < 40
        return int((~truth.visible & near & (np.hypot(*truth.boxes.velocity.T) > 0.5)).sum())

    scenes = [run.scene for run in comparison.runs["saga"]]
    assert hidden(run.scene, moment) == max(hidden(scene, k) for scene in scenes for k in range(len(scene)))


def test_the_command_prints_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.cli.start.scenario_settings", lambda scenario: SHORT)
    result = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["demo", "--output", str(tmp_path / "out"), "--scenes", "1"])
    assert result.exit_code == 0, result.output
    for text in ("occluded position RMSE, m", "ms per frame", *METHODS, "page: "):
        assert text in result.stdout


# The direction of the demonstration's comparison, on fixed seeds: `saga` is at least as good in every column

LENGTH = 8.0  # s
SEEDS = range(3)


@pytest.fixture(scope="module")
def metrics() -> Mapping[str, SceneMetrics]:
    """Pooled over one scene of each seed."""
    config, settings = load_config("simulated"), replace(SimulatorSettings(), duration=LENGTH)
    found = [compare(SimulatedTraffic(settings, 1, seed), config, METHODS).metrics for seed in SEEDS]
    return {method: SceneMetrics.pool(each[method] for each in found) for method in METHODS}


@pytest.mark.parametrize("other", ["centerpoint", "kf"])
def test_saga_is_at_least_as_good_in_every_column(metrics, other):
    saga, baseline = metrics["saga"], metrics[other]
    assert saga.mota >= baseline.mota
    assert saga.switches <= baseline.switches
    assert saga.carried.rmse <= baseline.carried.rmse
    assert saga.velocity.rmse <= 1.01 * baseline.velocity.rmse  # as good, to a hundredth
    assert saga.position.median <= baseline.position.median
    assert saga.position.rmse <= 1.05 * baseline.position.rmse  # one wrong pair in three short scenes is 5 %
