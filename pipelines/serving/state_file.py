"""A service's state on disk: one file, written whole or not at all, for its owner alone.

    saga-fg state 1                  the format and its version
    9f86d0...                        SHA-256 of all that follows, in hexadecimal
    {"version": ...}                 the header: version, method and configuration, plain JSON
    [null, 1.5, ...]                 the nodes of the tree of values, JSON (see `pipelines.serving.value_tree`)
    ...                              the bytes of its arrays

The sum finds damage, not forgery: who can write the file decides the state of the service.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from data_tools.files.atomic_files import atomic_file
from pipelines.serving.value_tree import TreeWriter, read_tree
from saga_fg.errors import InputError

FORMAT = b"saga-fg state 1"


def write_state(path: Path, header: Mapping[str, str], state: Any) -> None:
    """Write a state, and return once it is on the disk.

    Raises `InputError` as `atomic_file` does and for another kind of state, `OSError` for a disk that fails.
    """
    tree = TreeWriter(state)
    lines = [json.dumps(part, separators=(",", ":")).encode() for part in (dict(header), tree.nodes)]
    content = b"\n".join([*lines, bytes(tree.arrays)])
    with atomic_file(path) as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(b"\n".join([FORMAT, hashlib.sha256(content).hexdigest().encode(), content]))
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name, too
    finally:
        os.close(folder)


def read_state(path: Path, header: Mapping[str, str]) -> Any:
    """Return the state that was written with the same header.

    Raises `InputError` for a file that cannot be read, is damaged, or holds the state of something else.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: expected a state file of `saga-fg serve`, this is no regular file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a readable state file: {error.strerror or error}") from error
    first, _, rest = content.partition(b"\n")
    digest, _, rest = rest.partition(b"\n")
    if not first.startswith(b"saga-fg state "):
        raise InputError(f"{path}: expected a state file of `saga-fg serve`, this is none")
    if first != FORMAT:
        raise InputError(f"{path}: expected the format {FORMAT.decode()!r}, got {first[:40]!r}")
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        raise InputError(f"{path}: the state file is damaged: its checksum differs; remove it to begin anew")
    there, _, rest = rest.partition(b"\n")
    nodes, _, arrays = rest.partition(b"\n")
    try:
        _require_same(header, json.loads(there))
        return read_tree(json.loads(nodes), arrays)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # of constructors, for values of another program
        raise InputError(f"{path}: expected a state of this version: {type(error).__name__}: {error}") from error


def _require_same(here: Mapping[str, str], there: Mapping[str, str]) -> None:
    for name, expected in here.items():
        got = str(there.get(name))
        if got != expected:
            pairs = zip(got.splitlines(), expected.splitlines(), strict=False)
            line, wanted = next(((a, b) for a, b in pairs if a != b), (got[-60:], expected[-60:]))
            raise InputError(
                f"{name}: the state is of another one, {line.strip()[:80]!r} instead of {wanted.strip()[:80]!r}; "
                f"remove the file to begin anew"
            )
