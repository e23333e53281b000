"""A service that is killed and started again: nothing is lost, nothing counted twice."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipelines.serving import Address, StreamClient
from tests.pipelines.running_service import COMMAND, frame, serving, status, wait_for

FRAMES = 40


def sent(address: Address, seqs: Iterator[int] | range) -> list[dict[str, Any]]:
    """The last answer to each of these frames."""
    with StreamClient(address) as client:
        answers = []
        for seq in seqs:
            client.send(frame(seq))
            answers.append(client.receive())
        return answers


def test_after_a_kill_a_client_goes_on_where_the_state_ends(tmp_path: Path):
    with serving("--listen", "127.0.0.1:0") as (address, _):
        whole = sent(address, range(FRAMES))
    keeping = ("--listen", str(tmp_path / "s.sock"), "--snapshot", str(tmp_path / "state"), "--every", "0.05")
    with serving(*keeping) as (address, server):
        sent(address, range(15))
        wait_for(lambda: status(address)["durable_seq"] == {"sensor": 14})
        assert stat.S_IMODE((tmp_path / "state").stat().st_mode) == 0o600
        sent(address, range(15, 20))
        server.send_signal(signal.SIGKILL)
        server.wait()
    with serving(*keeping) as (address, server):
        durable = status(address)["durable_seq"]["sensor"]
        assert 14 <= durable <= 19
        assert status(address)["last_seq"]["sensor"] == durable
        rest = sent(address, range(10, FRAMES))  # more than needed: what is there already has no effect
        fresh = [answer for answer in rest if answer["type"] == "tracks"]
        assert [answer["seq"] for answer in fresh] == list(range(durable + 1, FRAMES))
        assert [answer["tracks"] for answer in fresh] == [answer["tracks"] for answer in whole[durable + 1 :]]
        told = status(address)
        assert (told["frames"], told["taken"]) == (FRAMES, {"sensor": FRAMES})
        server.send_signal(signal.SIGTERM)
        server.communicate()
        assert server.returncode == 143
    with serving(*keeping) as (address, _):  # the last state is written on the way out
        assert status(address)["durable_seq"] == {"sensor": FRAMES - 1}
    assert [p.name for p in tmp_path.iterdir() if "tmp" in p.name] == []


def test_frames_that_were_held_are_sent_again(tmp_path: Path):
    keeping = ("--listen", str(tmp_path / "s.sock"), "--snapshot", str(tmp_path / "state"), "--every", "0.05")
    reordering = (*keeping, "--reorder", "0.35")
    with serving(*reordering) as (address, server):
        sent(address, range(10))
        wait_for(lambda: status(address)["durable_seq"] == {"sensor": 5})
        assert status(address)["held"] == 4
        server.kill()
        server.wait()
    with serving(*reordering) as (address, server):
        sent(address, range(6, 12))
        assert status(address)["taken"] == {"sensor": 8}
        server.send_signal(signal.SIGTERM)
        server.communicate()
    with serving(*reordering) as (address, _):
        assert status(address)["taken"] == {"sensor": 12}


def test_the_state_of_another_configuration_is_refused(tmp_path: Path):
    state = tmp_path / "state"
    command = [*COMMAND, "serve", "--snapshot", str(state)]
    subprocess.run(command, input=frame(0), capture_output=True, check=True)
    before = state.read_bytes()
    other = [*command, "--estimator", "isam2"]
    done = subprocess.run(other, input="", capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "'estimator: kalman' instead of 'estimator: isam2'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert state.read_bytes() == before


def test_a_damaged_state_file_is_one_line_and_stays(tmp_path: Path, subtests: pytest.Subtests):
    state = tmp_path / "state"
    command = [*COMMAND, "serve", "--snapshot", str(state)]
    subprocess.run(command, input=frame(0), capture_output=True, check=True)
    whole = state.read_bytes()
    for damaged, message in [
        (whole[: len(whole) // 2], "the state file is damaged: its checksum differs; remove it to begin anew"),
        (whole[:-9] + b"x" + whole[-8:], "the state file is damaged: its checksum differs; remove it to begin anew"),
        (whole.replace(b"state 1", b"state 9", 1), "expected the format 'saga-fg state 1', got b'saga-fg state 9'"),
        (b"", "expected a state file of `saga-fg serve`, this is none"),
    ]:
        with subtests.test(message):
            state.write_bytes(damaged)
            done = subprocess.run(command, input=frame(1), capture_output=True, check=False)
            assert (done.returncode, done.stdout) == (2, b"")
            assert done.stderr.decode() == f"error: {state}: {message}\n"
            assert state.read_bytes() == damaged


def test_factors_of_ones_own_cannot_be_kept(tmp_path: Path):
    config = tmp_path / "own.yaml"
    config.write_text("tracker: {estimator: isam2, providers: ['walls:Wall']}\n")
    (tmp_path / "walls.py").write_text("class Wall:\n    name = 'wall'\n    def factors(self, view): ...\n")
    command = [*COMMAND, "serve", "--snapshot", str(tmp_path / "state"), "--config", str(config)]
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run(command, input="", capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 2
    assert "tracker.providers" in done.stderr


def test_a_state_file_is_of_one_service(tmp_path: Path):
    (tmp_path / "link").symlink_to(tmp_path / "state")
    with serving("--listen", str(tmp_path / "s.sock"), "--snapshot", str(tmp_path / "state")) as (address, server):
        for name in ("state", "link"):
            command = [*COMMAND, "serve", "--snapshot", str(tmp_path / name)]
            done = subprocess.run(command, input=frame(0), capture_output=True, check=False)
            assert done.returncode == 2
            assert done.stderr.decode() == f"error: {tmp_path / name}: another service keeps its state in this file\n"
            assert done.stdout == b""
        assert sent(address, range(1))[0]["type"] == "tracks"
        server.kill()
        server.wait()
    done = subprocess.run(command, input=frame(0), capture_output=True, check=False)  # a killed one holds nothing
    assert done.returncode == 0
