"""Many scenes at once."""

import fcntl
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import pytest

from data_tools.datasets.nuscenes import read_tracking_results
from data_tools.datasets.source import HeldScene, Part
from data_tools.simulator import SimulatorSettings
from data_tools.simulator.world import SimulatedSource, opened_scene
from pipelines.scale_out import (
    Job,
    LocalPool,
    Manifest,
    OutputFolder,
    RayPool,
    RunSummary,
    SceneTask,
    TrackTask,
    perform,
    pools,
    run_scenes,
)
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset
from tests.pipelines.command import COMMAND, done, refused, saga_fg
from tests.pipelines.scale_out_example import CONFIG, TRACK, Broken, Deadly, InThisProcess, content, write_recordings


def run(inputs: list[Part], output: Path, task: SceneTask = TRACK, workers: int = 0) -> RunSummary:
    def new_pool(scratch):
        return LocalPool(workers, scratch) if workers else InThisProcess()

    return run_scenes(inputs, len(inputs), task, output, new_pool)


def test_results_do_not_depend_on_the_number_of_workers(tmp_path):
    inputs = write_recordings(tmp_path / "in", 5)
    reports = [run(inputs, tmp_path / str(workers), workers=workers) for workers in (0, 2)]
    contents = [content(tmp_path / str(workers)) for workers in (0, 2)]
    assert contents[0] == contents[1]
    assert sorted(contents[0]) == [f"a{k:02d}.csv" for k in range(5)]
    assert len(set(contents[0].values())) == 5
    for report in reports:
        assert sorted(report.done) == [f"a{k:02d}" for k in range(5)]
        assert report.counts == {
            "frames": 75,
            "tracks": 10,
            "boxes": 140,
            "tracks of car": 10,
        }  # tracks are reported from their second hit on
    assert not list(tmp_path.rglob("*.tmp"))
    assert not list(tmp_path.rglob(".scratch"))


def test_what_has_changed_is_done_again_and_nothing_else(tmp_path):
    inputs, output = write_recordings(tmp_path / "in", 5), tmp_path / "out"
    run(inputs, output)
    expected = content(output)
    (output / "tracks" / "a00.csv").write_text("half a fi")
    (output / "tracks" / "a01.csv").unlink()
    (output / "manifest" / "a02.json").write_text('{"scene": "a0')
    with (tmp_path / "in" / "a03.csv").open("a") as file:
        file.write("9.0,car,50,0,0.9\n9.1,car,50,0,0.9\n")
    report = run(inputs, output)
    assert report.done == ["a00", "a01", "a02", "a03"]
    after = content(output)
    assert {name for name in after if after[name] != expected[name]} == {"a03.csv"}


def test_other_settings_or_another_method_do_everything_again(tmp_path):
    inputs, output = write_recordings(tmp_path / "in", 2), tmp_path / "out"
    run(inputs, output)
    other = replace(CONFIG, tracker=replace(CONFIG.tracker, report_coasting=0.0))
    for task in (replace(TRACK, settings=other), replace(TRACK, method="kf"), TRACK):
        assert run(inputs, output, task).done == ["a00", "a01"]


def test_the_manifest_says_how_a_result_came_about(tmp_path):
    inputs, output = write_recordings(tmp_path / "in", 1), tmp_path / "out"
    run(inputs, output)
    record = json.loads((output / "manifest" / "a00.json").read_text())
    assert list(record) == [
        *("scene", "status", "reason", "inputs", "configuration", "version", "results", "counts", "seconds")
    ]
    assert (record["scene"], record["status"], record["reason"]) == ("a00", "done", "")
    assert list(record["inputs"]) == ["a00.csv"]
    assert list(record["results"]) == ["tracks/a00.csv"]
    assert record["seconds"] > 0
    assert (output / "configuration.yaml").read_text() == TRACK.configuration


