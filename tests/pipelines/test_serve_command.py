"""`saga-fg serve` as a process of its own, and how it stops."""

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from typing import Any

import pytest

from pipelines.config import load_config
from pipelines.serving import StreamClient, parse_address
from saga_fg import Detection, Detections, Frame, InputError
from tests.pipelines.command import COMMAND, done, refused
from tests.pipelines.forked import run
from tests.pipelines.running_service import frame, serving, status, wait_for


def test_clients_share_one_tracker_and_one_may_listen():
    with serving("--listen", "127.0.0.1:0") as (address, _):
        with StreamClient(address) as listener, StreamClient(address) as sender:
            assert listener.ask({"type": "subscribe"}) == {"type": "subscribe"}
            for seq in range(5):
                sender.send(frame(seq))
                answer = sender.receive()
                assert answer == listener.receive()
                assert answer["seq"] == seq
            sender.send(b"nonsense\n")
            assert sender.receive()["type"] == "error"
        with StreamClient(address) as again:
            again.send(frame(5))
            assert [track["id"] for track in again.receive()["tracks"]] == [1]
            status = again.ask({"type": "status"})
            assert (status["frames"], status["refused"], status["last_seq"]) == (6, 1, {"sensor": 5})


def test_a_client_that_hangs_up_with_answers_unread_hurts_nobody():
    with serving("--listen", "127.0.0.1:0") as (address, _):
        rude = StreamClient(address)
        for seq in range(50):
            rude.send(frame(seq))
        rude.close()
        with StreamClient(address) as client:
            last = client.ask({"type": "status"})["last_seq"].get("sensor", -1)
            for seq in range(last + 1, 60):
                client.send(frame(seq))
                assert client.receive()["type"] in ("tracks", "repeat")
            assert client.ask({"type": "status"})["frames"] == 60


def test_a_line_without_end_is_refused_and_the_next_one_read():
    with serving("--listen", "127.0.0.1:0") as (address, _), StreamClient(address) as client:
        client.send(b"[" * (9 * 2**20) + b"\n")
        assert "at most" in client.receive()["message"]
        client.send(frame(0))
        assert client.receive()["type"] == "tracks"


def test_a_unix_socket_is_for_its_owner_and_gone_afterwards(tmp_path):
    path = tmp_path / "saga.sock"
    with serving("--listen", str(path)) as (address, server):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with StreamClient(address) as client:
            client.send(frame(0))
            assert client.receive()["type"] == "tracks"
        assert json.loads(done("status", path, "--json").stdout)["frames"] == 1
        assert "another server listens there" in refused("serve", "--listen", path)
        server.send_signal(signal.SIGTERM)
        _, errors = server.communicate(timeout=60)
        assert server.returncode == 143
        assert "1 frames tracked" in errors
    assert not path.exists()


def test_a_socket_left_behind_is_taken_over_and_a_file_is_not(tmp_path):
    stale = tmp_path / "stale.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(stale))
    with serving("--listen", str(stale)) as (address, _), StreamClient(address) as client:
        assert client.ask({"type": "status"})["frames"] == 0
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    refused("serve", "--listen", file)
    assert file.read_text() == "mine"


def test_other_machines_are_refused_and_nobody_there_is_one_line():
    assert "--allow-remote" in refused("serve", "--listen", "0.0.0.0:0")
    with pytest.raises(InputError, match="nobody answers there"):
        StreamClient(parse_address("127.0.0.1:9"))
    assert refused("status", "/nowhere/x.sock").startswith("error: /nowhere/x.sock: nobody answers there")


OTHER_SERVICES = [
    (b"HTTP/1.1 400 Bad Request\r\n", "expected an answer in JSON, got b'HTTP/1.1 400"),
    (b"[1]\n", "expected an object as answer"),
    (b'{"type": "tracks"}\n', "expected the status of `saga-fg serve`, got {'type': 'tracks'}"),
    (b"", "expected the status of `saga-fg serve`: the service has closed the connection"),
]


