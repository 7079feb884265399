"""Codec of ROS 2 bags in SQLite (``.db3``): an index of the messages, and their bytes.

The database is opened for reading alone and as immutable: nothing is written beside it, and no journal is read. Only
plain tables are read; a view or a virtual table, whose definition would be executed, is refused.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final
from urllib.parse import quote

from dhtorch.data.codecs.bag_messages import HEAD_BYTES, IndexedMessage, MessagePlace, Topic, make_topic
from dhtorch.data.io.decode import FormatError
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, open_regular

#: First bytes of a database.
SQLITE_SIGNATURE: Final = b"SQLite format 3\0"
#: ``MessagePlace.chunk`` of a message in a database.
DATABASE_ROW: Final = -2

_COLUMNS: Final = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"id", "topic_id", "data"}}
_MAX_TOPICS: Final = 100_000
_STEPS_PER_CHECK: Final = 100_000  # of SQLite's virtual machine, between looks at the clock
_MAX_QUERY_S: Final = 15.0  # s, of one query; opening a capture may take 20


def iter_database_messages(file: Path) -> Iterator[IndexedMessage]:
    """The messages of a database in its order.

    Raises:
        FormatError: no database of a bag, or a damaged one.
    """
    with _open_database(file) as database:
        topics = _read_topics(database, file)
        columns = "id, topic_id, timestamp, length(data), substr(data, 1, ?)"
        for row in database.execute(f"SELECT {columns} FROM messages ORDER BY id", (HEAD_BYTES,)):
            number, topic, stamp, length, head = row
            if topic not in topics or not isinstance(head, bytes) or not isinstance(stamp, int):
                raise FormatError(file, f"message {number}", f"topic {topic}", "a blob of a declared topic")
            yield IndexedMessage(topics[topic], stamp, MessagePlace(file, DATABASE_ROW, number, length), head)


def read_database_message(place: MessagePlace) -> bytes:
    """Bytes of a message.

    Raises:
        FormatError: missing, too long, or a damaged database.
    """
    with _open_database(place.file) as database:
        row = database.execute(
            "SELECT data FROM messages WHERE id = ? AND length(data) <= ?", (place.start, MAX_FILE_BYTES)
        ).fetchone()
    if row is None or not isinstance(row[0], bytes):
        raise FormatError(place.file, f"message {place.start}", "nothing", f"a blob of at most {MAX_FILE_BYTES} bytes")
    return row[0]


@contextmanager
def _open_database(file: Path) -> Iterator[sqlite3.Connection]:
    with open_regular(file) as stream:
        head = stream.read(len(SQLITE_SIGNATURE))
    if head != SQLITE_SIGNATURE:
        raise FormatError(file, "content", repr(head), "an SQLite database")
    address = f"file:{quote(str(file.resolve()))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_FILE_BYTES)
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA mmap_size = 0")
            end = time.monotonic() + _MAX_QUERY_S
            database.set_progress_handler(lambda: int(time.monotonic() > end), _STEPS_PER_CHECK)
            _check_tables(database, file)
            yield database
    except (sqlite3.Error, OverflowError, UnicodeDecodeError, MemoryError) as error:
        raise FormatError(file, "database", error or type(error).__name__, "a whole SQLite database") from None


def _check_tables(database: sqlite3.Connection, file: Path) -> None:
    for table, expected in _COLUMNS.items():
        row = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchone()
        kind = "nothing" if row is None else str(row[0])
        if row is None or kind != "table" or not str(row[1]).upper().startswith("CREATE TABLE"):
            raise FormatError(file, table, kind, "a plain table, as in a ROS 2 bag")
        columns = {name: hidden for _, name, _, _, _, _, hidden in database.execute(f"PRAGMA table_xinfo({table})")}
        missing = expected - {name for name, hidden in columns.items() if not hidden}
        if missing:
            raise FormatError(file, f"{table} columns", ", ".join(map(str, columns)), ", ".join(sorted(expected)))


def _read_topics(database: sqlite3.Connection, file: Path) -> dict[int, Topic]:
    rows = database.execute(
        "SELECT id, name, type, serialization_format FROM topics LIMIT ?", (_MAX_TOPICS + 1,)
    ).fetchall()
    if len(rows) > _MAX_TOPICS:
        raise FormatError(file, "topics", f"more than {_MAX_TOPICS}", "fewer")
    if not all(isinstance(word, str) for row in rows for word in row[1:]):
        raise FormatError(file, "topics", "a name that is no text", "texts")
    return {number: make_topic(*words) for number, *words in rows}
