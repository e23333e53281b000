"""Reading files of others: apart, damaged, and by streams."""

import io
import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sized
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.files import isolated_reading
from data_tools.files.isolated_reading import isolated
from data_tools.files.readers import JsonStream, open_json
from saga_fg.errors import InputError, MissingExtraError
from tests.data_tools import hostile_readers as readers
from tests.data_tools.damage import Target, another, targets

PROBLEM = "expected a good file"


def records(reader: Callable[..., Iterator[Any]], *arguments: Any, **options: Any) -> list[Any]:
    return list(isolated(PROBLEM, reader, "a.file", *arguments, **options))


def test_records_come_in_order_from_one_child_and_two_files_at_once_have_two():
    assert records(readers.numbers, 1000) == list(range(1000))
    children = {records(readers.process)[0] for _ in range(20)}
    assert len(children) == 1
    assert os.getpid() not in children
    both = isolated(PROBLEM, readers.process, "a"), isolated(PROBLEM, readers.process, "b")
    assert len({next(each) for each in both}) == 2


def test_what_goes_wrong_is_one_line_with_file_and_reason(subtests):
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


def test_errors_that_name_their_place_stay_as_they_are():
    with pytest.raises(InputError, match=r"^a\.file: line 7: expected a number$"):
        records(readers.refuses)
    with pytest.raises(MissingExtraError, match=r"^a\.file: needs more$"):
        records(readers.lacks)


def test_time_and_output_are_bounded(monkeypatch):
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


def test_hosts_are_reached_if_they_are_named(port):
    assert records(readers.connects, "localhost", port, hosts=["localhost"]) == [b"hello"]
    assert records(readers.connects, "127.0.0.1", port, hosts=None) == [b"hello"]
    for host, hosts in (("localhost", ()), ("127.0.0.1", ("localhost",)), ("localhost", ("127.0.0.1",))):
        with pytest.raises(InputError, match=rf"it would connect to {host}, which is not among the hosts"):
            records(readers.connects, host, port, hosts=hosts)


def test_paths_are_those_of_this_process(tmp_path, monkeypatch):
    records(readers.numbers, 1)
    (tmp_path / "text").write_text("one\ntwo\n")
    monkeypatch.chdir(tmp_path)
    assert list(isolated(PROBLEM, readers.lines, Path("text"))) == ["one", "two"]
    assert records(readers.environment) == [("1", str(tmp_path))]


def test_a_reader_that_nobody_waits_for_ends():
    found = isolated(PROBLEM, readers.sleeps, "a")
    child = next(found)
    del found  # which closes it
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


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


def test_a_child_ends_with_its_parent():
    root = Path(__file__).parents[3]
    with subprocess.Popen([sys.executable, "-c", PARENT], cwd=root, stdout=subprocess.PIPE, text=True) as parent:
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


def test_modules_of_the_current_folder_are_not_imported_by_the_child(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise SystemExit('hostile')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each not in ("", ".")])
    isolated_reading._end_idle()
    assert records(readers.numbers, 2) == [0, 1]


# Whatever happens to a file, its reader either reads it or says in one `InputError` what is wrong

INPUTS = 20


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return targets(tmp_path_factory.mktemp("damage"))


def test_what_is_whole_is_read(valid):
    """Else what is damaged tells nothing: it is refused for another reason."""
    read: dict[str, Any] = {name: target.read() for name, target in valid.items()}
    assert all(len(content) for content in read.values() if isinstance(content, Sized))
    assert json.loads(read["state"])["type"] == json.loads(read["state, graph"])["type"] == "tracks"
    assert [len(scene) for scene in read["nuScenes"]] == [3, 2]
    assert read["configuration"].tracker.max_delay == 0.5


@pytest.mark.parametrize("seed", range(2))
def test_damage_is_read_or_named(valid, seed):
    for number, (name, target) in enumerate(valid.items()):
        rng = random.Random(1000 * seed + number)
        originals = {path: path.read_bytes() for path in target.files}
        for _ in range(INPUTS):
            path = rng.choice(target.files)
            path.write_bytes(another(path, originals[path], rng))
            try:
                with suppress(InputError):
                    target.read()
            except Exception as error:
                raise AssertionError(f"{name}: {path.read_bytes()!r}") from error
            finally:
                path.write_bytes(originals[path])


values = st.recursive(
    st.none() | st.booleans() | st.integers(1 - 10**19, 10**19 - 1) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


def stream(text: str, piece: int = 1 << 20) -> JsonStream:
    return JsonStream(io.StringIO(text), "x.json", piece)


@given(st.lists(values, max_size=6), st.integers(1, 12), st.sampled_from([None, 1]))
def test_array_read_in_pieces_equals_json_loads(content, piece, indent):
    text = json.dumps(content, indent=indent)
    reader = stream(text, piece)
    assert list(reader.array()) == json.loads(text)
    reader.end()


@given(st.dictionaries(st.text(max_size=4), values, max_size=6), st.integers(1, 12))
def test_object_read_in_pieces_equals_json_loads(content, piece):
    reader = stream(json.dumps(content), piece)
    assert {key: reader.value() for key in reader.members()} == content
    reader.end()


@given(st.lists(values, min_size=1, max_size=4), st.data())
def test_a_truncated_array_is_an_error(content, data):
    text = json.dumps(content)
    cut = data.draw(st.integers(0, len(text) - 1))
    with pytest.raises(InputError, match=r"^x\.json: character \d+: "):
        list(stream(text[:cut], 3).array())


def test_broken_arrays_and_objects_name_file_and_position(subtests):
    for text in ["", "{}", "[1 2]", "[1,]", "[1", "nonsense", "[" * 100_000, "[1e]"]:
        with subtests.test(text=text), pytest.raises(InputError, match=r"^x\.json: character \d+: "):
            list(stream(text).array())
    for text in ['{"a" 1}', '{"a": 1,}', "{1: 2}", '{"a": 1', '{"a"']:
        with subtests.test(text=text):
            reader = stream(text)
            with pytest.raises(InputError, match=r"^x\.json: character \d+: "):
                {key: reader.value() for key in reader.members()}


def test_what_is_no_json_is_named(tmp_path):
    reader = stream("[] []")
    list(reader.array())
    with pytest.raises(InputError, match="expected the end"):
        reader.end()
    path = tmp_path / "x.json"
    path.write_bytes(b'["\xff\xfe"]')
    with open_json(path) as file, pytest.raises(InputError, match="expected JSON in UTF-8"):
        list(JsonStream(file, str(path)).array())
    with pytest.raises(InputError, match=r"none\.json: cannot be read: No such file"):
        open_json(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read"):
        open_json(tmp_path)
