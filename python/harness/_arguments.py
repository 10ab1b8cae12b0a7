"""Checks of arguments, with errors that name the argument."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any


def integer(argument: str, value: Any) -> int:
    """Returns an integer of any type, of at most 64 bits.

    Raises:
        TypeError: it is none.
        ValueError: it is too large.
    """
    try:
        number = int(operator.index(value))
    except TypeError:
        raise TypeError(f"{argument}: {value!r} must be an integer") from None
    if not -(2**63) <= number < 2**64:
        raise ValueError(f"{argument}: {number} must fit into 64 bits")
    return number


def name_tuple(names: str | Iterable[str]) -> tuple[str, ...]:
    """Returns names, or a single name, as a tuple. Raises TypeError for other values."""
    if not isinstance(names, Iterable):
        raise TypeError(f"{names!r} must be a name, or a list of names")
    return (names,) if isinstance(names, str) else tuple(names)
