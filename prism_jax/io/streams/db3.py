"""ROS 2 bags in SQLite: .db3 files of rosbag2's own storage."""

import contextlib
import itertools
import sqlite3
import struct
import urllib.parse
from collections.abc import Iterator

from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes
from prism_jax.io.streams.messages import CutError, MessageFile, Source

MAGIC = b"SQLite format 3\0"


class Db3File(MessageFile):
    """Messages of a .db3 file, in the order in which they were written. Only tables are
    read: a view may go on for ever."""

    def _all(self, told: bool) -> Iterator[tuple[Source, int, bytes]]:
        told = told or self._cut_page() > 0
        columns = "timestamp, data" if told else "0, x''"
        asked = f"SELECT rowid, topic_id, {columns} FROM messages ORDER BY rowid"
        with self._connected() as database:
            sources = self._sources(database)
            before = missing = 0
            try:
                for row, number, time, data in database.execute(asked):
                    missing += row - before - 1 if before else 0
                    if row <= before or number not in sources:
                        raise CutError("message without a place or a topic")
                    if type(time) is not int or type(data) is not bytes:
                        raise CutError("message without time or data")
                    before = row
                    yield sources[number], time, data
            except sqlite3.DatabaseError as error:
                raise CutError(f"damaged record ({error})") from None
        if missing:
            raise CutError(f"messages are missing: {missing:,}")

    def _cut_page(self) -> int:
        """The size of a page, if the file is shorter than its header says; else 0."""
        with self.opened(MAGIC, "a ROS 2 bag in SQLite") as file:
            rest = file.read(16).ljust(16, b"\0")
        page, count = struct.unpack(">H10xI", rest)
        page = 65536 if page == 1 else max(page, 512)
        return page if page * count > self.size else 0

    @contextlib.contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        page = self._cut_page()
        if self.size < page:
            remedy = "check how it was copied"
            raise InputError(self.path, "ends within its first page", remedy)
        place = f"file:{urllib.parse.quote(str(self.file.absolute()))}?mode=ro"
        place = ":memory:" if page else place
        # Iterating goes on in the thread that reads ahead.
        database = sqlite3.connect(place, uri=True, check_same_thread=False)
        try:
            if page:  # SQLite would take what is missing of the last one for zeros.
                whole = memoryview(read_bytes(self.file))[: self.size // page * page]
                database.deserialize(whole)
            database.execute("PRAGMA trusted_schema=OFF")
            database.execute("PRAGMA cell_size_check=ON")
            # Or SQLite would open no file that is shorter than it says.
            database.execute("PRAGMA writable_schema=ON")
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(self.size, 4096))
            database.set_authorizer(_reads_a_table)
            # So much work. No function of Python's counts it: that would drop a Ctrl-C.
            going = itertools.repeat(0, 100 + self.size // 2**13)
            ended = itertools.chain(going, itertools.repeat(1))
            database.set_progress_handler(ended.__next__, 2**20)
            yield database
        finally:
            database.close()

    def _sources(self, database: sqlite3.Connection) -> dict[int, Source]:
        asked = "SELECT id, name, type, serialization_format FROM topics"
        try:
            rows = {number: tuple(rest) for number, *rest in database.execute(asked)}
            if not all(type(text) is str for row in rows.values() for text in row):
                raise sqlite3.DatabaseError("a topic without name, type or encoding")
            return rows
        except sqlite3.DatabaseError as error:
            fault = f"not a ROS 2 bag ({error})"
            raise InputError(self.path, fault, "check how it was recorded") from None


def _reads_a_table(action: int, *named: str | None) -> int:
    """What SQLite may do: select from a table, not by way of a view."""
    allowed = action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
    return sqlite3.SQLITE_OK if allowed and not named[3] else sqlite3.SQLITE_DENY
