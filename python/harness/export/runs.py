"""Runs as the trackers of other projects take them: settings, metrics by epoch, final metrics and tags."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import harness
from harness import _harness

TAGS = (
    "dataset",
    "group_hash",
    "spec_hash",
    "seed",
    "status",
    "reason",
    "git_commit",
    "git_dirty",
    "harness_version",
    "mujoco_version",
    "candle_version",
    "host",
    "processor",
    "command",
    "task_hash",
    "notes",
)
"""The columns of the table `runs` that become tags."""

_BASELINES = ("persistence", "ridge", "training_mean", "nearest_neighbors")
"""The models that every run is compared with."""


@dataclass(frozen=True)
class Point:
    """A value of a curve."""

    name: str
    """Task, split and loss term: `prediction/train/total`."""
    epoch: int
    """The epoch, counted from 1."""
    value: float
    """The loss."""
    time: float
    """When the epoch ended, in seconds since 1970."""


@dataclass(frozen=True)
class Run:
    """A run with everything that is exported."""

    results: Path
    """The results folder."""
    row: dict[str, Any]
    """The run's row of the table `runs`."""

    @property
    def experiment(self) -> str:
        """The experiment's name."""
        return str(self.row["experiment"])

    @property
    def id(self) -> str:
        """The run's id, which is unique within its experiment."""
        return str(self.row["run"])

    @property
    def name(self) -> str:
        """The experiment and the id."""
        return f"{self.experiment}/{self.id}"

    @contextmanager
    def files(self) -> Iterator[list[Path]]:
        """Gives the run's files. Those of a published run, which shares files with others, exist until the end."""
        folder = self.results / "runs" / self.experiment / self.id
        with TemporaryDirectory() as temporary:
            if not (folder / "run.json").exists():
                folder = Path(temporary)
                _harness.extract(self.name, folder, self.results)
            yield sorted(file for file in folder.iterdir() if not file.name.startswith(".unfinished"))

    @cached_property
    def _recorded(self) -> tuple[str, str]:
        return _harness.recorded(self.experiment, self.id, self.results)

    @property
    def version(self) -> str:
        """A hash that changes if the run does: if it has more epochs, continues, or is done again."""
        state = self.row["status"]
        if state == "running":
            # Its record stays the same until the end.
            state += f" {len(self.curves)}"
        return hashlib.sha256((self._recorded[0] + state).encode()).hexdigest()

    @property
    def spec(self) -> str:
        """The resolved spec, in YAML."""
        return self._recorded[1]

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Every setting of the resolved spec, by dotted key."""
        return dict(_leaves(json.loads(self._recorded[0])["spec"]))

    @property
    def tags(self) -> dict[str, str]:
        """What is known about the run besides its settings."""
        known = {name: self.row[name] for name in TAGS if self.row[name] is not None}
        return {"run": self.name} | {name: _text(value) for name, value in known.items()}

    @property
    def started(self) -> float:
        """When the run began, in seconds since 1970."""
        return datetime.fromisoformat(self.row["started"]).timestamp()

    def _seconds(self, stage: str) -> float:
        return self.row[f"{stage}_seconds"] or 0.0

    @property
    def ended(self) -> float:
        """When a finished run ended, in seconds since 1970; `started` if the run is not done."""
        stages = ("collect", "prediction", "reconstruction", "evaluation")
        return self.started + sum(self._seconds(stage) for stage in stages)

    @cached_property
    def curves(self) -> list[Point]:
        """The losses of every epoch so far."""
        begin = self.started + self._seconds("collect")
        begins = {"prediction": begin, "reconstruction": begin + self._seconds("prediction")}
        ends: dict[tuple[str, int], float] = {}
        points = []
        select = "select task, split, term, epoch, value, seconds from epochs"
        for row in self._rows(select, "task, epoch, split, term"):
            task, epoch = row["task"], row["epoch"]
            if (task, epoch) not in ends:
                ends[task, epoch] = ends.get((task, epoch - 1), begins[task]) + row["seconds"]
            if row["value"] is not None:
                name = f"{task}/{row['split']}/{row['term']}"
                points.append(Point(name, epoch, row["value"], ends[task, epoch]))
        return points

    def metrics(self) -> dict[str, float]:
        """Returns the metrics over all joints, links or pixels, on the test samples, of network and baselines.

        A model of another program is called `network` too, so that charts of runs have both. A name is
        `network/prediction/contact_force/mae`, followed by `.` and a direction, by `.h5` for 5 samples ahead, and by
        `.given-arm-proprioception` for a model that got only these inputs. MLflow stores metrics in files, so no name
        may be that of another one's folder.
        """
        key = "model, task, modality, metric, direction, horizon, given"
        found = {}
        for row in self._rows(f"select {key}, value from all_metrics", key, "index is null and value is not null"):
            model = row["model"] if row["model"] in _BASELINES else "network"
            name = f"{model}/{row['task']}/{row['modality']}/{row['metric']}"
            direction = f".{row['direction']}" if row["direction"] else ""
            horizon = f".h{row['horizon']}" if row["horizon"] > 1 else ""
            given = f".given-{row['given'].replace(',', '-')}" if row["given"] else ""
            found[name + direction + horizon + given] = row["value"]
        return found

    def _rows(self, select: str, order: str, condition: str = "1 = 1") -> list[dict[str, Any]]:
        own = f"experiment = {_quoted(self.experiment)} and run = {_quoted(self.id)}"
        sql = f"{select} where {own} and {condition} order by {order}"
        return harness.query(sql, self.results).to_dicts()


def _leaves(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _text(value: Any) -> str:
    """A text as it is, and other values as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def params(run: Run) -> dict[str, str]:
    """Returns a run's settings as texts."""
    return {key: _text(value) for key, value in run.settings.items()}


def varying(runs: Iterable[Run]) -> list[str]:
    """Returns the keys of the settings in which runs differ."""
    values: dict[str, set[str]] = {}
    count = 0
    for count, run in enumerate(runs, 1):
        for key, value in params(run).items():
            values.setdefault(key, set() if count == 1 else {""}).add(value)
        for key in values.keys() - run.settings.keys():
            values[key].add("")
    return sorted(key for key, found in values.items() if len(found) > 1)


def read_runs(experiments: Sequence[str], condition: str | None, results: Path) -> list[Run]:
    """Reads the runs of experiments, or of all, that satisfy an SQL condition over the table `runs`.

    Raises:
        KeyError: an experiment has no runs.
        ValueError: the condition is wrong.
        FileNotFoundError: there is no results folder.
    """
    known = harness.query("select distinct experiment from runs order by experiment", results)["experiment"].to_list()
    for name in experiments:
        if name not in known:
            raise KeyError(f"'{name}' has no runs; those that have: {', '.join(known) or 'none'}")
    chosen = ", ".join(_quoted(name) for name in experiments or known) or "''"
    sql = f"select * from runs where experiment in ({chosen}) and ({condition or '1 = 1'}) order by experiment, run"
    return [Run(results, row) for row in harness.query(sql, results).to_dicts()]


def by_experiment(runs: list[Run]) -> dict[str, list[Run]]:
    """Groups runs by their experiment."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.experiment, []).append(run)
    return groups
