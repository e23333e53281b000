"""`saga-fg track ... --workers N`, killed in the middle and run again; and on a Ray cluster of two workers."""

from __future__ import annotations

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
from pathlib import Path

import pytest

from data_tools.datasets.nuscenes import read_tracking_results
from pipelines.scale_out import TrackTask
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset
from tests.pipelines.command import COMMAND, saga_fg
from tests.pipelines.scale_out_example import InThisProcess, content, write_recordings


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "short.yaml").write_text("duration: 2.0\nwarm_up: 3.0\n")
    result = saga_fg("simulate", "-o", folder / "data", "--scenes", "3", "--config", folder / "short.yaml")
    assert result.exit_code == 0, result.output
    return folder / "data"


def nuscenes(simulated: Path) -> list[str | Path]:
    detections = f"lidar={simulated / 'detections' / 'lidar.json'}"
    return ["track", "nuscenes", "--dataroot", simulated, "--detections", detections, "--split", "all"]


def test_the_merged_file_is_that_of_one_process(simulated: Path, tmp_path: Path) -> None:
    assert saga_fg(*nuscenes(simulated), "-o", tmp_path / "tracks.json").exit_code == 0
    result = saga_fg(*nuscenes(simulated), "-o", tmp_path / "run", "--workers", "2")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith(f"{tmp_path / 'run'}: 3 scenes: 3 done, 0 unchanged, 0 failed, 12 frames, ")
    assert (tmp_path / "run" / "tracks.json").read_bytes() == (tmp_path / "tracks.json").read_bytes()