def test_a_scene_that_fails_is_reported_and_stops_no_other(tmp_path):
    inputs, output = write_recordings(tmp_path / "in", 3), tmp_path / "out"
    good = (tmp_path / "in" / "a01.csv").read_text()
    (tmp_path / "in" / "a01.csv").write_text("timestamp,x,y\n0.0,far,1\n")
    report = run(inputs, output, workers=2)
    assert sorted(report.done) == ["a00", "a02"]
    assert report.failed == {"a01": f"{tmp_path / 'in' / 'a01.csv'}: line 2: x: expected a number, got 'far'"}
    record = Manifest(OutputFolder(output)).record("a01")
    assert (record.status, record.results) == ("failed", {})
    (tmp_path / "in" / "a01.csv").write_text(good)
    report = run(inputs, output)
    assert (report.done, report.unchanged) == (["a01"], ["a00", "a02"])


def test_a_mistake_in_a_task_names_its_line(tmp_path):
    report = run(write_recordings(tmp_path / "in", 1), tmp_path / "out", Broken())
    assert report.failed["a00"].startswith("scale_out_example.py:")
    assert report.failed["a00"].endswith("ZeroDivisionError: a00")


def test_a_killed_worker_costs_one_attempt_at_one_scene(tmp_path):
    inputs = write_recordings(tmp_path / "in", 4)
    (tmp_path / "deaths").mkdir()
    report = run(inputs, tmp_path / "out", Deadly("a01", tmp_path / "deaths", 1), 2)
    assert sorted(report.done) == ["a00", "a01", "a02", "a03"]
    assert len(list((tmp_path / "deaths").iterdir())) == 1
    run(inputs, tmp_path / "serial")
    assert content(tmp_path / "out") == content(tmp_path / "serial")


def test_a_scene_that_kills_every_worker_fails_alone(tmp_path):
    inputs = write_recordings(tmp_path / "in", 4)
    (tmp_path / "deaths").mkdir()
    report = run(inputs, tmp_path / "out", Deadly("a01", tmp_path / "deaths", 99), workers=2)
    assert sorted(report.done) == ["a00", "a02", "a03"]
    assert report.failed == {"a01": "the worker process ended 2 times (signal 9, Killed)"}


def test_simulated_scenes_are_made_at_the_worker(tmp_path):
    settings = SimulatorSettings(duration=1.0, warm_up=2.0)
    source = SimulatedSource(simulator=settings, scenes=2, seed=7)
    with source.parts() as parts:
        inputs = list(parts.parts)
    run(inputs, tmp_path / "parallel", workers=2)
    run(inputs, tmp_path / "serial")
    assert content(tmp_path / "parallel") == content(tmp_path / "serial")
    (first, second) = content(tmp_path / "serial").values()
    assert first != second


def test_a_held_scene_is_known_by_all_it_holds():
    settings = SimulatorSettings(duration=1.0, warm_up=2.0)
    with opened_scene(SimulatedSource(simulator=settings, scenes=1, seed=7), "scene-0001") as at:
        scene = at.read().scene("scene-0001")
    known = perform(Job(HeldScene(scene).part, TRACK)).digests
    assert set(known) == {"moments", "lidar", "camera"}
    assert perform(Job(HeldScene(scene).part, TRACK, known)).status == "unchanged"
    shorter = replace(scene, frames=[frame for frame in scene.frames if frame is not scene.frames[-1]])
    changed = perform(Job(HeldScene(shorter).part, TRACK, known))
    assert changed.status == "done"
    assert sum(changed.digests[name] != known[name] for name in known) == 1


def test_two_scenes_of_one_name_are_an_error(tmp_path):
    inputs = write_recordings(tmp_path / "in", 1)
    with pytest.raises(InputError, match="scene a00: expected a name of its own"):
        run([*inputs, *inputs], tmp_path / "out")