def test_the_status_of_another_service_is_one_line():
    def answer(listening, said):
        connection, _ = listening.accept()
        with connection:
            connection.recv(1000)
            connection.sendall(said)

    for said, message in OTHER_SERVICES:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            other = threading.Thread(target=answer, args=(listening, said))
            other.start()
            where = f"127.0.0.1:{listening.getsockname()[1]}"
            error = refused("status", where)
            other.join()
        assert error.startswith(f"error: {where}: {message}")
        assert len(error.splitlines()) == 1


def test_a_reader_that_goes_away_ends_the_pipe_in_one_line():
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([*COMMAND, "serve"], input=frame(0), stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert done.returncode == 0
    assert b"the reader of the tracks has gone away" in done.stderr
    assert b"Traceback" not in done.stderr


def test_kernels_are_there_before_the_service_listens():
    patched = (
        "import sys\n"
        "import saga_fg.kernels.compilation as c\n"
        "c.load_kernels = lambda: print('kernels loaded', file=sys.stderr, flush=True)\n"
        "from pipelines.cli.main import main; main()\n"
    )
    command = [sys.executable, "-c", patched, "serve", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stderr.readline().strip() == "kernels loaded"
            assert server.stderr.readline().startswith("listening at ")
        finally:
            server.kill()


# SIGTERM ends the service, with what came in done, whatever the tracker is doing

STUCK = """
import sys, time
from pipelines.serving import SocketServer, StopRequest, StreamSettings, StreamTracker, parse_address
from saga_fg import Tracks

class Stuck:
    max_jump = 10.0

    def step(self, frame):
        while True:
            {waiting}

    def tracks(self, timestamp):
        return Tracks.empty(timestamp)

stream = StreamTracker(Stuck, StreamSettings(stop_timeout=0.5))
with StopRequest(0.5) as stop:
    ready = lambda address: print(f"listening at {{address}}", file=sys.stderr, flush=True)
    SocketServer(stream, parse_address("127.0.0.1:0"), ready).run(stop)
"""


@pytest.mark.parametrize(("waiting", "number"), [("time.sleep(1)", signal.SIGTERM), ("pass", signal.SIGINT)])
def test_a_step_without_end_does_not_keep_the_service_alive(waiting, number):
    command = [sys.executable, "-c", STUCK.format(waiting=waiting)]
    with serving(command=command) as (address, server), StreamClient(address) as client:
        client.send(frame(0))
        with StreamClient(address):  # others may still connect
            time.sleep(0.2)
        server.send_signal(number)
        _, errors = server.communicate(timeout=60)
        assert server.returncode == 128 + number
        assert "Traceback" not in errors


def test_what_came_in_is_answered_before_the_end():
    with serving("--listen", "127.0.0.1:0", "--reorder", "0.5") as (address, server), StreamClient(address) as client:
        for seq in range(4):
            client.send(frame(seq))
            assert client.receive()["type"] == "held"
        server.send_signal(signal.SIGTERM)
        assert [client.receive()["seq"] for _ in range(4)] == [0, 1, 2, 3]
        _, errors = server.communicate(timeout=60)
    assert server.returncode == 143
    assert "4 frames tracked" in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 0)])
def test_a_pipe_ends_with_what_came_in(tmp_path, number, code):
    state = tmp_path / "state"
    command = [*COMMAND, "serve", "--reorder", "0.5", "--snapshot", str(state)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe) as server:
        server.stdin.write(b"".join(map(frame, range(4))) + frame(4)[:10])
        server.stdin.flush()
        assert [json.loads(server.stdout.readline())["type"] for _ in range(4)] == ["held"] * 4
        server.send_signal(number)
        out, errors = server.stdout.read(), server.stderr.read()
    assert server.returncode == code
    assert [json.loads(line)["seq"] for line in out.splitlines()] == [0, 1, 2, 3]
    assert b"Traceback" not in errors
    assert sorted(file.name for file in tmp_path.iterdir()) == [".state.lock", "state"]


