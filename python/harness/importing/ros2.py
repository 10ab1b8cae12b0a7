"""Reads ROS 2 bags (folders, MCAP and SQLite files), and ROS 1 bags."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path, PosixPath
from typing import Any

import numpy as np

from .mapping import Mapping, MappingError, StreamSettings
from .streams import Stream, Take, View, blaming, needing, seconds, sources

SUFFIXES = (".mcap", ".db3", ".bag")
MARKS = ("metadata.yaml",)
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
JOINT_STATE = "sensor_msgs/msg/JointState"
OF_EACH_JOINT = ("position", "velocity", "effort")
"""The fields of a sensor_msgs/JointState that have a value of each joint in its field `name`."""
NAMES = ("name", "names", "joint_names")
"""Fields that name the elements of a message's other fields."""
ENCODINGS = {
    "rgb8": ("RGB", 3),
    "bgr8": ("BGR", 3),
    "8UC3": ("BGR", 3),
    "rgba8": ("RGB", 4),
    "bgra8": ("BGR", 4),
    "8UC4": ("BGR", 4),
    "mono8": ("L", 1),
    "8UC1": ("L", 1),
    "mono16": ("L", 1),
    "16UC1": ("L", 1),
    "32FC1": ("L", 1),
}
"""The order of the channels and their number, for each encoding of a sensor_msgs/Image that can be read."""
DEPTHS = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
"""The types of the numbers that are not of 8 bits."""
PNG = b"\x89PNG"
"""What the picture begins with in a compressed depth, after a header."""


def takes(mapping: Mapping) -> list[Callable[[], Iterator[Take]]]:
    """Returns what yields the takes of each bag: one, or one of each value of the topic `episode`."""
    first: dict[str, BagStream] = {}
    return [partial(_takes_of, mapping, path, first) for path in sources(mapping, SUFFIXES, MARKS, ("*.mcap", "*.db3"))]


def _takes_of(mapping: Mapping, path: Path, first: dict[str, BagStream]) -> Iterator[Take]:
    """Yields the takes of a bag. `first` has the streams of the first bag, or gets them.

    Raises:
        MappingError: the bag is damaged, or does not fit the mapping.
    """
    assert mapping.sampling
    topic = mapping.sampling.divided_by.get("episode")
    terms = [term for selection in mapping.selections.values() for term in selection.terms]
    with opened(path) as bag:
        streams = {
            name: BagStream(bag, settings, terms, first.get(name))
            for name, settings in mapping.sampling.streams.items()
        }
        first.update({} if first else streams)
        yield from [Take(str(path), {**streams})] if topic is None else _by_topic(bag, streams, topic)


def _by_topic(bag: Bag, streams: dict[str, BagStream], topic: str) -> Iterator[Take]:
    """Yields a take for each value of a topic, which lasts from its first message to the first with another value.

    The bag's own times divide the streams, because the messages of such topics seldom have a header.
    """
    connection = bag.connection(topic, "episode")
    starts: list[tuple[int, Any]] = []
    for received, message in bag.messages(connection):
        value = getattr(message, "data", None)
        if value is None or not np.isscalar(value):
            raise MappingError(
                f"{bag.path}: {topic}: is a {connection.msgtype}; a topic 'episode' has one value 'data'"
            )
        if not starts or starts[-1][1] != value:
            starts.append((received, value))
    bounds = [start for start, _ in starts] + [sys.maxsize]
    for index, (_, value) in enumerate(starts):
        own: dict[str, Stream] = {}
        for name, stream in streams.items():
            inside = (stream.arrivals >= bounds[index]) & (stream.arrivals < bounds[index + 1])
            own[name] = View(stream, np.flatnonzero(inside))
        yield Take(f"{bag.path}, {topic} {value}", own)