def test_two_runs_do_not_write_to_one_folder(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    inputs, output = write_recordings(tmp_path / "in", 1), tmp_path / "out"
    run(inputs, output)
    with (output / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another run is writing"):
            run(inputs, output)


def test_one_process_of_a_node_compiles_kernels_while_the_others_wait(monkeypatch, tmp_path):
    happened: list[str] = []
    held = []

    def load() -> None:
        (lock,) = tmp_path.iterdir()
        held.append(lock.name)
        with lock.open("w") as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        happened.append("kernels")

    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(pools, "load_kernels", load)
    monkeypatch.setattr(pools, "perform", lambda job: happened.append(job))
    for job in ("first", "second"):
        pools.perform_on_node(job)  # type: ignore[arg-type]
    assert happened == ["kernels", "first", "kernels", "second"]
    assert len(set(held)) == 1
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path / "missing"))
    monkeypatch.setattr(pools, "load_kernels", lambda: happened.append("alone"))
    pools.perform_on_node("third")  # type: ignore[arg-type]
    assert happened[-2:] == ["alone", "third"]


def test_kernels_are_loaded_before_workers_begin(monkeypatch):
    """Else each of them compiles them, and says so."""
    happened: list[str] = []

    class Worker:
        def __init__(self, scratch: Path | None) -> None:
            happened.append("worker")

        def end(self) -> None:
            pass

    monkeypatch.setattr(pools, "_Worker", Worker)
    monkeypatch.setattr(pools, "load_kernels", lambda: happened.append("kernels"))
    assert list(LocalPool(2).outcomes(iter(()), 2)) == []
    assert happened == ["kernels", "worker", "worker"]


# `saga-fg track ... --workers N`, killed in the middle and run again; and on a Ray cluster of two workers


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "short.yaml").write_text("duration: 2.0\nwarm_up: 3.0\n")
    done("simulate", "-o", folder / "data", "--scenes", "3", "--config", folder / "short.yaml")
    return folder / "data"


def nuscenes(simulated: Path) -> list[str | Path]:
    detections = f"lidar={simulated / 'detections' / 'lidar.json'}"
    return ["track", "nuscenes", "--dataroot", simulated, "--detections", detections, "--split", "all"]


def test_the_merged_file_is_that_of_one_process(simulated, tmp_path):
    assert saga_fg(*nuscenes(simulated), "-o", tmp_path / "tracks.json").exit_code == 0
    result = done(*nuscenes(simulated), "-o", tmp_path / "run", "--workers", "2")
    assert result.stdout.startswith(f"{tmp_path / 'run'}: 3 scenes: 3 done, 0 unchanged, 0 failed, 12 frames, ")
    assert (tmp_path / "run" / "tracks.json").read_bytes() == (tmp_path / "tracks.json").read_bytes()


def test_failed_scenes_are_named_and_there_is_no_merged_file(simulated, tmp_path, monkeypatch):
    def run(task: TrackTask, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        if name == "scene-0002":
            raise InputError("bad weather")
        return run_of_task(task, name, dataset, folder)

    run_of_task = TrackTask.run
    monkeypatch.setattr(TrackTask, "run", run)
    monkeypatch.setattr("pipelines.cli.track.new_pool", lambda *_: InThisProcess())
    result = saga_fg(*nuscenes(simulated), "-o", tmp_path / "run", "--workers", "1")
    assert result.exit_code == 1
    assert "3 scenes: 2 done, 0 unchanged, 1 failed" in result.stdout
    assert result.stderr == "failed: scene-0002: bad weather\n"
    assert not (tmp_path / "run" / "tracks.json").exists()
    monkeypatch.setattr(TrackTask, "run", run_of_task)
    result = done(*nuscenes(simulated), "-o", tmp_path / "run", "--workers", "1")
    assert "3 scenes: 1 done, 2 unchanged, 0 failed" in result.stdout
    assert len(read_tracking_results(tmp_path / "run" / "tracks.json").samples) == 12


def test_files_by_pattern_and_url(tmp_path):
    write_recordings(tmp_path / "in", 3)
    run = ["track", "file", "--workers", "1"]
    assert saga_fg(*run, tmp_path / "in" / "*.csv", "-o", tmp_path / "pattern").exit_code == 0
    assert saga_fg(*run, f"file://{tmp_path}/in/*.csv", "-o", tmp_path / "url").exit_code == 0
    assert len(content(tmp_path / "pattern")) == 3
    assert content(tmp_path / "pattern") == content(tmp_path / "url")
    failed = saga_fg(*run, tmp_path / "in" / "a00.csv", f"file://{tmp_path}/in/none.csv", "-o", tmp_path / "pattern")
    assert failed.exit_code == 1
    assert "0 done, 1 unchanged, 1 failed" in failed.stdout
    assert failed.stderr.startswith(f"failed: none: file://{tmp_path}/in/none.csv: cannot be read: FileNotFoundError")


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (("-o", "out.csv"), "--output out.csv: expected the name of a folder"),
        (("-o", "out", "--scenes", "a00"), "--scenes: all scenes of a file are done"),
        (("-o", "out", "none*.csv"), "expected at least one file"),
    ],
)
def test_mistakes_end_in_one_line(tmp_path, monkeypatch, extra, message):
    monkeypatch.chdir(tmp_path)
    files = () if "none*.csv" in extra else ("a00.csv",)
    assert message in refused("track", "file", *files, "--workers", "1", *extra)
    assert list(tmp_path.iterdir()) == []


