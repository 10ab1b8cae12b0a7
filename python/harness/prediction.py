"""Tasks for models of other programs: windows as NumPy arrays, and the judgment of predictions. `task` opens one."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _harness
from ._arguments import integer, name_tuple
from ._attachments import attachment
from .recorded import read_json

if TYPE_CHECKING:
    import polars

    from .torch import WindowDataset

__all__ = ["Batch", "PredictionTask", "Submitted", "Windows"]

Arrays = dict[str, NDArray[Any]]
Predict = Callable[[Arrays, NDArray[np.float32]], Mapping[str, Any]]

PARTS = ("training", "validation", "test")


class Batch(NamedTuple):
    """Windows: what a model sees, the actions that follow, and what it has to predict."""

    context: Arrays
    actions: NDArray[np.float32]
    targets: Arrays


class Submitted(NamedTuple):
    """What `submit` did."""

    run: str
    was_done: bool


for _kind, _meanings in {
    Batch: {
        "context": "The inputs by modality, `[batch, context, ...]`. With a context above 1, `action` has the actions "
        "between its samples, `[batch, context - 1, elements]`. If the task begins at rest, `length` has the number of "
        "samples since the start of the episode, `[batch]`, and copies of the first sample come before them.",
        "actions": "The actions from the present sample on, `[batch, horizon, elements]`.",
        "targets": "The outputs by modality, `[batch, horizon, ...]`; empty for the inputs of the test.",
    },
    Submitted: {
        "run": "Name of the run, as EXPERIMENT/RUN.",
        "was_done": "Whether the same predictions were submitted before, so that nothing was written.",
    },
}.items():
    for _field, _meaning in _meanings.items():
        getattr(_kind, _field).__doc__ = _meaning


class Windows:
    """The windows of a part of a dataset. `PredictionTask` makes them.

    `windows[i]`, `windows[a:b]` and `windows[indices]` are batches. They are views of the dataset's memory if the
    windows follow one another in an episode, and copies if not. `windows[:]` has all windows.

    Attributes:
        samples: the present sample of each window, `[windows]`.
    """

    def __init__(self, task: PredictionTask, samples: NDArray[np.int64], has_targets: bool) -> None:
        self.samples = samples
        self._task, self._has_targets = task, has_targets

    def __len__(self) -> int:
        """Returns the number of windows."""
        return len(self.samples)

    def __repr__(self) -> str:
        return f"<harness.Windows: {len(self)} of {self._task.name}>"

    def __getitem__(self, index: int | slice | ArrayLike) -> Batch:
        """Returns a window without the axis of the batch, or a batch of windows."""
        if isinstance(index, slice):
            return self._batch(self.samples[index])
        if np.ndim(index) == 0:
            batch = self._batch(self.samples[[integer("index", index)]])
            context, targets = ({name: array[0] for name, array in part.items()} for part in (batch[0], batch[2]))
            return Batch(context, batch.actions[0], targets)
        return self._batch(self.samples[np.asarray(index)])

    def blocks(self) -> Iterator[Batch]:
        """Returns all windows as batches without copies, one for each run of windows that follow one another."""
        ends = np.flatnonzero(np.diff(self.samples) != 1) + 1
        for block in np.split(self.samples, ends):
            yield self._batch(block)

    def _batch(self, present: NDArray[np.int64]) -> Batch:
        task = self._task
        if task.start == "rest" and task.context > 1:
            context = task._since_the_start(present)
        else:
            context = {name: task._windows_of(name, present, 1 - task.context, task.context) for name in task.input}
            if task.context > 1:
                context["action"] = task._actions(present, 1 - task.context, task.context - 1)
        targets = {}
        if self._has_targets:
            first, count = min(task.horizon, 1), max(task.horizon, 1)
            targets = {name: task._windows_of(name, present, first, count) for name in task.output}
        return Batch(context, task._actions(present, 0, task.horizon), targets)


class PredictionTask(_harness.Task):
    """A task: a dataset, its split, inputs, outputs and a window. `task` opens it.

    A model sees the inputs at `context` samples and the actions that follow. It predicts the outputs at each of the
    next `horizon` samples. The program computes its metrics on the test windows, whose targets the model never gets.

    Attributes:
        experiment: name of the experiment that the task belongs to.
        name: name of the task within the experiment, such as `empty`.
        hash: a hash of dataset, split, inputs, outputs and window.
        dataset: name of the dataset.
        test_dataset: name of the dataset of the test windows: the same one, unless the test has its own.
        scenario: name of the world, or of the imported dataset.
        input: names of the inputs.
        output: names of the outputs.
        context: number of samples that a model sees, with the present one.
        horizon: number of samples that a model predicts; 0 if it estimates the outputs at the present sample.
        horizons: the horizons at which predictions are judged.
        start: `random`, or `rest` if a model sees all samples since the start of an episode.
        action: `increment` or `target`.
        shapes: the shape of a sample of each input and output.
        units: the unit of each input and output; None for images and for modalities with several units.
        results: the folder of datasets and runs.

    Example:
        >>> task = harness.task("smoke", cell="empty")
        >>> task.input, task.shapes["contact_force"], len(task.train())
        (['proprioception', 'vision'], (20,), 58)
    """

    experiment: str
    name: str
    hash: str
    dataset: str
    test_dataset: str
    scenario: str
    input: list[str]
    output: list[str]
    context: int
    horizon: int
    horizons: tuple[int, ...]
    start: str
    action: str
    shapes: dict[str, tuple[int, ...]]
    units: dict[str, str | None]
    results: Path

    def __init__(self, *arguments: Any) -> None:
        about = json.loads(self.description())
        keys = ("experiment", "name", "hash", "dataset", "test_dataset", "scenario", "input", "output", "context")
        for key in (*keys, "horizon", "start"):
            setattr(self, key, about[key])
        self.horizons, self.action = tuple(about["horizons"]), about["action"]
        modalities = about["modalities"]
        self.shapes = {name: tuple(known["shape"]) for name, known in modalities.items()}
        self.units = {name: known["unit"] for name, known in modalities.items()}
        self.results = arguments[5]
        # The image of which a name is the change.
        self._changes = {name: known["change_of"] for name, known in modalities.items() if known["change_of"]}
        self._arrays: Arrays = {name: self.array(name) for name in modalities}
        samples = self.bounds()[-1][1]
        # Without a setpoint, an action has no elements.
        setpoint = self.array("setpoint") if about["has_setpoint"] else np.zeros((samples, 0), np.float32)
        self._arrays["setpoint"] = setpoint
        self._steps = setpoint[1:] if self.action == "target" else np.diff(setpoint, axis=0)
        self._first = np.concatenate([np.full(end - first, first) for first, end in self.bounds()])

    def __repr__(self) -> str:
        given, found = ", ".join(self.input), ", ".join(self.output)
        return f"<harness.PredictionTask {self.experiment}/{self.name}: {given} to {found}, task {self.hash}>"

    def train(self) -> Windows:
        """Returns the windows for training."""
        return Windows(self, self.windows("training"), True)

    def validation(self) -> Windows:
        """Returns the windows for validation."""
        return Windows(self, self.windows("validation"), True)

    def test_inputs(self) -> Windows:
        """Returns the windows of the test without targets."""
        return Windows(self, self.windows("test"), False)

    def labels(self) -> polars.DataFrame:
        """Returns the labels of the episodes of an imported dataset, a row for each, in the order of `bounds()`.

        They are texts, and null where an episode has none. With them, models can weight or hold out groups. A simulated
        dataset has no labels.

        Raises:
            OSError: the description of the dataset can't be read.
        """
        import polars

        description = read_json(Path(self.results) / "datasets" / self.dataset / "dataset.json")
        episodes = description.get("imported", {}).get("episodes", [])
        return polars.DataFrame([episode.get("labels", {}) for episode in episodes])

    def torch(self, part: str = "train") -> WindowDataset:
        """Returns the windows of a part as a PyTorch map-style dataset; see `harness.torch.WindowDataset`.

        Args:
            part: `train` or `validation`.

        Raises:
            ImportError: the package torch is not installed.
            ValueError: there is no such part.
        """
        try:
            from .torch import WindowDataset
        except ImportError as error:
            raise ImportError(f"PredictionTask.torch needs PyTorch: pip install torch ({error})") from error
        return WindowDataset(self._part(part))

    def to_arrow(self, part: str = "train") -> polars.DataFrame:
        """Returns the windows of a part as a table, which every library of Arrow can read.

        Args:
            part: `train` or `validation`.

        Returns:
            One row for each window: `sample` is the present sample, `NAME` an input, `actions` the actions, and
            `target_NAME` an output, each as nested lists with the shape of a window.

        Raises:
            ValueError: there is no such part.

        Example:
            >>> harness.task("smoke", {"output": "contact_force"}, cell="empty").to_arrow().columns
            ['sample', 'proprioception', 'vision', 'actions', 'target_contact_force']
        """
        import polars

        windows = self._part(part)
        context, actions, targets = windows[:]
        columns = {"sample": windows.samples, **context, "actions": actions}
        columns |= {f"target_{name}": array for name, array in targets.items()}
        return polars.DataFrame({name: np.ascontiguousarray(array) for name, array in columns.items()})

    def _part(self, part: str) -> Windows:
        parts = {"train": self.train, "training": self.train, "validation": self.validation}
        if part not in parts:
            raise ValueError(f"part: there is no '{part}'; allowed: train, validation")
        return parts[part]()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the task to a YAML file, which `task`, `harness task` and `harness judge` open.

        Args:
            path: the file to write. An existing file is replaced.

        Raises:
            ValueError: the task uses a world file. Its spec is then shared together with this file.
            OSError: the file can't be written.
        """
        Path(path).write_text(self.yaml(), encoding="utf-8")

    def submit(
        self,
        predict: Predict,
        *,
        model: str,
        seed: int = 0,
        notes: Mapping[str, Any] | None = None,
        network: Any = None,
        batch_size: int = 256,
        progress: bool = True,
    ) -> Submitted:
        """Judges a model on the test windows, and writes the results as a run of the experiment.

        `predict(context, actions)` gets batches, as `Batch` describes them. It returns the outputs by modality,
        `[batch, horizon, ...]` in SI units: arrays, or what NumPy converts to them, such as tensors of PyTorch. The
        second axis may also have only the judged horizons. Images are `[batch, horizon, rows, columns, 3]`, uint8
        or numbers in [0, 1]. Changes of images are numbers in [-1, 1]. Nothing is written before all predictions are
        complete and finite. The same predictions are not written twice.

        Args:
            predict: the model.
            model: name of the model in tables: letters, digits, `_`, `-` and `.`.
            seed: seed of the model's training.
            notes: what to record about the model, such as its commit, the versions of packages or seconds of training.
            network: the model itself, which is stored with the run, and which `harness.load_network` then loads: the
                path of a file (ONNX `.onnx`, TorchScript `.pt`, or `torch.export` `.pt2`), or what
                `torch.export.export` or `torch.jit.trace` returned.
            batch_size: number of windows that `predict` gets at once.
            progress: shows progress bars on stderr.

        Returns:
            The name of the run, and whether it was done before.

        Raises:
            TypeError: `predict` returns something else than a dictionary of numbers, or `network` is no file.
            ValueError: predictions are missing, have a wrong shape or are not finite, or other predictions of the model
                with this seed were submitted before. The message says how to remove these.
            RuntimeError: the results can't be written, or another process is writing the run.

        Example:
            >>> task = harness.task("smoke", {"output": "contact_force"}, cell="empty")
            >>> targets = task.train()[:].targets["contact_force"]
            >>> def predict(context, actions):
            ...     return {"contact_force": [targets.mean(0)] * len(actions)}
            >>> task.submit(predict, model="mean", progress=False)
            Submitted(run='smoke/empty-model=mean-seed0-...', was_done=False)
        """
        if not callable(predict):
            raise TypeError("predict: it must be a function of a context and actions")
        if (size := integer("batch_size", batch_size)) < 1:
            raise ValueError(f"batch_size: {size} must be at least 1")
        if not isinstance(model, str):
            raise TypeError(f"model: {model!r} must be a text")
        if (number := integer("seed", seed)) < 0:
            raise ValueError(f"seed: {number} must not be negative")
        windows = self.test_inputs()
        parts: dict[tuple[str, int], list[NDArray[Any]]] = {}
        for start in range(0, len(windows), size):
            context, actions, _ = windows[start : start + size]
            # Copies, because a view gives access to all samples.
            predicted = predict({name: array.copy() for name, array in context.items()}, actions.copy())
            for key, values in self._checked(predicted, len(actions)).items():
                parts.setdefault(key, []).append(values)
        predictions = [(name, horizon, np.concatenate(values)) for (name, horizon), values in parts.items()]
        command = [Path(sys.executable).name, *sys.argv]
        with attachment(network) as file:
            return Submitted(*self.judge(predictions, model, number, _notes(notes), file, command, progress))

    def compare(self, **question: Any) -> polars.DataFrame:
        """Returns the means of all models, networks and baselines on the data of the task.

        Args:
            question: arguments of `harness.answer`, such as `metrics`.

        Raises:
            KeyError: the experiment has no finished runs.
        """
        from . import answer

        means = answer(self.experiment, results=self.results, **question)
        return means.filter(scenario=self.scenario)

    def _windows_of(self, name: str, present: NDArray[np.int64], start: int, count: int) -> NDArray[Any]:
        """Returns `count` samples of a modality for each window, the first of them `start` after the present one."""
        if name not in self._changes:
            return _sliding(self._arrays[name], present + start, count)
        now = (present + start)[:, None] + np.arange(count)
        before = np.maximum(now - 1, self._first[now])
        image = self._arrays[name]
        return (image[now].astype(np.float32) - image[before].astype(np.float32)) / np.float32(255)

    def _since_the_start(self, present: NDArray[np.int64]) -> Arrays:
        """Returns all samples of the inputs since the starts of the episodes, and the actions between them.

        Shorter contexts begin with copies of the episode's first sample, and with actions that change nothing.
        """
        first = self._first[present]
        length = present - first + 1
        longest = int(length.max(initial=1))
        at = present[:, None] + np.arange(1 - longest, 1)
        is_before = at < first[:, None]
        at = np.maximum(at, first[:, None])
        context = {name: self._windows_of(name, at.reshape(-1), 0, 1) for name in self.input}
        context = {name: array.reshape(*at.shape, *array.shape[2:]) for name, array in context.items()}
        still = 0 if self.action == "increment" else self._arrays["setpoint"][first][:, None]
        between = self._steps[np.minimum(at[:, :-1], len(self._steps) - 1)]
        context["action"] = np.where(is_before[:, :-1, None], still, between).astype(np.float32)
        return {**context, "length": length}

    def _actions(self, present: NDArray[np.int64], start: int, count: int) -> NDArray[np.float32]:
        return _sliding(self._steps, present + start, count)

    def _checked(self, predicted: Any, batch: int) -> dict[tuple[str, int], NDArray[Any]]:
        """Returns the predictions of a batch by modality and judged horizon."""
        if not isinstance(predicted, Mapping):
            kind = type(predicted).__name__
            if inspect.iscoroutine(predicted):
                predicted.close()
            raise TypeError(f"predict: it returned a {kind}, must be a dictionary with {', '.join(self.output)}")
        wrong = set(map(str, predicted)) ^ set(self.output)
        if wrong:
            raise ValueError(
                f"predict: it returned {', '.join(map(str, predicted)) or 'nothing'}, must be {', '.join(self.output)}"
            )
        checked = {}
        for name in self.output:
            values = _numbers(name, predicted[name])
            steps = {max(self.horizon, 1): self.horizons, len(self.horizons): range(1, len(self.horizons) + 1)}
            shape = self.shapes[name]
            if values.ndim != 2 + len(shape) or len(values) != batch or values.shape[1] not in steps:
                raise ValueError(f"predict: {self._shape_problem(name, values.shape, batch)}")
            if values.shape[2:] != shape:
                raise ValueError(f"predict: {self._shape_problem(name, values.shape, batch)}")
            if values.dtype != np.uint8:
                # A number beyond the range of float32 becomes infinite.
                with np.errstate(over="ignore"):
                    values = values.astype(np.float32)
            if not np.isfinite(values).all():
                place = tuple(int(index) for index in np.argwhere(~np.isfinite(values))[0])
                raise ValueError(f"predict: '{name}' has the value {values[place]} at {place}, must be finite")
            for horizon, step in zip(self.horizons, steps[values.shape[1]], strict=True):
                # A copy, because the model may use the memory of its answer again.
                checked[name, horizon] = values[:, step - 1].copy()
        return checked

    def _shape_problem(self, name: str, found: Sequence[int], batch: int) -> str:
        wanted = [batch, max(self.horizon, 1), *self.shapes[name]]
        return f"'{name}' has the shape {list(found)}, must be {wanted}"


