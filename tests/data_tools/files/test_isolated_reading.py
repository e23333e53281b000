"""Readers in a child process: nothing that a file makes them do reaches this one but its records."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from data_tools.files import isolated_reading
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError, MissingExtraError
from tests.data_tools import hostile_readers as readers

PROBLEM = "expected a good file"


def records(reader: Callable[..., Iterator[Any]], *arguments: Any, **options: Any) -> list[Any]:
    return list(isolated(PROBLEM, reader, "a.file", *arguments, **options))


def test_records_come_in_order_and_one_child_serves_many_files() -> None:
    assert records(readers.numbers, 1000) == list(range(1000))
    children = {records(readers.process)[0] for _ in range(20)}
    assert len(children) == 1
    assert os.getpid() not in children


def test_two_files_at_once_have_two_children() -> None:
    both = isolated(PROBLEM, readers.process, "a"), isolated(PROBLEM, readers.process, "b")
    assert len({next(each) for each in both}) == 2


def test_what_goes_wrong_is_one_line_with_file_and_reason(subtests: pytest.Subtests) -> None:
    for reader, reason in [
        (readers.crashes, "its reader crashed (SIGSEGV)"),
        (readers.exits, "its reader crashed (exit code 3)"),
        (readers.grows, "it takes more memory than this machine has for it"),
        (readers.fails, "KeyError: 'a\\nb'"),
    ]:
        with subtests.test(reason):
            with pytest.raises(InputError) as caught:
                records(reader)
            assert str(caught.value) == f"a.file: {PROBLEM}: {reason}"
            assert records(readers.numbers, 2) == [0, 1]


def test_errors_that_name_their_place_stay_as_they_are() -> None:
    with pytest.raises(InputError, match=r"^a\.file: line 7: expected a number$"):
        records(readers.refuses)
    with pytest.raises(MissingExtraError, match=r"^a\.file: needs more$"):
        records(readers.lacks)


def test_time_and_output_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_reading, "SECONDS", 0.5)
    monkeypatch.setattr(isolated_reading, "PATIENCE", 1000.0)
    with pytest.raises(InputError, match=r"a\.file: expected a good file: its reader took more than 0.5 s of CPU time"):
        records(readers.spins)
    monkeypatch.setattr(isolated_reading, "PATIENCE", 4.0)
    with pytest.raises(InputError, match=r"a\.file: expected a good file: its reader gave nothing for 2 s"):
        records(readers.sleeps)
    monkeypatch.undo()
    monkeypatch.setattr(isolated_reading, "MEMORY", 10**8)
    with pytest.raises(InputError, match=r"a\.file: expected a good file: it holds more than this machine has room"):
        records(readers.floods)


def test_a_larger_file_may_take_longer(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(bytes(10**6))
    (tmp_path / "b").write_bytes(bytes(10**6))
    assert isolated_reading._size(tmp_path / "a") == 10**6
    assert isolated_reading._size(tmp_path) == 2 * 10**6
    assert isolated_reading._size(tmp_path / "none") == 0


@pytest.fixture
def port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            while True:
                try:
                    there, _ = server.accept()
                except OSError:
                    return
                with there:
                    there.sendall(b"hello")

        threading.Thread(target=answer, daemon=True).start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)


def test_hosts_are_reached_if_they_are_named(port: int) -> None:
    assert records(readers.connects, "localhost", port, hosts=["localhost"]) == [b"hello"]
    assert records(readers.connects, "127.0.0.1", port, hosts=None) == [b"hello"]
    for host, hosts in (("localhost", ()), ("127.0.0.1", ("localhost",)), ("localhost", ("127.0.0.1",))):
        with pytest.raises(InputError, match=rf"it would connect to {host}, which is not among the hosts"):
            records(readers.connects, host, port, hosts=hosts)


def test_paths_are_those_of_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records(readers.numbers, 1)
    (tmp_path / "text").write_text("one\ntwo\n")
    monkeypatch.chdir(tmp_path)
    assert list(isolated(PROBLEM, readers.lines, Path("text"))) == ["one", "two"]
    assert records(readers.environment) == [("1", str(tmp_path))]


def test_a_reader_that_nobody_waits_for_ends() -> None:
    found = isolated(PROBLEM, readers.sleeps, "a")
    child = next(found)
    del found  # which closes it
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_a_child_whose_last_record_is_refused_serves_the_next_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_reading, "ENDING", 60.0)
    found = isolated(PROBLEM, readers.process, "a")
    child = next(found)
    del found
    assert records(readers.process) == [child]


PARENT = """
import sys, time
from data_tools.files.isolated_reading import isolated
from tests.data_tools import hostile_readers as readers
found = isolated("bad", readers.process, "a")
print(next(found), flush=True)
list(found)
busy = isolated("bad", readers.sleeps, "a")
next(busy)
time.sleep(1000)
"""


def test_a_child_ends_with_its_parent() -> None:
    root = Path(__file__).parents[3]
    with subprocess.Popen([sys.executable, "-c", PARENT], cwd=root, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        time.sleep(0.3)
        parent.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 10
    while Path(f"/proc/{child}").exists() and _running(child):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _running(process: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False


def test_modules_of_the_current_folder_are_not_imported_by_the_child(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('hostile')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each not in ("", ".")])
    isolated_reading._end_idle()
    assert records(readers.numbers, 2) == [0, 1]
