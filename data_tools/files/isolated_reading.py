"""Files that other programs wrote, read in a child process: none of them hangs, crashes or exhausts this one.

A reader is a generator at the top of a module. `isolated` runs it in a child and passes its records on. The child is
bounded in CPU time, memory and output, and reaches no network unless the caller names hosts. It stops with its parent.
A child that has done its work waits for the next file, so that many small files share the cost of one start.

The child has the rights of its parent: this protects from files that make a reader hang, crash or fill the memory, not
from a reader that runs code of a file.
"""

import atexit
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, Pipe
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, TypeVar

from saga_fg.errors import InputError, MissingExtraError

T = TypeVar("T")
SECONDS = 60.0  # of CPU time for any file
SECONDS_A_MEGABYTE = 2.0  # of CPU time besides, for each megabyte of the file
PATIENCE = 4.0  # seconds on the clock for each second of CPU time, on machines with other work
FOR_EVER = 1e9  # s of CPU time for a remote file, whose size is unknown
SILENCE = 120.0  # s on the clock for the next piece of a remote file
MEMORY = max(2**30, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2)  # bytes in the child, and of output
DOWNLOAD = 2**36  # bytes of a remote file
WRITTEN = 2**26  # bytes of a file that a child may write, such as a compiled module
KEPT, IDLE = 20.0, 60.0  # s without work: the parent uses a child no more, the child ends
ENDING = 0.02  # s on the clock for the end of the records, where the caller takes no more
_HEADROOM = 2**31  # bytes of address space of an interpreter and its libraries


def isolated(
    problem: str,
    reader: Callable[..., Iterator[T]],
    location: str | Path,
    *arguments: Any,
    hosts: Sequence[str] | None = (),
) -> Iterator[T]:
    """The records of `reader(location, *arguments)`, which runs in a child process.

    problem  the error's text where the file is at fault, such as "expected a readable Parquet file"
    hosts    that the reader may connect to: none, some by name, or any (None)

    Raises `InputError` naming location, problem and reason for whatever the reader raises, for a crash, and where it
    takes more CPU time, memory or output than a file of this size should. `InputError` and `MissingExtraError` of the
    reader come as they are.
    """
    remote = "://" in str(location)
    seconds = FOR_EVER if remote else SECONDS + SECONDS_A_MEGABYTE * _size(Path(location)) / 1e6
    silence, left = (SILENCE, DOWNLOAD) if remote else (PATIENCE * seconds, MEMORY)
    child: _Child | None = None
    done = False
    try:
        child = _idle_or_new()
        child.connection.send((problem, reader, (location, *arguments), seconds, hosts, Path.cwd()))
        while True:
            if not child.connection.poll(silence):
                raise TimeoutError(f"its reader gave nothing for {silence:.0f} s")
            answer = child.connection.recv_bytes()
            left -= len(answer)
            if left < 0:
                raise OSError("it holds more than this machine has room for")
            kind, content = ForkingPickler.loads(answer)
            if kind is not None:
                done = True
                raise kind(content)
            if not content:
                break
            yield content[0]
        done = True
    except (OSError, EOFError) as error:
        reason = str(error) if child is None or isinstance(error, TimeoutError) or left < 0 else child.end(seconds)
        raise InputError(f"{location}: {problem}: {reason}") from error
    finally:
        if child is not None:
            child.keep() if done or child.has_ended() else child.kill()


