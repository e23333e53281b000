"""Messages of a recording: a file of MCAP, or a bag folder of ROS 2 with files of MCAP or SQLite in it.

Messages in ROS 2's encoding (CDR) are decoded by the definition that the recording holds, where it holds none by the
one that is known here; those in protobuf by the recording's descriptors. Decoders come with the extra [mcap].

Sources: https://mcap.dev/spec; the storage plugins of https://github.com/ros2/rosbag2.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, redirect_stderr
from dataclasses import dataclass
from io import SEEK_END, StringIO
from pathlib import Path
from typing import Any

from data_tools.datasets.mcap.definitions import definition, plain_type
from data_tools.files.error_messages import unknown_name
from data_tools.files.input_files import open_bytes
from saga_fg.errors import InputError, MissingExtraError

SUFFIXES = (".mcap", ".db3")
_MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of a file
Decode = Callable[[bytes], Any]


@dataclass(frozen=True)
class Topic:
    """A topic, the type of its messages without `/msg`, and how many there are."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class LoggedMessage:
    """A message; number: from 1 within its topic, in the order of the recording; log_time: ns."""

    topic: Topic
    number: int
    log_time: int
    message: Any


class Recording:
    """The topics of a recording, and their messages, which are read when asked for.

    Raises `InputError` where `path` is no recording, `MissingExtraError` without the extra [mcap].
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        load_mcap()
        self.files = _files(self.path)
        self.topics: dict[str, Topic] = {}
        for file in self.files:
            for found in _reader(file).topics():
                before = self.topics.get(found.name, found)
                if before.type != found.type:
                    raise InputError(f"{file}: {found.name}: expected messages of {before.type}, got {found.type}")
                count = found.count if before is found else before.count + found.count
                self.topics[found.name] = Topic(found.name, found.type, count)

    @property
    def name(self) -> str:
        """Name of the file without its suffix, or of the folder."""
        return self.path.name if self.path.is_dir() else self.path.stem

    def messages(self, topics: Collection[str]) -> Iterator[LoggedMessage]:
        """Messages of some topics, in the order of the files. Raises `InputError` for one that cannot be decoded."""
        counts = dict.fromkeys(topics, 0)
        for name in topics:
            if name not in self.topics:
                raise InputError(f"{self.path}: {unknown_name('topic', name, tuple(sorted(self.topics)))}")
        for file in self.files:
            for topic, time, decode, data in _reader(file).messages(topics):
                counts[topic] += 1
                with _library_errors(f"{file}: {topic}: message {counts[topic]}"):
                    message = decode(data)
                yield LoggedMessage(self.topics[topic], counts[topic], time, message)


@dataclass(frozen=True)
class _McapFile:
    path: Path

    def topics(self) -> list[Topic]:
        from mcap.reader import make_reader

        with open_bytes(self.path) as file, _library_errors(str(self.path), self.path):
            summary = make_reader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                counts = summary.statistics.channel_message_counts
                channels = [(each, counts.get(each.id, 0)) for each in summary.channels.values()]
                schemas = summary.schemas
                return [
                    Topic(each.topic, plain_type(schemas[each.schema_id].name), count)
                    for each, count in channels
                    if each.schema_id in schemas
                ]
        found: dict[str, Topic] = {}  # a file without a summary is read from end to end
        with open_bytes(self.path) as file, _library_errors(str(self.path), self.path):
            for schema, channel, _ in make_reader(file).iter_messages(log_time_order=False):
                if schema is not None:
                    count = found[channel.topic].count if channel.topic in found else 0
                    found[channel.topic] = Topic(channel.topic, plain_type(schema.name), count + 1)
        return list(found.values())

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Decode, bytes]]:
        from mcap.reader import make_reader

        decoders: dict[int, Decode] = {}
        with open_bytes(self.path) as file:
            found = iter(make_reader(file, validate_crcs=True).iter_messages(topics=list(topics), log_time_order=False))
            while True:
                with _library_errors(str(self.path), self.path):
                    record = next(found, None)
                if record is None:
                    return
                schema, channel, message = record
                decode = decoders.get(channel.id)
                if decode is None:
                    with _library_errors(f"{self.path}: {channel.topic}"):
                        decode = _decoder(schema, channel.message_encoding)
                    decoders[channel.id] = decode
                yield channel.topic, message.log_time, decode, message.data


@dataclass(frozen=True)
class _SqliteFile:
    path: Path

    def topics(self) -> list[Topic]:
        query = """SELECT topics.name, topics.type, COUNT(messages.id)
                   FROM topics LEFT JOIN messages ON messages.topic_id = topics.id GROUP BY topics.id"""
        with self._opened() as rows:
            return [Topic(str(name), plain_type(str(type_)), int(count)) for name, type_, count in rows(query)]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Decode, bytes]]:
        from mcap.records import Schema

        decoders: dict[str, Decode] = {}
        marks = ",".join("?" * len(topics))
        query = f"""SELECT topics.name, topics.type, topics.serialization_format, messages.timestamp, messages.data
                    FROM messages JOIN topics ON messages.topic_id = topics.id
                    WHERE topics.name IN ({marks}) ORDER BY messages.timestamp, messages.id"""
        with self._opened() as rows:
            definitions = self._definitions(rows)
            for topic, type_, encoding, time, data in rows(query, *topics):
                if topic not in decoders:
                    with _library_errors(f"{self.path}: {topic}"):
                        text = definitions.get(type_, "")
                        schema = Schema(id=1, name=type_, encoding="ros2msg" if text else "", data=text.encode())
                        decoders[topic] = _decoder(schema, encoding)
                yield topic, int(time), decoders[topic], bytes(data)

    @staticmethod
    def _definitions(rows: Callable[..., Iterator[Any]]) -> dict[str, str]:
        """Definitions by type, of bags that hold them."""
        tables = {name for (name,) in rows("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if "message_definitions" not in tables:
            return {}
        query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
        return {str(type_): str(text) for type_, text in rows(query) if text}

    @contextmanager
    def _opened(self) -> Iterator[Callable[..., Iterator[Any]]]:
        open_bytes(self.path).close()
        with closing(sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro", uri=True)) as database:

            def rows(query: str, *values: Any) -> Iterator[Any]:
                try:
                    yield from database.execute(query, values)
                except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
                    raise InputError(f"{self.path}: expected a bag of ROS 2 in SQLite: {error}") from error

            yield rows


def _reader(path: Path) -> _McapFile | _SqliteFile:
    return _McapFile(path) if path.suffix == ".mcap" else _SqliteFile(path)


def _files(path: Path) -> list[Path]:
    """The files of a recording, in order of time."""
    if not path.is_dir():
        if not path.exists():
            raise InputError(f"{path}: expected a recording, there is no such file")
        if path.suffix not in SUFFIXES:
            raise InputError(f"{path}: expected a file {' or '.join(SUFFIXES)}, or a bag folder")
        return [path]
    found = sorted((each for each in path.iterdir() if each.suffix in SUFFIXES), key=_split_number)
    if not found:
        squeezed = any(each.name.endswith((".mcap.zstd", ".db3.zstd")) for each in path.iterdir())
        hint = "; decompress its files first: unzstd NAME.zstd" if squeezed else ""
        raise InputError(f"{path}: expected a bag folder with files .mcap or .db3, there are none{hint}")
    return found


def _split_number(path: Path) -> tuple[str, int, str]:
    """Files of a bag are numbered at the end of their names: bag_9.mcap comes before bag_10.mcap."""
    stem, _, number = path.stem.rpartition("_")
    return (stem, int(number), "") if number.isdecimal() else ("", 0, path.stem)


def _decoder(schema: Any, encoding: str) -> Decode:
    """The function that decodes messages of a schema. Raises `InputError` where there is none."""
    import mcap_protobuf.decoder
    import mcap_ros2.decoder
    from mcap.records import Schema

    if schema is not None and encoding == "cdr" and schema.encoding != "ros2msg":
        text = definition(schema.name)
        if text is None:
            raise InputError(f"expected the definition of {schema.name} in the recording, it has none as ros2msg")
        schema = Schema(id=schema.id or 1, name=schema.name, encoding="ros2msg", data=text.encode())
    for factory in (mcap_ros2.decoder.DecoderFactory(), mcap_protobuf.decoder.DecoderFactory()):
        with redirect_stderr(StringIO()):  # where broken definitions are printed, before they are raised
            decode = factory.decoder_for(encoding, schema)
        if decode is not None:
            return decode
    raise InputError(f"expected messages encoded as cdr (ROS 2) or protobuf, got {encoding!r}")


@contextmanager
def _library_errors(where: str, mcap: Path | None = None) -> Iterator[None]:
    """An `InputError` that names the place for whatever a library raises about broken bytes, as of a file of MCAP."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except Exception as error:  # the libraries trust what they read: any exception may come
        reason = str(error).strip().splitlines()
        text = f"{where}: not readable: {reason[0] if reason else type(error).__name__}"
        hint = "; the file may be cut off: mcap recover" if mcap is not None and _cut_off(mcap) else ""
        raise InputError(text + hint) from error


def _cut_off(path: Path) -> bool:
    """True for a file that begins as MCAP and does not end so."""
    with open_bytes(path) as file:
        start = file.read(len(_MAGIC))
        file.seek(-len(start), SEEK_END)
        return start == _MAGIC != file.read()


def load_mcap() -> None:
    """Raise `MissingExtraError` where the packages that read recordings are not installed."""
    try:
        import foxglove_schemas_protobuf  # noqa: F401
        import mcap_protobuf  # noqa: F401
        import mcap_ros2  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("recordings of ROS 2 need mcap: pip install 'saga-fg[mcap]'") from error