def test_a_killed_run_is_completed_by_the_next(tmp_path):
    inputs = write_recordings(tmp_path / "in", 12, rows=40)
    run = ["track", "file", str(tmp_path / "in" / "*.csv"), "--workers", "2", "--output", str(tmp_path / "out")]
    driver = subprocess.Popen([*COMMAND, *run], stdout=subprocess.DEVNULL)
    while len(list(tmp_path.glob("out/manifest/*.json"))) < 3:
        assert driver.poll() is None
        time.sleep(0.02)
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("out/manifest/*.json")}
    assert 3 <= len(before) < len(inputs)
    (tmp_path / "out" / "tracks" / ".a11.csv.0123456789ab.tmp").write_text("half a fi")  # as a write that was cut off
    assert f"12 scenes: {12 - len(before)} done, {len(before)} unchanged, 0 failed" in done(*run).stdout
    assert {path: path.stat().st_mtime_ns for path in before} == before
    run_scenes(inputs, 12, TRACK, tmp_path / "serial", lambda _: InThisProcess())
    assert content(tmp_path / "out") == content(tmp_path / "serial")
    assert len(content(tmp_path / "out")) == 12
    assert not (tmp_path / "out" / ".scratch").exists()


CLUSTER = """
from pathlib import Path
import sys
from tests.pipelines.scale_out_example import Deadly, write_recordings
from pipelines.scale_out import RayPool, run_scenes

folder = Path(sys.argv[1])
inputs = write_recordings(folder / "in", 6)
(folder / "deaths").mkdir()
task = Deadly("a02", folder / "deaths", 1)
report = run_scenes(inputs, 6, task, folder / "ray", lambda scratch: RayPool("local", 2))
assert sorted(report.done) == [f"a{k:02d}" for k in range(6)], report
"""


