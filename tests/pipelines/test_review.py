"""Reviews of labels: the server by HTTP, the file of corrections, and the records that make labels again."""

from __future__ import annotations

import http.client
import json
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import numpy as np
import pytest
import yaml

from data_tools.datasets.corrections import read_corrections
from data_tools.datasets.detection_files import read_tracks
from data_tools.datasets.labelling_tools import read_from_tool, write_for_tool
from data_tools.datasets.results import SceneResult
from data_tools.lidar import Scan, read_scan
from data_tools.metrics import SceneBoxes
from pipelines.review import CORRECTIONS, ReviewServer, ReviewSession, read_label_run
from pipelines.review.server import LARGEST
from saga_fg import InputError
from saga_fg.types.dataset import Scene
from tests.pipelines.command import COMMAND, done, refused

HEADER = "scene,timestamp,label,x,y,length,width,height,yaw,score"
SAME_BOX = ",4.5,1.8,1.5,0,0.9"
STEP = 0.25


def rows(scene: str) -> list[str]:
    """A car that drives, one that is parked, and one that passes out of sight for a second."""
    rng = np.random.default_rng(2)
    places = [
        (STEP * k, x, y)
        for k in range(24)
        for x, y in ((2.0 * k, 0.0), (20.0, 8.0), (40.0 - k, -8.0))
        if y >= 0 or not 10 <= k < 14
    ]
    return [
        f"{scene},{t},car,{x + rng.normal(0, 0.1):.3f},{y + rng.normal(0, 0.1):.3f}{SAME_BOX}" for t, x, y in places
    ]


