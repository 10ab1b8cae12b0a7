"""Reads Parquet files, whose rows are the samples."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl

from .alignment import wanted
from .labels import Labeling
from .mapping import UNITS, Columns, Mapping, MappingError, Rows, Selection, with_numbers
from .recording import Recording
from .streams import irregular


def open_parquet(mapping: Mapping, what: Rows) -> Recording:
    """Opens Parquet files.

    Raises:
        MappingError: they can't be read, do not fit the mapping, or their rows are not samples at its rate.
        FileNotFoundError: there is none.
    """
    files = sorted(mapping.source.glob("**/*.parquet")) if mapping.source.is_dir() else [mapping.source]
    if not files:
        raise FileNotFoundError(f"source: {mapping.source} holds no .parquet file")
    keys = list(dict.fromkeys([what.episode, what.order]))
    try:
        table = scanned(files)
        available = table.collect_schema().names()
        for key in keys:
            if key not in available:
                raise MappingError(f"there is no column '{key}'; the columns are {', '.join(available)}")
        columns = wanted(mapping.selections, available)
        _check_order(files, table.select(keys).collect(), what)
        told = [what.episode, *_constant(table, what.episode)]
        rows = table.select(list(dict.fromkeys([*keys, *columns, *told]))).sort(keys).collect()
    except pl.exceptions.PolarsError as error:
        raise MappingError(f"source: {mapping.source} can't be read: {' '.join(str(error).split())}") from None
    groups = rows.partition_by(what.episode, maintain_order=True)
    episodes = (partial(_columns, group, columns, mapping.selections) for group in groups)
    places = [f"{mapping.source}, {what.episode} {group[what.episode][0]}" for group in groups]
    labeling, first = Labeling(mapping), [{name: group[name][0] for name in told} for group in groups]
    labels = [labeling.of(str(each[what.episode]), each) for each in first]
    return Recording(what.sample_rate_hz, len(groups), episodes, places, labels=labels)


def _columns(rows: pl.DataFrame, names: list[str], selections: dict[str, Selection]) -> Columns:
    return with_numbers({name: rows[name].to_list() for name in names}, selections)


def scanned(files: list[Path]) -> pl.LazyFrame:
    """Returns the rows of files, without a meaning for any letter in their paths.

    Raises:
        MappingError: their columns or the columns' types differ.
    """

    def scan(paths: list[Path]) -> pl.LazyFrame:
        return pl.scan_parquet([path.absolute() for path in paths], glob=False, hive_partitioning=False)

    kinds = [scan([path]).collect_schema() for path in files]
    for path, found in zip(files, kinds, strict=True):
        differing = sorted(name for name in {*found, *kinds[0]} if found.get(name) != kinds[0].get(name))
        for name in differing[:1]:
            own, first = (
                f"has '{name}' as {each[name]}" if name in each else f"has no column '{name}'"
                for each in (found, kinds[0])
            )
            raise MappingError(f"{path}: {own}, and {files[0]} {first}; save all files alike")
    return scan(files)


def _constant(table: pl.LazyFrame, episode: str) -> list[str]:
    """Returns the columns of texts that have one value in each episode."""
    texts = [name for name, kind in table.collect_schema().items() if kind == pl.String and name != episode]
    if not texts:
        return []
    counts = table.group_by(episode).agg(pl.col(texts).n_unique()).select(pl.col(texts).max()).collect()
    return [name for name in texts if counts[name][0] == 1]


def _check_order(files: list[Path], keys: pl.DataFrame, what: Rows) -> None:
    """Checks that the rows of each episode are its samples, one after the other at the sample rate.

    Args:
        files: the files.
        keys: the columns `episode` and `order` of all rows, in the order of the files.
        what: the names of these columns, and the sample rate.

    Raises:
        MappingError: they are not.
    """
    for key, name in (("episode", what.episode), ("order", what.order)):
        given = keys[name]
        has_value = given.is_finite().fill_null(False) if given.dtype.is_float() else given.is_not_null()
        for row in (~has_value).arg_true().head(1):
            found = "null" if given[row] is None else given[row]
            raise MappingError(f"{key}: {_at(files, row)}: '{name}' is {found}; every row needs a value of it")
    places = keys.select(pl.arg_sort_by(keys.columns)).to_series()
    keys = keys[places]
    twice = keys.is_duplicated().arg_true()
    if len(twice):
        same = " and ".join(_at(files, places[row]) for row in twice.head(2))
        raise MappingError(f"order: two rows of an episode have the same '{what.order}': {same}")
    values, units = _numbers(keys[what.order])
    episodes = keys[what.episode]
    is_next = (episodes == episodes.shift()).fill_null(False).to_numpy()
    is_whole = (values == np.rint(values)).all()
    periods = _periods(np.diff(values)[is_next[1:]], units, is_whole, what, files[0])
    starts = np.flatnonzero(~is_next).tolist()

    def problem(period: float) -> tuple[int, str] | None:
        # Whole times of another period are rounded, each by up to half of their unit.
        rounding = 1.0 if is_whole and not period.is_integer() else 0.0
        for start, end in itertools.pairwise([*starts, len(values)]):
            if found := irregular(values[start:end], period, rounding):
                return start + found[0], found[1]
        return None

    problems = [problem(period) for period in periods]
    if None not in problems:
        row, how = problems[0]
        raise MappingError(
            f"order: {_at(files, places[row])}: the row with {what.order} {keys[what.order][row]} of episode "
            f"{episodes[row]} {how} at sample_rate_hz {what.sample_rate_hz:g}; each row is a sample, and none may "
            "be missing; if they have times, use 'streams', whose rows are aligned by their times"
        )


def _numbers(order: pl.Series) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns the column `order` as numbers, and the units that they may have if they are times.

    Raises:
        MappingError: it holds something else.
    """
    kind = order.dtype
    if kind.is_integer() or kind.is_float():
        return order.to_numpy(), tuple(UNITS)
    if kind.is_decimal():
        return order.cast(pl.Float64).to_numpy(), tuple(UNITS)
    if isinstance(kind, pl.Datetime | pl.Duration):
        return order.cast(pl.Int64).to_numpy(), (str(kind.time_unit),)
    raise MappingError(
        f"order: '{order.name}' holds {kind}, whose order may be another than that of the rows: as text, 10 comes "
        "before 2; name a column of numbers, of dates with times, or of durations"
    )


