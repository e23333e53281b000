"""Options that several commands share, and the parsing of their values."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.cli.console import set_up_logging
from saga_fg.errors import InputError

Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Say more on stderr.", callback=set_up_logging, show_default=False)
]
Scenario = Literal["traffic", "red-light", "road-works", "towing", "cycling", "two-sensors"]

Config = Annotated[
    Path | None, typer.Option("--config", help="YAML file over the defaults; see `saga-fg config`.", metavar="FILE")
]

Online = Annotated[
    bool, typer.Option("--online", help="Estimate online too, with a fixed-lag smoother, beside the full batch.")
]
Lag = Annotated[float | None, typer.Option("--lag", min=0.0, help="Length of the window of --online, s.  [default: 3]")]

Result = Annotated[
    Path, typer.Argument(help="Result of any tracker, in the format that `saga-fg track` writes for the dataset.")
]


def online_window(online: bool, lag: float | None) -> float | None:
    """Length of the window, s, None without --online. Raises `InputError` where --lag would have no effect."""
    if lag is not None and not online:
        raise InputError(f"--lag {lag:g}: expected with --online only")
    return (3.0 if lag is None else lag) if online else None


def apart(output: Path, *inputs: Path, option: str = "--output") -> None:
    """Raise `InputError` where the output, which `option` names, would overwrite what is read."""
    for path in inputs:
        if os.path.realpath(output) == os.path.realpath(path):  # unlike Path.resolve, it stands links in a circle
            raise InputError(f"{option} {output}: expected another file than those that are read")


def counts(option: str, value: str, least: int = 1) -> tuple[int, ...]:
    """The entries of a comma-separated option as whole numbers from `least` on, each once."""
    entries = dict.fromkeys(entry.strip() for entry in value.split(",") if entry.strip())
    if not entries or not all(entry.isdecimal() and len(entry) < 10 and int(entry) >= least for entry in entries):
        raise InputError(f"{option}: expected whole numbers >= {least} with commas between them, got {value[:40]!r}")
    return tuple(map(int, entries))
