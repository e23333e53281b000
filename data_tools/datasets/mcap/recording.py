"""Messages of a recording: a file of MCAP, or a bag folder of ROS 2 with files of MCAP or SQLite in it.

Messages in ROS 2's encoding (CDR) are decoded by the definition that the recording holds, where it holds none by the
one of `ros2_types`. The decoder comes with the extra [mcap].

Sources: https://mcap.dev/spec; the storage plugins of https://github.com/ros2/rosbag2.
"""

import sqlite3
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from io import SEEK_END
from pathlib import Path
from typing import Any

from data_tools.datasets.mcap.ros2_types import decoder, definition, plain_type
from data_tools.files import isolated, one_line, open_bytes
from saga_fg.errors import InputError, require_extra, unknown_name

SUFFIXES = (".mcap", ".db3")
_NO_BAG = "expected a bag of ROS 2 in SQLite"
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
    """A message, or what is taken from it; number: from 1 within its topic, in their order; log_time: ns."""

    topic: Topic
    number: int
    log_time: int
    message: Any


class Recording:
    """The files and topics of a recording.

    Raises `InputError` where `path` is no recording, `MissingExtraError` without the extra [mcap].
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        require_extra("mcap", "a recording of ROS 2", "mcap", "rosbags")
        self.files = _files(self.path)
        self.topics: dict[str, Topic] = {}
        for file in self.files:
            for found in isolated("not readable", _topics, file):
                before = self.topics.get(found.name, found)
                if before.type != found.type:
                    raise InputError(f"{file}: {found.name}: expected messages of {before.type}, got {found.type}")
                count = found.count if before is found else before.count + found.count
                self.topics[found.name] = Topic(found.name, found.type, count)

    @property
    def name(self) -> str:
        """Name of the file without its suffix, or of the folder."""
        return self.path.name if self.path.is_dir() else self.path.stem

    def chosen(self, topics: Collection[str]) -> dict[str, Topic]:
        """Topics by name. Raises `InputError` for one that is not there."""
        for name in topics:
            if name not in self.topics:
                raise InputError(f"{self.path}: {unknown_name('topic', name, tuple(sorted(self.topics)))}")
        return {name: self.topics[name] for name in topics}


def decoded_messages(files: Sequence[Path], topics: Mapping[str, Topic], since: int = 0) -> Iterator[LoggedMessage]:
    """Messages of some topics in the order of the files, to be read in a child process; those logged from `since`, ns.

    Raises `InputError` for one that cannot be decoded.
    """
    counts = dict.fromkeys(topics, 0)
    for file in files:
        with _readable(file):
            for topic, time, decode, data in _reader(file).messages(topics, since):
                counts[topic] += 1
                with one_line("not readable", f"{file}: {topic}: message {counts[topic]}"):
                    message = decode(data)
                yield LoggedMessage(topics[topic], counts[topic], time, message)


def _topics(file: Path) -> Iterator[Topic]:
    with _readable(file):
        yield from _reader(file).topics()


@dataclass(frozen=True)
class _McapFile:
    path: Path

    def topics(self) -> list[Topic]:
        from mcap.reader import make_reader

        with open_bytes(self.path) as file:
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
        with open_bytes(self.path) as file:
            for schema, channel, _ in make_reader(file).iter_messages(log_time_order=False):
                if schema is not None:
                    count = found[channel.topic].count if channel.topic in found else 0
                    found[channel.topic] = Topic(channel.topic, plain_type(schema.name), count + 1)
        return list(found.values())

    def messages(self, topics: Collection[str], since: int) -> Iterator[tuple[str, int, Decode, bytes]]:
        from mcap.reader import make_reader

        decoders: dict[int, Decode] = {}
        with open_bytes(self.path) as file:
            reader = make_reader(file, validate_crcs=True)
            begin = since or None
            for schema, channel, message in reader.iter_messages(list(topics), begin, log_time_order=False):
                if channel.id not in decoders:
                    where, encoding = f"{self.path}: {channel.topic}", channel.message_encoding
                    if schema is None:
                        raise InputError(f"{where}: expected messages encoded as cdr (ROS 2), got {encoding!r}")
                    text = schema.data.decode() if schema.encoding == "ros2msg" else None
                    decoders[channel.id] = _decoder(where, schema.name, encoding, text)
                yield channel.topic, message.log_time, decoders[channel.id], message.data


@dataclass(frozen=True)
class _SqliteFile:
    """A bag in SQLite, of which plain tables alone are read: a view may compute for ever."""

    path: Path

    def topics(self) -> list[Topic]:
        query = """SELECT topics.name, topics.type, COUNT(messages.id)
                   FROM topics LEFT JOIN messages ON messages.topic_id = topics.id GROUP BY topics.id"""
        with self._opened() as (database, _):
            return [
                Topic(str(name), plain_type(str(type_)), int(count)) for name, type_, count in database.execute(query)
            ]

    def messages(self, topics: Collection[str], since: int) -> Iterator[tuple[str, int, Decode, bytes]]:
        decoders: dict[str, Decode] = {}
        marks = ",".join("?" * len(topics))
        query = f"""SELECT topics.name, topics.type, topics.serialization_format, messages.timestamp, messages.data
                    FROM messages JOIN topics ON messages.topic_id = topics.id
                    WHERE topics.name IN ({marks}) AND (? = 0 OR messages.timestamp >= ?)
                    ORDER BY messages.timestamp, messages.id"""
        with self._opened() as (database, tables):
            definitions = self._definitions(database) if "message_definitions" in tables else {}
            for topic, type_, encoding, time, data in database.execute(query, (*topics, since, since)):
                if topic not in decoders:
                    decoders[topic] = _decoder(f"{self.path}: {topic}", type_, encoding, definitions.get(type_))
                if not isinstance(time, int):
                    raise InputError(f"{self.path}: {topic}: timestamp: expected whole nanoseconds, got {time!r:.40}")
                yield topic, time, decoders[topic], bytes(data)

    @staticmethod
    def _definitions(database: sqlite3.Connection) -> dict[str, str]:
        """Definitions by type, of bags that hold them."""
        query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
        return {str(type_): str(text) for type_, text in database.execute(query) if text}

    @contextmanager
    def _opened(self) -> Iterator[tuple[sqlite3.Connection, set[str]]]:
        """The database, opened to be read, and the names of its plain tables."""
        open_bytes(self.path).close()
        with closing(sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            query = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql LIKE 'CREATE TABLE%'"
            tables = {str(name) for (name,) in database.execute(query)}
            for name in ("topics", "messages"):
                if name not in tables:
                    raise InputError(f"{self.path}: {_NO_BAG}: it has no plain table {name}")
            database.set_authorizer(_plain_reading)
            yield database, tables


def _plain_reading(action: int, _: str | None, __: str | None, ___: str | None, view: str | None) -> int:
    """Allow what reads tables and calls functions, none of it on behalf of a view or a trigger."""
    allowed = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION)
    return sqlite3.SQLITE_OK if action in allowed and view is None else sqlite3.SQLITE_DENY


@contextmanager
def _readable(file: Path) -> Iterator[None]:
    """Errors about a file, with a hint where a file of MCAP was cut off."""
    problem = _NO_BAG if file.suffix == ".db3" else "not readable"
    try:
        with one_line(problem, file):
            yield
    except InputError as error:
        if str(error).startswith(f"{file}: not readable") and _cut_off(file):
            raise InputError(f"{error}; the file may be cut off: mcap recover") from error
        raise


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


def _decoder(where: str, type_: str, encoding: str, text: str | None) -> Decode:
    """The function that decodes messages of a type by its definition, that which is known here for None.

    Raises `InputError` that begins with `where` for none.
    """
    if encoding != "cdr":
        raise InputError(f"{where}: expected messages encoded as cdr (ROS 2), got {encoding!r}")
    if text is None and definition(type_) is None:
        raise InputError(f"{where}: expected the definition of {type_} in the recording, it has none as ros2msg")
    with one_line("not readable", where):
        return decoder(type_, text)


def _cut_off(path: Path) -> bool:
    """True for a file that begins as MCAP and does not end so."""
    with open_bytes(path) as file:
        start = file.read(len(_MAGIC))
        file.seek(-len(start), SEEK_END)
        return start == _MAGIC != file.read()
