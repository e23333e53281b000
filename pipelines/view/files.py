"""Files of drawings: `.rrd` for rerun, `.mcap` for Foxglove."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from data_tools.files.atomic_files import check_writable
from pipelines.view.drawing import Drawing
from pipelines.view.to_mcap import load_mcap, write_mcap
from pipelines.view.to_rerun import load_rerun, write_rerun
from saga_fg.errors import InputError


def check_view_file(path: Path) -> None:
    """Check the suffix, the package and the folder of a file for `write_view`.

    Raises `InputError`, `MissingExtraError`.
    """
    (load_mcap if _is_mcap(path) else load_rerun)()
    check_writable(path)


def write_view(path: Path, name: str, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    """Write drawings in order of time to a file for rerun or Foxglove, whole or not at all.

    name   of the recording
    roots  frames that get a 3D view each

    Raises `InputError` for other suffixes and where the file cannot be written, `MissingExtraError` where the package
    that writes it is not installed.
    """
    if _is_mcap(path):
        write_mcap(path, drawings)
    else:
        write_rerun(path, name, roots, drawings)


def _is_mcap(path: Path) -> bool:
    if path.suffix not in (".rrd", ".mcap"):
        raise InputError(f"{path}: expected a file name that ends in .rrd (rerun) or .mcap (Foxglove)")
    return path.suffix == ".mcap"
