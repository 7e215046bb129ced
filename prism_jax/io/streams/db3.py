"""ROS 2 bags in SQLite: .db3 files of rosbag2's own storage."""

import contextlib
import sqlite3
import struct
import urllib.parse
from collections import Counter
from collections.abc import Collection, Iterator

from prism_jax.io.errors import InputError
from prism_jax.io.files import read_bytes
from prism_jax.io.streams.messages import CutError, Message, MessageFile, Topic

MAGIC = b"SQLite format 3\0"


class Db3File(MessageFile):
    """Messages of a .db3 file, in the order in which they were written."""

    def topics(self) -> dict[str, Topic]:
        counted = "SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"
        counts: Counter[str] = Counter()
        with self._connected() as database:
            rows = self._topics(database)
            names = {number: name for number, (name, *_) in rows.items()}
            # Iterating over the messages tells of what is cut.
            with contextlib.suppress(CutError, sqlite3.DatabaseError):
                if self._cut_page():
                    every = self.messages(set(names.values()))
                    counts.update(message.topic for message in every)
                else:
                    for number, count in database.execute(counted):
                        counts[names.get(number, "")] += count
        return {
            name: Topic(kind, encoding, counts[name])
            for name, kind, encoding in rows.values()
            if counts[name]
        }

    def messages(self, wanted: Collection[str]) -> Iterator[Message]:
        with self._connected() as database:
            names = {
                number: name
                for number, (name, *_) in self._topics(database).items()
                if name in wanted
            }
            everything = "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            try:
                for number, time, data in database.execute(everything):
                    if number not in names:
                        continue
                    if type(time) is not int or type(data) is not bytes:
                        raise CutError("message without time or data")
                    yield Message(names[number], time, data)
            except sqlite3.DatabaseError as error:
                raise CutError(f"damaged record ({error})") from None

    def _cut_page(self) -> int:
        """The size of a page, if the file is shorter than its header says; else 0."""
        with self.opened(MAGIC, "a ROS 2 bag in SQLite") as file:
            rest = file.read(16).ljust(16, b"\0")
        page, count = struct.unpack(">H10xI", rest)
        page = 65536 if page == 1 else max(page, 512)
        return page if page * count > self.path.stat().st_size else 0

    @contextlib.contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        if page := self._cut_page():
            # SQLite would take what is missing of the last page for zeros.
            database = sqlite3.connect(":memory:", check_same_thread=False)
            data = read_bytes(self.path)
            database.deserialize(data[: len(data) // page * page])
        else:
            place = f"file:{urllib.parse.quote(str(self.path.absolute()))}?mode=ro"
            # Iterating goes on in the thread that reads ahead.
            database = sqlite3.connect(place, uri=True, check_same_thread=False)
        try:
            database.execute("PRAGMA trusted_schema=OFF")
            # Or SQLite would open no file that is shorter than it says.
            database.execute("PRAGMA writable_schema=ON")
            yield database
        finally:
            database.close()

    def _topics(self, database: sqlite3.Connection) -> dict[int, tuple[str, str, str]]:
        asked = "SELECT id, name, type, serialization_format FROM topics"
        try:
            rows = {number: tuple(rest) for number, *rest in database.execute(asked)}
            if not all(type(text) is str for row in rows.values() for text in row):
                raise sqlite3.DatabaseError("a topic without name, type or encoding")
            return rows
        except sqlite3.DatabaseError as error:
            fault = f"not a ROS 2 bag ({error})"
            raise InputError(self.path, fault, "check how it was recorded") from None
