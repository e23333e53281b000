"""Files written whole or not at all, and files at an address."""

import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from data_tools.files.file_access import (
    PROTOCOLS,
    atomic_directory,
    atomic_file,
    check_writable,
    check_writable_folder,
    expanded,
    local_copy,
    local_tree,
    remove_leftovers,
    write_text,
)
from saga_fg.errors import InputError, MissingExtraError


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_half(path: Path, exception: type[BaseException]) -> None:
    with atomic_file(path) as file:
        file.write(b"half")
        raise exception


def fill_half(path: Path) -> None:
    with atomic_directory(path) as folder:
        (folder / "old").write_text("half")
        raise KeyboardInterrupt


def test_interrupted_file_leaves_the_earlier_one(tmp_path, subtests):
    for exception in [KeyboardInterrupt, RuntimeError, SystemExit]:
        with subtests.test(exception=exception):
            path = tmp_path / "out.txt"
            write_text(path, "earlier")
            with pytest.raises(exception):
                write_half(path, exception)
            assert path.read_text() == "earlier"
            assert names(tmp_path) == ["out.txt"]


def test_new_files_have_ordinary_permissions_links_survive_and_names_have_a_greatest_length(tmp_path):
    write_text(tmp_path / "ours", "")
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode
    (tmp_path / "link").symlink_to(tmp_path / "target")
    write_text(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "text"
    write_text(tmp_path / ("n" * 255), "text")
    with pytest.raises(InputError, match="not writable"):
        write_text(tmp_path / ("n" * 256), "text")


def test_paths_of_another_kind(tmp_path):
    with pytest.raises(InputError, match="expected the name of a file to write, this is a folder"):
        write_text(tmp_path, "x")
    with pytest.raises(InputError, match="no regular file"):
        write_text("/dev/null", "x")
    assert Path("/dev/null").is_char_device()
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="expected the name of a folder"), atomic_directory(tmp_path / "out"):
        pytest.fail("the block must not run")


def test_folder_that_is_missing_or_a_file(tmp_path, subtests):
    for output in [atomic_file, atomic_directory]:
        with subtests.test(output=output):
            (tmp_path / "file").write_text("")
            for parent, reason in (("missing", "does not exist"), ("file", "is not a folder")):
                with (
                    pytest.raises(InputError, match=f"not writable: the folder .*{parent} {reason}"),
                    output(tmp_path / parent / "out"),
                ):
                    pytest.fail("the block must not run")


def test_folder_without_permission(tmp_path, monkeypatch):
    # permission bits do not bind root, who may well run the tests: refuse as the system would
    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refuse)
    monkeypatch.setattr(Path, "mkdir", refuse)
    for output in (atomic_file, atomic_directory):
        with (
            pytest.raises(InputError, match=r"out: not writable: Permission denied; expected a folder"),
            output(tmp_path / "out"),
        ):
            pytest.fail("the block must not run")


def test_full_disk_is_one_line(tmp_path):
    with pytest.raises(InputError, match="out: not written: No space left"), atomic_file(tmp_path / "out"):
        raise OSError(28, "No space left on device")
    assert names(tmp_path) == []


def test_directory_appears_when_complete(tmp_path):
    final = tmp_path / "out"
    with atomic_directory(final) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("a")
        assert not final.exists()
    assert (final / "sub" / "a").read_text() == "a"
    assert names(tmp_path) == ["out"]


def test_directory_with_files_keeps_the_others(tmp_path):
    final = tmp_path / "out"
    (final / "sub").mkdir(parents=True)
    (final / "old").write_text("old")
    (final / "sub" / "a").write_text("old")
    with atomic_directory(final) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("new")
        (folder / "b").write_text("new")
    assert (final / "old").read_text() == "old"
    assert (final / "sub" / "a").read_text() == "new"
    assert (final / "b").read_text() == "new"
    assert names(tmp_path) == ["out"]


