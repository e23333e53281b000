"""A parallel run into a folder where somebody has planted links, or a manifest that names files elsewhere."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipelines.scale_out import Manifest, OutputFolder, RunSummary, file_name, run_scenes
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset
from tests.pipelines.command import done, refused
from tests.pipelines.scale_out_example import TRACK, InThisProcess, content, write_recordings


def run(folder: Path, scenes: int = 1) -> RunSummary:
    inputs = write_recordings(folder / "in", scenes)
    return run_scenes(inputs, scenes, TRACK, folder / "out", lambda scratch: InThisProcess())


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A folder beside the output, with a file that must stay as it is."""
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "a00.csv").write_text("mine")
    (tmp_path / "out").mkdir()
    return tmp_path / "victim"


def unharmed(victim: Path) -> bool:
    return [path.read_text() for path in victim.iterdir()] == ["mine"]


def test_a_link_where_a_file_belongs_is_replaced(tmp_path, victim):
    links = [tmp_path / "out" / name for name in ("configuration.yaml", "tracks/a00.csv", "manifest/a00.json")]
    for link in links:
        link.parent.mkdir(exist_ok=True)
        link.symlink_to(victim / "a00.csv")
    assert run(tmp_path).done == ["a00"]
    assert not any(link.is_symlink() or link.read_text() == "mine" for link in links)
    assert unharmed(victim)


@pytest.mark.parametrize("name", ["tracks", ".lock"])
def test_a_link_where_a_folder_or_the_lock_belongs_is_refused(tmp_path, victim, name):
    (tmp_path / "out" / name).symlink_to(victim / "a00.csv" if name == ".lock" else victim)
    with pytest.raises(InputError, match=rf"out/{name}.*: not writable: expected no link on the way"):
        run(tmp_path)
    assert unharmed(victim)


def test_a_link_where_the_scratch_folder_belongs_is_removed(tmp_path, victim):
    for to in ("victim", "victim/a00.csv", "nowhere"):
        (tmp_path / "out" / ".scratch").symlink_to(tmp_path / to)
        run(tmp_path)
        assert not (tmp_path / "out" / ".scratch").is_symlink()
        assert not (tmp_path / "nowhere").exists()
        assert unharmed(victim)


def test_leftovers_are_not_looked_for_behind_links(tmp_path, victim):
    (victim / "a00.csv").rename(victim / ".a00.csv.0123456789ab.tmp")
    (tmp_path / "out" / "linked").symlink_to(victim)
    (tmp_path / "out" / ".linked.0123456789ab.tmp").symlink_to(victim)
    run(tmp_path)
    assert unharmed(victim)
    assert not (tmp_path / "out" / ".linked.0123456789ab.tmp").is_symlink()


FORGED = (
    *("../victim/a00.csv", "{victim}/a00.csv", "tracks/../../victim/a00.csv", "tracks/a01.csv", "tracks/a00.b.csv"),
    *("a01.csv", "tracks/b/a01.csv", "manifest/a00/x", ".scratch/a00.csv", "configuration.yaml"),
    *("", ".", "..", "./a00.csv", "a//a00.csv", "a00.csv/", "a00\0.csv"),
)


def test_a_manifest_names_nothing_of_others(tmp_path, victim):
    run(tmp_path, 2)
    out = tmp_path / "out"
    path = out / "manifest" / "a00.json"
    record, before = json.loads(path.read_text()), content(out)
    for name in FORGED:
        forged = record | {"results": record["results"] | {name.format(victim=victim): "0" * 64}}
        path.write_text(json.dumps(forged))
        assert Manifest(OutputFolder(out)).record("a00") is None, name
    assert run(tmp_path, 2).done == ["a00"]
    assert content(out) == before
    assert unharmed(victim)
    assert list(json.loads(path.read_text())["results"]) == ["tracks/a00.csv"]


def test_a_record_of_another_scene_is_none(tmp_path):
    run(tmp_path, 2)
    records = tmp_path / "out" / "manifest"
    (records / "a00.json").write_bytes((records / "a01.json").read_bytes())
    assert run(tmp_path, 2).done == ["a00"]
    assert sorted(content(tmp_path / "out")) == ["a00.csv", "a01.csv"]


@dataclass(frozen=True)
class InFoldersOfItsOwn:
    """Writes files whose names are its own affair, in a folder named for the scene."""

    configuration: str = "folders"

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        own = folder / "points" / file_name(name)
        own.mkdir(parents=True)
        (own / "all.bin").write_bytes(b"1")
        return {}


def test_results_may_be_in_a_folder_of_the_scene(tmp_path):
    inputs = write_recordings(tmp_path / "in", 1)
    reports = [
        run_scenes(inputs, 1, InFoldersOfItsOwn(), tmp_path / "out", lambda scratch: InThisProcess()) for _ in range(2)
    ]
    assert (reports[0].done, reports[1].unchanged) == (["a00"], ["a00"])


def test_a_result_behind_a_link_is_neither_believed_nor_removed(tmp_path, victim):
    run(tmp_path)
    (tmp_path / "out" / "tracks").rename(tmp_path / "moved")
    (tmp_path / "out" / "tracks").symlink_to(tmp_path / "moved")
    before = (tmp_path / "moved" / "a00.csv").read_bytes()
    with pytest.raises(InputError, match="expected no link on the way"):
        run(tmp_path)
    assert (tmp_path / "moved" / "a00.csv").read_bytes() == before


def test_a_record_of_other_types_is_none(tmp_path):
    run(tmp_path)
    path = tmp_path / "out" / "manifest" / "a00.json"
    sound = json.loads(path.read_text())
    for change in (
        {"results": ["tracks/a00.csv"]},
        {"results": {"tracks/a00.csv": 1}},
        {"inputs": "a00.csv"},
        {"counts": {"frames": "many"}},
        {"counts": None},
    ):
        path.write_text(json.dumps(sound | change))
        assert Manifest(OutputFolder(tmp_path / "out")).record("a00") is None
    assert run(tmp_path).done == ["a00"]


def test_a_record_that_is_a_pipe_or_nested_too_deeply_is_none(tmp_path):
    for number, scene in enumerate(("a00", "a01")):
        run(tmp_path, 2)
        path = tmp_path / "out" / "manifest" / f"{scene}.json"
        path.unlink()
        path.write_text("[" * 10_000) if number else os.mkfifo(path)
        assert run(tmp_path, 2).done == [scene]


def test_the_output_itself_may_be_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    assert run(tmp_path).done == ["a00"]
    assert run(tmp_path).unchanged == ["a00"]
    assert list(content(tmp_path / "disk")) == ["a00.csv"]


def test_merged_tables_are_not_written_through_a_link(tmp_path, victim):
    (tmp_path / "short.yaml").write_text("duration: 1.0\nwarm_up: 1.0\n")

    data, out = tmp_path / "data", tmp_path / "out"
    done("simulate", "-o", data, "--scenes", 1, "--config", tmp_path / "short.yaml")
    (out / "v1.0-mini").symlink_to(victim)
    said = refused(
        *("smooth", "nuscenes", "--dataroot", data, "--split", "all", "--workers", 1, "-o", out),
        *("--detections", f"lidar={data / 'detections' / 'lidar.json'}"),
    )
    assert said == f"error: {out / 'v1.0-mini'}: not writable: expected a folder, this is a link\n"
    assert unharmed(victim)
