"""Metrics of your own, computed from the stored predictions of finished runs. `harness.add_metric` adds one."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars
from numpy.typing import NDArray

from . import _harness

__all__ = ["Metric"]

Metric = Callable[[NDArray[np.float64], NDArray[np.float64]], "float | None"]
"""A function of the reference and the prediction, each `[samples, elements]` in SI units."""

BUILT_IN = (
    *("smape", "wmape", "r2", "rmse", "mae", "relative_error", "skill"),
    *("accuracy", "balanced_accuracy", "log_loss", "confusion", "angle"),
)

Value = tuple[str, int, str | None, float | None]
"""A modality, a horizon, the modalities that the model got, and the value of a metric."""


def add(metric: Metric, runs: str, name: str, unit: str, modality: str | None, results: Path) -> int:
    """Computes a metric for finished runs, adds it to their tables, and returns their number.

    All values are computed before the first run is changed.
    """
    if not callable(metric):
        raise TypeError("add_metric: the metric must be a function of a reference and a prediction")
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name):
        raise ValueError(f"name: {name!r} must be 1 to 64 lowercase letters, digits and '_', a letter first")
    if any(name == known or name.startswith(f"{known}_") for known in BUILT_IN):
        raise ValueError(f"name: '{name}' is a metric of the harness; use another name")
    if not isinstance(unit, str) or not 0 < len(unit) <= 32:
        raise ValueError(f"unit: {unit!r} must be a text, such as 'N', or '1' for a number without a unit")
    computed = {run: _values(metric, run, modality, results) for run in _matching(runs, results)}
    for run, values in computed.items():
        _harness.add_metric(run, name, unit, values, results)
    return len(computed)


def _matching(wanted: str, results: Path) -> list[str]:
    """Returns the names of the finished runs of an experiment, or of those whose names begin with `wanted`."""
    sql = "select experiment, run from runs where status = 'done' order by experiment, run"
    runs = _table(sql, results).rows()
    of_experiment = [f"{experiment}/{run}" for experiment, run in runs if experiment == wanted]
    beginning = [f"{experiment}/{run}" for experiment, run in runs if f"{experiment}/{run}".startswith(wanted)]
    if found := of_experiment or (beginning if wanted else []):
        return found
    experiments = sorted({experiment for experiment, _ in runs})
    raise KeyError(f"no finished run matches '{wanted}'; experiments with finished runs: {', '.join(experiments)}")


def _values(metric: Metric, run: str, modality: str | None, results: Path) -> list[Value]:
    """Returns the values of a metric for each modality and horizon of a run."""
    experiment, name = run.split("/", 1)
    chosen = f" and modality = {_quoted(modality)}" if modality is not None else ""
    rows = _table(
        "select modality, horizon, given, episode, sample, index, reference, predicted from all_predictions where "
        f"experiment = {_quoted(experiment)} and run = {_quoted(name)}{chosen}",
        results,
    )
    if rows.is_empty():
        of = f" of {modality}" if modality is not None else ""
        raise ValueError(f"{run} has no stored predictions{of}; those of images are not stored")
    values = []
    keys = ["modality", "horizon", "given"]
    for key, part in sorted(rows.partition_by(keys, as_dict=True).items(), key=str):
        part = part.sort("episode", "sample", "index")
        elements = part["index"].n_unique()
        reference, predicted = (part[side].to_numpy().reshape(-1, elements) for side in ("reference", "predicted"))
        values.append((*key, _number(metric(reference.copy(), predicted.copy()), run)))
    return values


def _number(value: Any, run: str) -> float | None:
    """Returns the value of a metric; None if it is not defined."""
    try:
        number = math.nan if value is None else float(value)
    except (TypeError, ValueError):
        kind = type(value).__name__
        raise TypeError(f"add_metric: the metric returned a {kind} for {run}, must be a number or None") from None
    if math.isinf(number):
        raise ValueError(f"add_metric: the metric returned {number} for {run}, must be finite or None")
    return None if math.isnan(number) else number


def _table(sql: str, results: Path) -> polars.DataFrame:
    return polars.DataFrame(_harness.query(sql, results))


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
