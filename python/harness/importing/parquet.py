"""Reads Parquet files, whose rows are the samples."""

from __future__ import annotations

import polars as pl

from .alignment import wanted
from .mapping import Mapping, MappingError, Rows
from .recording import Recording


def open_parquet(mapping: Mapping, what: Rows) -> Recording:
    """Opens Parquet files.

    Raises:
        MappingError: they can't be read, or do not fit the mapping.
        FileNotFoundError: there is none.
    """
    files = sorted(mapping.source.glob("**/*.parquet")) if mapping.source.is_dir() else [mapping.source]
    if not files:
        raise FileNotFoundError(f"source: {mapping.source} holds no .parquet file")
    keys = list(dict.fromkeys([what.episode, what.order]))
    try:
        table = pl.scan_parquet(files, hive_partitioning=False)
        available = table.collect_schema().names()
        for key in keys:
            if key not in available:
                raise MappingError(f"there is no column '{key}'; the columns are {', '.join(available)}")
        columns = wanted(mapping.selections, available)
        rows = table.select(list(dict.fromkeys([*keys, *columns]))).sort(keys).collect()
    except pl.exceptions.PolarsError as error:
        raise MappingError(f"source: {mapping.source} can't be read: {error}") from None
    if rows.select(keys).is_duplicated().any():
        raise MappingError(f"order: two rows of an episode have the same '{what.order}'")
    groups = rows.partition_by(what.episode, maintain_order=True)
    episodes = ({name: group[name].to_list() for name in columns} for group in groups)
    return Recording(what.sample_rate_hz, len(groups), episodes)
