"""Many scenes in parallel: the same bytes whatever the workers, only what has to be done again, nothing lost."""

from __future__ import annotations

import fcntl
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest

from data_tools.datasets.detection_file_source import DetectionFileSource
from data_tools.datasets.source import HeldScene, Part
from data_tools.simulator import SimulatorSettings
from data_tools.simulator.source import SimulatedScene, SimulatedSource
from pipelines.scale_out import (
    Job,
    LocalPool,
    Manifest,
    OutputFolder,
    RunSummary,
    SceneTask,
    perform,
    pools,
    run_scenes,
)
from saga_fg.errors import InputError
from tests.pipelines.scale_out_example import CONFIG, TRACK, Broken, Deadly, InThisProcess, content, write_recordings


def run(inputs: list[Part], output: Path, task: SceneTask = TRACK, workers: int = 0) -> RunSummary:
    def new_pool(scratch):
        return LocalPool(workers, scratch) if workers else InThisProcess()

    return run_scenes(inputs, len(inputs), task, output, new_pool)


def written(output: Path) -> dict[str, int]:
    """Times at which the files of a run were written, ns."""
    return {str(path): path.stat().st_mtime_ns for path in output.glob("*/*")}


def test_results_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
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


def test_a_second_run_does_nothing_again(tmp_path: Path) -> None:
    inputs = write_recordings(tmp_path / "in", 3)
    run(inputs, tmp_path / "out")
    before = written(tmp_path / "out")
    report = run(inputs, tmp_path / "out")
    assert report.unchanged == ["a00", "a01", "a02"]
    assert report.counts["frames"] == 45
    assert written(tmp_path / "out") == before


def test_what_has_changed_is_done_again_and_nothing_else(tmp_path: Path) -> None:
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


def test_other_settings_or_another_method_do_everything_again(tmp_path: Path) -> None:
    inputs, output = write_recordings(tmp_path / "in", 2), tmp_path / "out"
    run(inputs, output)
    other = replace(CONFIG, tracker=replace(CONFIG.tracker, report_coasting=0.0))
    for task in (replace(TRACK, settings=other), replace(TRACK, method="kf"), TRACK):
        assert run(inputs, output, task).done == ["a00", "a01"]
    run(inputs, output, replace(TRACK, source=DetectionFileSource(table="ndjson")))
    assert list(content(output)) == ["a00.ndjson", "a01.ndjson"]  # results of an earlier form do not stay behind


def test_the_manifest_says_how_a_result_came_about(tmp_path: Path) -> None:
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


def test_a_scene_that_fails_is_reported_and_stops_no_other(tmp_path: Path) -> None:
    inputs, output = write_recordings(tmp_path / "in", 3), tmp_path / "out"
    good = (tmp_path / "in" / "a01.csv").read_text()
    (tmp_path / "in" / "a01.csv").write_text("timestamp,x,y\n0.0,far,1\n")
    report = run(inputs, output, workers=2)
    assert sorted(report.done) == ["a00", "a02"]
    assert report.failed == {"a01": f"{tmp_path / 'in' / 'a01.csv'}: line 2: x: expected a number, got 'far'"}
    record = Manifest(OutputFolder(output)).record("a01")
    assert record is not None
    assert (record.status, record.results) == ("failed", {})
    (tmp_path / "in" / "a01.csv").write_text(good)
    report = run(inputs, output)
    assert (report.done, report.unchanged) == (["a01"], ["a00", "a02"])


def test_a_mistake_in_a_task_names_its_line(tmp_path: Path) -> None:
    report = run(write_recordings(tmp_path / "in", 1), tmp_path / "out", Broken())
    assert report.failed["a00"].startswith("scale_out_example.py:")
    assert report.failed["a00"].endswith("ZeroDivisionError: a00")


def test_a_killed_worker_costs_one_attempt_at_one_scene(tmp_path: Path) -> None:
    inputs = write_recordings(tmp_path / "in", 4)
    (tmp_path / "deaths").mkdir()
    report = run(inputs, tmp_path / "out", Deadly("a01", tmp_path / "deaths", 1), 2)
    assert sorted(report.done) == ["a00", "a01", "a02", "a03"]
    assert len(list((tmp_path / "deaths").iterdir())) == 1
    run(inputs, tmp_path / "serial")
    assert content(tmp_path / "out") == content(tmp_path / "serial")


def test_a_scene_that_kills_every_worker_fails_alone(tmp_path: Path) -> None:
    inputs = write_recordings(tmp_path / "in", 4)
    (tmp_path / "deaths").mkdir()
    report = run(inputs, tmp_path / "out", Deadly("a01", tmp_path / "deaths", 99), workers=2)
    assert sorted(report.done) == ["a00", "a02", "a03"]
    assert report.failed == {"a01": "the worker process ended 2 times (signal 9, Killed)"}


def test_simulated_scenes_are_made_at_the_worker(tmp_path: Path) -> None:
    settings = SimulatorSettings(duration=1.0, warm_up=2.0)
    source = SimulatedSource(simulator=settings, scenes=2, seed=7)
    inputs = [SimulatedScene(source, f"scene-000{k}") for k in (1, 2)]
    run(inputs, tmp_path / "parallel", workers=2)
    run(inputs, tmp_path / "serial")
    assert content(tmp_path / "parallel") == content(tmp_path / "serial")
    (first, second) = content(tmp_path / "serial").values()
    assert first != second


def test_a_held_scene_is_known_by_all_it_holds() -> None:
    settings = SimulatorSettings(duration=1.0, warm_up=2.0)
    source = SimulatedScene(SimulatedSource(simulator=settings, scenes=1, seed=7), "scene-0001")
    with source.opened() as at:
        scene = at.read().scene("scene-0001")
    known = perform(Job(HeldScene(scene), TRACK)).digests
    assert set(known) == {"moments", "lidar", "camera"}
    assert perform(Job(HeldScene(scene), TRACK, known)).status == "unchanged"
    shorter = replace(scene, frames=[frame for frame in scene.frames if frame is not scene.frames[-1]])
    changed = perform(Job(HeldScene(shorter), TRACK, known))
    assert changed.status == "done"
    assert sum(changed.digests[name] != known[name] for name in known) == 1


def test_two_scenes_of_one_name_are_an_error(tmp_path: Path) -> None:
    inputs = write_recordings(tmp_path / "in", 1)
    with pytest.raises(InputError, match="scene a00: expected a name of its own"):
        run([*inputs, *inputs], tmp_path / "out")


def test_two_runs_do_not_write_to_one_folder(tmp_path: Path) -> None:
    fcntl = pytest.importorskip("fcntl")
    inputs, output = write_recordings(tmp_path / "in", 1), tmp_path / "out"
    run(inputs, output)
    with (output / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another run is writing"):
            run(inputs, output)


def test_one_process_of_a_node_compiles_kernels_while_the_others_wait(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
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


def test_kernels_are_loaded_before_workers_begin(monkeypatch: pytest.MonkeyPatch) -> None:
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
