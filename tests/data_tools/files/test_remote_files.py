"""Files by path, URL, pattern and list."""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from data_tools.files.input_files import PROTOCOLS, expanded, local_copy, local_tree, name_of
from saga_fg.errors import InputError, MissingExtraError


def test_a_path_is_itself_and_a_url_a_copy_that_goes_away(tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    original = tmp_path / "a.csv"
    original.write_text("x")
    with local_copy(str(original)) as path:
        assert path == original
    with local_copy(f"file://{original}") as path:
        assert (path.name, path.read_text()) == ("a.csv", "x")
        assert path != original
    assert not path.exists()
    assert original.exists()


def test_an_error_about_a_copy_names_the_url(tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    (tmp_path / "a.csv").write_text("x")
    url = f"file://{tmp_path}/a.csv"
    with pytest.raises(InputError) as caught, local_copy(url) as path:
        raise InputError(f"{path}: line 1: wrong")
    assert str(caught.value) == f"{url}: line 1: wrong"


def test_the_folder_for_temporary_files_may_be_a_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec")
    for name in ("data", "temporary"):
        (tmp_path / name).mkdir()
    (tmp_path / "data" / "a.csv").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "link"))
    with local_tree(f"file://{tmp_path}/data", ["*.csv"]) as folder:
        assert (folder / "a.csv").read_text() == "x"
    assert not list((tmp_path / "temporary").iterdir())


def test_names() -> None:
    assert name_of("s3://bucket/day/a.csv") == "a.csv"
    assert name_of("https://host/a.csv?version=2") == "a.csv"
    assert name_of("/data/a.csv") == "a.csv"


def test_patterns_are_sorted_and_every_file_comes_once(tmp_path: Path) -> None:
    for name in ("b.csv", "a.csv", "c.npz"):
        (tmp_path / name).touch()
    (tmp_path / "list.txt").write_text(f"# some\n\n{tmp_path}/c.npz\n{tmp_path}/*.csv\n")
    assert expanded([f"{tmp_path}/*.csv"]) == [f"{tmp_path}/a.csv", f"{tmp_path}/b.csv"]
    assert [Path(path).name for path in expanded([f"{tmp_path}/b.csv", f"{tmp_path}/list.txt"])] == [
        *("b.csv", "c.npz", "a.csv")
    ]
    with pytest.raises(InputError, match="expected at least one file"):
        expanded([f"{tmp_path}/*.ndjson"])
    with pytest.raises(InputError, match=r"none\.txt: cannot be read"):
        expanded([f"{tmp_path}/none.txt"])


def test_what_cannot_be_read_is_named(subtests: pytest.Subtests) -> None:
    for url, message in [
        ("file:///nowhere/a.csv", "file:///nowhere/a.csv: cannot be read: FileNotFoundError"),
        ("no://a/b.csv", "expected a URL"),
    ]:
        with subtests.test(message):
            pytest.importorskip("fsspec")
            with pytest.raises(InputError, match=message), local_copy(url):
                pass


def test_without_fsspec_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MissingExtraError, match=r"saga-fg\[remote\]"), local_copy("s3://bucket/a.csv"):
        pass


def test_a_list_in_itself_is_refused(tmp_path: Path) -> None:
    one, other = tmp_path / "one.txt", tmp_path / "other.txt"
    one.write_text(f"{other}\n")
    other.write_text(f"{one}\n")
    with pytest.raises(InputError, match=r"one\.txt: expected a list of files, this one is in itself"):
        expanded([str(one)])
    other.write_text(f"{other.parent}/./other.txt\n")
    with pytest.raises(InputError, match=r"other\.txt: expected a list of files, this one is in itself"):
        expanded([str(one)])


def test_lists_of_lists_are_read_once(tmp_path: Path) -> None:
    for k in range(40):  # 2^40 paths through them
        (tmp_path / f"{k}.txt").write_text(f"{tmp_path}/{k + 1}.txt\n{tmp_path}/./{k + 1}.txt\n")
    (tmp_path / "40.txt").write_text(f"{tmp_path}/a.csv\n")
    assert expanded([str(tmp_path / "0.txt")]) == [str(tmp_path / "a.csv")]


