"""`saga-fg track --explain` and `saga-fg explain`: the life of a track, from files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.pipelines.command import saga_fg


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cars in two scenes; the second one of scene b hides after a second, for longer than tracks are remembered."""
    folder = tmp_path_factory.mktemp("explain")
    lines = ["scene,timestamp,label,x,y,score"]
    for scene in "ab":
        for k in range(80):
            lines.append(f"{scene},{k / 10},car,{k / 2},0.0,0.9")
            if scene == "a" or k < 10:
                lines.append(f"{scene},{k / 10},car,{k / 2 - 8},0.0,0.9")
    (folder / "detections.csv").write_text("\n".join(lines) + "\n")
    result = saga_fg("track", "file", folder / "detections.csv", "-o", folder / "tracks.csv", "--explain")
    assert result.exit_code == 0, result.output
    return folder


def test_the_life_of_a_track_is_told_from_initiation_to_end(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "events.json"
    result = saga_fg("explain", folder / "tracks.csv", "--track", "b-2", "--json", file)
    assert result.exit_code == 0, result.output
    first, *lines = result.stdout.splitlines()
    assert first.startswith("track 2 of b, car: ")
    assert "initiated by detection" in lines[0]
    assert any("kept: detection 1" in line for line in lines)
    assert any("missed, not detected for" in line for line in lines)
    assert "deleted: " in lines[-1]
    events = json.loads(file.read_text())
    assert [event["event"] for event in events][:2] == ["initiated", "matched"]
    assert events[-1]["event"] == "deleted"
    assert {event["scene"] for event in events} == {"b"}


def test_a_track_that_lives_to_the_end(folder: Path) -> None:
    result = saga_fg("explain", folder / "tracks.csv", "--track", "1", "--scene", "a")
    assert result.exit_code == 0, result.output
    assert "then the recording ends" in result.stdout.splitlines()[0]


def test_tracks_that_are_not_there(folder: Path) -> None:
    for arguments, expected in [
        (("--track", "1"), "expected --scene, the track is in a, b"),
        (("--track", "99"), "expected events of track 99, there are none"),
        (("--track", "car"), "expected the number of a track"),
    ]:
        result = saga_fg("explain", folder / "tracks.csv", *arguments)
        assert result.exit_code == 2
        assert expected in result.stderr


def test_journals_that_are_not_there_or_broken(tmp_path: Path) -> None:
    result = saga_fg("explain", tmp_path / "tracks.json", "--track", "1")
    assert result.exit_code == 2
    assert "track with --explain" in result.stderr
    for content, expected in (("{\n", "line 1: broken or truncated JSON"), ("3\n", "line 1: expected an event")):
        (tmp_path / "tracks.json.journal.jsonl").write_text(content)
        result = saga_fg("explain", tmp_path / "tracks.json", "--track", "1")
        assert result.exit_code == 2
        assert expected in result.stderr


def test_an_event_that_nobody_wrote(folder: Path, tmp_path: Path) -> None:
    for change in [{"time": "noon"}, {"time": None}, {"event": "eaten"}, {"sensor": {}}, {"label": 1}]:
        lines = (folder / "tracks.csv.journal.jsonl").read_text().splitlines()
        events = [json.loads(line) for line in lines]
        changed = next(event for event in events if event.get("track") == 1)
        changed.update(change)
        if "label" in change:
            del changed["label"]
        (tmp_path / "t.csv.journal.jsonl").write_text("\n".join(map(json.dumps, events)))
        result = saga_fg("explain", tmp_path / "t.csv", "--track", "1", "--scene", changed["scene"])
        assert result.exit_code == 2
        assert result.stderr.startswith(
            f"error: {tmp_path / 't.csv.journal.jsonl'}: expected events as --explain writes"
        )
        assert result.stdout == ""


def test_the_running_graph_is_drawn(folder: Path, tmp_path: Path) -> None:
    arguments = ("explain", folder / "tracks.csv", "--graph", "--time", "0.55", "--output")
    done = saga_fg(*arguments, tmp_path / "g.svg", "--scene", "b")
    assert done.exit_code == 0, done.output
    drawn = (tmp_path / "g.svg").read_text()
    for words in ("b: the running graph at 0.50 s", "car 1", "car 2", "interaction factor", "detection factor"):
        assert f"<!-- {words}" in drawn
    assert saga_fg(*arguments, tmp_path / "g.png", "--scene", "a", "--track", "2").exit_code == 0
    assert (tmp_path / "g.png").read_bytes().startswith(b"\x89PNG")


def test_graphs_that_are_not_there(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments, expected in [
        (("--graph", "--output", "g.txt"), "ends in .png, .svg or .pdf"),
        (("--graph", "--output", "g.png"), "--scene: expected one of those with graphs, a, b"),
        (
            ("--graph", "--output", "g.png", "--scene", "a", "--time", "9"),
            "expected 0 to 7.90 s after",
        ),
        (("--graph", "--output", "g.png", "--scene", "a", "--track", "9"), "--track 9: expected a track that is there"),
        ((), "expected --track, or --graph"),
    ]:
        monkeypatch.chdir(tmp_path)
        done = saga_fg("explain", folder / "tracks.csv", *arguments)
        assert done.exit_code == 2
        assert expected in done.stderr
        assert not list(tmp_path.iterdir())


def test_a_graph_that_nobody_wrote(tmp_path: Path) -> None:
    for broken in ({"nodes": 3, "factors": []}, {"nodes": [], "factors": [{"kind": "initiation", "nodes": [4]}]}, {}):
        event = {"scene": "a", "event": "graph", "time": 1.0, "sensor": "lidar", **broken}
        (tmp_path / "t.csv.journal.jsonl").write_text(json.dumps(event) + "\n")
        done = saga_fg("explain", tmp_path / "t.csv", "--graph", "--output", tmp_path / "g.png")
        assert done.exit_code == 2
        assert "expected graphs as --explain writes them" in done.stderr


def test_what_keeps_no_journal(folder: Path, tmp_path: Path) -> None:
    for option, expected in [(("--method", "centerpoint"), "keeps no journal"), (("--workers", "1"), "goes without")]:
        arguments = (folder / "detections.csv", "-o", tmp_path / "out.csv", "--explain")
        result = saga_fg("track", "file", *arguments, *option)
        assert result.exit_code == 2
        assert expected in result.stderr