def test_a_ray_cluster_of_two_workers_of_which_one_is_killed(tmp_path):
    pytest.importorskip("ray", reason="Ray comes with the extra ray")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", CLUSTER, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stderr
    assert len(list((tmp_path / "deaths").iterdir())) == 1
    pattern = str(tmp_path / "in" / "*.csv")
    assert saga_fg("track", "file", pattern, "--workers", "1", "-o", tmp_path / "serial").exit_code == 0
    assert content(tmp_path / "ray") == content(tmp_path / "serial")


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a cluster of two CPUs that `ray start` has made, and that ends with its processes."""
    pytest.importorskip("ray", reason="Ray comes with the extra ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")  # handed out by the environment, as the guide says
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    folder = Path(tempfile.mkdtemp(prefix="ray"))  # short: Ray puts sockets into it
    ray = [sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start", "--head", "--block"]
    ray += ["--node-ip-address", "127.0.0.1", "--port", address.rpartition(":")[2], "--num-cpus", "2"]
    ray += ["--include-dashboard", "false", "--temp-dir", str(folder)]
    with (folder / "log").open("w") as log:
        head = subprocess.Popen(ray, stdout=log, stderr=log, start_new_session=True)
    try:
        while "Ray runtime started" not in (folder / "log").read_text():
            assert head.poll() is None, (folder / "log").read_text()
            time.sleep(0.2)
        yield address
    finally:
        os.killpg(head.pid, signal.SIGTERM)
        head.wait()
        shutil.rmtree(folder, ignore_errors=True)


def test_a_cluster_that_is_there_already(cluster, tmp_path):
    write_recordings(tmp_path / "in", 3)
    pattern = str(tmp_path / "in" / "*.csv")
    command = [*COMMAND, "track", "file", pattern, "--ray", cluster, "--output", str(tmp_path / "ray")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert run.returncode == 0, run.stderr
    assert "3 scenes: 3 done, 0 unchanged, 0 failed" in run.stdout
    assert saga_fg("track", "file", pattern, "--workers", "1", "-o", tmp_path / "serial").exit_code == 0
    assert content(tmp_path / "ray") == content(tmp_path / "serial")


def test_a_cluster_elsewhere_is_asked_by_its_address_and_named_where_there_is_none(monkeypatch):
    asked = []

    def init(**options: object) -> None:
        asked.append(options)
        raise ConnectionError("refused\nby a firewall")

    ray = ModuleType("ray")
    ray.__spec__ = ModuleSpec("ray", None)
    vars(ray)["init"] = init
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises(InputError, match=r"--ray 10\.0\.0\.1:6379: no cluster there: refused$"):
        list(RayPool("10.0.0.1:6379", 2).outcomes(iter(()), 0))
    assert asked[0]["address"] == "10.0.0.1:6379"
    assert "num_cpus" not in asked[0]


def test_without_ray_the_extra_is_named(tmp_path, monkeypatch):
    write_recordings(tmp_path / "in", 1)
    monkeypatch.setitem(sys.modules, "ray", None)
    said = refused("track", "file", tmp_path / "in" / "a00.csv", "--ray", "local", "-o", tmp_path / "out")
    assert said == "error: --ray needs ray: pip install 'saga-fg[ray]'\n"


def test_edge_rules_that_meet_no_class_are_told_once_however_it_runs(tmp_path, caplog):
    write_recordings(tmp_path / "in", 2)
    pattern, warnings = tmp_path / "in" / "*.csv", list[list[str]]()
    for classes, *how in (("truck",), ("truck",), ("truck", "--method", "kf"), ("car",)):
        (tmp_path / "rules.yaml").write_text(f"tracker: {{edges: [{{kind: following, classes: [{classes}]}}]}}\n")
        caplog.clear()
        run = ("track", "file", pattern, "-o", tmp_path / "out", "--config", tmp_path / "rules.yaml", "--workers", "1")
        done(*run, *how)
        warnings.append([record.getMessage() for record in caplog.records])
    what = "no edges: tracker.edges act on truck, and the tracks are of car; objects are tracked one by one"
    told = [f"{what}; fill in and add --classes car=..."]
    assert warnings == [told, told, [], []]  # also where the results are there already


def test_labels_are_those_of_one_process(simulated, tmp_path):
    smooth = ["smooth", *nuscenes(simulated)[1:]]
    assert saga_fg(*smooth, "-o", tmp_path / "serial").exit_code == 0
    result = done(*smooth, "-o", tmp_path / "run", "--workers", "2")
    assert "3 scenes: 3 done, 0 unchanged, 0 failed, " in result.stdout
    tables = sorted(path.relative_to(tmp_path / "serial") for path in (tmp_path / "serial" / "v1.0-mini").iterdir())
    assert Path("v1.0-mini/sample_annotation.json") in tables
    for name in (Path("tracking.json"), *tables):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "serial" / name).read_bytes(), name
    header, *rows = (tmp_path / "serial" / "labels.csv").read_text().splitlines()
    assert len(rows) > 20
    parts = [path.read_text().splitlines() for path in sorted((tmp_path / "run" / "labels").iterdir())]
    assert [part[0] for part in parts] == [header] * 3
    assert [row for part in parts for row in part[1:]] == rows