def test_a_pipe_whose_reader_sleeps_ends_too_and_keeps_its_state(tmp_path):
    read, write = os.pipe()
    command = [*COMMAND, "serve", "--snapshot", str(tmp_path / "state"), "--every", "3600"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=write, stderr=subprocess.PIPE) as server:
        asks = b'{"type": "status"}\n'
        server.stdin.write(frame(0) + frame(1))
        server.stdin.flush()
        assert os.read(read, 10)  # it runs
        os.set_blocking(server.stdin.fileno(), False)
        refusals = 0
        while refusals < 20:  # until neither side takes any more
            try:
                os.write(server.stdin.fileno(), asks)
                refusals = 0
            except BlockingIOError:
                refusals += 1
                time.sleep(0.02)
        server.send_signal(signal.SIGTERM)
        _, errors = server.communicate(timeout=60)
    os.close(read)
    os.close(write)
    assert server.returncode == 143
    assert b"Traceback" not in errors
    answer = json.loads(run("serve", "--snapshot", tmp_path / "state", given=frame(1))[0])
    assert (answer["type"], answer["last_seq"]) == ("repeat", 1)


@pytest.mark.parametrize("saving", ["time.sleep(3600)", "raise RuntimeError"])
def test_what_cannot_be_kept_does_not_hold_up_the_end(tmp_path, saving):
    """A step without end holds the stream, so that its state cannot be collected."""
    script = (
        "import os, signal, sys, time\n"
        "from pathlib import Path\n"
        "from pipelines.serving import StopRequest\n"
        "def save():\n"
        f"    Path({str(tmp_path / 'saved')!r}).touch()\n"
        f"    {saving}\n"
        "def clear():\n"
        f"    Path({str(tmp_path / 'cleared')!r}).touch()\n"
        "with StopRequest(0.1, save, clear):\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    time.sleep(3600)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], check=False, timeout=60)
    assert done.returncode == 143
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cleared", "saved"]


def test_a_client_that_reads_nothing_does_not_hold_up_the_end():
    with serving("--listen", "127.0.0.1:0") as (address, server), StreamClient(address) as rude:
        for _ in range(2000):
            rude.send({"type": "status"})
        wait_for(lambda: status(address)["messages"] > 100)
        server.send_signal(signal.SIGTERM)
        server.communicate(timeout=60)
        assert server.returncode == 143


def test_settings_for_dense_traffic_are_those_of_track_and_a_file_lies_over_them(tmp_path):
    """The tracks of a stream are those of the same settings in a program."""
    frames: list[Any] = [
        {
            "timestamp": k / 10,
            "detections": [{"label": "car", "x": k - 12 * n, "y": 4 * (n % 2), "yaw": 0.0} for n in range(6)],
        }
        for k in range(15)
    ]
    stream = "\n".join(map(json.dumps, frames)).encode()
    config = tmp_path / "c.yaml"
    config.write_text("tracker: {min_hits: 4}\n")
    cases: Any = [
        (("--settings", "dense"), "dense", None, ""),
        (("--settings", "plain"), "file", None, ""),
        (
            ("--settings", "dense", "--config", config),
            "dense",
            config,
            f"{config}: over --settings dense",
        ),
    ]
    for options, family, own, said in cases:
        out, errors = run("serve", *options, given=stream)
        assert errors.count(said or "over the settings") == (said != "")
        tracker = load_config(family, own).new_tracker("saga")
        for given, line in zip(frames, out.splitlines(), strict=True):
            cars = [Detection(c["label"], (c["x"], c["y"], 0.0), yaw=c["yaw"]) for c in given["detections"]]
            tracks = tracker.step(Frame(given["timestamp"], "sensor", Detections.of(cars)))
            answer = json.loads(line)["tracks"]
            assert [track["id"] for track in answer] == tracks.id.tolist()
            assert [track["vx"] for track in answer] == pytest.approx(tracks.boxes.velocity[:, 0], abs=1e-3)


def test_a_file_of_settings_decides_about_dense_traffic(tmp_path):
    cars: Any = [
        [{"label": "car", "x": k - 12 * n, "y": 4 * (n % 2), "yaw": 0.0} for n in range(6)] for k in range(115)
    ]
    frames = [{"timestamp": k / 10, "detections": each} for k, each in enumerate(cars)]
    stream, config = "\n".join(map(json.dumps, frames)).encode(), tmp_path / "c.yaml"
    config.write_text("tracker: {min_hits: 2}\n")
    for options, told in (((), True), (("--config", str(config)), False), (("--method", "centerpoint"), False)):
        _, errors = run("serve", *options, given=stream)
        assert ("dense traffic: 6 vehicles at a time with headings, 10 Hz" in errors) == told