def test_failed_scenes_are_named_and_there_is_no_merged_file(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(task: TrackTask, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        if name == "scene-0002":
            raise InputError("bad weather")
        return done(task, name, dataset, folder)

    done = TrackTask.run
    monkeypatch.setattr(TrackTask, "run", run)
    monkeypatch.setattr("pipelines.cli.track.new_pool", lambda *_: InThisProcess())
    result = saga_fg(*nuscenes(simulated), "-o", tmp_path / "run", "--workers", "1")
    assert result.exit_code == 1
    assert "3 scenes: 2 done, 0 unchanged, 1 failed" in result.stdout
    assert result.stderr == "failed: scene-0002: bad weather\n"
    assert not (tmp_path / "run" / "tracks.json").exists()
    monkeypatch.setattr(TrackTask, "run", done)
    result = saga_fg(*nuscenes(simulated), "-o", tmp_path / "run", "--workers", "1")
    assert result.exit_code == 0
    assert "3 scenes: 1 done, 2 unchanged, 0 failed" in result.stdout
    assert len(read_tracking_results(tmp_path / "run" / "tracks.json").samples) == 12


def test_files_by_pattern_and_url(tmp_path: Path) -> None:
    write_recordings(tmp_path / "in", 3)
    run = ["track", "file", "--workers", "1"]
    assert saga_fg(*run, tmp_path / "in" / "*.csv", "-o", tmp_path / "pattern").exit_code == 0
    assert saga_fg(*run, f"file://{tmp_path}/in/*.csv", "-o", tmp_path / "url").exit_code == 0
    (tmp_path / "list.txt").write_text(f"# ours\n{tmp_path}/in/a00.csv\n\nfile://{tmp_path}/in/a01.csv\n")
    assert saga_fg(*run, tmp_path / "list.txt", "-o", tmp_path / "list").exit_code == 0
    assert len(content(tmp_path / "pattern")) == 3
    assert content(tmp_path / "pattern") == content(tmp_path / "url")
    assert list(content(tmp_path / "list")) == ["a00.csv", "a01.csv"]
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
def test_mistakes_end_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    files = () if "none*.csv" in extra else ("a00.csv",)
    result = saga_fg("track", "file", *files, "--workers", "1", *extra)
    assert result.exit_code == 2
    assert message in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_killed_run_is_completed_by_the_next(tmp_path: Path) -> None:
    inputs = write_recordings(tmp_path / "in", 12, rows=40)
    run = ["track", "file", str(tmp_path / "in" / "*.csv"), "--workers", "2", "--output", str(tmp_path / "out")]
    driver = subprocess.Popen([*COMMAND, *run], stdout=subprocess.DEVNULL)
    while len(list(tmp_path.glob("out/manifest/*.json"))) < 3:
        assert driver.poll() is None
        time.sleep(0.02)
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    done = {path: path.stat().st_mtime_ns for path in tmp_path.glob("out/manifest/*.json")}
    assert 3 <= len(done) < len(inputs)
    (tmp_path / "out" / "tracks" / ".a11.csv.0123456789ab.tmp").write_text("half a fi")  # as a write that was cut off
    again = subprocess.run([*COMMAND, *run], capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert f"12 scenes: {12 - len(done)} done, {len(done)} unchanged, 0 failed" in again.stdout
    assert {path: path.stat().st_mtime_ns for path in done} == done
    run[-1] = str(tmp_path / "serial")
    assert saga_fg(*run).exit_code == 0
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


def test_a_ray_cluster_of_two_workers_of_which_one_is_killed(tmp_path: Path) -> None:
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


def test_a_cluster_that_is_there_already(cluster: str, tmp_path: Path) -> None:
    write_recordings(tmp_path / "in", 3)
    pattern = str(tmp_path / "in" / "*.csv")
    command = [*COMMAND, "track", "file", pattern, "--ray", cluster, "--output", str(tmp_path / "ray")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert "3 scenes: 3 done, 0 unchanged, 0 failed" in done.stdout
    assert saga_fg("track", "file", pattern, "--workers", "1", "-o", tmp_path / "serial").exit_code == 0
    assert content(tmp_path / "ray") == content(tmp_path / "serial")


def test_without_ray_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_recordings(tmp_path / "in", 1)
    monkeypatch.setitem(sys.modules, "ray", None)
    result = saga_fg("track", "file", tmp_path / "in" / "a00.csv", "--ray", "local", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr == 'error: --ray: Ray is not installed; pip install "saga-fg[ray]"\n'


def test_edge_rules_that_meet_no_class_are_told_once_however_it_runs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_recordings(tmp_path / "in", 2)
    pattern, warnings = tmp_path / "in" / "*.csv", list[list[str]]()
    for classes in ("[truck]", "[car]"):
        rules = f"tracker: {{edges: [{{kind: following, classes: {classes}}}]}}\n"
        (tmp_path / "rules.yaml").write_text(rules)
        for where in (("--workers", "1"), ("--workers", "1"), ("--workers", "1", "--method", "kf")):
            caplog.clear()
            command = ("track", "file", pattern, "-o", tmp_path / "out", "--config", tmp_path / "rules.yaml", *where)
            result = saga_fg(*command)
            assert result.exit_code == 0, result.output
            warnings.append([record.getMessage() for record in caplog.records])
    what = "no edges: tracker.edges act on truck, and the tracks are of car; objects are tracked one by one"
    told = [f"{what}; fill in and add --classes car=..."]
    assert warnings == [told, told, [], [], [], []]  # also where the results are there already


def test_labels_are_those_of_one_process(simulated: Path, tmp_path: Path) -> None:
    smooth = ["smooth", *nuscenes(simulated)[1:]]
    assert saga_fg(*smooth, "-o", tmp_path / "serial").exit_code == 0
    result = saga_fg(*smooth, "-o", tmp_path / "run", "--workers", "2")
    assert result.exit_code == 0, result.output
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


def test_kitti_sequences_in_parallel(recordings: Path, tmp_path: Path) -> None:
    kitti = recordings / "kitti"
    track = [
        *("track", "kitti", "--dataroot", kitti, "--detections", kitti / "detections" / "pointrcnn"),
        *("--sequences", "0000,0017", "--method", "centerpoint"),
    ]
    assert saga_fg(*track, "-o", tmp_path / "serial").exit_code == 0
    assert saga_fg(*track, "-o", tmp_path / "run", "--workers", "2").exit_code == 0
    for name in ("0000.txt", "0017.txt", "tracks.csv"):
        assert (tmp_path / "run" / "tracks" / name).read_bytes() == (tmp_path / "serial" / name).read_bytes()
    assert "0 done, 2 unchanged" in saga_fg(*track, "-o", tmp_path / "run", "--workers", "1").stdout
