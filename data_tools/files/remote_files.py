"""Files by path or by URL: s3://bucket/a.csv, gs://..., https://..., and others that fsspec opens.

URLs need the extra `[remote]` (https://filesystem-spec.readthedocs.io) and the package of their protocol, such as s3fs,
which finds credentials itself.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import glob, has_magic
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from data_tools.files.input_files import read_text
from saga_fg.errors import InputError, MissingExtraError


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
        path = Path(folder) / name_of(location)
        file_system, remote = _file_system(location)
        try:
            file_system.get_file(remote, str(path))
        except Exception as error:  # each protocol has its own
            raise InputError(f"{location}: cannot be read: {type(error).__name__}: {error}") from error
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
    file_system, remote = _file_system(location)
    remote = remote.rstrip("/")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve()  # the system's temporary folder may be a link
        try:
            for found in (name for pattern in patterns for name in sorted(file_system.glob(f"{remote}/{pattern}"))):
                path = folder / PurePosixPath(found).relative_to(remote)
                if folder not in path.resolve().parents:
                    raise InputError(f"{location}: expected files below it, got {found}")
                path.parent.mkdir(parents=True, exist_ok=True)
                file_system.get_file(found, str(path))
        except InputError:
            raise
        except Exception as error:  # each protocol has its own
            raise InputError(f"{location}: cannot be read: {type(error).__name__}: {error}") from error
        with _called(folder, location.rstrip("/")):
            yield folder


def expanded(locations: Sequence[str]) -> list[str]:
    """Paths and URLs, with patterns such as `*.csv` replaced by the sorted matching files, each file once.

    A file ending in .txt is a list with one path, URL or pattern a line. Relative paths start from the working
    directory; returned paths are absolute.

    Raises `InputError` for a pattern or list without files, and for a list that is in itself.
    """
    return _expanded(locations, ())


def _expanded(locations: Sequence[str], lists: tuple[str, ...]) -> list[str]:
    """Expand `locations`; `lists` are the lists that contain them."""
    found: list[str] = []
    for location in locations:
        if location in lists:
            raise InputError(f"{location}: expected a list of files, this one is in itself")
        if name_of(location).endswith(".txt"):
            with local_copy(location) as path:
                lines = [line.strip() for line in read_text(path).splitlines()]
            found += _expanded([line for line in lines if line and not line.startswith("#")], (*lists, location))
        elif is_url(location) and "*" in location:
            file_system, remote = _file_system(location)
            found += sorted(file_system.unstrip_protocol(path) for path in file_system.glob(remote))
        elif has_magic(location) and not Path(location).exists():
            found += sorted(str(Path(path).absolute()) for path in glob(location, recursive=True))  # noqa: PTH207
        else:
            found.append(location if is_url(location) else str(Path(location).absolute()))
    if not found:
        raise InputError(f"{', '.join(locations)}: expected at least one file, there is none")
    return list(dict.fromkeys(found))


@contextmanager
def _called(copy: Path, location: str) -> Iterator[None]:
    """Replace the name of a copy by its `location` in every `InputError` of the block."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(str(copy), location)) from error


def _file_system(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the name of the file in it."""
    fsspec = _fsspec(url)
    try:
        file_system, name = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise MissingExtraError(f"{url}: {error}") from error
    except ValueError as error:
        raise InputError(f"{url}: expected a URL that fsspec knows: {error}") from error
    return file_system, name


def _fsspec(url: str) -> ModuleType:
    try:
        import fsspec
    except ImportError as error:
        raise MissingExtraError(f'{url}: URLs need fsspec; pip install "saga-fg[remote]"') from error
    module: ModuleType = fsspec
    return module
