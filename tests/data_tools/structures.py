"""Files that keep their format and hold what nobody meant: the structure is changed, not the bytes.

`restructured(path, content, rng)` takes a valid file apart by the suffix of its name, changes its parts, and puts it
together again, so that a reader gets past the format to what is in it: repeated columns, nested values, types that do
not fit, records that name each other in circles, lengths that lie, and a little that unpacks to much.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import json
import random
import sqlite3
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import yaml

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, -(2**63), 2**64, 10**30, 0.5, -0.0, 1e-320, 1e300, float("nan")),
    *(float("inf"), "", "a", "car", "CAR", "0", "1.5", "1e5", "nan", "2024-01-01T00:00:00Z", "../x", "a\nb", "\0"),
    *([], [1.0], [0, 0, 0], [[0.0] * 4] * 4, {}, {"x": 1, "y": 2}, {"a": {"a": {}}}, "a" * 3000, [0.0] * 3000),
)
NAMES = (
    *("timestamp", "time", "t", "ts_ns", "frame", "x", "y", "z", "pos_x", "position", "vx", "vy", "yaw", "heading"),
    *("qw", "qx", "qy", "qz", "length", "width", "l", "w", "height", "score", "label", "class", "category", "id"),
    *("track_id", "scene", "sensor", "ego_x", "ego_y", "ego_yaw", "cov_xx", "cov_xy", "visible", "", " x", "X"),
)
SEPARATORS = (",", ";", "\t", "|", " ")
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "latin-1")


def restructured(path: Path, content: bytes, rng: random.Random) -> bytes:
    """The content of a file of this name with one to three parts changed; as it was where its format is not known."""
    change = BY_SUFFIX.get(path.suffix, _text)
    for _ in range(rng.randint(1, 3)):
        with suppress(UnicodeError):  # a change before has put something there that is no text
            content = change(content, rng)
    return content


def _csv(content: bytes, rng: random.Random) -> bytes:
    """Columns and cells of a table."""
    with suppress(csv.Error):
        rows = [row for row in csv.reader(io.StringIO(content.decode(), newline="")) if row]
        if len(rows) > 1:
            _change_columns(rows, rng)
            out, separator = io.StringIO(newline=""), rng.choice(SEPARATORS) if rng.random() < 0.1 else ","
            end = rng.choice(("\n", "\r\n", "\r")) if rng.random() < 0.1 else "\n"
            csv.writer(out, delimiter=separator, lineterminator=end, quoting=rng.choice((0, 1))).writerows(rows)
            return out.getvalue().encode(rng.choice(ENCODINGS) if rng.random() < 0.1 else "utf-8", "replace")
    return content


def _change_columns(rows: list[list[str]], rng: random.Random) -> None:
    header, k = rows[0], rng.randrange(len(rows[0]))
    one = rng.randrange(1, len(rows))
    what = rng.randrange(9)
    if what == 0:
        header[k] = rng.choice(NAMES)
    elif what == 1:
        header[k] = rng.choice(header)
    elif what == 2:
        for row in rows:
            del row[k : k + 1]
    elif what == 3:
        name = rng.choice(NAMES)
        for number, row in enumerate(rows):
            row.insert(k, name if number == 0 else str(rng.choice(VALUES)))
    elif what == 4:
        order = rng.sample(range(len(header)), len(header))
        rows[:] = [[row[i] for i in order if i < len(row)] for row in rows]
    elif what == 5:
        rows.insert(one, list(header))
    elif what == 6:
        rows[one] = rows[one][:k] + rng.choice(([], [""] * 3, ["x"] * 2000))
    elif what == 7:
        rows[1:] = [list(row) for row in rows[1:] for _ in range(rng.randint(0, 3))]
    elif k < len(rows[one]):
        rows[one][k] = str(rng.choice(VALUES))


def _json(content: bytes, rng: random.Random) -> bytes:
    """A value somewhere in a document, or a line of documents."""
    try:
        return json.dumps(_changed(json.loads(content), rng)).encode()
    except ValueError:
        return _ndjson(content, rng)


def _ndjson(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines()
    if not lines:
        return content
    k = rng.randrange(len(lines))
    with suppress(ValueError):
        value = _changed(json.loads(lines[k]), rng)
        text = json.dumps(value)
        if isinstance(value, dict) and value and rng.random() < 0.2:
            name = rng.choice(list(value))
            text = f"{text[:-1]}, {json.dumps(name)}: {json.dumps(rng.choice(VALUES))}}}"  # the name twice
        lines[k] = text.encode()
    if rng.random() < 0.2:
        lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
    return b"\n".join(lines) + b"\n"


def _changed(document: Any, rng: random.Random) -> Any:
    """A document with one value changed: replaced, taken from elsewhere in it, left out, repeated, or renamed."""
    places = list(_places(document))
    if not places:
        return deepcopy(rng.choice(VALUES))
    holder, key = rng.choice(places)
    what = rng.randrange(6)
    if what == 0:
        other, name = rng.choice(places)
        holder[key] = json.loads(json.dumps(other[name]))  # such as the token of another record
    elif what == 1:
        del holder[key]
    elif what == 2 and isinstance(holder, list):
        holder[key:key] = [holder[key]] * rng.choice((1, 2, 50))
    elif what == 3 and isinstance(holder, dict):
        holder[rng.choice((*NAMES, *holder))] = holder.pop(key)
    elif what == 4 and isinstance(holder[key], list):
        rng.shuffle(holder[key])
    else:
        holder[key] = deepcopy(rng.choice(VALUES))
    return json.loads(json.dumps(document))


def _places(value: Any) -> Any:
    """All (holder, key) in a document."""
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])


_YamlLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where it is built
_YamlDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def _yaml(content: bytes, rng: random.Random) -> bytes:
    bomb = "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
    circle = "tracker: &t\n  classes: *t\n"
    merged = "base: &b {max_delay: 1}\ntracker: {<<: *b}\n"
    if b"&" in content:
        return content
    if rng.random() < 0.1:
        return content + b"\n" + rng.choice((bomb, circle, merged, "--- 1\n--- 2\n", "? [1]\n: 2\n")).encode()
    try:
        document = yaml.load(content, _YamlLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return content
    if not isinstance(document, dict | list):
        return content
    return yaml.dump(_changed(json.loads(json.dumps(document, default=str)), rng), Dumper=_YamlDumper).encode()


def _text(content: bytes, rng: random.Random) -> bytes:
    """Words and lines of a text: repeated, left out, exchanged, in another order."""
    lines = [line.split() for line in content.decode().splitlines()]
    full = [line for line in lines if line]
    if not full:
        return content
    line, other = rng.choice(full), rng.choice(full)
    k = rng.randrange(len(line))
    what = rng.randrange(8)
    if what == 0:
        line[k] = rng.choice(other)
    elif what == 1:
        del line[k]
    elif what == 2:
        line.insert(k, line[k])
    elif what == 3:
        rng.shuffle(lines)
    elif what == 4:
        lines.insert(rng.randrange(len(lines)), list(line))
    elif what == 5:
        lines += [list(line)] * rng.choice((1, 3, 200))
    elif what == 6:
        lines.remove(line)
    else:
        line[k] = str(rng.choice(VALUES)).replace("\n", " ")
    return ("\n".join(" ".join(line) for line in lines) + "\n").encode()


def _gz(content: bytes, rng: random.Random) -> bytes:
    """The text in an archive; rarely one that unpacks to much."""
    with suppress(OSError, EOFError, zlib.error):
        text = _text(gzip.decompress(content), rng)
        if rng.random() < 0.01:
            piece = rng.choice((b"FLASER ", b"x\n", b"\0", text or b"\n"))
            text += piece * (10**6 // len(piece))
        return gzip.compress(text, 1)
    return content


def _state(content: bytes, rng: random.Random) -> bytes:
    """Nodes, header and numbers of a state file, with a sum that is right."""
    parts = content.split(b"\n", 4)
    if len(parts) < 5:
        return content
    what = rng.randrange(4)
    k = 2 if what == 0 else 3
    if what < 3:
        with suppress(ValueError, RecursionError):
            parts[k] = json.dumps(_changed(json.loads(parts[k]), rng)).encode()
    elif len(parts[4]) > 8:
        at = rng.randrange(len(parts[4]) - 7)
        number = rng.choice((0.0, -1.0, 1e300, float("nan"), float("inf"), 1e-320, rng.gauss(0, 1e3)))
        parts[4] = parts[4][:at] + struct.pack("<d", number) + parts[4][at + 8 :]
    parts[1] = hashlib.sha256(b"\n".join(parts[2:])).hexdigest().encode()
    return b"\n".join(parts)


STATEMENTS = (
    "ALTER TABLE messages RENAME TO old; CREATE VIEW messages AS SELECT * FROM old",
    "ALTER TABLE topics RENAME TO old; CREATE VIEW topics AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL "
    "SELECT i FROM n) SELECT i AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format, "
    "'' AS offered_qos_profiles FROM n",
    "CREATE TABLE x(a INTEGER, b AS (a + randomblob(1000000000)))",
    "ALTER TABLE messages ADD COLUMN c AS (zeroblob(1000000000))",
    "CREATE VIRTUAL TABLE f USING fts5(a)",
    "ALTER TABLE messages DROP COLUMN timestamp",
    "ALTER TABLE messages RENAME COLUMN data TO Data",
    "UPDATE messages SET data = zeroblob(length(data))",
    "UPDATE messages SET data = substr(data, 1, length(data) / 2)",
    "UPDATE messages SET data = CAST(data AS TEXT)",
    "UPDATE messages SET data = NULL",
    "UPDATE messages SET data = zeroblob(2000000) WHERE id < 3",
    "UPDATE messages SET timestamp = 'now'",
    "UPDATE messages SET timestamp = -9223372036854775808",
    "UPDATE messages SET timestamp = 9223372036854775807 WHERE id % 2",
    "UPDATE messages SET timestamp = 1e300",
    "UPDATE messages SET topic_id = 99",
    "UPDATE messages SET topic_id = 1",
    "UPDATE topics SET name = (SELECT name FROM topics LIMIT 1)",
    "UPDATE topics SET type = (SELECT type FROM topics LIMIT 1)",
    "UPDATE topics SET type = 'tf2_msgs/msg/TFMessage'",
    "UPDATE topics SET type = NULL, name = 1.5",
    "UPDATE topics SET serialization_format = 'json'",
    "DELETE FROM topics WHERE id % 2",
    "DELETE FROM messages",
    "INSERT INTO messages SELECT id + 100000, topic_id, timestamp, data FROM messages",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END",
    "UPDATE message_definitions SET encoded_message_definition = 'float64[2000000000] x'",
    "UPDATE message_definitions SET encoded_message_definition = 'a/A a'",
    "UPDATE message_definitions SET encoding = 'ros2idl'",
    "PRAGMA user_version = 99",
    "DROP TABLE schema",
    "CREATE TABLE metadata2(a); DROP TABLE metadata",
)


def _sqlite(content: bytes, rng: random.Random) -> bytes:
    """Tables, views and rows of a bag."""
    database = sqlite3.connect(":memory:")
    try:
        database.deserialize(content)
        with suppress(sqlite3.Error):
            database.executescript(rng.choice(STATEMENTS))
        return database.serialize()
    except sqlite3.Error:
        return content
    finally:
        database.close()


_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _MESSAGE = 6, 5


def _mcap(content: bytes, rng: random.Random) -> bytes:
    """Records of a recording: an opcode, a length and what is in it; chunks are packed anew."""
    records, at, end = list[tuple[int, bytes]](), len(_MAGIC), len(content) - len(_MAGIC)
    while at + 9 <= end:
        (length,) = struct.unpack_from("<Q", content, at + 1)
        records.append((content[at], content[at + 9 : at + 9 + length]))
        at += 9 + length
    if not records:
        return content
    k = rng.randrange(len(records))
    code, body = records[k]
    what = rng.randrange(8)
    if what == 0:
        records.insert(rng.randrange(len(records)), records[k])
    elif what == 1:
        del records[k]
    elif what == 2:
        rng.shuffle(records)
    elif what == 3:
        records[k] = (rng.choice((0, _MESSAGE, _CHUNK, 4, 3, 11, 15, 99, 255)), body)
    elif what == 4 and len(body) >= 8:  # a number in it, such as a length, a time or the id of a channel
        j, form = rng.randrange(len(body) - 7), rng.choice("HIQ")
        size = struct.calcsize(form)
        number = struct.pack(f"<{form}", rng.choice((0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2**16 - 1)))
        records[k] = (code, body[:j] + number + body[j + size :])
    elif what == 5:
        records.insert(k, (_CHUNK, _packed(bytes(10**7 if rng.random() < 0.01 else rng.choice((100, 10**5))), rng)))
    elif what == 6:
        records.insert(k, (_CHUNK, _packed(_record(*records[k]) * rng.choice((1, 2, 100)), rng)))
    else:
        records[k] = (code, body[: rng.randint(0, len(body))])
    return _MAGIC + b"".join(_record(*record) for record in records) + _MAGIC


def _record(code: int, body: bytes) -> bytes:
    return struct.pack("<BQ", code, len(body)) + body


def _packed(records: bytes, rng: random.Random) -> bytes:
    """The body of a chunk: times, size, checksum, name of the compression, and the records."""
    name, packed = b"", records
    if rng.random() < 0.5:
        import zstandard

        name, packed = b"zstd", zstandard.compress(records)
    size = rng.choice((len(records), len(records), 0, 2**40))
    name = rng.choice((name, name, name, b"lz4", b"zstd", b"xz"))
    head = struct.pack("<QQQI", 0, rng.choice((0, 2**64 - 1)), size, 0)
    return head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed


def _npz(content: bytes, rng: random.Random) -> bytes:
    """Arrays of an archive: other shapes, types and names."""
    out = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as made:
            names = archive.namelist()
            chosen = rng.choice(names) if names else ""
            for name in names:
                kept = archive.read(name)
                if name == chosen:
                    kept = _npy(kept, rng)
                    name = rng.choice((name, name, f"{rng.choice(NAMES)}.npy", f"../{name}", name.upper(), "x/"))
                with warnings.catch_warnings():  # the same name twice is one of the faults
                    warnings.simplefilter("ignore")
                    made.writestr(name, kept)
                    if rng.random() < 0.05:
                        made.writestr(rng.choice((name, f"{rng.choice(NAMES)}.npy")), kept)
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError, EOFError):
        return content
    return out.getvalue()


TYPES = ("<f4", ">f8", "<i8", "|u1", "<U3", "|S5", "<c16", "<M8[ns]", "<m8[s]", "|b1", "|O", "<f2", "|V8")
SHAPES = ((), (0,), (2,), (3, 4), (1, 1, 1), (-1,), (2**40,), (2**62, 2), (10**7,))


def _npy(content: bytes, rng: random.Random) -> bytes:
    """The header of an array."""
    header = {
        "descr": rng.choice((*TYPES, [("x", "<f8"), ("y", "<f8")])),
        "fortran_order": rng.random() < 0.2,
        "shape": rng.choice(SHAPES),
    }
    text = repr(header).encode() + b"\n"
    data = content[128:] if rng.random() < 0.7 else bytes(10**6 if rng.random() < 0.05 else 10**4)
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def _arrow(content: bytes, rng: random.Random) -> bytes:
    """A table with a column of another name, another type, twice, or very long, in the format that the file had."""
    import pyarrow
    from pyarrow import feather, parquet

    is_parquet = content[:4] == b"PAR1"
    try:
        source = pyarrow.BufferReader(content)
        table = parquet.read_table(source) if is_parquet else feather.read_table(source)
    except (pyarrow.ArrowException, OSError, ValueError):
        return content
    columns, names, n = list(table.columns), list(table.column_names), len(table)
    if not columns:
        return content
    k = rng.randrange(len(columns))
    what = rng.randrange(6)
    if what == 0:
        names[k] = rng.choice((*NAMES, *names))
    elif what == 1:
        del names[k], columns[k]
    elif what == 2:
        columns.append(columns[k])
        names.append(rng.choice((names[k], *NAMES)))
    elif what == 3:
        rows = 200_000 if rng.random() < 0.01 else rng.choice((0, 1, n, 3000))
        columns = [pyarrow.chunked_array([[None] * rows], each.type) for each in columns]
    else:
        columns[k] = _column(n, rng)
    out = pyarrow.BufferOutputStream()
    try:
        made = pyarrow.table(columns, names)
        if is_parquet:
            codec = rng.choice(("none", "snappy", "gzip", "zstd", "lz4"))
            parquet.write_table(made, out, compression=codec, use_dictionary=rng.random() < 0.5)
        else:
            feather.write_feather(made, out, compression=rng.choice(("uncompressed", "lz4", "zstd")))
    except (pyarrow.ArrowException, ValueError):
        return content
    return bytes(out.getvalue())


def _column(n: int, rng: random.Random) -> Any:
    """n values of a type that no table of boxes has, or in which they hardly fit."""
    import pyarrow as pa

    kinds: tuple[Callable[[], Any], ...] = (
        lambda: pa.nulls(n),
        lambda: pa.array([[1.0]] * n),
        lambda: pa.array([{"x": 1.0, "y": 2.0}] * n),
        lambda: pa.array([[("a", 1)]] * n, pa.map_(pa.string(), pa.int64())),
        lambda: pa.array(["a"] * n).dictionary_encode(),
        lambda: pa.array([b"\xff"] * n),
        lambda: pa.array([b"abcd"] * n, pa.binary(4)),
        lambda: pa.array([1] * n, pa.decimal128(38, 10)),
        lambda: pa.array([0] * n, pa.timestamp("ns", tz="Asia/Tokyo")),
        lambda: pa.array([2**62] * n, pa.timestamp("s")),
        lambda: pa.array([0] * n, pa.date32()),
        lambda: pa.array([1] * n, pa.duration("ms")),
        lambda: pa.array([2**64 - 1] * n, pa.uint64()),
        lambda: pa.array(np.full(n, np.inf, np.float16)),
        lambda: pa.array([True] * n),
        lambda: pa.array(["a" * 10_000] * n, pa.large_string()),
        lambda: pa.array([rng.choice(("1", "x", None)) for _ in range(n)]),
    )
    return rng.choice(kinds)()


def _cloud(content: bytes, rng: random.Random) -> bytes:
    """Numbers and words in the header of a cloud."""
    end = content.find(b"DATA ") if content[:1] == b"#" else content.find(b"end_header")
    lines = content[: max(end, 0)].decode("latin-1").splitlines()
    full = [k for k, line in enumerate(lines) if len(line.split()) > 1]
    if not full:
        return content
    k = rng.choice(full)
    words = lines[k].split()
    j = rng.randrange(1, len(words))
    words[j] = rng.choice(
        ("0", "-1", "1", "3", "4294967295", "99999999999", "x", "rgb", "U", "8", "double", "list uchar int", words[j])
    )
    lines[k] = " ".join(words)
    if rng.random() < 0.2:
        lines.insert(k, rng.choice(lines))
    rest = content[end:]
    if content[:1] == b"#" and rng.random() < 0.2:
        rest = rng.choice((b"DATA binary\n", b"DATA binary_compressed\n\xff\xff\xff\xff\xff\xff\xff\xff")) + bytes(100)
    return "\n".join(lines).encode("latin-1") + b"\n" + rest


BY_SUFFIX: dict[str, Callable[[bytes, random.Random], bytes]] = {
    ".csv": _csv,
    ".json": _json,
    ".ndjson": _ndjson,
    ".jsonl": _ndjson,
    ".yaml": _yaml,
    ".db3": _sqlite,
    ".mcap": _mcap,
    ".gz": _gz,
    ".saga": _state,
    ".npz": _npz,
    ".npy": _npy,
    ".parquet": _arrow,
    ".feather": _arrow,
    ".pcd": _cloud,
    ".ply": _cloud,
}