def at(time: float, x: float, y: float) -> dict[str, Any]:
    return {"time": time, "x": x, "y": y}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table, its labels, and those of a parallel run."""
    folder = tmp_path_factory.mktemp("review")
    (folder / "two.csv").write_text("\n".join([HEADER, *rows("a"), *rows("b")]) + "\n")
    done("smooth", "file", folder / "two.csv", "-o", folder / "labels")
    return folder


@pytest.fixture
def labels(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made / "labels", tmp_path / "labels"))


def session_of(labels: Path, file: Path | None = None) -> ReviewSession:
    return ReviewSession(labels, read_label_run(labels), labels / CORRECTIONS if file is None else file, "anna")


class Client:
    """A window: it knows the version that it saw last."""

    def __init__(self, server: ReviewServer) -> None:
        self.server, self.version = server, ""

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self.server.server_port, timeout=60)
        raw = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        sent = {"Content-Type": "application/json", **{k.replace("_", "-"): v for k, v in headers.items()}}
        connection.request(method, path, raw, sent)
        answer = connection.getresponse()
        content = answer.read()
        is_json = answer.headers["Content-Type"] == "application/json"
        connection.close()
        return answer.status, json.loads(content) if is_json else content.decode()

    def own(self, method: str, name: str, body: Any = None) -> tuple[int, Any]:
        status, answer = self.ask(method, f"/{self.server.token}/{name}", body)
        self.version = answer.get("version", self.version) if isinstance(answer, dict) else self.version
        return status, answer

    def state(self, scene: str) -> Any:
        status, answer = self.own("GET", f"state?scene={scene}")
        assert status == 200, answer
        return answer

    def correct(self, **correction: Any) -> tuple[int, Any]:
        return self.own("POST", "correct", {"version": self.version, "correction": correction})

    def undo(self, scene: str) -> tuple[int, Any]:
        return self.own("POST", "undo", {"version": self.version, "scene": scene})


@pytest.fixture
def server(labels: Path) -> Iterator[ReviewServer]:
    with ReviewServer(session_of(labels)) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def boxes_of(answer: Any) -> set[tuple[int, str, int, int]]:
    """Moment, name, x and y of all boxes of an answer."""
    result = answer["scene"]["methods"]["labels"]
    return {(k, result["ids"][row[0]], row[2], row[3]) for k, moment in enumerate(result["moments"]) for row in moment}


def labels_at(answer: Any, moment: int) -> list[str]:
    return sorted(answer["scene"]["labels"][row[1]] for row in answer["scene"]["methods"]["labels"]["moments"][moment])


def test_a_session_of_twenty_actions_with_a_reload_and_two_windows(server, made, labels, tmp_path):
    one, other = Client(server), Client(server)
    assert len(one.state("a")["rows"]) == len(other.state("a")["rows"]) > 0
    parked, driving, passing = at(1.0, 20.0, 8.0), at(3.0, 24.0, 0.0), at(1.0, 36.0, -8.0)
    actions = [
        {"what": "exists", "at": parked, "value": True},
        {"what": "class", "at": parked, "label": "bus"},
        {"what": "box", "at": driving, "box": {"x": 24.6, "y": 0.2}},
        {"what": "box", "at": at(4.0, 32.0, 0.0), "box": {"x": 32.2, "y": 0.0, "yaw": 0.1}},
        {"what": "size", "at": driving, "box": {"length": 5.0, "width": 2.0, "height": 1.6}},
        {"what": "standing", "at": parked, "until": 4.0},
        {"what": "same", "at": at(2.0, 32.0, -8.0), "and": at(4.0, 24.0, -8.0), "value": True},
        {"what": "same", "at": at(1.0, 8.0, 0.0), "and": at(1.25, 10.0, 0.0), "value": False},
        {"what": "exists", "at": passing, "value": False},
    ]
    written = 0
    for scene in "ab":
        for number, action in enumerate(actions):
            status, answer = one.correct(**action, scene=scene, who="anna", when="today")
            assert status == 200, answer
            written += 1
            kept = read_corrections(labels / CORRECTIONS)  # as `smooth` reads them, before the answer is used
            assert len(kept) == written
            assert answer["corrections"][-1]["number"] == written
            if number == 4:
                status, stale = other.correct(**action, scene=scene)
                assert status == 409
                assert "another window" in stale["error"]
                assert len(read_corrections(labels / CORRECTIONS)) == written
                assert boxes_of(other.state(scene)) == boxes_of(one.state(scene))  # it looks again
    status, answer = other.undo("a")
    assert status == 409
    before = other.state("b")
    status, answer = other.undo("b")
    assert status == 200
    assert len(boxes_of(answer)) > len(boxes_of(before))  # what was deleted is back
    assert other.correct(**actions[-1], scene="b")[0] == 200
    again = Client(server)  # a window that is opened anew
    assert boxes_of(again.state("b")) == boxes_of(other.state("b")) == boxes_of(before)
    assert labels_at(again.state("b"), 4) == ["bus", "car"]

    run = done("smooth", "file", made / "two.csv", "--corrections", labels / CORRECTIONS, "-o", tmp_path / "new")
    assert "not applied" not in run.stderr
    table = read_tracks(tmp_path / "new" / "labels.csv", labels=True)
    for scene in "ab":
        mine = table.select(table.scene == scene)
        moment, place = np.rint(mine.timestamp / STEP).astype(int), 100 * mine.boxes.position[:, :2]
        found = dict(zip(zip(moment.tolist(), mine.id.tolist(), strict=True), place.tolist(), strict=True))
        shown = {row[:2]: row[2:] for row in boxes_of(again.state(scene))}
        assert shown.keys() == found.keys()
        offset = np.array([np.subtract(shown[key], found[key]) for key in shown])
        np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1.5)


@pytest.mark.parametrize(
    ("correction", "expected"),
    [
        ({"what": "class", "at": at(3.0, 500.0, 0.0), "label": "bus", "scene": "a"}, "no object within 2 m"),
        ({"what": "exists", "at": at(99.0, 20.0, 8.0), "value": False, "scene": "a"}, "outside the recording"),
        ({"what": "exists", "at": at(1.0, 20.0, 8.0), "value": "no", "scene": "a"}, "value: expected true or false"),
        ({"what": "paint", "scene": "a"}, "what: expected one of exists"),
        ({"what": "exists", "at": at(1.0, float("nan"), 8.0), "scene": "a"}, "x: expected a number"),
        ({"what": "exists", "at": at(1.0, 20.0, 8.0)}, "unknown scene ''"),
        ({"what": "exists", "at": at(1.0, 20.0, 8.0), "scene": "../a"}, "unknown scene '../a'"),
        ([1], "expected an object with what and at, got list"),
        (None, "expected an object with what and at, got NoneType"),
    ],
)
def test_actions_that_cannot_be_done_are_one_line_and_leave_the_file(server, labels, correction, expected):
    client = Client(server)
    before = client.state("a")
    status, answer = client.own("POST", "correct", {"version": client.version, "correction": correction})
    assert status == 422
    assert expected in answer["error"]
    assert "\n" not in answer["error"]
    assert not (labels / CORRECTIONS).exists()
    assert client.state("a") == before


def test_what_contradicts_counts_and_the_earlier_one_is_named(server):
    client = Client(server)
    client.state("a")
    place = at(1.0, 20.0, 8.0)
    client.correct(what="class", at=place, label="bus", scene="a")
    status, answer = client.correct(what="class", at=place, label="truck", scene="a")
    assert status == 200
    assert [bool(each["problem"]) for each in answer["corrections"]] == [True, False]
    assert "line 2, which comes later and counts" in answer["corrections"][0]["problem"]
    assert "truck" in labels_at(answer, 4)
    assert "bus" in labels_at(client.undo("a")[1], 4)
    assert client.undo("a")[0] == 200
    status, answer = client.undo("a")
    assert (status, answer["error"]) == (422, "undo: there is no correction of scene a to take back")


def test_bad_requests_are_one_line_of_json(server):
    client, port, token = Client(server), server.server_port, server.token
    good = {"version": "", "correction": {}}
    cases: list[tuple[int, str, str, Any, dict[str, str]]] = [
        (403, "GET", "/", None, {}),
        (403, "GET", f"/{token[:-1]}/", None, {}),
        (403, "POST", "/wrong/correct", good, {}),
        (403, "GET", f"/{token}/", None, {"Host": f"labels.example:{port}"}),
        (403, "POST", f"/{token}/undo", good, {"Origin": "http://labels.example"}),
        (404, "GET", f"/{token}/../../etc/passwd", None, {}),
        (404, "POST", f"/{token}/labels.csv", good, {}),
        (404, "GET", f"/{token}/correct", None, {}),
        (404, "POST", f"/{token}/", good, {}),
        (405, "PUT", f"/{token}/correct", good, {}),
        (405, "DELETE", f"/{token}/", None, {}),
        (422, "GET", f"/{token}/state", None, {}),
        (422, "GET", f"/{token}/state?scene=c", None, {}),
        (400, "POST", f"/{token}/correct", b'{"version": "', {}),
        (400, "POST", f"/{token}/correct", b"[" * 30000, {}),
        (400, "POST", f"/{token}/correct", b"\xff\xfe", {}),
        (400, "POST", f"/{token}/correct", [], {}),
        (400, "POST", f"/{token}/correct", {"version": 3}, {}),
        (400, "POST", f"/{token}/undo", {"version": ""}, {}),
        (409, "POST", f"/{token}/undo", {"version": "", "scene": "a"}, {}),
        (411, "POST", f"/{token}/correct", b"", {"Content-Length": "many"}),
        (413, "POST", f"/{token}/correct", b"", {"Content-Length": str(LARGEST + 1)}),
        (413, "POST", f"/{token}/correct", b"", {"Content-Length": "9" * 5000}),
        (413, "POST", f"/{token}/correct", b"", {"Content-Length": "0" * 12 + "9" * 12}),
        (415, "POST", f"/{token}/correct", good, {"Content_Type": "text/plain"}),
    ]
    for expected, method, path, body, headers in cases:
        status, answer = client.ask(method, path, body, **headers)
        assert (status, list(answer)) == (expected, ["error"]), (method, path, answer)
        assert "\n" not in answer["error"]
        assert answer["error"]


def test_what_is_no_http_is_answered_or_closed_and_the_others_are_served(server):
    for raw in (
        b"hello\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /" + b"a" * 70000 + b" HTTP/1.1\r\n\r\n",
        b"\0" * 100,
        f"GET http://[/ HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode(),
    ):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=20) as connection:
            connection.sendall(raw)
            connection.shutdown(socket.SHUT_WR)
            answer = b"".join(iter(lambda: connection.recv(4096), b""))
            assert b"Error" not in answer
    idle = [socket.create_connection(("127.0.0.1", server.server_port)) for _ in range(5)]  # that say nothing
    assert Client(server).state("a")["corrections"] == []
    for connection in idle:
        connection.close()


def test_the_page_is_served_behind_the_token_and_loads_nothing(server):
    status, page = Client(server).ask("GET", f"/{server.token}/")
    assert status == 200
    assert "connect-src 'self'" in page
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in page
    assert server.token not in page


def test_a_failure_while_writing_changes_nothing(server, labels, monkeypatch):
    client = Client(server)
    before = client.state("a")

    def fail(path: Path, content: str) -> None:
        raise InputError(f"{path}: not written: disk full")

    monkeypatch.setattr("data_tools.datasets.corrections.write_text", fail)
    status, answer = client.correct(what="exists", at=at(1.0, 20.0, 8.0), value=False, scene="a")
    assert (status, answer["error"]) == (422, f"{labels / CORRECTIONS}: not written: disk full")
    assert client.state("a") == before

    def crash(path: Path, content: str) -> None:
        raise RuntimeError("anything")

    monkeypatch.setattr("data_tools.datasets.corrections.write_text", crash)
    status, answer = client.correct(what="exists", at=at(1.0, 20.0, 8.0), value=False, scene="a")
    assert (status, answer["error"]) == (500, "RuntimeError: anything")
    assert client.state("a") == before


def test_a_file_that_is_read_only_stays_as_it_is(server, labels):
    client, file = Client(server), labels / CORRECTIONS
    gone = {"what": "exists", "at": at(1.0, 20.0, 8.0), "value": False, "scene": "a"}
    file.write_text(json.dumps(gone) + "\n")
    file.chmod(0o444)
    client.state("a")
    for status, answer in (client.correct(**gone), client.undo("a")):
        assert (status, answer["error"]) == (422, f"{file}: not writable: the file is read-only")
    assert file.read_text() == json.dumps(gone) + "\n"
    assert f"{file}: not writable" in refused("review", labels)


def test_a_file_that_is_changed_or_broken_by_hand_is_seen(server, labels):
    client = Client(server)
    client.state("a")
    file = labels / CORRECTIONS
    gone = {"what": "exists", "at": at(1.0, 20.0, 8.0), "value": False}
    file.write_text("\n" + json.dumps(gone) + "\n\n")  # of any scene
    status, answer = client.correct(what="exists", at=at(3.0, 24.0, 0.0), value=True, scene="a")
    assert status == 409
    assert [each["number"] for each in client.state("b")["corrections"]] == [2]
    assert client.correct(what="exists", at=at(3.0, 24.0, 0.0), value=True, scene="b")[0] == 200
    assert client.undo("b")[0] == client.undo("b")[0] == 200
    assert not file.read_text().strip()
    file.write_text(json.dumps(gone)[:-5])
    status, answer = client.own("GET", "state?scene=a")
    assert status == 422
    assert "line 1: broken or truncated JSON" in answer["error"]
    with pytest.raises(InputError, match="line 1: broken or truncated JSON"):
        session_of(labels)


def test_the_command_names_what_is_missing(made, labels, tmp_path):
    assert "expected a folder that saga-fg smooth wrote" in refused("review", tmp_path / "none")
    assert "expected a folder that saga-fg smooth wrote" in refused("review", made)
    assert "expected a file name that ends in .html" in refused("review", labels, "--page", "page.txt")
    record = json.loads((labels / "run.json").read_text())
    run = yaml.safe_load(record["configuration"])
    for change, expected in (
        ({"options": "detections: [gone.csv]"}, "labels: its recordings (file) are needed: "),
        ({"options": "paint: 1"}, "options: paint: unknown key"),
        ({"options": "detections: 5"}, "options: detections: expected a list"),
        ({"options": "detections: ["}, "options: expected YAML"),
        ({"dataset": "none"}, "unknown dataset 'none'"),
        ({"directory": str(tmp_path / "gone")}, "there is no"),
        ({"method": "magic"}, "run.json: expected the record of labels: configuration: method: expected one of"),
    ):
        changed = {**record, "configuration": yaml.safe_dump({**run, **change})}
        (labels / "run.json").write_text(json.dumps(changed))
        assert expected in refused("review", labels)
    done("track", "file", made / "two.csv", "-o", tmp_path / "tracks.csv")
    shutil.copy(tmp_path / "tracks.run.json", labels / "run.json")
    assert "run.json: expected the record of labels: configuration: tracker: unknown key" in refused("review", labels)
    (labels / "run.json").write_text(json.dumps(record))
    table = (labels / "labels.csv").read_text()
    (labels / "labels.csv").write_text(table.replace("\nb,", "\nc,"))
    assert "labels.csv: unknown scene 'c', expected one of: a, b; these are another run's" in refused("review", labels)
    (labels / "labels.csv").unlink()
    assert "expected the table labels.csv" in refused("review", labels)


def test_a_page_to_be_opened_without_a_server(labels, tmp_path):
    done("review", labels, "--page", tmp_path / "review.html")
    page = (tmp_path / "review.html").read_text()
    assert "connect-src" not in page
    assert "makeReview" in page


def test_labels_in_parallel_of_trackers_and_with_corrections_are_known_again(made, tmp_path):
    table, mine = made / "two.csv", tmp_path / "mine.jsonl"
    done("track", "file", table, "-o", tmp_path / "theirs.csv")
    gone = {"what": "exists", "at": at(1.0, 20.0, 8.0), "value": False, "scene": "a"}
    mine.write_text(json.dumps(gone) + "\n")
    arguments = ["smooth", "file", table, "--tracks", tmp_path / "theirs.csv", "--corrections", mine]
    done(*arguments, "-o", tmp_path / "whole")
    done("smooth", "file", table, "--workers", "1", "-o", tmp_path / "parts")
    run = read_label_run(tmp_path / "whole")
    assert run.corrections == str(mine)
    session = session_of(tmp_path / "whole", mine)
    answer = session.state("a")
    assert len(answer["corrections"]) == 1
    shown = read_tracks(tmp_path / "whole" / "labels.csv", labels=True)
    assert len(boxes_of(answer)) == (shown.scene == "a").sum()
    parts = session_of(tmp_path / "parts")
    assert len(boxes_of(parts.state("b"))) == (shown.scene == "b").sum()


@pytest.mark.parametrize("name", ["simulated", "nuscenes"])
def test_the_record_makes_the_same_source_and_settings(name, tmp_path):
    if name == "nuscenes":
        done("simulate", "--output", tmp_path / "rec", "--scenes", "1", "--seed", "3")
        detections = f"lidar={tmp_path / 'rec/detections/lidar.json'}"
        source = ["--dataroot", tmp_path / "rec", "--split", "all", "--detections", detections]
    else:
        (tmp_path / "s.yaml").write_text("duration: 4.0\n")
        source = ["--scenes", "1", "--simulator", tmp_path / "s.yaml"]
    done("smooth", name, *source, "-o", tmp_path / "labels")
    session = session_of(tmp_path / "labels")
    (scene,) = session._shown
    shown = read_tracks(tmp_path / "labels" / "labels.csv", labels=True)
    assert len(boxes_of(session.state(scene))) == len(shown)
    if name == "nuscenes":  # whose labels have certain classes
        place = at(float(shown.timestamp[0]), *shown.boxes.position[0, :2].tolist())
        record = {"what": "class", "at": place, "label": "trcuk", "scene": scene}
        with pytest.raises(InputError, match=r"label: unknown class 'trcuk'; did you mean 'truck'\?"):
            session.correct(session.state(scene)["version"], record)
        mine = tmp_path / "mine.jsonl"
        mine.write_text(json.dumps(record) + "\n")
        told = refused("smooth", name, *source, "--corrections", mine, "-o", tmp_path / "new")
        assert "mine.jsonl: line 1: label: unknown class 'trcuk'" in told


class OneScan:
    """A scan 1.02 s after the start, of a sensor that is turned by 90 degrees and 2 m before the vehicle."""

    timestamps = np.array([1.02])
    world_T_ego = None
    ego_T_lidar = np.array([[0.0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 1.8], [0, 0, 0, 1]])

    def __len__(self) -> int:
        return 1

    def __getitem__(self, row: int) -> Any:
        return SimpleNamespace(points=np.array([[0.0, -18.0, 0.0], [8.0, -18.01, 0.5], [0.0, 40.0, 0.0]]))


def test_points_of_the_lidar_beside_a_box(server):
    client = Client(server)
    assert client.own("GET", "points?scene=a&moment=4&x=20&y=8") == (200, [])
    vars(server.session)["_scans"] = {"a": OneScan()}
    scene = server.session._shown["a"].scene
    x, y = scene.world_T_ego[4, :2, 3]
    status, points = client.own("GET", f"points?scene=a&moment=4&x={x + 20}&y={y + 8}")
    assert status == 200
    start = scene.world_T_ego[0, :2, 3]
    expected = 100 * (np.array([[x + 20, y], [x + 20, y + 8]]) - start)
    np.testing.assert_allclose(sorted(points), expected, atol=3)  # thinned to 5 cm
    assert client.own("GET", "points?scene=a&moment=5&x=20&y=8") == (200, [])  # none at that time
    assert client.own("GET", "points?scene=a&moment=nan&x=20&y=8")[0] == 400
    assert client.own("GET", "points?scene=a&moment=-1&x=20&y=8")[0] == 422
    assert client.own("GET", "points?scene=a&moment=4&x=nan&y=8")[0] == 400
    assert client.own("GET", "points?scene=a&moment=4&x=20&y=1e300")[0] == 400


def test_the_command_serves_until_it_is_interrupted(labels):
    options = [*COMMAND, "review", str(labels), "--who", "anna"]
    command = subprocess.Popen(options, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    url = urlsplit(command.stdout.readline().strip())
    assert url.hostname == "127.0.0.1"
    with urlopen(url.geturl(), timeout=60) as page:
        assert b"makeReview" in page.read()
    with urlopen(f"{url.geturl()}state?scene=a", timeout=60) as answer:
        version = json.load(answer)["version"]
    action = {"what": "exists", "at": at(1.0, 20.0, 8.0), "value": False, "scene": "a"}
    body = json.dumps({"version": version, "correction": action}).encode()
    with urlopen(Request(f"{url.geturl()}correct", body, {"Content-Type": "application/json"}), timeout=60) as answer:
        assert answer.status == 200
    command.send_signal(signal.SIGINT)
    try:
        _, told = command.communicate(timeout=60)
    finally:
        command.kill()
    assert command.returncode == 0, told
    assert f"--corrections {labels / CORRECTIONS}" in told
    assert len(read_corrections(labels / CORRECTIONS)) == 1


def edit_in_tool(folder: Path, tool: str, scene: Scene, change: Callable[[SceneBoxes], SceneBoxes]) -> None:
    """What somebody does with a scene in a labelling tool."""
    path = folder / (f"{scene.name}.json" if tool == "openlabel" else scene.name)
    found, _ = read_from_tool(path, tool, scene, ["car", "bus"])
    write_for_tool(path, tool, SceneResult(scene, change(found)))


def parked_passing(found: SceneBoxes) -> SceneBoxes:
    """Without what is parked; the car that passes by is a bus, and at one moment 0.8 m to the right."""
    found = found.select(found.boxes.position[:, 1] < 4)
    passing = found.boxes.position[:, 1] < -4
    position = found.boxes.position - 0.8 * (passing & (found.frame == 3))[:, None] * np.array([0, 1, 0])
    return replace(found, boxes=replace(found.boxes, position=position, label=np.where(passing, "bus", "car")))


@pytest.mark.parametrize("tool", ["openlabel", "cvat", "sustechpoints"])
def test_labels_go_out_to_a_tool_and_edits_come_back(made, labels, tmp_path, tool):
    out, mine = tmp_path / "out", labels / CORRECTIONS
    assert f"{out}: 144 boxes, 0 point clouds" in done("review", labels, "--export", tool, out).output
    assert "0 new corrections: nothing was changed" in done("review", labels, "--import", tool, out).output
    assert not mine.exists()
    with read_label_run(labels).open() as (_, dataset):
        edit_in_tool(out, tool, dataset.scene("a"), parked_passing)
    told = done("review", labels, "--import", tool, out, "--who", "anna").output
    assert f"{mine}: 3 new corrections: 1 exists, 1 class, 1 box" in told
    assert {(one.who, one.scene) for one in read_corrections(mine)} == {("anna", "a")}
    assert "0 new corrections" in done("review", labels, "--import", tool, out).output  # they are there
    done("smooth", "file", made / "two.csv", "--corrections", mine, "-o", tmp_path / "mended")
    rows = read_tracks(tmp_path / "mended" / "labels.csv", labels=True)
    rows = rows.select(np.flatnonzero(rows.scene == "a"))
    y = rows.boxes.position[:, 1]
    assert not ((y > 4) & (y < 12)).any()
    assert set(rows.boxes.label[y < -4].tolist()) == {"bus"}
    (moved,) = np.flatnonzero((y < -4) & (rows.timestamp == 3 * STEP))
    assert y[moved] < -8.2
    assert rows.source[moved] == "corrected"


def test_a_box_that_a_tool_moved_out_of_sight_is_named_and_the_others_count(made, labels, tmp_path):
    def moved(found: SceneBoxes) -> SceneBoxes:
        passing = (found.boxes.position[:, 1] < -4) & np.isin(found.frame, [3, 9])
        by = np.where(found.frame == 3, 500.0, 0.8) * passing
        return replace(found, boxes=replace(found.boxes, position=found.boxes.position - by[:, None] * [0, 1, 0]))

    done("review", labels, "--export", "openlabel", tmp_path / "out")
    with read_label_run(labels).open() as (_, dataset):
        edit_in_tool(tmp_path / "out", "openlabel", dataset.scene("a"), moved)
    told = done("review", labels, "--import", "openlabel", tmp_path / "out")
    assert "1 new correction: 1 box" in told.output
    (line,) = [line for line in told.stderr.splitlines() if "m from its object" in line]
    assert f"{tmp_path / 'out' / 'a.json'}: box, car at " in line
    assert "the box is 500.0 m from its object, expected at most 20 m: left out" in line


def test_boxes_of_unknown_size_do_not_go_out_and_are_counted(tmp_path):
    rows = "".join(f"{k},car,{5 * k},0\n" for k in range(20))
    (tmp_path / "seen.csv").write_text("timestamp,label,x,y\n" + rows)
    done("smooth", "file", tmp_path / "seen.csv", "-o", tmp_path / "labels")
    told = done("review", tmp_path / "labels", "--export", "openlabel", tmp_path / "out")
    assert "0 boxes, 0 point clouds; 20 boxes without a size left out" in told.output


def test_what_is_wrong_with_a_tool_or_its_files_is_one_line(labels, tmp_path):
    out = tmp_path / "out"
    assert "unknown labelling tool 'cavt'; did you mean 'cvat'?" in refused("review", labels, "--export", "cavt", out)
    assert not out.exists()
    assert f"{out}: expected a.json, as written by" in refused("review", labels, "--import", "openlabel", out)
    done("review", labels, "--export", "sustechpoints", tmp_path / "other")
    of_another = "expected a, as written by --export cvat; this is of sustechpoints"
    assert of_another in refused("review", labels, "--import", "cvat", tmp_path / "other")
    assert "expected one of" in refused("review", labels, "--export", "cvat", out, "--import", "cvat", out)
    done("review", labels, "--export", "openlabel", out)
    (out / "b.json").unlink()
    assert f"{out / 'b.json'}: there is no such" in done("review", labels, "--import", "openlabel", out).stderr
    assert f"{out}: expected a new or an empty folder" in refused("review", labels, "--export", "openlabel", out)
    whole = (out / "a.json").read_text()
    (out / "a.json").write_text(whole[:-9])
    assert "a.json: broken or truncated JSON" in refused("review", labels, "--import", "openlabel", out)
    assert not (labels / CORRECTIONS).exists()
    (out / "a.json").write_text(whole.replace('"type": "car"', '"type": "kart"'))
    told = done("review", labels, "--import", "openlabel", out)
    assert "class kart: taken over, no label has had it before" in told.stderr
    assert "not taken over: " + str(out / "a.json") not in told.stderr
    assert "3 class" in told.output
    (out / "a.json").unlink()
    (labels / CORRECTIONS).unlink()
    for file in (tmp_path / "other" / "a" / "label").glob("*4.json"):
        file.write_text(file.read_text().replace('"obj_type": "car"', '"obj_type": "kart"'))
    told = done("review", labels, "--import", "sustechpoints", tmp_path / "other")
    assert "boxes of another class: an object has one, here car" in told.stderr


def test_scans_go_out_in_the_coordinates_of_the_boxes(labels, tmp_path, monkeypatch):
    surroundings = SimpleNamespace(scans=lambda: {"a": OneScan()})
    monkeypatch.setattr("data_tools.datasets.source.DatasetSource.surroundings", lambda *_: surroundings)
    monkeypatch.setattr(OneScan, "__getitem__", lambda *_: Scan.of(np.array([[0.0, -18.0, 0.0]])))
    assert "1 point cloud" in done("review", labels, "--export", "sustechpoints", tmp_path / "out").output
    (cloud,) = (tmp_path / "out").rglob("*.pcd")
    assert cloud.relative_to(tmp_path / "out").as_posix() == "a/lidar/000004.pcd"
    np.testing.assert_allclose(read_scan(cloud).points, [[20.0, 0.0, 1.8]], atol=1e-5)
