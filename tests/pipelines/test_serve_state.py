"""The state of a service on disk."""

import errno
import hashlib
import json
import os
import signal
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.config import load_config
from pipelines.serving import Address, StateKeeper, StreamClient, StreamTracker
from pipelines.serving.messages import encode
from pipelines.serving.state import read_state, write_state
from saga_fg import InputError
from tests.pipelines.command import refused
from tests.pipelines.forked import run
from tests.pipelines.running_service import frame, serving, status, wait_for

FRAMES = 40


def sent(address: Address, seqs: Iterator[int] | range) -> list[dict[str, Any]]:
    """The last answer to each of these frames."""
    with StreamClient(address) as client:
        answers = []
        for seq in seqs:
            client.send(frame(seq))
            answers.append(client.receive())
        return answers


def test_after_a_kill_a_client_goes_on_where_the_state_ends(tmp_path):
    service = stream()
    whole = [answer for seq in range(FRAMES) for _, answer in service.handle(frame(seq), "me")]
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
        server.wait()
        assert server.returncode == 143
    with serving(*keeping) as (address, _):  # the last state is written on the way out
        assert status(address)["durable_seq"] == {"sensor": FRAMES - 1}
    assert [p.name for p in tmp_path.iterdir() if "tmp" in p.name] == []


def test_frames_that_were_held_are_sent_again(tmp_path):
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
        server.wait()
    with serving(*reordering) as (address, _):
        assert status(address)["taken"] == {"sensor": 12}


def test_factors_of_ones_own_cannot_be_kept(tmp_path, monkeypatch):
    config = tmp_path / "own.yaml"
    config.write_text("tracker: {estimator: isam2, providers: ['walls:Wall']}\n")
    (tmp_path / "walls.py").write_text("class Wall:\n    name = 'wall'\n    def factors(self, view): ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "tracker.providers" in refused("serve", "--snapshot", tmp_path / "state", "--config", config)


def test_a_state_file_is_of_one_service(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "state")
    with serving("--listen", str(tmp_path / "s.sock"), "--snapshot", str(tmp_path / "state")) as (address, server):
        for name in ("state", "link"):
            said = refused("serve", "--snapshot", tmp_path / name)
            assert said == f"error: {tmp_path / name}: another service keeps its state in this file\n"
        assert sent(address, range(1))[0]["type"] == "tracks"
        server.kill()
        server.wait()
    run("serve", "--snapshot", tmp_path / "state", given=frame(0))  # a killed one holds nothing


# A state on disk: whole, for its owner, and of the same configuration, or refused in one line

HEADER = {"version": "1", "configuration": "a: 1\nb: 2\n"}


def stream() -> StreamTracker[str]:
    config = load_config("file")
    return StreamTracker(lambda: config.new_tracker("saga"))


def file_sent(service: StreamTracker[str], *seqs: int) -> list[dict[str, Any]]:
    lines = [encode({"seq": k, "timestamp": k / 10, "detections": [{"x": 0.8 * k, "y": 0}]}) for k in seqs]
    return [answer for line in lines for _, answer in service.handle(line, "me")]


def kept(service: StreamTracker[str], path: Path) -> StateKeeper:
    keeper = StateKeeper(service, path, 1.0, HEADER)
    keeper.restore()
    return keeper


def test_a_state_is_for_its_owner_alone(tmp_path):
    path = tmp_path / "state.saga"
    old = os.umask(0)
    try:
        write_state(path, HEADER, [1.5])
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_state(path, HEADER) == [1.5]
    assert [file.name for file in tmp_path.iterdir()] == ["state.saga"]


def test_damage_anywhere_is_refused(tmp_path):
    path = tmp_path / "state.saga"
    write_state(path, HEADER, {"numbers": [1, 2.5, "x"]})
    whole = path.read_bytes()
    flipped = [whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :] for k in range(len(whole))]
    cases = [(damaged, "") for damaged in (*flipped, *(whole[:k] for k in range(len(whole))))]
    cases += [
        (whole[:-9], "the state file is damaged: its checksum differs; remove it to begin anew"),
        (whole.replace(b"state 1", b"state 9", 1), "expected the format 'saga-fg state 1', got b'saga-fg state 9'"),
        (b"", "expected a state file of `saga-fg serve`, this is none"),
    ]
    for damaged, message in cases:
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=rf"state\.saga: {message}"):
            read_state(path, HEADER)
        assert path.read_bytes() == damaged


