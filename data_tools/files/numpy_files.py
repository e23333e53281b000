"""Reading NumPy files: plain arrays only, never pickled objects."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from saga_fg.errors import InputError


def load_array(file: BinaryIO) -> NDArray[Any]:
    """The array of a .npy file. Raises `InputError` for anything else."""
    loaded = _loaded(file, None)
    if not isinstance(loaded, np.ndarray):
        raise InputError("expected a single array, got an archive")
    return loaded


def load_archive(file: BinaryIO, wanted: Collection[str] | None = None) -> tuple[set[str], dict[str, NDArray[Any]]]:
    """Names of all arrays of a .npz file, and those `wanted` (None: all). Raises `InputError` for anything else."""
    loaded = _loaded(file, wanted)
    if isinstance(loaded, np.ndarray):
        raise InputError("expected a NumPy archive of plain arrays, got a single array")
    return loaded


def _first_line(error: Exception) -> str:
    """The first line of the message of an exception."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def _loaded(file: BinaryIO, wanted: Collection[str] | None) -> NDArray[Any] | tuple[set[str], dict[str, NDArray[Any]]]:
    try:
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return _as_doubles(loaded)
        names = set(loaded.files)
        return names, {name: _as_doubles(loaded[name]) for name in (names if wanted is None else names & set(wanted))}
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # NumPy's reader raises many types for broken files
        reason = _first_line(error)
        if "pickle" in reason:  # NumPy would advise to trust the file
            raise InputError("expected NumPy's format, with plain arrays and no pickled objects") from error
        raise InputError(f"expected NumPy's format, with plain arrays: {reason}") from error


def _as_doubles(array: NDArray[Any]) -> NDArray[Any]:
    """Floats of any width as doubles; a signalling NaN becomes a quiet one without a warning."""
    with np.errstate(invalid="ignore"):
        return array.astype(np.float64, copy=False) if array.dtype.kind == "f" else array
