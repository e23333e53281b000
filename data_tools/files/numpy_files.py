"""Reading NumPy files: plain arrays only, never pickled objects."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from data_tools.files.error_messages import error_context
from data_tools.files.input_files import open_bytes
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError

_PROBLEM = "expected NumPy's format, with plain arrays"


def load_array(file: BinaryIO) -> NDArray[Any]:
    """The array of a .npy file. Raises `InputError` for anything else."""
    with _plain_arrays():
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return _as_doubles(loaded)
    raise InputError("expected a single array, got an archive")


def load_archive(path: Path, wanted: Collection[str] | None = None) -> tuple[set[str], dict[str, NDArray[Any]]]:
    """Names of all arrays of a .npz file, and those `wanted` (None: all).

    It is read in a child process, since its arrays may be compressed. Raises `InputError` naming the file for anything
    else.
    """
    names, *arrays = isolated(_PROBLEM, _archive, path, None if wanted is None else set(wanted))
    return set(names), dict(arrays)


def _archive(path: Path, wanted: Collection[str] | None) -> Iterator[Any]:
    """The names of all arrays; then name and content of each that is wanted."""
    with error_context(str(path)), open_bytes(path) as file, _plain_arrays():
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            raise InputError("expected a NumPy archive of plain arrays, got a single array")
        yield loaded.files
        for name in loaded.files:
            if wanted is None or name in wanted:
                yield name, _as_doubles(loaded[name])


@contextmanager
def _plain_arrays() -> Iterator[None]:
    """Errors about what is no plain array."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # NumPy's reader raises many types for broken files
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # NumPy would advise to trust the file
            raise InputError("expected NumPy's format, with plain arrays and no pickled objects") from error
        raise InputError(f"{_PROBLEM}: {reason}") from error


def _as_doubles(array: NDArray[Any]) -> NDArray[Any]:
    """Floats of any width as doubles; a signalling NaN becomes a quiet one without a warning."""
    with np.errstate(invalid="ignore"):
        return array.astype(np.float64, copy=False) if array.dtype.kind == "f" else array
