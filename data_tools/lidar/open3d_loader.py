"""Open3D, imported on first use, because the import takes half a second and much memory.

On Linux its extension links `libusb-1.0.so.0` (for depth cameras), which neither its wheel nor a slim system carries.
The package `libusb-package` carries it; once loaded with global symbols, it satisfies the later link by its name.
"""

from __future__ import annotations

import ctypes
import importlib
import sys
from types import ModuleType

from saga_fg.errors import MissingExtraError


def load_open3d() -> ModuleType:
    """The module `open3d`. Raises `MissingExtraError` with the reason where it cannot be imported."""
    if "open3d" not in sys.modules:
        _preload_libusb()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise MissingExtraError(f"open3d cannot be imported: {error}; `pip install open3d libusb-package`") from error


def _preload_libusb() -> None:
    if not sys.platform.startswith("linux"):
        return
    try:
        path = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return  # the system may have its own libusb
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
