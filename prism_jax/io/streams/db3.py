"""ROS 2 bags in SQLite: .db3 files of rosbag2's own storage."""

import contextlib
import os
import sqlite3
import struct
import urllib.parse
from collections.abc import Collection, Iterator

from prism_jax.io.errors import InputError
from prism_jax.io.streams.messages import (
    CutError,
    Message,
    MessageFile,
    Topic,
    full_name,
)

MAGIC = b"SQLite format 3\0"


class Db3File(MessageFile):
    """Messages of a .db3 file, in the order in which they were written."""

    def topics(self) -> dict[str, Topic]:
        with self._connected() as database:
            rows = self._topics(database)
        return {
            name: Topic(full_name(kind), encoding, count)
            for name, kind, encoding in rows.values()
            if (count := self._count(name))
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
                    if number in names:
                        yield Message(names[number], time, data)
            except sqlite3.DatabaseError as error:
                raise CutError(f"it is damaged ({error})") from None

    def _count(self, topic: str) -> int:
        """How many messages there are of a topic; of a file that is cut, whole ones."""
        counted = "SELECT COUNT(*) FROM messages WHERE topic_id IN "
        named = "(SELECT id FROM topics WHERE name = ?)"
        count = 0
        try:
            if self._is_whole():
                with self._connected() as database:
                    return database.execute(counted + named, [topic]).fetchone()[0]
            for _ in self.messages({topic}):
                count += 1
        except (CutError, sqlite3.DatabaseError):
            pass  # which iterating over the messages tells
        return count

    def _is_whole(self) -> bool:
        """Whether the file is as long as its header says."""
        with open(self.path, "rb") as file:
            header = file.read(32)
            size = os.fstat(file.fileno()).st_size
        if len(header) < 32:
            return False
        (page,) = struct.unpack_from(">H", header, 16)
        (count,) = struct.unpack_from(">I", header, 28)
        return size >= count * (65536 if page == 1 else page)

    @contextlib.contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        with self.opened(MAGIC, "a ROS 2 bag in SQLite"):
            pass
        place = urllib.parse.quote(str(self.path.absolute()))
        # Iterating goes on in the thread that reads ahead.
        database = sqlite3.connect(
            f"file:{place}?mode=ro", uri=True, check_same_thread=False
        )
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
            return {number: tuple(rest) for number, *rest in database.execute(asked)}
        except sqlite3.DatabaseError as error:
            fault = f"is not a ROS 2 bag ({error})"
            raise InputError(self.path, fault, "check how it was recorded") from None
