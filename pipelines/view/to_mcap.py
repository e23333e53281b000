"""Drawings as a file of MCAP (https://mcap.dev) for Foxglove, and for whatever else reads its messages.

Messages are JSON after the schemas in `foxglove_schemas`; the path of a drawing is the topic of its messages, its frame
the message's. Chunks are compressed with zstd. Times are nanoseconds from the scene's start.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from data_tools.files.atomic_files import atomic_file
from pipelines.view.drawing import Drawing
from pipelines.view.foxglove_messages import foxglove_message, nanoseconds
from pipelines.view.foxglove_schemas import SCHEMAS
from saga_fg.errors import MissingExtraError

LIBRARY = "saga-fg"


def load_mcap() -> ModuleType:
    """The module mcap.writer. Raises `MissingExtraError` where the package is not installed."""
    try:
        import mcap.writer
    except ImportError as error:
        raise MissingExtraError('files for Foxglove need mcap; pip install "saga-fg[mcap]"') from error
    return mcap.writer


def write_mcap(path: Path, drawings: Iterable[Drawing]) -> None:
    """Write drawings in order of time.

    Raises `InputError` where the file cannot be written, `MissingExtraError` without mcap.
    """
    package = load_mcap()
    with atomic_file(path) as file:
        writer = package.Writer(file, compression=package.CompressionType.ZSTD)
        writer.start(library=LIBRARY)
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for each in drawings:
            name, message = foxglove_message(each)
            if name not in schemas:
                schemas[name] = writer.register_schema(name, "jsonschema", _json(SCHEMAS[name]))
            topic = f"/{each.path}"
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schemas[name])
            time = nanoseconds(each)
            writer.add_message(channels[topic], log_time=time, publish_time=time, data=_json(message))
        writer.finish()


def _json(content: object) -> bytes:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode("utf-8")
