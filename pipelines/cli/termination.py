"""SIGTERM as an exception: `finally` blocks run, temporary files go, workers end, as they do after Ctrl-C.

Unlike `KeyboardInterrupt`, which comes wherever it may, it waits while work is under way that is short and must not be
cut in two:

* an import, which might swallow the exception or leave a module half made, and the start of a process;
* the moments when a temporary file or folder is made, moved into its place, or removed;
* Python that a compiled kernel calls: the kernel checks no exceptions and would go on without the result;
* the compiler's work on memory that is not Python's, which would be released twice.
"""

from __future__ import annotations

import signal
import sys
import weakref
from types import FrameType

TERMINATED = 128 + signal.SIGTERM  # exit code, as shells have it

_AGAIN = 0.02  # s, until it is tried again
_UNINTERRUPTED = frozenset(
    {
        "data_tools.files.file_access",
        "importlib._bootstrap",
        "multiprocessing.process",
        "multiprocessing.util",
        "numba.core.caching",
        "numba.core.serialize",  # called by kernels for the types of their results
        "shutil",
        __name__,
        "tempfile",
    }
)
_UNINTERRUPTED_PACKAGE = "llvmlite."  # also called back by the compiler, where exceptions are printed and forgotten


class Terminated(BaseException):
    """The process has been asked to end."""


def raise_on_sigterm() -> None:
    """Make SIGTERM raise `Terminated` in the main thread, which has to be the caller's.

    Where that is swallowed, as in a finaliser, it is raised again, and nothing is printed.
    """
    raised: weakref.ref[Terminated] | None = None

    def on_signal(_: int, frame: FrameType | None) -> None:
        nonlocal raised
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
        on_its_way = raised is not None and raised() is not None
        if not on_its_way and not _uninterrupted(frame):
            error = Terminated()
            raised = weakref.ref(error)
            try:
                raise error
            finally:
                del error  # which would keep itself alive, by its traceback

    report = sys.unraisablehook

    def on_swallowed(swallowed: sys.UnraisableHookArgs) -> None:
        if not isinstance(swallowed.exc_value, Terminated):
            report(swallowed)

    sys.unraisablehook = on_swallowed
    signal.signal(signal.SIGALRM, on_signal)
    signal.signal(signal.SIGTERM, on_signal)


def ignore_sigterm() -> None:
    """Ignore SIGTERM: the process is about to end by itself."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_IGN)


def _uninterrupted(frame: FrameType | None) -> bool:
    while frame is not None:
        name = str(frame.f_globals.get("__name__"))
        if name in _UNINTERRUPTED or name.startswith(_UNINTERRUPTED_PACKAGE):
            return True
        frame = frame.f_back
    return False
