"""Episodes of a dataset from the columns of a recording."""

from __future__ import annotations

import itertools
from dataclasses import replace
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from PIL import Image

from harness.recorded import Episode

from .alignment import Pictures
from .mapping import Columns, Look, Mapping, MappingError, Selection
from .pictures import is_file, shown

SHARE_FRAMES = 100
"""After how many frames the progress is told."""


def episode_of(
    index: int, columns: Columns, mapping: Mapping, rate: float, advance: Callable[[float], None]
) -> Episode:
    """Returns an episode.

    Args:
        index: its number.
        columns: the values of its columns, [samples, …].
        mapping: which columns are which modality.
        rate: samples per second.
        advance: is told each share of the episode that is done, from 0 to 1.

    Raises:
        MappingError: it is too short, or a value does not fit its modality.
    """
    selections, shift = mapping.selections, mapping.shift
    first = next(iter(selections.values())).columns(list(columns))[0]
    rows = len(columns[first])
    samples = rows - shift
    if samples < 2:
        left_out = " after its first row, which is left out" if shift else ""
        noun = "sample" if samples == 1 else "samples"
        raise MappingError(
            f"it has {samples} {noun}{left_out}; it must have 2 or more; 'bad_episodes: skip' leaves out such episodes"
        )
    vectors = {name: each.pick(columns) for name, each in selections.items() if each.size is None}
    elements = {name: selections[name].elements(columns, values.shape[1]) for name, values in vectors.items()}
    vectors = {name: values[:samples] if name == "setpoint" else values[shift:] for name, values in vectors.items()}
    images = {}
    with_size = [(name, selection) for name, selection in selections.items() if selection.size is not None]
    for name, selection in with_size:
        pictures = columns[selection.column_of_pictures(list(columns))]
        if isinstance(pictures, Pictures):
            # They know the place of each picture for messages.
            pictures = replace(pictures, look=selection.look)
            selection = replace(selection, look=Look())

        def tell(share: float) -> None:
            advance(share / len(with_size))

        images[name] = _frames(itertools.islice(pictures, shift, None), samples, selection, tell)
    if not images:
        advance(1.0)
    return Episode(index, np.arange(samples) / rate, vectors, images, elements=elements)


def _frames(
    pictures: Iterable[Any], samples: int, selection: Selection, advance: Callable[[float], None]
) -> np.ndarray:
    """Returns pictures as RGB pixels, uint8 [samples, rows, columns, 3]. Converts a repeated picture once."""
    assert selection.size
    shape = (*selection.size, 3)
    frames = np.empty((samples, *shape), np.uint8)
    previous, told = None, 0
    for sample, picture in enumerate(pictures):
        frames[sample] = frames[sample - 1] if sample and picture is previous else _frame(picture, selection, shape)
        previous = picture
        if sample + 1 - told == SHARE_FRAMES or sample + 1 == samples:
            advance((sample + 1 - told) / samples)
            told = sample + 1
    return frames


def _frame(picture: Any, selection: Selection, shape: tuple[int, int, int]) -> np.ndarray:
    """Returns a picture as RGB pixels of this shape. It may be an array, raw bytes, or the bytes of an image file."""
    if isinstance(picture, dict):
        picture = picture.get("bytes")
    if isinstance(picture, bytes):
        if len(picture) == np.prod(shape) and not is_file(picture):
            picture = np.frombuffer(picture, np.uint8).reshape(shape)
    try:
        image = Image.fromarray(shown(picture, selection.look)).convert("RGB")
    except (TypeError, ValueError) as error:
        raise selection.error(f"a value {error}") from None
    height, width, _ = shape
    # Each new pixel is the mean of the pixels that it covers.
    is_whole = image.size == (width, height)
    return np.asarray(image if is_whole else image.resize((width, height), Image.Resampling.BOX))
