"""Input files: by path or URL, regular files only, with errors that name the file and the nearest name.

Opening input files, which must be regular files.

A device may be endless, and a pipe without a writer blocks: both are refused before a byte is read.

Files by path or by URL: s3://bucket/a.csv, gs://..., https://..., and others of `PROTOCOLS` that fsspec opens.

URLs need the extra `[remote]` (https://filesystem-spec.readthedocs.io) and the package of their protocol, such as s3fs,
which finds credentials itself. They are read in a child process, which connects to no other host than the URL's.
"""

from __future__ import annotations

import io
import os
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from glob import glob, has_magic
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any, TextIO, TypeVar
from urllib.parse import urlsplit

from data_tools.files.isolated_reading import isolated, one_line
from saga_fg.errors import InputError, MissingExtraError

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
        return content.decode("utf-8")
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
    if find_spec("fsspec") is None:
        raise MissingExtraError(f'{url}: URLs need fsspec; pip install "saga-fg[remote]"')
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
