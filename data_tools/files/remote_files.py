"""Files by path or by URL: s3://bucket/a.csv, gs://..., https://..., and others of `PROTOCOLS` that fsspec opens.

URLs need the extra `[remote]` (https://filesystem-spec.readthedocs.io) and the package of their protocol, such as s3fs,
which finds credentials itself. They are read in a child process, which connects to no other host than the URL's. A list
of files names no host of its own accord.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from glob import glob, has_magic
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from urllib.parse import urlsplit

from data_tools.files.input_files import read_text
from data_tools.files.isolated_reading import isolated, one_line
from saga_fg.errors import InputError, MissingExtraError

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
def local_copy(location: str, hosts: Collection[str] = ()) -> Iterator[Path]:
    """A local file with the content of `location`, under its name: itself, or a temporary copy.

    An `InputError` that is raised in the block, about the copy, names `location` instead.

    hosts  that the URL may lead to, besides its own

    Raises `InputError` where it cannot be read, `MissingExtraError` for a URL without the packages it takes.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / (name_of(location) or "file")
        with path.open("wb") as file:
            for _, piece in _remote(_pieces, location, None, hosts=hosts):
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


def expanded(locations: Sequence[str], hosts: Collection[str] = ()) -> list[str]:
    """Paths and URLs, with patterns such as `*.csv` replaced by the sorted matching files, each file once.

    A file ending in .txt is a list with one path, URL or pattern a line. Relative paths start from the working
    directory; returned paths are absolute. URLs in lists may name the hosts (or buckets) of `locations`, and these:

    hosts  further ones

    Raises `InputError` for a pattern or list without files, for a list that is in itself, for another host in a list,
    and for a path in a list that is read from a URL.
    """
    return _expanded(locations, (), {*hosts, *(_host(each) for each in locations)})


def _expanded(locations: Sequence[str], lists: tuple[str, ...], hosts: set[str]) -> list[str]:
    """Expand `locations`; `lists` are the lists that contain them."""
    found: list[str] = []
    for location in locations:
        if location in lists:
            raise InputError(f"{location}: expected a list of files, this one is in itself")
        if lists:
            _check_entry(location, lists[-1], hosts)
        if name_of(location).endswith(".txt"):
            with local_copy(location, hosts) as path:
                lines = [line.strip() for line in read_text(path).splitlines()]
            entries = [line for line in lines if line and not line.startswith("#")]
            found += _expanded(entries, (*lists, location), hosts)
        elif is_url(location) and "*" in location:
            found += sorted(_remote(_matching, location, hosts=hosts))
        elif has_magic(location) and not Path(location).exists():
            found += sorted(str(Path(path).absolute()) for path in glob(location, recursive=True))  # noqa: PTH207
        else:
            found.append(location if is_url(location) else str(Path(location).absolute()))
    if not found:
        raise InputError(f"{', '.join(locations)}: expected at least one file, there is none")
    return list(dict.fromkeys(found))


def _check_entry(location: str, of: str, hosts: set[str]) -> None:
    """Raise `InputError` for an entry that a list, local or `of` a URL, may not have."""
    if is_url(of) and urlsplit(location).scheme in ("", "file") and urlsplit(of).scheme != "file":
        raise InputError(f"{of}: {location}: expected URLs in a list that is read from a URL, this is a local file")
    if _host(location) not in hosts and urlsplit(location).scheme not in ("", "file", "memory"):
        host = _host(location)
        raise InputError(f"{of}: {location}: this list names another host; if you know it: --hosts {host}")


def _host(location: str) -> str:
    """Host or bucket of a URL, "" for a path."""
    return (urlsplit(location).hostname or "") if is_url(location) else ""


@contextmanager
def _called(copy: Path, location: str) -> Iterator[None]:
    """Replace the name of a copy by its `location` in every `InputError` of the block."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(str(copy), location)) from error


def _remote(reader: Callable[..., Iterator[T]], url: str, *arguments: Any, hosts: Collection[str] = ()) -> Iterator[T]:
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
    own = None if protocol in _STORES else [_host(url), *hosts] if protocol in _HOSTS else []
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