def test_known_files_of_an_earlier_run_go(tmp_path):
    final, known = tmp_path / "out", ("tracks.csv", "map/[0-9]*.ply", "linked/[0-9]*.ply", "own")
    elsewhere = tmp_path / "elsewhere"
    for name in ("out/map/0.ply", "out/map/1.ply", "out/old/0.ply", "out/tracks.csv", "out/notes", "elsewhere/0.ply"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    (final / "linked").symlink_to(elsewhere)
    (final / "own").mkdir()
    with atomic_directory(final, known) as folder:
        (folder / "map").mkdir()
        (folder / "map" / "0.ply").write_text("new")
    assert names(final) == ["linked", "map", "notes", "old", "own"]
    assert names(final / "map") == ["0.ply"]
    assert names(elsewhere) == ["0.ply"]
    with atomic_directory(final, known) as folder:
        (folder / "a").write_text("a")
    assert names(final) == ["a", "linked", "notes", "old", "own"]


@pytest.mark.parametrize("exists", [True, False])
def test_interrupted_directory_leaves_nothing(tmp_path, exists):
    final = tmp_path / "out"
    if exists:
        final.mkdir()
        (final / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        fill_half(final)
    assert names(tmp_path) == (["out"] if exists else [])
    assert not exists or (final / "old").read_text() == "old"


def test_other_os_errors_pass(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_file(tmp_path / "out"):
        (tmp_path / "elsewhere").read_text()


def test_paths_are_checked_before_long_work(tmp_path):
    check_writable(tmp_path / "new.json")
    check_writable_folder(tmp_path / "new")
    (tmp_path / "there").mkdir()
    check_writable_folder(tmp_path / "there")
    (tmp_path / "file").touch()
    assert names(tmp_path) == ["file", "there"]
    assert names(tmp_path / "there") == []
    for check, path in (
        (check_writable, tmp_path),
        (check_writable, tmp_path / "missing" / "new.json"),
        (check_writable_folder, tmp_path / "missing" / "new"),
        (check_writable_folder, tmp_path / "file"),
    ):
        with pytest.raises(InputError, match=str(path)):
            check(path)


def test_only_what_a_killed_write_left_is_removed(tmp_path):
    for name in (".a.csv.0123456789ab.tmp", "a.csv", ".hidden", ".a.tmp", "b.0123456789ab.tmp"):
        (tmp_path / name).touch()
    (tmp_path / ".folder.0123456789ab.tmp").mkdir()
    (tmp_path / ".folder.0123456789ab.tmp" / "inside").touch()
    remove_leftovers(tmp_path, "b.csv")
    assert (tmp_path / ".a.csv.0123456789ab.tmp").exists()
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a.csv", ".hidden", ".a.tmp", "b.0123456789ab.tmp"}


# Files by path, URL, pattern and list


def test_a_path_is_itself_and_a_url_a_copy_that_goes_away(tmp_path):
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


def test_an_error_about_a_copy_names_the_url(tmp_path):
    pytest.importorskip("fsspec")
    (tmp_path / "a.csv").write_text("x")
    url = f"file://{tmp_path}/a.csv"
    with pytest.raises(InputError) as caught, local_copy(url) as path:
        raise InputError(f"{path}: line 1: wrong")
    assert str(caught.value) == f"{url}: line 1: wrong"


def test_the_folder_for_temporary_files_may_be_a_link(tmp_path, monkeypatch):
    pytest.importorskip("fsspec")
    for name in ("data", "temporary"):
        (tmp_path / name).mkdir()
    (tmp_path / "data" / "a.csv").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "link"))
    with local_tree(f"file://{tmp_path}/data", ["*.csv"]) as folder:
        assert (folder / "a.csv").read_text() == "x"
    assert not list((tmp_path / "temporary").iterdir())


def test_patterns_are_sorted_and_every_file_comes_once(tmp_path):
    for name in ("b.csv", "a.csv", "c.npz"):
        (tmp_path / name).touch()
    assert expanded([f"{tmp_path}/*.csv"]) == [f"{tmp_path}/a.csv", f"{tmp_path}/b.csv"]
    assert [Path(path).name for path in expanded([f"{tmp_path}/b.csv", f"{tmp_path}/*"])] == ["b.csv", "a.csv", "c.npz"]
    with pytest.raises(InputError, match="expected at least one file"):
        expanded([f"{tmp_path}/*.ndjson"])
    assert expanded(["none.csv", f"file://{tmp_path}/a.csv"]) == [
        str(Path("none.csv").absolute()),
        f"file://{tmp_path}/a.csv",
    ]


def test_without_fsspec_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MissingExtraError, match=r"saga-fg\[remote\]"), local_copy("s3://bucket/a.csv"):
        pass


def test_other_protocols_and_chains_are_refused(subtests):
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


def test_what_is_not_there_is_one_line(subtests):
    for url in ["file:///nowhere/a.csv", "no://a/b.csv", "http://localhost:1/a", "ftp://localhost:1/a.csv"]:
        with subtests.test(url=url):
            pytest.importorskip("fsspec")
            with pytest.raises((InputError, MissingExtraError)) as caught, local_copy(url):
                pass
            assert str(caught.value).startswith(f"{url}: ")
            assert "\n" not in str(caught.value)


def test_pieces_of_a_large_file_are_put_together(tmp_path):
    pytest.importorskip("fsspec")
    content = bytes(range(256)) * 40_000  # more than one piece
    (tmp_path / "large.bin").write_bytes(content)
    with local_copy(f"file://{tmp_path}/large.bin") as path:
        assert path.read_bytes() == content
    with local_tree(f"file://{tmp_path}", ["*.bin", "l*"]) as folder:
        assert (folder / "large.bin").read_bytes() == content