def _periods(steps: np.ndarray, units: tuple[str, ...], is_whole: bool, what: Rows, file: Path) -> list[float]:
    """Returns what `order` may grow by from a sample to the next, the nearest first: 1 if it counts them, otherwise
    their period as a time.

    Raises:
        MappingError: it grows by something else.
    """
    if len(steps) == 0:
        return [1.0]
    typical = float(np.median(steps))
    periods = {unit: 1e9 / what.sample_rate_hz / UNITS[unit] for unit in units}
    allowed = [f"{period:g} {unit}" for unit, period in periods.items()]
    if len(units) > 1 and is_whole:
        periods["counter"] = 1.0
    near = [period for period in periods.values() if 1 / 1.5 < typical / period < 1.5]
    if near:
        return sorted(near, key=lambda each: abs(np.log(typical / each)))
    rates = {unit: 1e9 / UNITS[unit] / typical for unit in units}
    fitting = [f"{rate:.4g} if it is in {unit}" for unit, rate in rates.items() if 0.01 <= rate <= 1000]
    raise MappingError(
        f"order: {file}: '{what.order}' grows by {typical:g} from row to row, which does not fit sample_rate_hz "
        f"{what.sample_rate_hz:g}: a counter grows by 1, and a time by {' or '.join(allowed)}; "
        f"write the rate of the rows{', which is ' * bool(fitting)}{', and '.join(fitting)}"
    )


def _at(files: list[Path], row: int) -> str:
    """Returns the place of a row, counted over all files."""
    for path in files:
        length = scanned([path]).select(pl.len()).collect().item()
        if row < length:
            return f"{path}: row {row}"
        row -= length
    raise IndexError(row)