def _sliding(array: NDArray[Any], starts: NDArray[np.int64], count: int) -> NDArray[Any]:
    """Returns `count` items from each start on, `[starts, count, ...]`; a view if the starts follow one another."""
    shape, strides = (len(array) - count + 1, count, *array.shape[1:]), (array.strides[0], *array.strides)
    windows = np.lib.stride_tricks.as_strided(array, shape, strides, writeable=False)
    if len(starts) and starts[-1] - starts[0] == len(starts) - 1 and (np.diff(starts) == 1).all():
        return windows[starts[0] : starts[-1] + 1]
    return windows[starts]


def _numbers(name: str, values: Any) -> NDArray[Any]:
    """Returns what a model returned as an array of numbers."""
    if hasattr(values, "detach"):
        values = values.detach().cpu()
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"predict: '{name}' must be an array of numbers") from None
    if array.dtype.kind not in "fiu":
        raise TypeError(f"predict: '{name}' has the type {array.dtype}, must be an array of numbers")
    return array


def _notes(notes: Mapping[str, Any] | None) -> dict[str, str]:
    """Returns notes as texts."""
    if not isinstance(notes, Mapping | None):
        raise TypeError(f"notes: {notes!r} must be a dictionary, such as {{'commit': 'ab12cd3'}}")
    for name in notes or {}:
        if not isinstance(name, str):
            raise TypeError(f"notes: {name!r} must be a text")
    return {name: str(note) for name, note in (notes or {}).items()}


