"""Atomic output: a file appears complete or not at all.

A file is written under a temporary name in its own folder and moved over its final name with `os.replace` (atomic on
POSIX and Windows) only when everything went well; any exception, KeyboardInterrupt included, removes the temporary one
and leaves an earlier file of that name as it was.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import zipfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from data_tools.files.input_files import open_bytes
from saga_fg.errors import InputError

LEFTOVER = re.compile(r"\.(.*)\.[0-9a-f]{12}\.tmp", re.DOTALL)  # temporary name of a file or folder
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open `path` for writing bytes; it appears, or is replaced, when the block ends without an exception.

    The temporary file is opened at once, so that a folder which is not writable is an error before any work is done.
    Raises `InputError` if the folder is missing or not writable, if `path` is read-only or no regular file, or the disk
    full.
    """
    final, temporary, file = _opened(path)
    try:
        with _disk_full(final), file:
            yield file
        temporary.replace(final)
    except OSError as error:
        if error.filename == str(temporary):
            raise _not_writable(final, error) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_directory(path: str | Path, known: Collection[str] = ()) -> Iterator[Path]:
    """Yield an empty folder to fill; its files appear under `path` when the block ends without an exception.

    A `path` that does not exist, or is empty, appears in one step. In one that has files already, each new file
    replaces its namesake in one step. Files by the names or patterns `known`, which are all that such a run may write,
    and which this one has not written, are of an earlier run and are removed; others stay. Without `known` a folder
    collects the files of several runs. Raises `InputError` as `atomic_file` does.
    """
    final, temporary = _opened_folder(path)
    try:
        with _disk_full(final):
            yield temporary
        _move_into_place(temporary, final, known)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a whole file atomically. Raises `InputError` as `atomic_file` does."""
    with atomic_file(path) as file:
        file.write(content)


def write_text(path: str | Path, content: str) -> None:
    """Write a whole UTF-8 text file atomically. Raises `InputError` as `atomic_file` does."""
    write_bytes(path, content.encode("utf-8"))


def write_zip(path: str | Path, files: Iterable[Path]) -> Path:
    """Write a ZIP archive of files, by their names without folders; the same files make the same bytes."""
    with atomic_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in files:
            entry = zipfile.ZipInfo(each.name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            with open_bytes(each) as source, archive.open(entry, "w") as target:
                shutil.copyfileobj(source, target, 1 << 20)
    return Path(path)


def check_writable(path: str | Path) -> None:
    """Raise the `InputError` that `atomic_file` would raise: before long work, not after it."""
    _, temporary, file = _opened(path)
    file.close()
    temporary.unlink()


def check_writable_folder(path: str | Path) -> None:
    """Raise the `InputError` that `atomic_directory` would raise: before long work, not after it."""
    _, temporary = _opened_folder(path)
    temporary.rmdir()


def remove_leftovers(folder: str | Path, of: str | None = None) -> None:
    """Remove the temporary files that killed processes have left in a folder, while no process writes to it.

    of: the final name of the file or folder, None for any.
    """
    for path in Path(folder).glob(".*.tmp"):
        leftover = LEFTOVER.fullmatch(path.name)
        if leftover and of in (None, leftover[1]):
            linked = path.is_symlink() or not path.is_dir()
            path.unlink(missing_ok=True) if linked else shutil.rmtree(path, ignore_errors=True)


def _opened(path: str | Path) -> tuple[Path, Path, BinaryIO]:
    """The file to write, its temporary file, and that file opened."""
    final = _final(path)
    if final.exists() and not final.is_file():
        kind = "a folder" if final.is_dir() else "no regular file"
        raise InputError(f"{path}: expected the name of a file to write, this is {kind}")
    if final.exists() and not final.stat().st_mode & 0o222:  # a folder one may write to would let it be replaced
        raise InputError(f"{path}: not writable: the file is read-only")
    temporary = _temporary(final)
    try:
        file = temporary.open("xb")
    except OSError as error:
        raise _not_writable(final, error) from error
    return final, temporary, file


def _opened_folder(path: str | Path) -> tuple[Path, Path]:
    """The folder to write, and its empty temporary folder."""
    final = _final(path)
    if final.exists() and not final.is_dir():
        raise InputError(f"{path}: expected the name of a folder to write to, this is a file")
    temporary = _temporary(final)
    try:
        temporary.mkdir()
        if final.exists():  # is it writable too? the temporary folder lies beside it
            probe = _temporary(final / "probe")
            probe.touch()
            probe.unlink()
    except OSError as error:
        with suppress(OSError):
            temporary.rmdir()
        raise _not_writable(final, error) from error
    return final, temporary


def _final(path: str | Path) -> Path:
    """`path` in an existing folder, with links followed, which keeps them."""
    try:
        final = Path(path).expanduser().resolve()
        with suppress(FileNotFoundError, NotADirectoryError):
            final.stat()  # raises for names that the system refuses
        if final.parent.is_dir():
            return final
        reason = "is not a folder" if final.parent.exists() else "does not exist"
    except (OSError, RuntimeError) as error:  # name too long, a circle of links
        raise _not_writable(Path(path), error) from error
    raise InputError(f"{path}: not writable: the folder {final.parent} {reason}")


def _temporary(final: Path) -> Path:
    return final.with_name(f".{final.name[:100]}.{secrets.token_hex(6)}.tmp")


def _not_writable(path: Path, error: Exception) -> InputError:
    reason = getattr(error, "strerror", None) or error
    return InputError(f"{path}: not writable: {reason}; expected a folder one may write to")


@contextmanager
def _disk_full(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise InputError(f"{path}: not written: {error.strerror}") from error
        raise


def _move_into_place(source: Path, final: Path, known: Collection[str]) -> None:
    if not final.exists() or not any(final.iterdir()):
        with suppress(FileNotFoundError):
            final.rmdir()
        source.rename(final)
        return
    for folder in (final / p.relative_to(source) for p in source.rglob("*") if p.is_dir()):
        if folder.is_symlink():
            raise InputError(f"{folder}: not writable: expected a folder, this is a link")
    written = {file.relative_to(source) for file in source.rglob("*") if not file.is_dir()}
    for name in sorted(written):
        target = final / name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / name, target)  # noqa: PTH105 (the call this module is about)
    for old in {file for pattern in known for file in final.glob(pattern)}:
        linked = any((final / parent).is_symlink() for parent in old.relative_to(final).parents)
        if old.relative_to(final) not in written and not linked and not old.is_dir():
            old.unlink()
            with suppress(OSError):  # others are in it
                old.parent.rmdir()
