"""Files of drawings; the name's suffix says whose: `.rrd` is rerun's, `.mcap` is for Foxglove."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from data_tools.files.atomic_files import check_writable
from pipelines.view.drawing import Drawing
from pipelines.view.to_mcap import load_mcap, write_mcap
from pipelines.view.to_rerun import load_rerun, write_rerun
from saga_fg.errors import InputError


def check_view_file(path: Path) -> None:
    """What `write_view` would find wrong before it begins: the suffix, a missing package, the folder.

    Raises `InputError`, `MissingExtraError`.
    """
    (load_mcap if _is_mcap(path) else load_rerun)()
    check_writable(path)


def write_view(path: Path, name: str, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    """Write drawings in order of time to a file for rerun or Foxglove, whole or not at all.

    name   of the recording
    roots  frames that are a space of their own each

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