class Bag:
    """An opened bag."""

    def __init__(self, path: Path, reader: Any):
        self.path, self._reader = path, reader
        self._begun: list[Any] = []

    def close(self) -> None:
        """Ends what is still being read. Otherwise, the bag's database could not be closed."""
        for messages in self._begun:
            messages.close()

    @property
    def connections(self) -> list[Any]:
        """The topics with their types."""
        found: list[Any] = self._reader.connections
        return found

    def connection(self, topic: str, key: str) -> Any:
        """Returns a topic, for a key of the mapping.

        Raises:
            MappingError: the bag does not have it, or with messages of several types.
        """
        found = [each for each in self.connections if each.topic == topic]
        if not found:
            names = ", ".join(sorted({each.topic for each in self.connections}))
            raise MappingError(f"{self.path}: there is no topic '{topic}' for {key}; the topics are {names}")
        if len({each.msgtype for each in found}) > 1:
            raise MappingError(f"{self.path}: {topic}: has messages of several types")
        return found[0]

    def raw(self, connection: Any, start: int | None = None, stop: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yields when each message of a topic was received, ns, and its bytes."""
        same = [each for each in self.connections if each.topic == connection.topic]
        with blaming(f"{self.path}: {connection.topic}"):
            messages = self._reader.messages(same, start=start, stop=stop)
            self._begun.append(messages)
        index = 0
        while True:
            with blaming(f"{self.path}: {connection.topic}: message {index}"):
                found = next(messages, None)
            if found is None:
                self._begun.remove(messages)
                return
            yield found[1], found[2]
            index += 1

    def messages(
        self, connection: Any, start: int | None = None, stop: int | None = None, first: int = 0
    ) -> Iterator[tuple[int, Any]]:
        """Yields when each message of a topic was received, ns, and the message. `first` is the number of the first."""
        for index, (received, data) in enumerate(self.raw(connection, start, stop), first):
            with blaming(f"{self.path}: {connection.topic}: message {index}"):
                message = self._reader.deserialize(data, connection.msgtype)
            yield received, message


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Opens a bag. Types that the bag does not define are those of ROS 2 Humble.

    Raises:
        MappingError: it is no bag, or damaged.
        ImportError: the package rosbags is not installed.
    """
    with needing("rosbags", "ROS 2 bags"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    with contextlib.ExitStack() as stack:
        with blaming(str(path)):
            types = get_typestore(Stores.ROS2_HUMBLE)
            reader = stack.enter_context(AnyReader([_BagPath(path)], default_typestore=types))
        bag = Bag(path, reader)
        stack.callback(bag.close)
        yield bag


class _BagPath(PosixPath):
    """A path in whose text `%`, `?` and `#` are escaped by format(), because rosbags formats it into an SQLite URI."""

    def __format__(self, _: str) -> str:
        return str(self).replace("%", "%25").replace("?", "%3f").replace("#", "%23")


class BagStream(Stream):
    """The messages of a topic. A message's numbers are columns, called by the names of its fields.

    The values of a JointState are in the order of the first message of the first bag, whatever the order in others.
    """

    def __init__(self, bag: Bag, settings: StreamSettings, terms: list[str], first_bag: BagStream | None):
        """Reads the times of a topic. `terms` are those of the mapping, and `first_bag` is the first bag's stream."""
        topic = settings.where["topic"]
        self.place, self._bag = f"{bag.path}: {topic}", bag
        self._names: Any = first_bag._names if first_bag else None
        """The names of the elements in the first message of the first bag."""
        self._named_by: str = first_bag._named_by if first_bag else self.place
        self._connection = bag.connection(topic, f"streams.{settings.name}.topic")
        self._prefix = f"{settings.name}."
        which = settings.where.get("time", "header")
        self._frame_id = settings.where.get("frame_id")
        received, stamps = [], []
        first = None
        joints: dict[str, None] = {}
        frames: set[str] = set()
        for row, (time, message) in enumerate(self._own(bag.messages(self._connection), frames)):
            if first is None:
                first = message
                self._names = self._names if first_bag else _names(message)
            if self._connection.msgtype == JOINT_STATE:
                joints |= dict.fromkeys(message.name)
            elif _names(message) != self._names:
                raise self._other_names(row, _names(message))
            received.append(time)
            header = getattr(message, "header", None)
            if which == "header" and header is not None:
                stamps.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
                # The clock of a simulation begins at 0.
                if stamps[-1] == 0 and row > 0:
                    raise MappingError(
                        f"{self.place}: message {row}: its header has no time; say 'time: received' in streams."
                        f"{settings.name} to use the times at which the bag received the messages"
                    )
        if first is None and frames:
            raise MappingError(
                f"{self.place}: no message has the frame_id '{self._frame_id}'; there are {', '.join(sorted(frames))}"
            )
        if first is None:
            raise MappingError(f"{self.place}: holds no messages")
        self.arrivals = np.array(received, np.int64)
        """int64 [rows], ns: when the bag received each message."""
        self.received = self.arrivals if stamps else None
        self.times = np.array(stamps, np.int64) if stamps else self.arrivals
        self.is_picture = self._connection.msgtype in (IMAGE, COMPRESSED)
        self.columns = [settings.name] if self.is_picture else self._columns(first, terms, list(joints))
        self._block: tuple[int, int, list[Any]] = (0, 0, [])

    def _own(self, messages: Iterator[tuple[int, Any]], frames: set[str]) -> Iterator[tuple[int, Any]]:
        """Yields the messages of the stream's frame, or all. Adds the frames of the others to a set."""
        for time, message in messages:
            frame = getattr(getattr(message, "header", None), "frame_id", "")
            if self._frame_id in (None, frame):
                yield time, message
            else:
                frames.add(frame)

    def _columns(self, message: Any, terms: list[str], joints: list[str]) -> list[str]:
        found = [f"{self._prefix}{path}" for path in fields(message)]
        if found == [f"{self._prefix}data"]:
            return [self._prefix.rstrip(".")]
        # Other patterns, such as `STREAM.*`, would otherwise match each value twice.
        chosen = [each for each in found if any(term.startswith(f"{each}.") for term in terms)]
        return found + [f"{field}.{joint}" for field in chosen for joint in joints]

    def _other_names(self, row: int, names: Any) -> MappingError:
        hint = ""
        if self._connection.msgtype == JOINT_STATE:
            term = f"{self._prefix}position.{names[0] if names else 'JOINT'}"
            hint = f"; select joints by their names, such as {term}, with 'missing: skip' if a message has only some"
        return MappingError(
            f"{self.place}: message {row}: its names are {names}, and those of message 0 {self._names} in "
            f"{self._named_by}; a stream must have the same in all messages{hint}"
        )

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        if self.is_picture:
            raise MappingError(f"{self.place}: '{column}' holds pictures, no numbers; give the modality a size")
        path = column.removeprefix(self._prefix) if column.startswith(self._prefix) else "data"
        values: list[np.ndarray] = []
        for row, message in enumerate(self._messages(first, last), first):
            numbers = self._numbers(message, path, row)
            if values and len(numbers) != len(values[0]):
                raise MappingError(
                    f"{self.at(row)}: '{column}' has {len(numbers)} values, and {len(values[0])} in message {first}"
                )
            values.append(numbers)
        return np.array(values, np.float64)

    def _numbers(self, message: Any, path: str, row: int) -> np.ndarray:
        """Returns the numbers of a field, or of one joint in it, float64 [numbers]."""
        field, _, joint = path.partition(".")
        by_joint = self._connection.msgtype == JOINT_STATE and field in OF_EACH_JOINT
        value = message
        for name in [field] if by_joint else path.split("."):
            value = getattr(value, name)
        numbers = flattened(value)
        # A list that is empty in this message has no numbers.
        numbers = np.zeros(0) if numbers is None else numbers
        if not by_joint:
            return numbers
        names = message.name
        if joint:
            place = names.index(joint) if joint in names else len(numbers)
            return numbers[place : place + 1] if place < len(numbers) else np.array([np.nan])
        if names == self._names:
            return numbers
        if sorted(names) != sorted(self._names) or len({*names}) < len(names):
            raise self._other_names(row, names)
        return numbers[[names.index(each) for each in self._names]] if len(numbers) == len(names) else numbers

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        if not self.is_picture:
            raise MappingError(f"{self.place}: holds no pictures, but {self._connection.msgtype}")
        first, wanted = int(rows[0]), set(rows.tolist())
        for row, message in enumerate(self._range(first, int(rows[-1]) + 1), first):
            if row in wanted:
                yield self._picture(message, row)

    def _messages(self, first: int, last: int) -> list[Any]:
        """Returns the messages of some rows, and keeps them for the other columns."""
        if self._block[:2] != (first, last):
            self._block = (first, last, list(self._range(first, last)))
        return self._block[2]

    def _range(self, first: int, last: int) -> Iterator[Any]:
        start, stop = int(self.arrivals[first]), int(self.arrivals[last - 1]) + 1
        # Several messages may have been received at once.
        before = int(np.searchsorted(self.arrivals, start))
        messages = self._own(self._bag.messages(self._connection, start, stop, before), set())
        for row, (_, message) in enumerate(messages, before):
            if first <= row < last:
                yield message

    def _picture(self, message: Any, row: int) -> Any:
        if self._connection.msgtype == COMPRESSED:
            file: bytes = message.data.tobytes()
            if "compressedDepth" in message.format:
                if not message.format.startswith("16UC1") or PNG not in file[:64]:
                    raise MappingError(
                        f"{self.at(row)}: has the format '{message.format}'; compressed depths can be read as "
                        "16UC1 in PNG"
                    )
                return file[file.index(PNG) :]
            return file
        if message.encoding not in ENCODINGS:
            raise MappingError(
                f"{self.at(row)}: has the encoding '{message.encoding}'; those that can be read are "
                f"{', '.join(ENCODINGS)}"
            )
        order, channels = ENCODINGS[message.encoding]
        kind = np.dtype(DEPTHS.get(message.encoding, "u1"))
        data, wide = np.asarray(message.data), message.width * channels * kind.itemsize
        if message.step < wide or len(data) < message.step * message.height or not wide * message.height:
            raise MappingError(
                f"{self.at(row)}: has {len(data)} bytes for {message.height} x {message.width} pixels of {channels}"
            )
        picture = data[: message.step * message.height].reshape(message.height, message.step)[:, :wide]
        if channels == 1:
            return np.ascontiguousarray(picture).view(kind.newbyteorder(">" if message.is_bigendian else "<"))
        picture = picture.reshape(message.height, message.width, channels)[..., :3]
        return np.ascontiguousarray(picture if order == "RGB" else picture[..., ::-1])

    def at(self, row: int) -> str:
        return f"{self.place}: message {row}, received at {seconds(self.arrivals[row])} s"


def _names(message: Any) -> Any:
    """Returns the names of a message's elements, or None if it has none."""
    return next((getattr(message, field) for field in NAMES if hasattr(message, field)), None)


def fields(message: Any) -> list[str]:
    """Returns the paths of a message's fields that consist of numbers, such as `position` or `wrench.force`."""
    found = []
    for name in getattr(message, "__dataclass_fields__", {}):
        value = getattr(message, name)
        if name in ("header", "layout") or name.startswith("__"):
            continue
        if flattened(value) is not None:
            found.append(name)
        found += [f"{name}.{inner}" for inner in fields(value)]
    return found


def flattened(value: Any) -> np.ndarray | None:
    """Returns the numbers of a field in the order of its definition, float64 [numbers]; None if it holds others."""
    if isinstance(value, bool | int | float | np.number | np.bool_):
        return np.array([value], np.float64)
    if isinstance(value, np.ndarray):
        return value.reshape(-1).astype(np.float64) if value.dtype.kind in "biuf" else None
    if isinstance(value, list | tuple):
        parts = [flattened(each) for each in value]
    elif hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("__")]
        parts = [flattened(getattr(value, name)) for name in names]
    else:
        return None
    if not parts or any(part is None for part in parts):
        return None
    return np.concatenate([part for part in parts if part is not None])
