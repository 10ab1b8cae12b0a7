"""Reads the frames of videos and of folders of images."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from .mapping import MappingError
from .streams import Stream, blaming, nanoseconds, natural, needing

VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm")
TIME = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
"""What an image is called whose name is its time."""
IMAGES = (".bmp", ".jpeg", ".jpg", ".png", ".ppm", ".tif", ".tiff", ".webp")


class Folder(Stream):
    """A folder of images. Each file is a row, in the order of the names, in which numbers count as numbers."""

    def __init__(self, name: str, path: Path):
        self.place, self.columns = str(path), [name]
        self.files = sorted((file for file in path.iterdir() if file.suffix.lower() in IMAGES), key=natural)
        self.times = np.zeros(0, np.int64)
        if not self.files:
            raise MappingError(f"{path}: holds no image: no file that ends in {', '.join(IMAGES)}")

    @property
    def count(self) -> int:
        """Number of images."""
        return len(self.files)

    def times_in_names(self, unit: int) -> np.ndarray:
        """Returns the times by which the files are called, int64 [rows], ns.

        Raises:
            MappingError: a name is no number. Python's `float` would also take 1_5.
        """
        for file in self.files:
            if not TIME.fullmatch(file.stem):
                raise MappingError(f"{file}: the file is not called by a time")
        whole = all(file.stem.isdecimal() for file in self.files)
        values = [int(file.stem) if whole else float(file.stem) for file in self.files]
        # In the order of the names, 0.25 comes before 0.5, but -1 after 0.
        order = np.argsort(values, kind="stable")
        self.files = [self.files[index] for index in order]
        return nanoseconds(np.array(values)[order], unit, self.at)

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        raise MappingError(f"{self.place}: '{column}' holds pictures, no numbers; give the modality a size")

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        for row in rows.tolist():
            yield self.files[row].read_bytes()

    def at(self, row: int) -> str:
        return str(self.files[row])


class Video(Stream):
    """The frames of a video's first stream of pictures, with the times at which the video shows them."""

    def __init__(self, name: str, path: Path):
        self.path, self.place, self.columns = path, str(path), [name]
        self._row, self._picture = -1, cast(Any, None)
        """The last row that was decoded, and its frame."""
        self._frames = self._decoded()
        with blaming(self.place), _opened(path) as container:
            video = _video(container, path)
            packets = [packet.pts for packet in container.demux(video) if packet.size and not packet.is_discard]
            if None in packets:
                raise MappingError(f"{path}: frame {packets.index(None)}: has no time; use rate_hz or 'times'")
            if not packets:
                raise MappingError(f"{path}: frame 0: the video holds no frames")
            self._stamps = np.sort(np.array(packets, np.int64))
            base = video.time_base
            self.times = np.array([round(stamp * base * 10**9) for stamp in self._stamps.tolist()], np.int64)

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self._stamps)

    def read(self, column: str, first: int, last: int) -> np.ndarray:
        raise MappingError(f"{self.place}: '{column}' holds pictures, no numbers; give the modality a size")

    def pictures(self, column: str, rows: np.ndarray) -> Iterator[Any]:
        for row in rows.tolist():
            if row < self._row:
                self._row, self._frames = -1, self._decoded()
            # An episode may begin with the frame that the one before ended with.
            while self._row < row:
                stamp, self._picture = next(self._frames, (None, None))
                if stamp is None or stamp > self._stamps[row]:
                    raise MappingError(f"{self.at(row)}: can't be decoded; the video is damaged there")
                self._row = row if stamp == self._stamps[row] else self._row
            yield self._array(row)

    def _array(self, row: int) -> np.ndarray:
        components = self._picture.format.components
        # A depth becomes a picture by its range later.
        is_deep = len(components) == 1 and components[0].bits > 8
        with blaming(self.at(row)):
            array: np.ndarray = self._picture.to_ndarray(format="gray16le" if is_deep else "rgb24")
        turns, rest = divmod(self._picture.rotation, 90)
        if rest:
            raise MappingError(
                f"{self.at(row)}: is shown turned by {self._picture.rotation} degrees; turn it by quarters"
            )
        # As players show it.
        return np.rot90(array, turns)

    def _decoded(self) -> Iterator[tuple[int, Any]]:
        decoded = 0
        with _opened(self.path) as container:
            video = _video(container, self.path)
            video.thread_type = "AUTO"
            # Otherwise, the decoder invents what is missing.
            video.codec_context.options = {"err_detect": "explode"}
            frames = container.decode(video)
            while True:
                with blaming(self.at(min(decoded, self.count - 1))):
                    frame = next(frames, None)
                    if frame is None:
                        return
                    if frame.is_corrupt:
                        raise MappingError(f"{self.at(decoded)}: is damaged")
                decoded += 1
                yield frame.pts, frame

    def at(self, row: int) -> str:
        return f"{self.place}: frame {row}, at {self.times[row] / 1e9:.3f} s"


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with needing("av", "videos"):
        import av
    with blaming(str(path)):
        # Otherwise, what is before a colon would be a protocol.
        container = av.open(f"file:{path}")
    with container:
        yield container


def _video(container: Any, path: Path) -> Any:
    if not container.streams.video:
        raise MappingError(f"{path}: holds no stream of pictures")
    return container.streams.video[0]
