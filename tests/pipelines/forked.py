"""The command in processes of their own, forked from one in which it is imported already: each starts at once."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing import forkserver, reduction
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import TextIO

from pipelines.cli.main import main

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["pytest", "tests.pipelines.forked_imports"])


def context() -> ForkServerContext:
    """The context of processes that are forked; the one to fork is begun where it finds the modules of the clone."""
    with contextlib.chdir(Path(__file__).parents[2]):
        forkserver.ensure_running()
    return CONTEXT


class _Ends:
    """Descriptors that a process gets as its standard input, output and error."""

    def __init__(self, *numbers: int) -> None:
        self.numbers = numbers

    def __getstate__(self) -> list[object]:
        return [reduction.DupFd(number) for number in self.numbers]  # type: ignore[attr-defined]

    def __setstate__(self, duplicates: Sequence[object]) -> None:
        self.numbers = tuple(each.detach() for each in duplicates)  # type: ignore[attr-defined]


def _main(ends: _Ends, arguments: Sequence[str], before: Callable[[], object] | None) -> None:
    for standard, given in enumerate(ends.numbers):
        os.dup2(given, standard)
        os.close(given)
    sys.stdin = os.fdopen(0, closefd=False)
    if before is not None:
        before()
    sys.argv = ["saga-fg", *arguments]
    main()


class Command:
    """A running command: what `subprocess.Popen` has, as far as tests need it. Output goes to files or pipes."""

    returncode: int | None = None
    stderr: TextIO | None = None

    def __init__(
        self, arguments: Sequence[object], ends: tuple[int, int, int], before: Callable[[], object] | None = None
    ) -> None:
        words = [str(argument) for argument in arguments]
        self._process = context().Process(target=_main, args=(_Ends(*ends), words, before), daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        self.returncode = self._process.exitcode
        if self.returncode is None:
            raise subprocess.TimeoutExpired("saga-fg", timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()

    def communicate(self, timeout: float) -> tuple[None, str]:
        """Wait for the end; the rest of what it said on stderr, which fits into a pipe."""
        self.wait(timeout)
        assert self.stderr is not None
        return None, self.stderr.read()


def listening(arguments: Sequence[object], before: Callable[[], object] | None = None) -> Command:
    """A command whose stderr is a pipe."""
    read, write = os.pipe()
    with Path(os.devnull).open("r+b") as nothing:
        command = Command(arguments, (nothing.fileno(), nothing.fileno(), write), before)
    os.close(write)
    command.stderr = os.fdopen(read)
    return command


def run(*arguments: object, given: bytes = b"") -> tuple[bytes, str]:
    """Run a command that succeeds; its output, and what it says on stderr."""
    with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        source.write(given)
        source.seek(0)
        code = Command(arguments, (source.fileno(), out.fileno(), errors.fileno())).wait(120)
        out.seek(0)
        errors.seek(0)
        said = errors.read().decode()
        assert code == 0, said
        return out.read(), said
