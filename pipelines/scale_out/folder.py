"""A folder for results, in which nothing is read, written or removed through a link.

Other users with access to the folder could plant links in it, or name files elsewhere in its manifest. So paths below
the folder are walked by descriptors, a part at a time and without following links (`O_NOFOLLOW`), and results are
renamed into place, which replaces a link instead of its target. The folder itself may be a link: the user names it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from data_tools.files.atomic_files import LEFTOVER
from saga_fg.errors import InputError

_FOLDER = os.O_RDONLY | os.O_DIRECTORY
_LINK = (errno.ELOOP, errno.ENOTDIR)


class OutputFolder:
    """Files by their names relative to a folder, with `/` between the parts of a name."""

    def __init__(self, path: Path) -> None:
        """Make the folder where it is missing. Raises `InputError` where that is not possible."""
        self.path = path
        with self._writing(""):
            path.mkdir(parents=True, exist_ok=True)

    def read(self, name: str) -> bytes | None:
        """The content of a regular file; None where there is none, or where a link is on the way."""
        with suppress(OSError), self._parent(name) as (parent, last):
            if stat.S_ISREG(_mode(parent, last)):
                descriptor = os.open(last, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=parent)
                with os.fdopen(descriptor, "rb") as file:
                    return file.read()
        return None

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all. Raises `InputError` where that is not possible without following links."""
        with self._writing(name), self._parent(name, make=True) as (parent, last):
            temporary = f".{last[:100]}.{secrets.token_hex(6)}.tmp"
            try:
                descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666, dir_fd=parent)
                with os.fdopen(descriptor, "wb") as file:
                    file.write(content)
                os.replace(temporary, last, src_dir_fd=parent, dst_dir_fd=parent)
            finally:
                with suppress(FileNotFoundError):
                    os.unlink(temporary, dir_fd=parent)

    def remove(self, name: str) -> None:
        """Remove a file or a link, if there is one."""
        with suppress(OSError), self._parent(name) as (parent, last):
            os.unlink(last, dir_fd=parent)

    def remove_folder(self, name: str) -> None:
        """Remove a folder with its content, or a file of its name, if there is one."""
        with suppress(OSError), self._parent(name) as (parent, last):
            _remove(parent, last)

    def new_folder(self, name: str) -> Path:
        """Make an empty folder in place of anything of its name. Raises `InputError` where that is not possible."""
        self.remove_folder(name)
        with self._writing(name), self._parent(name) as (parent, last):
            os.mkdir(last, dir_fd=parent)
        return self.path / name

    def remove_leftovers(self) -> None:
        """Remove temporary files of killed runs, here and in folders below."""
        with self._parent(".") as (root, _):
            for _, folders, files, parent in os.fwalk(".", dir_fd=root):
                for name in (*folders, *files):
                    if LEFTOVER.fullmatch(name):
                        with suppress(OSError):
                            _remove(parent, name)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder for the block; the system lets go of it when the process ends, however it does.

        Raises `InputError` if another process holds it.
        """
        with self._writing(".lock"), self._parent(".lock") as (parent, last):
            lock = os.open(last, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666, dir_fd=parent)
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InputError(f"{self.path}: another run is writing to this folder") from error
            yield
        finally:
            os.close(lock)

    @contextmanager
    def _parent(self, name: str, make: bool = False) -> Iterator[tuple[int, str]]:
        """A descriptor of the folder a file is in, and the last part of the file's name."""
        *folders, last = name.split("/")
        descriptor = os.open(self.path, _FOLDER)
        try:
            for folder in folders:
                if make:
                    with suppress(FileExistsError):
                        os.mkdir(folder, dir_fd=descriptor)
                inner = os.open(folder, _FOLDER | os.O_NOFOLLOW, dir_fd=descriptor)
                os.close(descriptor)
                descriptor = inner
            yield descriptor, last
        finally:
            os.close(descriptor)

    @contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = "expected no link on the way" if name and error.errno in _LINK else error.strerror
            where = self.path / name
            raise InputError(f"{where}: not writable: {reason}; expected a folder for the results") from error


def _mode(parent: int, name: str) -> int:
    return os.stat(name, dir_fd=parent, follow_symlinks=False).st_mode


def _remove(parent: int, name: str) -> None:
    if stat.S_ISDIR(_mode(parent, name)):
        shutil.rmtree(name, dir_fd=parent)
    else:
        os.unlink(name, dir_fd=parent)


def is_inside(name: object) -> bool:
    """Return True for the name of a file below a folder: relative, and without `..`."""
    if not isinstance(name, str) or "\0" in name:
        return False
    path = PurePosixPath(name)
    return str(path) == name and not path.is_absolute() and ".." not in path.parts and name != "."
