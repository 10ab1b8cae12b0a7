"""Labels of episodes: what was the same during a trial, such as the object that was touched."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping as Labels
from pathlib import Path
from typing import Any

import polars as pl

from .categories import slug
from .mapping import NAME, Mapping, MappingError

TRIAL = "trial"
"""The label that every episode has: the name of its file, folder or group, or the value that divides a file."""
TAKEN = ("dataset", "scenario", "episode", "sample", "time")
"""Columns of the table `episodes`, which no label can be called."""
KINDS = {"": (str, r".+?"), "int": (int, r"[+-]?\d+"), "float": (float, r"[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")}
"""What a part of a name may be, as in `{n:int}`, and how it is read."""
PART = ", part "
"""What is before the number of a part that begins where the time of a trial goes back."""
_PART = re.compile(r"\{(\w+)(?::(\w+))?\}")


class Labeling:
    """The keys `trial` and `episodes` of a mapping: labels from the names of trials, and from a table beside them."""

    def __init__(self, mapping: Mapping):
        self.pattern = mapping.text.get(TRIAL)
        self.folder = mapping.source if mapping.source.is_dir() else mapping.source.parent
        self.kinds: dict[str, Any] = {}
        self.expression = self._compiled(self.pattern) if self.pattern else None
        path = mapping.text.get("episodes", "")
        self.path = mapping.folder / path if str(path).endswith(".csv") else None
        self.table = None if self.path is None else _read(self.path)

    def _compiled(self, pattern: str) -> re.Pattern[str]:
        expression, end = "", 0
        for part in _PART.finditer(pattern):
            name, kind = part[1], part[2] or ""
            if kind not in KINDS or not NAME.fullmatch(name) or name in self.kinds or name in TAKEN:
                raise MappingError(
                    f"trial: {part[0]} is not understood; write {{object}}, {{n:int}} or {{mass:float}}, each with "
                    f"another name of lower-case letters, digits and _, and none of {', '.join(TAKEN)}"
                )
            self.kinds[name], group = KINDS[kind]
            expression += f"{re.escape(pattern[end : part.start()])}(?P<{name}>{group})"
            end = part.end()
        if not self.kinds:
            raise MappingError(f"trial: '{pattern}' names no part, such as {{object}} in '{{object}}_{{n:int}}.csv'")
        return re.compile(expression + re.escape(pattern[end:]))

    def of(self, place: str, own: Labels[str, Any]) -> dict[str, Any]:
        """Returns the labels of a trial.

        Args:
            place: where it is.
            own: labels that the recording itself has.

        Raises:
            MappingError: its name does not match the pattern, or the table has not exactly one row for it.
        """
        name = place.removeprefix(f"{self.folder}/")
        name = name.removesuffix(".gz")
        name, part = name.rsplit(PART, 1) if PART in name else (name, "")
        plain = str(Path(name).with_suffix("")) if re.search(r"\.[A-Za-z]\w*$", name) else name
        labels: dict[str, Any] = {TRIAL: plain + (PART + part if part else "")} | {
            slug(key).lower(): value for key, value in own.items()
        }
        if self.expression:
            found = self.expression.fullmatch(name) or self.expression.fullmatch(plain)
            if not found:
                raise MappingError(f"trial: '{name}' does not match '{self.pattern}'")
            labels |= {key: self.kinds[key](text) for key, text in found.groupdict().items()}
        if self.table is not None:
            labels |= self._row(name, labels)
        return {key: value for key, value in labels.items() if key not in TAKEN and NAME.fullmatch(key)}

    def _row(self, name: str, labels: dict[str, Any]) -> dict[str, Any]:
        """Returns the row of the table for a trial."""
        assert self.table is not None
        keys = [key for key in self.table.columns if key in labels]
        if not keys:
            raise MappingError(
                f"{self.path}: needs a column by which its rows are those of the trials: {', '.join(labels)}; its "
                f"columns are {', '.join(self.table.columns)}"
            )
        given = {key: {str(labels[key]), name} if key == TRIAL else {str(labels[key])} for key in keys}
        is_it = [pl.col(key).cast(pl.String).is_in(list(values)) for key, values in given.items()]
        rows = self.table.filter(*is_it)
        if rows.height != 1:
            wanted = ", ".join(f"{key} {labels[key]}" for key in keys)
            raise MappingError(f"{self.path}: has {rows.height} rows for the trial with {wanted}; it needs one")
        return {key: value for key, value in rows.row(0, named=True).items() if key not in keys}


def number(key: str, value: float | str, labels: Labels[str, Any]) -> float:
    """Returns the number of a key of a mapping, or that of the label that it names.

    Raises:
        MappingError: there is no such label, or it has no number.
    """
    if not isinstance(value, str):
        return float(value)
    if value not in labels:
        raise MappingError(f"{key}: there is no label '{value}'; the labels are {', '.join(labels)}")
    found = labels[value]
    if isinstance(found, bool) or not isinstance(found, int | float) or not math.isfinite(found):
        raise MappingError(f"{key}: the label '{value}' of trial {labels[TRIAL]} is {found}, which is no number")
    return float(found)


def _read(path: Path) -> pl.DataFrame:
    try:
        table = pl.read_csv(path, glob=False, infer_schema_length=None)
    except FileNotFoundError:
        raise FileNotFoundError(f"episodes: {path} is not there") from None
    except (pl.exceptions.PolarsError, OSError) as error:
        raise MappingError(f"{path}: can't be read: {' '.join(str(error).split())}") from None
    names = {name: slug(name).lower() for name in table.columns}
    for name, short in names.items():
        if not NAME.fullmatch(short) or short in TAKEN or list(names.values()).count(short) > 1:
            raise MappingError(f"{path}: the column '{name}' can't name a label; give it another name")
    return table.rename(names)


def unified(labels: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, str]]]:
    """Returns the labels of all episodes with values of one kind for each, and their names with these kinds."""
    names = list(dict.fromkeys(name for each in labels for name in each))
    kinds: dict[str, str] = {}
    for name in names:
        values = [each[name] for each in labels if each.get(name) is not None]
        is_number = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
        is_whole = all(isinstance(value, int) for value in values)
        kinds[name] = "integer" if is_number and is_whole else "real" if is_number else "text"
    convert = {"integer": int, "real": float, "text": str}

    def value(each: dict[str, Any], name: str) -> Any:
        return None if each.get(name) is None else convert[kinds[name]](each[name])

    unified = [{name: value(each, name) for name in names} for each in labels]
    return unified, [{"name": name, "kind": kind} for name, kind in kinds.items()]
