"""A state on disk: whole, for its owner, and of the same configuration, or refused in one line."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from pipelines.config import load_config
from pipelines.serving import StateKeeper, StreamTracker
from pipelines.serving.messages import encode
from pipelines.serving.state import read_state, write_state
from saga_fg import InputError

HEADER = {"version": "1", "configuration": "a: 1\nb: 2\n"}


def stream() -> StreamTracker[str]:
    config = load_config("file")
    return StreamTracker(lambda: config.new_tracker("saga"))


def sent(service: StreamTracker[str], *seqs: int) -> list[dict[str, Any]]:
    lines = [encode({"seq": k, "timestamp": k / 10, "detections": [{"x": 0.8 * k, "y": 0}]}) for k in seqs]
    return [answer for line in lines for _, answer in service.handle(line, "me")]


def kept(service: StreamTracker[str], path: Path) -> StateKeeper:
    keeper = StateKeeper(service, path, 1.0, HEADER)
    keeper.restore()
    return keeper


def test_a_state_is_for_its_owner_alone(tmp_path: Path):
    path = tmp_path / "state.saga"
    old = os.umask(0)
    try:
        write_state(path, HEADER, [1.5])
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_state(path, HEADER) == [1.5]
    assert [file.name for file in tmp_path.iterdir()] == ["state.saga"]


def test_damage_anywhere_is_refused(tmp_path: Path):
    path = tmp_path / "state.saga"
    write_state(path, HEADER, {"numbers": [1, 2.5, "x"]})
    whole = path.read_bytes()
    for k in range(len(whole)):
        path.write_bytes(whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :])
        with pytest.raises(InputError, match=r"state\.saga: "):
            read_state(path, HEADER)
        path.write_bytes(whole[:k])
        with pytest.raises(InputError, match=r"state\.saga: "):
            read_state(path, HEADER)


def test_another_configuration_is_refused_with_what_differs(tmp_path: Path):
    path = tmp_path / "state.saga"
    write_state(path, HEADER, None)
    with pytest.raises(InputError, match="configuration: the state is of another one, 'b: 2' instead of 'b: 3'"):
        read_state(path, {**HEADER, "configuration": "a: 1\nb: 3\n"})
    with pytest.raises(InputError, match=r"version: .* '1' instead of '2'"):
        read_state(path, {**HEADER, "version": "2"})
    with pytest.raises(InputError, match="no regular file"):
        read_state(tmp_path, HEADER)


def test_a_stream_goes_on_as_if_nothing_had_happened(tmp_path: Path):
    whole = sent(stream(), *range(20))
    first = stream()
    keeper = kept(first, tmp_path / "state.saga")
    assert [a["durable_seq"] for a in sent(first, *range(8))] == [-1] * 8
    assert keeper.save()
    assert sent(first, 8, 9)[-1]["durable_seq"] == 7
    keeper.release()  # and is killed
    second = stream()
    kept(second, tmp_path / "state.saga")
    assert (second.status()["last_seq"], second.status()["frames"]) == ({"sensor": 7}, 8)
    rest = sent(second, *range(7, 20))
    assert rest[0]["type"] == "repeat"
    assert [a["tracks"] for a in rest[1:]] == [a["tracks"] for a in whole[8:]]
    assert (second.status()["frames"], second.status()["taken"]) == (20, {"sensor": 20})


def test_a_reset_is_on_the_disk_before_it_is_answered(tmp_path: Path):
    first = stream()
    keeper = kept(first, tmp_path / "state.saga")
    sent(first, 0, 1)
    assert first.handle(b'{"type": "reset"}', "me")[-1][1] == {"type": "reset", "durable": True}
    keeper.release()
    second = stream()
    kept(second, tmp_path / "state.saga")
    assert second.status()["last_seq"] == {"sensor": 1}
    assert [t["id"] for t in sent(second, 500, 501)[-1]["tracks"]] == [1]


def test_a_full_disk_is_told_and_got_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any):
    service = stream()
    keeper = kept(service, tmp_path / "state.saga")
    sent(service, 0)

    def full(fd: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        assert not any(keeper.save() for _ in range(5))
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "No space left" in service.status()["state"]["error"]
    assert [path.name for path in tmp_path.iterdir()] == [".state.saga.lock"]
    assert sent(service, 1)[0]["durable_seq"] == -1
    assert keeper.save()
    assert service.status()["state"]["error"] is None
    assert sent(service, 2)[0]["durable_seq"] == 1


def test_a_state_that_does_not_fit_is_never_half_used(tmp_path: Path):
    path = tmp_path / "state.saga"
    nothing = {"tracker": None, "numbering": {}, "newest": 0}
    for state in (None, {"tracker": 1}, nothing | {"counts": {"messages": "a"}}, nothing | {"counts": {}}):
        write_state(path, HEADER, state)
        with pytest.raises(InputError, match="expected a state that fits"):
            kept(stream(), path)
