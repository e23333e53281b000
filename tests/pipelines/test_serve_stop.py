"""SIGTERM ends the service, with what came in done, whatever the tracker is doing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipelines.serving import StreamClient
from tests.pipelines.running_service import COMMAND, frame, serving, status, wait_for

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
def test_a_step_without_end_does_not_keep_the_service_alive(waiting: str, number: signal.Signals):
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
def test_a_pipe_ends_with_what_came_in(tmp_path: Path, number: signal.Signals, code: int):
    state = tmp_path / "state"
    command = [*COMMAND, "serve", "--reorder", "0.5", "--snapshot", str(state)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        server.stdin.write(b"".join(map(frame, range(4))) + frame(4)[:10])
        server.stdin.flush()
        assert [json.loads(server.stdout.readline())["type"] for _ in range(4)] == ["held"] * 4
        assert server.stderr is not None
        server.send_signal(number)
        out, errors = server.stdout.read(), server.stderr.read()
    assert server.returncode == code
    assert [json.loads(line)["seq"] for line in out.splitlines()] == [0, 1, 2, 3]
    assert b"Traceback" not in errors
    assert sorted(file.name for file in tmp_path.iterdir()) == [".state.lock", "state"]


def test_a_pipe_whose_reader_sleeps_ends_too_and_keeps_its_state(tmp_path: Path):
    read, write = os.pipe()
    command = [*COMMAND, "serve", "--snapshot", str(tmp_path / "state"), "--every", "3600"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=write, stderr=subprocess.PIPE) as server:
        assert server.stdin is not None
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
    command = [*COMMAND, "serve", "--snapshot", str(tmp_path / "state")]
    done = subprocess.run(command, input=frame(1), capture_output=True, check=True)
    answer = json.loads(done.stdout)
    assert (answer["type"], answer["last_seq"]) == ("repeat", 1)


@pytest.mark.parametrize("saving", ["time.sleep(3600)", "raise RuntimeError"])
def test_what_cannot_be_kept_does_not_hold_up_the_end(tmp_path: Path, saving: str):
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
