"""Categories: values of a finite set, such as objects. A dataset has an element for each, of which one is 1."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np


BOOLEANS = ("false", "true")
"""The texts that are 0 and 1."""


def slug(text: str) -> str:
    """Returns a text with _ in the place of what no name of a column may contain."""
    return re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")


def text_of(value: Any) -> str:
    """Returns the text by which values are compared: that of 3, 3.0 and '3' is the same, and that of true is 1. Empty
    for a missing value."""
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    if value is None or isinstance(value, float | np.floating) and math.isnan(value):
        return ""
    text = str(value).strip()
    if text.lower() in BOOLEANS:
        return str(BOOLEANS.index(text.lower()))
    try:
        number = float(text)
    except ValueError:
        return text
    return f"{number:.12g}" if math.isfinite(number) else text


class CategoryError(ValueError):
    """Raised if values are no categories, or a value is none of them. The message says which."""


@dataclass(frozen=True)
class Categories:
    """A finite set of values, in the order of the elements."""

    texts: tuple[str, ...]
    """The values, as `text_of` returns them."""
    names: tuple[str, ...]
    """The names of the elements."""

    @classmethod
    def of(cls, values: Iterable[Any]) -> Categories:
        """Returns these values as categories.

        Raises:
            CategoryError: there is only one, or the names of two are the same.
        """
        given = [str(value) for value in values]
        names, texts = [slug(value) for value in given], [text_of(value) for value in given]
        if len({*texts}) < 2:
            raise CategoryError(f"the only value is '{given[0]}'; there must be two categories or more")
        for place, (value, name) in enumerate(zip(given, names, strict=True)):
            alike = [
                other for other in range(place) if names[other].lower() == name.lower() or texts[other] == texts[place]
            ]
            if not name or alike:
                others = f"categories '{given[alike[0]]}' and '{value}' are" if alike else f"category '{value}' is"
                raise CategoryError(
                    f"the {others} called '{name}' in columns; letters a to z and digits must tell a category from the others"
                )
        return cls(tuple(texts), tuple(names))

    def numbers(self, values: Any, at: Callable[[int], str], missing: Iterable[float] = ()) -> np.ndarray:
        """Returns the numbers of the values' categories, from 0, float64 [rows]. That of a missing value is NaN, and so
        are those of the numbers that stand for one.

        Raises:
            CategoryError: a row has several values, or one that is no category. `at` returns the place of a row.
        """
        if isinstance(values, np.ndarray) and values.size != len(values):
            raise CategoryError(f"categories are from one value of each row, which has {values.size // len(values)}")
        flat = values.reshape(-1).tolist() if isinstance(values, np.ndarray) else list(values)
        known = {text: float(number) for number, text in enumerate(self.texts)}
        known |= dict.fromkeys(["", *map(text_of, missing)], math.nan)
        numbers = np.empty(len(flat))
        for row, value in enumerate(flat):
            number = known.get(text_of(value))
            if number is None:
                raise CategoryError(
                    f"{at(row)}: '{text_of(value)}' is none of the categories {', '.join(self.texts)}; add it to "
                    "'categories'"
                )
            numbers[row] = number
        return numbers

    def elements(self, numbers: np.ndarray) -> np.ndarray:
        """Returns the elements of categories with these numbers, float32 [rows, categories]."""
        return np.eye(len(self.names), dtype=np.float32)[numbers.astype(np.int64)]
