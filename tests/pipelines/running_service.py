"""A service as a process of its own, for tests."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipelines.serving import Address, StreamClient, parse_address
from pipelines.serving.messages import encode
from tests.pipelines.forked import Command, listening


def frame(seq: int, sensor: str = "sensor") -> bytes:
    detections = [{"label": "car", "x": 0.8 * seq, "y": 0.0}]
    return encode({"seq": seq, "timestamp": seq / 10, "sensor": sensor, "detections": detections})


@contextmanager
def serving(
    *arguments: str, command: Sequence[str] | None = None, before: Callable[[], object] | None = None
) -> Iterator[tuple[Address, subprocess.Popen[str] | Command]]:
    """A service, or a command of its own, and its address; `before` runs in its process first."""
    if command is None:
        server: subprocess.Popen[str] | Command = listening(["serve", *arguments], before)
    else:
        server = subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True)
    assert server.stderr is not None
    with server.stderr:
        try:
            line = server.stderr.readline().strip()
            while line.startswith(("WARNING: compiling kernels", "compiling kernels", "going on from")):
                line = server.stderr.readline().strip()
            assert line.startswith("listening at "), line
            yield parse_address(line.removeprefix("listening at ")), server
        finally:
            server.kill()
            server.wait()


def limits(folder: Path, **settings: float) -> tuple[str, str]:
    """The option --limits with a file of these."""
    path = folder / "limits.yaml"
    path.write_text("".join(f"{name}: {value}\n" for name, value in settings.items()))
    return "--limits", str(path)


def status(address: Address) -> dict[str, Any]:
    with StreamClient(address) as client:
        return client.ask({"type": "status"})


def wait_for(happened: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something has happened."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)