class _Child:
    """A child process that serves readers, one after the other."""

    def __init__(self) -> None:
        self.connection, there = Pipe()
        with there:
            handle = there.fileno()
            path = os.pathsep.join(each or str(Path.cwd()) for each in sys.path)
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", f"from {__name__} import serve; serve({handle})"],
                env={**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                pass_fds=(handle,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        self._since = 0.0

    @property
    def usable(self) -> bool:
        """True if it can take another file."""
        return time.monotonic() - self._since < KEPT and self._process.poll() is None

    def has_ended(self) -> bool:
        """True where nothing but the end of the records is left, for a caller that takes no more of them."""
        with suppress(OSError, EOFError):
            if self.connection.poll(ENDING):
                kind, content = ForkingPickler.loads(self.connection.recv_bytes(10**4))
                return kind is not None or not content
        return False

    def keep(self) -> None:
        """Let it wait for the next file."""
        self._since = time.monotonic()
        _idle.setdefault(os.getpid(), []).append(self)

    def kill(self) -> None:
        self.connection.close()
        self._process.kill()
        self._process.wait()

    def end(self, seconds: float) -> str:
        """Why it ended."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        code = self._process.returncode or 0
        if code == -signal.SIGXCPU:
            return f"its reader took more than {seconds:g} s of CPU time"
        if code == -signal.SIGKILL:
            return "its reader was killed, as systems do that run out of memory"
        return f"its reader crashed ({signal.Signals(-code).name if code < 0 else f'exit code {code}'})"


_idle: dict[int, list[_Child]] = {}  # by process, since a fork takes over what is not its own


def _idle_or_new() -> _Child:
    mine = _idle.setdefault(os.getpid(), [])
    while mine:
        child = mine.pop()
        if child.usable:
            return child
        child.kill()
    return _Child()


@atexit.register
def _end_idle() -> None:
    for child in _idle.pop(os.getpid(), ()):
        child.kill()


def _size(path: Path) -> int:
    """Bytes of a file, or of the files of a folder."""
    with suppress(OSError, ValueError):
        return sum(each.stat().st_size for each in (path.iterdir() if path.is_dir() else (path,)))
    return 0


@contextmanager
def one_line(problem: str, location: str | Path) -> Iterator[None]:
    """An `InputError` of one line for whatever a library raises."""
    try:
        yield
    except (InputError, MissingExtraError):
        raise
    except MemoryError as error:
        raise InputError(f"{location}: {problem}: it takes more memory than this machine has for it") from error
    except Exception as error:  # libraries trust what they read: any exception may come
        text = (str(error).strip().splitlines() or [""])[0][:300]
        unsaid = not text or isinstance(error, OSError | LookupError | AttributeError)
        name = type(error).__name__
        raise InputError(f"{location}: {problem}: {f'{name}: {text}'.rstrip(': ') if unsaid else text}") from error


def serve(handle: int) -> None:
    """Serve the parent at the other end of a connection until it goes away; the child's only function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    threading.Thread(target=_end_with_parent, args=(handle,), daemon=True).start()
    _limit(resource.RLIMIT_AS, MEMORY + _HEADROOM)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_FSIZE, WRITTEN)
    network, connection = _Network(), Connection(handle)
    while connection.poll(IDLE):
        problem, reader, arguments, seconds, hosts, folder = connection.recv()
        os.chdir(folder)
        network.hosts, network.addresses = hosts, set()
        used = resource.getrusage(resource.RUSAGE_SELF)
        _limit(resource.RLIMIT_CPU, used.ru_utime + used.ru_stime + seconds + 1)
        try:
            with one_line(problem, arguments[0]):
                for record in reader(*arguments):
                    connection.send((None, (record,)))
            connection.send((None, ()))
        except (InputError, MissingExtraError) as error:
            connection.send((type(error), str(error)))


def _limit(what: int, most: float) -> None:
    with suppress(ValueError, OSError):  # where a smaller one holds, or the system has no such limit
        resource.setrlimit(what, (int(most), resource.getrlimit(what)[1]))


def _end_with_parent(handle: int) -> None:
    closed = select.poll()
    closed.register(handle, 0)  # tells when the other end is closed
    closed.poll()
    os._exit(1)


class _Network:
    """Allows this process to connect to `hosts` and their addresses alone; to any host where `hosts` is None."""

    def __init__(self) -> None:
        self.hosts: Sequence[str] | None = ()
        self.addresses: set[str] = set()
        self._resolve, socket.getaddrinfo = socket.getaddrinfo, self._resolved
        sys.addaudithook(self._check)

    def _resolved(self, *arguments: Any, **named: Any) -> Any:
        found = self._resolve(*arguments, **named)
        self.addresses |= {str(each[4][0]) for each in found}
        return found

    def _check(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.hosts is None or not event.startswith(("socket.connect", "socket.send", "socket.get")):
            return
        place = arguments[0] if event.startswith("socket.get") else arguments[1]
        place = place[0] if isinstance(place, tuple) else place
        if place not in self.hosts and place not in self.addresses:
            raise PermissionError(f"it would connect to {place}, which is not among the hosts that were given")
