# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and ROS 2, and MCAP files, read message by message with rosbags (pure Python, no ROS)."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slamdepth.errors import DatasetError, SlamdepthError
from slamdepth.typing import Floats

ENDINGS = (".bag", ".mcap", ".db3")
_SKIPPED_AT_MOST = 50
"""Messages that are read over rather than looked for in the index."""
_LEAST_STAMPED = 0.9
"""Share of stamps that must be set and increase; else the times of the recorder are taken."""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, its message type with three parts, and how many messages it has."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class TopicIndex:
    """Where the messages of a topic are, in order of their stamps.

    Attributes:
        times_s: ``(N,)`` strictly increasing: stamps of the headers, or of the recorder.
        positions: ``(N,)`` place of each in the order of the bag.
        bag_ns: ``(M,)`` the recorder's times of all messages, in the order of the bag.
        notes: what was dropped or assumed, one line each.
    """

    times_s: Floats
    positions: Any
    bag_ns: Any
    notes: tuple[str, ...]


class BagFile:
    """A bag that is open for reading.

    Attributes:
        path: the file, or the folder of a ROS 2 bag.
        topics: by name.

    Raises:
        DatasetError: rosbags is not installed, or the bag is damaged or not indexed; says what to do.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._told():
            self._reader = self._opened()
            self.topics = {
                name: Topic(name, info.msgtype or "", int(info.msgcount))
                for name, info in self._reader.topics.items()
            }

    def first(self, topic: str) -> Any:
        """The first message of a topic; None where it has none.

        Raises:
            DatasetError: the bag is damaged there.
        """
        return next(self.messages(topic), None)

    def messages(self, topic: str, start_ns: int | None = None) -> Iterator[Any]:
        """The messages of a topic in the order of the bag.

        Args:
            start_ns: the recorder's time of the first one; None: all.

        Raises:
            DatasetError: the bag is damaged.
        """
        with self._told():
            for connection, _, raw in self._reader.messages(self._connections(topic), start=start_ns):
                yield self._reader.deserialize(raw, connection.msgtype)

    def index(self, topic: str) -> TopicIndex:
        """Times and places of the messages of a topic; reads all of them once and keeps none.

        Raises:
            DatasetError: the bag is damaged, or the topic has no message.
        """
        bag_ns: list[int] = []
        stamps_ns: list[int] = []
        with self._told():
            for _, time_ns, raw in self._reader.messages(self._connections(topic)):
                bag_ns.append(time_ns)
                stamps_ns.append(_stamp_ns(raw, is_cdr=self._reader.is2))
        if not bag_ns:
            raise DatasetError(f"{self.path}: topic {topic} has no messages")
        recorded, stamps = np.array(bag_ns, np.int64), np.array(stamps_ns, np.int64)
        times_ns, notes = stamps, list[str]()
        if not _are_usable(stamps):
            times_ns = recorded
            notes.append(f"{topic}: stamps are not set; times are those of the recorder")
        order = np.argsort(times_ns, kind="stable")
        keep = np.concatenate([[True], np.diff(times_ns[order]) > 0])
        if not keep.all():
            notes.append(f"{topic}: {np.count_nonzero(~keep)} messages repeat a time and are left out")
        positions = order[keep]
        return TopicIndex(times_ns[positions] / 1e9, positions, recorded, tuple(notes))

    def reader_of(self, topic: str, index: TopicIndex) -> TopicReader:
        """Reads single messages of a topic, with a file handle of its own."""
        return TopicReader(BagFile(self.path), topic, index)

    def _connections(self, topic: str) -> list[Any]:
        return [connection for connection in self._reader.connections if connection.topic == topic]

    def _opened(self) -> Any:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise DatasetError(
                f"{self.path}: bags are read with the package rosbags: pip install 'slamdepth[ros]'"
            ) from error
        # Bags of ROS 2 before Iron name the types of their messages without defining them.
        reader = AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Whatever a damaged bag makes rosbags raise becomes one line."""
        try:
            yield
        except SlamdepthError:
            raise
        except Exception as error:  # of SQLite, LZ4, Zstandard, struct, assertions, ...
            why = " ".join(f"{error}".split())[:200] or type(error).__name__
            raise DatasetError(
                f"{self.path}: this bag cannot be read ({why}); {_repair(self.path)}"
            ) from error


class TopicReader:
    """Single messages of a topic, fast in their order.

    Several threads may read, one at a time.
    """

    def __init__(self, bag: BagFile, topic: str, index: TopicIndex) -> None:
        self._bag, self._topic, self._index = bag, topic, index
        self._lock = threading.Lock()
        self._messages: Iterator[Any] = iter(())
        self._next = -1

    def read(self, number: int) -> Any:
        """The message ``number`` in order of :attr:`TopicIndex.times_s`.

        Raises:
            DatasetError: the bag is damaged there.
        """
        position = int(self._index.positions[number])
        with self._lock:
            if not self._next <= position <= self._next + _SKIPPED_AT_MOST or self._next < 0:
                start_ns = int(self._index.bag_ns[position])
                # Several messages may have been recorded at one time.
                self._next = int(np.searchsorted(self._index.bag_ns, start_ns, side="left"))
                self._messages = self._bag.messages(self._topic, start_ns)
            while True:
                message = next(self._messages, None)
                self._next += 1
                if message is None:
                    self._next = -1
                    raise DatasetError(f"{self._bag.path}: {self._topic} ends before message {number}")
                if self._next == position + 1:
                    return message


def _stamp_ns(raw: Any, *, is_cdr: bool) -> int:
    """Nanoseconds of the stamp of a message that begins with a header; 0 where it is too short."""
    data = bytes(raw[:12])
    if len(data) < 12:
        return 0
    # CDR begins with its representation, of which the second byte tells the order; ROS 1 with a counter.
    order: Literal["big", "little"] = "big" if is_cdr and not data[1] & 1 else "little"
    return int.from_bytes(data[4:8], order) * 1_000_000_000 + int.from_bytes(data[8:12], order)


def _are_usable(stamps: Any) -> bool:
    if np.count_nonzero(stamps > 0) < len(stamps):
        return False
    return bool(np.count_nonzero(np.diff(stamps) > 0) >= _LEAST_STAMPED * (len(stamps) - 1))


def _repair(path: Path) -> str:
    name = shlex.quote(str(path))
    if path.suffix == ".bag":
        return f"if it is damaged or was not closed, try: rosbag reindex {name}"
    if path.suffix == ".mcap":
        return f"if it is damaged or was not closed, try: mcap recover {name} -o recovered.mcap"
    folder = shlex.quote(str(path if path.is_dir() else path.parent))
    return f"if it is damaged or was not closed, try: ros2 bag reindex {folder}"
