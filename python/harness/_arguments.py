"""Checks of arguments, with errors that name the argument."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any


def integer(argument: str, value: Any) -> int:
    """Returns an integer of any type. Raises TypeError for other values."""
    try:
        return int(operator.index(value))
    except TypeError:
        raise TypeError(f"{argument}: {value!r} must be an integer") from None


def name_tuple(names: str | Iterable[str]) -> tuple[str, ...]:
    """Returns names, or a single name, as a tuple."""
    return (names,) if isinstance(names, str) else tuple(names)