def test_another_configuration_is_refused_with_what_differs(tmp_path):
    path = tmp_path / "state.saga"
    write_state(path, HEADER, None)
    with pytest.raises(InputError, match="configuration: the state is of another one, 'b: 2' instead of 'b: 3'"):
        read_state(path, {**HEADER, "configuration": "a: 1\nb: 3\n"})
    with pytest.raises(InputError, match=r"version: .* '1' instead of '2'"):
        read_state(path, {**HEADER, "version": "2"})
    with pytest.raises(InputError, match="no regular file"):
        read_state(tmp_path, HEADER)


def test_a_reset_is_on_the_disk_before_it_is_answered(tmp_path):
    first = stream()
    keeper = kept(first, tmp_path / "state.saga")
    file_sent(first, 0, 1)
    assert first.handle(b'{"type": "reset"}', "me")[-1][1] == {"type": "reset", "durable": True}
    keeper.release()
    second = stream()
    kept(second, tmp_path / "state.saga")
    assert second.status()["last_seq"] == {"sensor": 1}
    assert [t["id"] for t in file_sent(second, 500, 501)[-1]["tracks"]] == [1]


def test_a_full_disk_is_told_and_got_over(tmp_path, monkeypatch, caplog):
    service = stream()
    keeper = kept(service, tmp_path / "state.saga")
    file_sent(service, 0)

    def full(fd: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        assert not any(keeper.save() for _ in range(5))
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "No space left" in service.status()["state"]["error"]
    assert [path.name for path in tmp_path.iterdir()] == [".state.saga.lock"]
    assert file_sent(service, 1)[0]["durable_seq"] == -1
    assert keeper.save()
    assert service.status()["state"]["error"] is None
    assert file_sent(service, 2)[0]["durable_seq"] == 1


def test_a_state_that_does_not_fit_is_never_half_used(tmp_path):
    path = tmp_path / "state.saga"
    nothing = {"tracker": None, "numbering": {}, "newest": 0}
    for state in (None, {"tracker": 1}, nothing | {"counts": {"messages": "a"}}, nothing | {"counts": {}}):
        write_state(path, HEADER, state)
        with pytest.raises(InputError, match="expected a state that fits"):
            kept(stream(), path)


@pytest.mark.parametrize("part", ["last", "taken", "open", "unconfirmed"])
def test_numbers_of_frames_that_are_none_are_refused(tmp_path, part):
    service, path = stream(), tmp_path / "state.saga"
    file_sent(service, 0, 1)
    state, _, _ = service.state()
    state["numbering"][part] = {"a": [np.array([1])] if part == "open" else np.array([1])}
    write_state(path, HEADER, state)
    with pytest.raises(InputError, match=f"{part}: expected whole numbers"):
        kept(stream(), path)


def test_values_that_no_service_writes_are_refused(tmp_path, subtests):
    service, path = stream(), tmp_path / "state.saga"
    keeper = kept(service, path)
    file_sent(service, 0, 1)
    keeper.save()
    keeper.release()
    form, _, header, nodes, arrays = path.read_bytes().split(b"\n", 4)
    labels = next(node["array"] for node in json.loads(nodes) if "array" in node and node["array"][0] == "<U6")
    for old, new, message in (
        (json.dumps(labels), json.dumps([labels[0], [0], *labels[2:]]), r"label: expected 1 rows, got 0"),
        (json.dumps(labels), json.dumps([labels[0], [0] * 53, *labels[2:]]), "expected an array of numbers"),
        ("0.1", "NaN", "unknown node nan"),
        ("0.1", "1e999", "unknown node inf"),
    ):
        with subtests.test(new):
            forged = nodes.replace(old.replace(" ", "").encode(), new.encode(), 1)
            assert forged != nodes
            content = b"\n".join([header, forged, arrays])
            path.write_bytes(b"\n".join([form, hashlib.sha256(content).hexdigest().encode(), content]))
            with pytest.raises(InputError, match=message):
                kept(stream(), path)