def task_text(
    dataset: str | os.PathLike[str],
    inputs: str | Iterable[str] | None,
    outputs: str | Iterable[str] | None,
    context: int,
    horizons: int | Iterable[int],
    split: Mapping[str, Any] | None,
    action: str,
    name: str | None,
    results: Path,
) -> str:
    """Returns the spec of a task on a dataset of a results folder, as JSON, which is YAML too."""
    if inputs is None or outputs is None:
        raise TypeError("task: give the inputs and the outputs of a task on a dataset")
    steps = [horizons] if np.ndim(horizons) == 0 else list(horizons)  # type: ignore[arg-type]
    steps = [integer("horizons", step) for step in steps]
    if not steps or min(steps) < 0 or (min(steps) == 0 and len(steps) > 1):
        raise ValueError(f"horizons: {steps} must be numbers of samples, at least 1, or 0 alone")
    spec: dict[str, Any] = {
        **_source(Path(dataset).name, results),
        "input": list(name_tuple(inputs)),
        "output": list(name_tuple(outputs)),
        "window": {"context": integer("context", context), "horizon": max(steps)},
        "split": dict(split or {}),
        "action": action,
        "tasks": ["prediction"],
    }
    identity = hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
    return json.dumps({"name": name or f"task-{identity[:12]}", **spec})


def _source(dataset: str, results: Path) -> dict[str, Any]:
    """Returns the part of a spec that makes or names a dataset."""
    path = results / "datasets" / dataset / "dataset.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"dataset: there is no {dataset} in {results / 'datasets'}; `harness.collect(SPEC)` makes the datasets of "
            "an experiment"
        )
    described = read_json(path)
    if "imported" in described:
        return {"scenarios": [dataset]}
    return {"scenarios": [described["scenario"]], "simulation": described["simulation"]}


def check_horizons(task: PredictionTask, horizons: int | Iterable[int]) -> None:
    """Raises ValueError unless the task judges predictions at these horizons."""
    steps = [horizons] if np.ndim(horizons) == 0 else list(horizons)  # type: ignore[arg-type]
    other = [step for step in steps if step not in task.horizons]
    if other:
        allowed = ", ".join(map(str, task.horizons))
        raise ValueError(f"horizons: {other[0]} is not judged; up to {task.horizon}, these are: {allowed}")
