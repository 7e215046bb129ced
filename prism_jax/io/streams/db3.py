"""ROS 2 bags in SQLite: .db3 files of rosbag2's own storage."""

import contextlib
import sqlite3
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
            counts = dict.fromkeys(rows, 0)
            try:
                counted = "SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"
                counts.update(database.execute(counted).fetchall())
            except sqlite3.DatabaseError:
                with contextlib.suppress(sqlite3.DatabaseError):
                    for (number,) in database.execute("SELECT topic_id FROM messages"):
                        counts[number] = counts.get(number, 0) + 1
        return {
            name: Topic(full_name(kind), encoding, counts[number])
            for number, (name, kind, encoding) in rows.items()
            if counts[number]
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
