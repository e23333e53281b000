"""Files read within bounds, and files written whole or not at all.

Opening input files, which must be regular files.

A device may be endless, and a pipe without a writer blocks: both are refused before a byte is read.

Files by path or by URL: s3://bucket/a.csv, gs://..., https://..., and others of `PROTOCOLS` that fsspec opens.

URLs need the extra `[remote]` (https://filesystem-spec.readthedocs.io) and the package of their protocol, such as s3fs,
which finds credentials itself. They are read in a child process, which connects to no other host than the URL's.

A file is written under a temporary name in its own folder and moved over its final name with `os.replace` (atomic on
POSIX and Windows) only when everything went well; any exception, KeyboardInterrupt included, removes the temporary one
and leaves an earlier file of that name as it was.
"""

import errno
import io
import os
import re
import secrets
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from glob import glob, has_magic
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, TextIO, TypeVar
from urllib.parse import urlsplit

from data_tools.files.isolated_reading import isolated, one_line
from saga_fg.errors import InputError, MissingExtraError, require_extra

_COMPRESSED = {
    b"BZh": "bzip2",
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "zip",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
}
_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)


def open_bytes(path: str | Path) -> io.BufferedReader:
    """Open a file to read bytes. Raises `InputError` naming it if it cannot be opened or is no regular file."""
    try:
        descriptor = os.open(path, _FLAGS)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe" if stat.S_ISFIFO(mode) else "a device"
        raise InputError(f"{path}: cannot be read: expected a regular file, this is {kind}")
    return os.fdopen(descriptor, "rb")


def open_text(path: str | Path, encoding: str = "utf-8", newline: str | None = None) -> TextIO:
    """Open a file to read text. Raises `InputError` as `open_bytes` does."""
    return io.TextIOWrapper(open_bytes(path), encoding=encoding, newline=newline)


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file. Raises `InputError` as `open_bytes` does."""
    try:
        with open_bytes(path) as file:
            return file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def read_text(path: str | Path) -> str:
    """Read a whole text file in UTF-8. Raises `InputError` as `open_bytes` does, and for what is no such text."""
    content = read_bytes(path)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        packed = next((name for start, name in _COMPRESSED.items() if content.startswith(start)), None)
        got = (
            f"a file compressed by {packed}, to be decompressed first"
            if packed
            else "bytes that are none: another encoding, or no text"
        )
        raise InputError(f"{path}: expected text in UTF-8, got {got}") from error


T = TypeVar("T")
_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "hdfs")  # their clients know which hosts these have
_HOSTS = ("https", "http", "sftp", "ftp")
PROTOCOLS = ("file", "memory", *_STORES, *_HOSTS)
_PIECE = 2**22  # bytes
_PROBLEM = "cannot be read"


def is_url(location: str) -> bool:
    """True for a URL, False for a path."""
    return "://" in location


def name_of(location: str) -> str:
    """The last part of a path or URL."""
    return Path(urlsplit(location).path if is_url(location) else location).name


@contextmanager
def local_copy(location: str) -> Iterator[Path]:
    """A local file with the content of `location`, under its name: itself, or a temporary copy.

    An `InputError` that is raised in the block, about the copy, names `location` instead.

    Raises `InputError` where it cannot be read, `MissingExtraError` for a URL without the packages it takes.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / (name_of(location) or "file")
        with path.open("wb") as file:
            for _, piece in _remote(_pieces, location, None):
                file.write(piece)
        with _called(path, location):
            yield path


@contextmanager
def local_tree(location: str, patterns: Sequence[str]) -> Iterator[Path]:
    """A local folder with the files below `location` that match: itself, or a temporary copy.

    patterns: paths relative to `location`, with `*` for names; missing files are left out. An `InputError` that is
    raised in the block, about a file of the copy, names `location` instead.

    Raises `InputError` where files cannot be read, `MissingExtraError` for a URL without the packages it takes.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve()  # the system's temporary folder may be a link
        for name, piece in _remote(_pieces, location.rstrip("/"), list(patterns)):
            path = folder / name
            if folder not in path.resolve().parents:
                raise InputError(f"{location}: expected files below it, got {name}")
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab") as file:
                file.write(piece)
        with _called(folder, location.rstrip("/")):
            yield folder


def expanded(locations: Sequence[str]) -> list[str]:
    """Paths and URLs, with patterns such as `*.csv` replaced by the sorted matching files, each file once.

    Returned paths are absolute. Raises `InputError` where there is no file.
    """
    found: list[str] = []
    for location in locations:
        if is_url(location):
            found += sorted(_remote(_matching, location)) if "*" in location else [location]
        elif has_magic(location) and not os.path.exists(location):  # noqa: PTH110 - false for names too long
            found += sorted(str(Path(path).absolute()) for path in glob(location, recursive=True))  # noqa: PTH207
        else:
            found.append(str(Path(location).absolute()))
    if not found:
        raise InputError(f"{', '.join(locations)[:500]}: expected at least one file, there is none")
    return list(dict.fromkeys(found))


@contextmanager
def _called(copy: Path, location: str) -> Iterator[None]:
    """Replace the name of a copy by its `location` in every `InputError` of the block."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(str(copy), location)) from error


def _remote(reader: Callable[..., Iterator[T]], url: str, *arguments: Any) -> Iterator[T]:
    """The records of a reader of a URL. Raises `InputError` for one of another protocol, and for chains of them."""
    protocol = url.partition("://")[0]
    if protocol not in PROTOCOLS or "::" in url:
        known = ", ".join(PROTOCOLS)
        got = f"{protocol}://" if protocol not in PROTOCOLS else "a chain"
        raise InputError(f"{url}: expected a URL of one protocol, one of {known}, got {got}")
    require_extra("remote", f"{url}: a URL", "fsspec")
    if protocol == "memory":  # of this process, a child has none
        with one_line(_PROBLEM, url):
            yield from reader(url, *arguments)
        return
    own = None if protocol in _STORES else [urlsplit(url).hostname or ""] if protocol in _HOSTS else []
    yield from isolated(_PROBLEM, reader, url, *arguments, hosts=own)


def _pieces(url: str, patterns: Sequence[str] | None) -> Iterator[tuple[str, bytes]]:
    """Names below a URL and contents of the files that match, piece by piece; of the URL itself for None."""
    file_system, remote = _file_system(url)
    found: dict[str, Any] = {remote: {}} if patterns is None else {}
    for pattern in patterns or ():
        found |= file_system.glob(f"{remote}/{pattern}", detail=True)
    for path in sorted(path for path, about in found.items() if about.get("type") != "directory"):
        with file_system.open(path, "rb") as file:
            yield str(PurePosixPath(path).relative_to(remote)), b""
            while piece := file.read(_PIECE):
                yield str(PurePosixPath(path).relative_to(remote)), bytes(piece)


def _matching(url: str) -> Iterator[str]:
    file_system, remote = _file_system(url)
    yield from (file_system.unstrip_protocol(path) for path in file_system.glob(remote))


def _file_system(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the name of the file in it."""
    import fsspec

    try:
        file_system, name = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise MissingExtraError(f"{url}: {error}") from error
    return file_system, name


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
