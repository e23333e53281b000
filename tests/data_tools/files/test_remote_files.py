"""Files by path, URL, pattern and list."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import pytest

from data_tools.files.remote_files import expanded, local_copy, local_tree, name_of
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


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("file:///nowhere/a.csv", "file:///nowhere/a.csv: cannot be read: FileNotFoundError"),
        ("no://a/b.csv", "expected a URL"),
    ],
)
def test_what_cannot_be_read_is_named(url: str, message: str) -> None:
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