def test_entries_that_can_be_no_files_are_refused(tmp_path: Path, subtests: pytest.Subtests) -> None:
    path = tmp_path / "list.txt"
    for entry, message in [
        ("a\0b.csv", r"list\.txt: expected names without a zero byte, got 'a\\x00b\.csv'"),
        ("[" * 5000, r"list\.txt, \[+: expected at least one file, there is none"),
    ]:
        with subtests.test(message):
            path.write_text(f"{entry}\n")
            with pytest.raises(InputError, match=message):
                expanded([str(path)])


def test_other_protocols_and_chains_are_refused(subtests: pytest.Subtests) -> None:
    for url, message in [
        ("zip://a.csv::file:///nowhere/a.zip", "got zip://"),
        ("zip://a.csv::https://localhost/a.zip", "got zip://"),
        ("reference://a.csv", "got reference://"),
        ("file:///a.csv::https://localhost/b", "got a chain"),
        ("simplecache::s3://bucket/a.csv", "got simplecache::s3://"),
        ("github://a:b@/c.csv", "got github://"),
        ("://a.csv", "got ://"),
    ]:
        for read in [local_copy, lambda url: local_tree(url, ["*"]), lambda url: expanded([f"{url}*"])]:
            with subtests.test(message):
                with pytest.raises(InputError) as caught, ExitStack() as stack:
                    stack.enter_context(read(url))
                assert f"expected a URL of one protocol, one of {', '.join(PROTOCOLS)}, {message}" in str(caught.value)


def test_what_is_not_there_is_one_line(subtests: pytest.Subtests) -> None:
    for url in ["file:///nowhere", "http://localhost:1/a", "ftp://localhost:1/a.csv"]:
        with subtests.test(url=url):
            pytest.importorskip("fsspec")
            with pytest.raises((InputError, MissingExtraError)) as caught, local_copy(url):
                pass
            assert str(caught.value).startswith(f"{url}: ")
            assert "\n" not in str(caught.value)


def test_a_list_names_no_other_host_unless_it_is_given(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("https://data.example.org/a.csv\ns3://bucket/b.csv\n")
    with pytest.raises(InputError) as caught:
        expanded([str(path)])
    assert str(caught.value) == (
        f"{path}: https://data.example.org/a.csv: this list names another host; "
        "if you know it: --hosts data.example.org"
    )
    with pytest.raises(InputError, match="--hosts bucket"):
        expanded([str(path)], ["data.example.org"])
    both = ["https://data.example.org/a.csv", "s3://bucket/b.csv"]
    assert expanded([str(path)], ["data.example.org", "bucket"]) == both
    assert expanded(["s3://bucket/c.csv", str(path)], ["data.example.org"]) == ["s3://bucket/c.csv", *both]


def test_a_list_from_a_url_names_no_local_files(tmp_path: Path) -> None:
    memory = pytest.importorskip("fsspec").filesystem("memory")
    for entry in ("/etc/passwd", "file:///etc/passwd", "a.csv", "*.csv"):
        memory.pipe_file("/lists/one.txt", f"{entry}\n".encode())
        with pytest.raises(InputError, match=r"memory://lists/one\.txt: .* expected URLs in a list"):
            expanded(["memory://lists/one.txt"])
    memory.pipe_file("/lists/one.txt", b"memory://lists/a.csv\n")
    assert expanded(["memory://lists/one.txt"]) == ["memory://lists/a.csv"]
    memory.store.clear()


def test_pieces_of_a_large_file_are_put_together(tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    content = bytes(range(256)) * 40_000  # more than one piece
    (tmp_path / "large.bin").write_bytes(content)
    with local_copy(f"file://{tmp_path}/large.bin") as path:
        assert path.read_bytes() == content
    with local_tree(f"file://{tmp_path}", ["*.bin", "l*"]) as folder:
        assert (folder / "large.bin").read_bytes() == content
