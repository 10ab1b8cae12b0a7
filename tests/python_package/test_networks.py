"""Networks rebuilt from their files, in PyTorch and in ONNX, compared with the harness's own predictions."""

import copy
import importlib.util
import itertools
import json
import pickle
import re
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import yaml
from conftest import ROOT, SMOKE
from numpy.typing import NDArray

import harness

Arrays = dict[str, NDArray[Any]]
Overrides = dict[str, Any]

TOLERANCE = 1e-5
"""Largest difference of a predicted value, in standard deviations of its modality."""
SETTINGS = ("input", "output", "action", "tasks", "network", "scaling")
"""The settings of a spec that determine what a network computes."""

# Networks that no experiment has.
OTHERS: dict[str, Overrides] = {
    "vision alone": {"input": ["vision"], "output": ["vision"]},
    "image change as input": {"input": ["frame_difference"], "output": ["frame_difference"]},
    "two images": {"input": ["vision", "frame_difference"], "output": ["vision", "frame_difference"]},
    "everything": {
        "input": ["proprioception", "arm", "contact_force", "contact_force_mean", "vision", "frame_difference"],
        "output": ["proprioception", "arm", "contact_force", "contact_force_mean", "vision", "frame_difference"],
    },
    "vectors from an image": {"input": ["vision"], "output": ["arm", "contact_force_mean"]},
    "image from vectors": {"input": ["proprioception", "arm"], "output": ["frame_difference"]},
    "late, vision alone": {"input": ["vision"], "output": ["vision"], "network.fusion": "late"},
    "late, image from vectors": {"input": ["arm"], "output": ["vision"], "network.fusion": "late"},
    "averaged": {"network.average": 2},
    "averaged, late, deep": {
        "network.average": 4,
        "network.fusion": "late",
        "network.hidden": [12, 8, 6],
        "network.channels": [3, 5],
    },
    "product": {"network.fusion": "product"},
    "product of vectors": {"network.fusion": "product", "input": ["proprioception", "arm", "contact_force"]},
    "product with a set": {
        "scenarios": ["cluttered"],
        "input": ["arm", "boxes_from_arm", "vision"],
        "network.fusion": "product",
        "network.hidden": [12, 8, 6],
    },
    "deep": {"network.hidden": [12, 8, 6], "network.channels": [3, 5, 4, 2], "input": ["vision", "arm"]},
    "deep, vectors": {"network.hidden": [12, 8, 6], "input": ["proprioception"], "output": ["contact_force"]},
    "target": {"action": "target"},
    "scaled by element": {"scaling": {"contact_force": {"scale": "per_element", "minimum": 0.1}}},
    "without a minimum": {"scaling": {"contact_force": {"minimum": None}}},
    "trained in bf16": {"training.precision": "bf16"},
    "other losses": {"training.losses.proprioception": "absolute", "training.losses.contact_force": "huber"},
    "changes": {
        "outputs": {"proprioception": {"predict": "change"}, "contact_force": {"predict": "change", "loss": "huber"}},
        "input": ["proprioception", "contact_force", "vision"],
    },
    "two cameras": {"scenarios": ["wrist"], "input": ["vision", "wrist"], "output": ["wrist", "proprioception"]},
    "another robot": {"scenarios": ["tendon"], "input": ["proprioception"], "output": ["proprioception"]},
}

# Settings of which every pair of values occurs in some network.
AXES: dict[str, tuple[Any, ...]] = {
    "input": (["proprioception", "arm"], ["vision"], ["vision", "frame_difference"], ["proprioception", "vision"]),
    "output": (["contact_force"], ["vision"], ["vision", "frame_difference"], ["arm", "contact_force", "vision"]),
    "network.fusion": ("early", "late"),
    "network.channels": ([3], [3, 5, 4]),
    "network.average": (1, 2),
    "network.hidden": ([10], [12, 8, 6]),
    "action": ("increment", "target"),
}


def combined() -> dict[str, Overrides]:
    """Networks with every pair of values of `AXES`, chosen greedily."""
    every = list(itertools.product(*AXES.values()))

    def pairs(values: tuple[Any, ...]) -> set[str]:
        return {json.dumps(pair) for pair in itertools.combinations(enumerate(values), 2)}

    missing, chosen = set().union(*map(pairs, every)), []
    while missing:
        chosen.append(max(every, key=lambda values: len(pairs(values) & missing)))
        missing -= pairs(chosen[-1])
    return {f"combined {index}": dict(zip(AXES, values, strict=True)) for index, values in enumerate(chosen)}


def spec_of(path: Path) -> dict[str, Any]:
    """A spec with what it takes from the spec that it extends."""
    own = yaml.safe_load(path.read_text())
    base = own.pop("extends", None)
    return merged(spec_of(path.parent / base), own) if base else own


def merged(base: Any, own: Any, key: str = "") -> Any:
    """Sections are merged key by key, and axes replaced. None in the place of a section or a list leaves it out."""
    if not (isinstance(base, dict) and isinstance(own, dict)):
        return own
    is_axis = key == "vary"
    both = {name: own[name] if is_axis else merged(base[name], own[name], name) for name in base if name in own}
    is_left_out = [name for name in both if both[name] is None and isinstance(base[name], dict | list)]
    return {name: value for name, value in {**base, **own, **both}.items() if name not in is_left_out}


def settings_of_label(axis: dict[str, Overrides], label: str) -> Overrides:
    """The settings of a label and of the label that it extends."""
    own = dict(axis[label])
    base = own.pop("extends", None)
    return {**(settings_of_label(axis, base) if base else {}), **own}


def networks_of(spec: Path) -> Iterator[Overrides]:
    """The settings of each network without memory that an experiment trains."""
    experiment = spec_of(spec)
    base = {key: experiment[key] for key in SETTINGS if key in experiment}
    # Only the world `cluttered` has boxes.
    if not {"empty", "cluttered"}.issuperset(experiment["scenarios"]) or "boxes" in json.dumps(experiment):
        base["scenarios"] = experiment["scenarios"]
    axes = experiment.get("vary", {})
    labels = [axis for axis in axes.values() if isinstance(axis, dict) and axis != {"without": "each"}]
    labeled = [[settings_of_label(axis, label) for label in axis] for axis in labels]
    readings = [{}, *(reading["settings"] for reading in experiment.get("readings", []))]
    values = [[{key: value} for value in values] for key, values in axes.items() if isinstance(values, list)]
    for chosen in itertools.product(*labeled, readings, *values):
        changes = {key: value for settings in chosen for key, value in settings.items()}
        own = {key: value for key, value in changes.items() if key.split(".")[0] in SETTINGS}
        # Networks with memory have tests of their own, because `load_model` has no state.
        if own.get("network.memory", base["network"].get("memory", "none")) == "none":
            yield {**base, **own}


def kinds() -> dict[str, Overrides]:
    """Every network of the repository's experiments, each once, and the others."""
    found: dict[str, Overrides] = {}
    texts = set()
    for spec in sorted((ROOT / "experiments").glob("*.yaml")):
        if spec.name == "claims.yaml":
            continue
        for index, settings in enumerate(networks_of(spec)):
            text = json.dumps(settings, sort_keys=True)
            if text not in texts:
                texts.add(text)
                found[f"{spec.stem} {index}" if index else spec.stem] = settings
    return {**found, **OTHERS, **combined()}


KINDS = kinds()


def settings_of(kind: str) -> Overrides:
    """The settings of a network by dotted key, with those of the smoke experiment where it has none."""
    smoke = {**yaml.safe_load(SMOKE.read_text()), "scenarios": ["empty"], "action": "increment", "scaling": {}}
    whole = {**smoke, **{key: value for key, value in KINDS[kind].items() if "." not in key}}
    network = {"fusion": "early", "average": 1, "channels": None, "hidden": None, **whole["network"]}
    return {**whole, **{f"network.{key}": value for key, value in network.items()}, **KINDS[kind]}


def images(modalities: list[str]) -> bool:
    return not {"vision", "frame_difference", "wrist"}.isdisjoint(modalities)


def many(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 1


GROUPS: dict[str, Callable[[Overrides], bool]] = {
    "only vectors": lambda settings: not images(settings["input"] + settings["output"]),
    "images as input": lambda settings: images(settings["input"]),
    "images as output": lambda settings: images(settings["output"]),
    "several convolutions": lambda settings: many(settings["network.channels"]),
    "several hidden layers": lambda settings: many(settings["network.hidden"]),
    "averaged images": lambda settings: settings["network.average"] > 1,
    "late fusion": lambda settings: settings["network.fusion"] == "late",
    "product of experts": lambda settings: settings["network.fusion"] == "product",
    "the next setpoint as action": lambda settings: settings["action"] == "target",
    "scaling by element": lambda settings: "per_element" in json.dumps(settings["scaling"]),
    "training in bf16": lambda settings: settings.get("training.precision") == "bf16",
    "other worlds": lambda settings: settings["scenarios"] != ["empty"],
    "all": lambda settings: True,
}
"""The rows of the table that a test prints, some of which are in docs/networks.md. A network can belong to several."""

LARGEST: dict[tuple[str, str], float] = {}
"""The largest difference found for each network and program."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder for all networks, which share the datasets."""
    return tmp_path_factory.mktemp("networks")


class Trained:
    """A trained network, observations and actions for it, and what the harness makes of them."""

    def __init__(self, name: str, folder: Path, settings: Overrides | None = None) -> None:
        self.name = name
        settings = KINDS[name] if settings is None else settings
        spec = {**yaml.safe_load(SMOKE.read_text()), "scenarios": ["empty"]}
        # A section of the settings is shared by many networks.
        for key, value in copy.deepcopy(settings).items():
            *sections, last = key.split(".")
            within = spec
            for section in sections:
                within = within.setdefault(section, {})
            within[last] = value
        spec["tasks"] = ["prediction", "reconstruction"]
        self.results = folder / re.sub(r"\W+", "_", name)
        if not self.results.exists():
            self.results.mkdir()
            (folder / "datasets").mkdir(exist_ok=True)
            (self.results / "datasets").symlink_to(folder / "datasets")
            (self.results / "smoke.yaml").write_text(yaml.safe_dump(spec))
        harness.run(self.results / "smoke.yaml", results=self.results, progress=False)
        self.run = harness.query("select run from runs", self.results).item()
        self.model = harness.load_model(self.run, self.results)
        data = harness.Dataset(self.results / "datasets" / self.model.dataset)
        at = np.concatenate([np.arange(first + 1, end - 1) for first, end in data.bounds])
        self.observation = {name: observed(data, name, at) for name in self.model.input}
        setpoint, following = data["setpoint"][at], data["setpoint"][at + 1]
        self.action = following - setpoint if self.model.action == "increment" else following.copy()
        self.latent, self.log_variance = self.model.encode(self.observation)
        self.predicted = self.model.predict(self.observation, self.action)
        self.reconstructed = self.model.reconstruct(self.latent)

    def assert_equal(self, found: Arrays, expected: Arrays, program: str = "") -> None:
        """Compares values in standard deviations of their modality."""
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            assert found[name].shape == values.shape, name
            self._assert_small(np.abs(found[name] - values) / self.deviation(name), name, program)

    def assert_same_posterior(self, mean: NDArray[Any], log_variance: NDArray[Any], program: str = "") -> None:
        self._assert_small(np.abs(mean - self.latent), "mean", program)
        self._assert_small(np.abs(log_variance - self.log_variance), "log-variance", program)

    def _assert_small(self, error: NDArray[Any], name: str, program: str) -> None:
        largest = float(error.max())
        assert largest <= TOLERANCE, (name, largest)
        LARGEST[self.name, program] = max(LARGEST.get((self.name, program), 0.0), largest)

    def deviation(self, name: str) -> NDArray[Any]:
        path = self.results / "runs" / "smoke" / self.run / "prediction.safetensors"
        return read_file(path)[1][f"scale.{name}.deviation"]


def observed(data: harness.Dataset, name: str, at: NDArray[Any]) -> NDArray[Any]:
    """The values of a modality at some samples, none of which is an episode's first."""
    if name == "frame_difference":
        change: NDArray[Any] = (data["vision"][at].astype(np.float32) - data["vision"][at - 1]) / np.float32(255)
        return change
    values: NDArray[Any] = data[name][at]
    return values


def read_file(path: Path) -> tuple[dict[str, Any], Arrays]:
    """The description and the tensors of a network's file, as its format is documented, without a library."""
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    note = json.loads(header.pop("__metadata__")["harness"])
    tensors = {}
    for name, entry in header.items():
        first, last = entry["data_offsets"]
        assert entry["dtype"] == "F32"
        tensors[name] = np.frombuffer(data[end + first : end + last], "<f4").reshape(entry["shape"])
    return note.get("network"), tensors


@pytest.fixture(scope="module", params=KINDS)
def trained(request: pytest.FixtureRequest, folder: Path) -> Trained:
    return Trained(request.param, folder)


def test_the_kinds_have_every_value_of_every_network_setting() -> None:
    schema = json.loads((ROOT / "experiments" / "schema.json").read_text())
    settings = schema["$defs"]["Network"]["properties"]
    used: dict[str, set[Any]] = {key: set() for key in settings}
    for overrides in KINDS.values():
        network = {**overrides.get("network", {})}
        dotted = {key: value for key, value in overrides.items() if key.startswith("network.")}
        network |= {key.removeprefix("network."): value for key, value in dotted.items()}
        for key, value in network.items():
            used[key].add(json.dumps(value))

    def values(name: str) -> set[str]:
        found = schema["$defs"][name]
        return {json.dumps(choice["const"]) for choice in found["oneOf"]}

    assert used["preset"] == values("Preset")
    assert used["fusion"] | {'"early"'} == values("Fusion")
    lengths = {
        key: {len(list(np.atleast_1d(json.loads(value)))) > 1 for value in used[key]} for key in ("hidden", "channels")
    }
    assert lengths == {"hidden": {False, True}, "channels": {False, True}}
    assert used["average"] == {"1", "2", "4"}
    known = {"preset", "fusion", "hidden", "channels", "average", "memory", "memory_samples", "draws"}
    assert set(settings) == known, "a new setting needs new kinds"


def test_onnx_agrees_with_the_harness(trained: Trained, tmp_path: Path) -> None:
    for task, expected in (("prediction", trained.predicted), ("reconstruction", trained.reconstructed)):
        path = tmp_path / f"{task}.onnx"
        harness.export_onnx(trained.run, path, task, trained.results)
        model = onnx.load(path)
        onnx.checker.check_model(model, full_check=True)
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        given = dict(trained.observation)
        if task == "prediction":
            given["action"] = trained.action
        assert {value.name for value in session.get_inputs()} == given.keys()
        names = [value.name for value in session.get_outputs()]
        answer = dict(zip(names, session.run(names, given), strict=True))
        trained.assert_same_posterior(answer.pop("latent.mean"), answer.pop("latent.log_variance"), "ONNX")
        trained.assert_equal({name.split(".")[1]: values for name, values in answer.items()}, expected, "ONNX")
        one = session.run(names, {name: values[:1] for name, values in given.items()})
        assert all(len(values) == 1 for values in one)


def test_torch_agrees_with_the_harness(trained: Trained) -> None:
    torch = pytest.importorskip("torch", reason="`make interchange` tests with torch")
    network = harness.load_network(trained.run, trained.results)
    observation = channels_first(trained.observation)
    with torch.no_grad():
        mean, log_variance = network.encode(observation)
        predicted = network(observation, trained.action)
        reconstructed = network.reconstruct(mean)
    trained.assert_same_posterior(mean.numpy(), log_variance.numpy(), "PyTorch")
    for found, expected in ((predicted, trained.predicted), (reconstructed, trained.reconstructed)):
        values = {name: values.numpy() for name, values in found.items()}
        trained.assert_equal(values, channels_first(expected), "PyTorch")


class Remembered:
    """A trained network with memory, and what it predicted along its test episode."""

    def __init__(self, memory: str, results: Path) -> None:
        settings: dict[str, Any] = {"scenarios": ["empty"], "network.memory": memory, "training.epochs": 2}
        settings |= {"window.context": 6, "window.start": "rest", "window.horizon": 3}
        settings["outputs.proprioception.predict"] = "value" if memory == "window" else "change"
        assert harness.run(SMOKE, settings, results=results, progress=False) == (1, 0)
        (folder,) = (results / "datasets").iterdir()
        self.data = harness.Dataset(folder)
        rows = harness.query(
            "select episode, sample, horizon, modality, predicted from all_predictions "
            "where task = 'prediction' order by episode, sample, horizon, modality, index",
            results,
        ).rows()
        self.expected: dict[tuple[Any, ...], list[float]] = {}
        for *key, predicted in rows:
            self.expected.setdefault(tuple(key), []).append(predicted)
        (self.episode,) = {key[0] for key in self.expected}
        self.first, self.end = self.data.bounds[self.episode]
        self.compared: set[tuple[Any, ...]] = set()

    def windows(self) -> Iterator[tuple[int, range]]:
        """Each present sample, and the horizons that the episode has after it."""
        for present in range(self.first, self.end - 1):
            yield present, range(1, min(3, self.end - 1 - present) + 1)

    def action(self, present: int, horizon: int) -> NDArray[np.float32]:
        """The action before the sample at a horizon, `[1, elements]`."""
        setpoint = self.data["setpoint"]
        return (setpoint[present + horizon] - setpoint[present + horizon - 1])[None]

    def compare(self, present: int, horizon: int, predictions: Mapping[str, NDArray[np.float32]]) -> None:
        """Compares predictions of one sample with those in the tables."""
        for name, values in predictions.items():
            key = (self.episode, present - self.first + horizon, horizon, name)
            if key in self.expected:
                np.testing.assert_allclose(values[0], self.expected[key], rtol=1e-4, atol=1e-5)
                self.compared.add(key)


@pytest.mark.parametrize("memory", ["window", "gru", "rssm"])
def test_torch_agrees_with_networks_that_have_a_memory(memory: str, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="`make interchange` tests with torch")
    run = Remembered(memory, tmp_path)
    network = harness.load_network("smoke/empty", tmp_path)
    assert network.has_memory
    names = [quantity["name"] for quantity in network.description["inputs"]]
    state = None
    for present, horizons in run.windows():
        seen = channels_first({name: observed(run.data, name, np.array([present])) for name in names})
        with torch.no_grad():
            ahead = network.observe(state, seen)
        for horizon in horizons:
            with torch.no_grad():
                ahead = network.act(ahead, run.action(present, horizon))
                predictions = network.predict(ahead)
            state = ahead if horizon == 1 else state
            run.compare(present, horizon, {name: values.numpy() for name, values in predictions.items()})
    assert run.compared == run.expected.keys()


@pytest.mark.parametrize("memory", ["window", "gru", "rssm"])
def test_onnx_agrees_with_networks_that_have_a_memory(memory: str, tmp_path: Path) -> None:
    run = Remembered(memory, tmp_path)
    sessions = {}
    for task in ("prediction", "reconstruction"):
        path = tmp_path / f"{task}.onnx"
        harness.export_onnx("smoke/empty", path, task, tmp_path)
        onnx.checker.check_model(onnx.load(path), full_check=True)
        sessions[task] = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    shapes = {value.name: value.shape for value in sessions["prediction"].get_inputs()}
    given = shapes.keys() - {"state", "seen", "action"}
    state = np.zeros((1, shapes["state"][1]), np.float32)

    def answer(task: str, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
        names = [value.name for value in sessions[task].get_outputs()]
        return dict(zip(names, sessions[task].run(names, values), strict=True))

    for present, horizons in run.windows():
        values = {name: observed(run.data, name, np.array([present])) for name in given}
        ahead, is_seen = state, np.ones((1, 1), np.float32)
        for horizon in horizons:
            values |= {"state": ahead, "seen": is_seen, "action": run.action(present, horizon)}
            found = answer("prediction", values)
            if horizon == 1:
                reconstructed = answer("reconstruction", values)
                for name in ("latent.mean", "state.next"):
                    np.testing.assert_array_equal(reconstructed[name], found[name])
                assert {f"reconstructed.{name}" for name in given} <= reconstructed.keys()
                state = found["state.next"]
            # The values of samples that are not seen are ignored.
            ahead, is_seen = found["state.next"], np.zeros((1, 1), np.float32)
            predictions = {name.split(".")[1]: part for name, part in found.items() if name.startswith("predicted.")}
            run.compare(present, horizon, predictions)
    assert run.compared == run.expected.keys()


def test_a_network_takes_the_batches_of_a_dataset(smoke: Trained) -> None:
    torch = pytest.importorskip("torch", reason="`make interchange` tests with torch")
    model, network = smoke.model, harness.load_network(smoke.run, smoke.results)
    data = harness.Dataset(smoke.results / "datasets" / model.dataset)
    transitions = data.torch(model.input, model.output, model.action)
    observation, action, following = next(iter(torch.utils.data.DataLoader(transitions, batch_size=8)))
    with torch.no_grad():
        predicted = network(observation, action)
    arrays = {name: observed(data, name, transitions.samples[:8]) for name in model.input}
    expected = model.predict(arrays, action.numpy())
    smoke.assert_equal({name: values.numpy() for name, values in predicted.items()}, channels_first(expected))
    assert {name: values.shape for name, values in predicted.items()} == {
        name: values.shape for name, values in following.items()
    }


def channels_first(values: Arrays) -> Arrays:
    """The values with images as PyTorch has them, `[batch, 3, rows, columns]`."""
    return {name: value.transpose(0, 3, 1, 2) if value.ndim == 4 else value for name, value in values.items()}


def test_a_file_says_everything_about_its_tensors(trained: Trained) -> None:
    for task, path in harness._harness.networks(trained.run, trained.results):
        description, tensors = read_file(path)
        changes = any("change" in quantity for quantity in description["outputs"])
        assert (description["format"], description["task"]) == (3 if changes else 1, task)
        layers = [*description.get("encoder", []), *description["decoder"]]
        named = [name for layer in layers for name in names_in(layer)]
        assert sorted(named) == sorted(name for name in tensors if not name.startswith("scale."))
        parameters = {name: tensors[name].size for name in named}
        assert sum(layer["parameters"] for layer in layers) == sum(parameters.values())
        for quantity in [*description.get("inputs", []), *description["outputs"]]:
            assert tensors[quantity["mean"]].size == np.prod(quantity["shape"])


def test_the_table_in_the_documentation_counts_these_networks() -> None:
    """Prints the table as measured by the tests above, with `pytest -s`."""
    settings = {kind: settings_of(kind) for kind in KINDS}
    groups = {name: [kind for kind in KINDS if belongs(settings[kind])] for name, belongs in GROUPS.items()}
    for name, kinds in groups.items():
        measured = [max(LARGEST.get((kind, program), 0.0) for kind in kinds) for program in ("ONNX", "PyTorch")]
        print(f"| {name} | {len(kinds)} | " + " | ".join(f"{value:.1e}" for value in measured) + " |")
    page = (ROOT / "docs/networks.md").read_text()
    rows = re.findall(r"^\| ([\w ]+) \| (\d+) \| (\S+) \| (\S+) \|$", page, re.MULTILINE)
    # The page has the most important rows.
    assert {name: int(count) for name, count, *_ in rows}.items() <= {
        name: len(kinds) for name, kinds in groups.items()
    }.items()
    assert "all" in {name for name, *_ in rows}
    assert all(0 < float(value) <= TOLERANCE for _, _, *values in rows for value in values)


def names_in(layer: dict[str, Any]) -> list[str]:
    """The names of a layer's tensors."""
    return [*layer.get("weights", []), *(layer[key] for key in ("weight", "bias") if key in layer)]


@pytest.fixture(scope="module")
def smoke(folder: Path) -> Trained:
    return Trained("smoke", folder)


def test_an_onnx_model_says_what_it_takes_and_returns(smoke: Trained, tmp_path: Path) -> None:
    harness.export_onnx("smoke/", tmp_path / "network.onnx", results=smoke.results)
    model = onnx.load(tmp_path / "network.onnx")
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert (properties["run"], properties["experiment"]) == (smoke.run, "smoke")
    assert json.loads(properties["network"])["latent"] == 4
    assert model.opset_import[0].version == 17
    session = onnxruntime.InferenceSession(tmp_path / "network.onnx", providers=["CPUExecutionProvider"])
    inputs = {value.name: (value.type, value.shape) for value in session.get_inputs()}
    assert inputs == {
        "proprioception": ("tensor(float)", ["batch", 20]),
        "vision": ("tensor(uint8)", ["batch", 64, 64, 3]),
        "action": ("tensor(float)", ["batch", 3]),
    }
    outputs = {value.name: value.shape for value in session.get_outputs()}
    assert outputs == {
        "latent.mean": ["batch", 4],
        "latent.log_variance": ["batch", 4],
        "predicted.proprioception": ["batch", 20],
        "predicted.contact_force": ["batch", 20],
        "predicted.frame_difference": ["batch", 64, 64, 3],
    }
    told = {value.name: value.doc_string for value in model.graph.input}
    assert told["action"] == "increment: rotation (rad), lift (m), extension (m)"


PROGRAM = [sys.executable, "-c", "import sys; from harness import _harness; sys.exit(_harness.main(sys.argv, []))"]
"""The program without the commands that are written in Python."""


@pytest.mark.parametrize(("command", "usage"), [([sys.executable, "-m", "harness"], 1), (PROGRAM, 2)])
def test_both_commands_write_the_same_model(smoke: Trained, tmp_path: Path, command: list[str], usage: int) -> None:
    command = [*command, "export", "--results", str(smoke.results), "--format", "onnx"]
    for task in ("prediction", "reconstruction"):
        by_function, by_command = tmp_path / f"{task}.onnx", tmp_path / f"new/{task}.onnx"
        harness.export_onnx(smoke.run, by_function, task, smoke.results)
        subprocess.run([*command, smoke.run, by_command, "--task", task], check=True, capture_output=True)
        assert by_function.read_bytes() == by_command.read_bytes()
    wrong = subprocess.run([*command, "nothing", tmp_path / "x.onnx"], capture_output=True, text=True)
    assert (wrong.returncode, wrong.stderr.count("\n")) == (usage, 1), wrong.stderr
    assert not (tmp_path / "x.onnx").exists()


def test_the_program_says_which_formats_the_package_has(tmp_path: Path) -> None:
    wrong = subprocess.run(
        [*PROGRAM, "export", "--format", "lerobot", "x", tmp_path / "y"], capture_output=True, text=True
    )
    assert wrong.returncode == 2 and "the Python package (pip install .) also exports datasets" in wrong.stderr


def test_a_wrong_export_says_what_is_allowed(smoke: Trained, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no 'regression'; allowed: prediction, reconstruction"):
        harness.export_onnx(smoke.run, tmp_path / "x.onnx", "regression", smoke.results)
    with pytest.raises(KeyError, match="nothing"):
        harness.export_onnx("nothing", tmp_path / "x.onnx", results=smoke.results)
    assert list(tmp_path.iterdir()) == []


def test_files_without_a_description_are_refused(smoke: Trained, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="`make interchange` tests with torch")
    from harness.networks import Network, NetworkFile

    (_, path), _ = harness._harness.networks(smoke.run, smoke.results)
    without = tmp_path / "prediction.safetensors"
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    del header["__metadata__"]
    head = json.dumps(header).encode()
    without.write_bytes(len(head).to_bytes(8, "little") + head + data[end:])
    with pytest.raises(ValueError, match="no description"):
        NetworkFile(without)
    with pytest.raises(ValueError, match="is not the file of a network"):
        NetworkFile(SMOKE)
    with pytest.raises(RuntimeError, match="no reconstruction"):
        Network(NetworkFile(path)).reconstruct(smoke.latent)


def test_a_torch_network_trains_and_refuses_wrong_observations(smoke: Trained) -> None:
    torch = pytest.importorskip("torch", reason="`make interchange` tests with torch")
    network = harness.load_network(smoke.run, smoke.results)
    observation = channels_first(smoke.observation)
    _, tensors = read_file(smoke.results / "runs" / "smoke" / smoke.run / "prediction.safetensors")
    parameters = dict(network.named_parameters())
    assert {name for name in tensors if not name.startswith("scale.")} < parameters.keys()
    sum(values.sum() for values in network(observation, smoke.action).values()).backward()
    assert all(parameters[name].grad is not None for name in parameters if not name.startswith("reconstruction."))
    with pytest.raises(KeyError, match="lacks vision; the network takes proprioception, vision"):
        network({"proprioception": observation["proprioception"]}, smoke.action)
    with pytest.raises(KeyError, match="has visoin"):
        network({**observation, "visoin": observation["vision"]}, smoke.action)
    with pytest.raises(ValueError, match=r"'action' has the shape \[1, 3\], must be"):
        network(observation, smoke.action[:1])
    with pytest.raises(ValueError, match=r"'proprioception' has the shape \[20\], must be \[batch, 20\]"):
        network({name: values[0] for name, values in observation.items()}, smoke.action)
    with pytest.raises(ValueError, match=r"64, 64, 3\], must be .* 3, 64, 64\]; channels come first in PyTorch"):
        network(smoke.observation, smoke.action)
    with pytest.raises(TypeError, match=r"'vision' must be uint8, or float in \[0, 1\]"):
        network({**observation, "vision": observation["vision"].astype(int)}, smoke.action)
    copied = pickle.loads(pickle.dumps(network))
    assert torch.equal(copied.encode(observation)[0], network.encode(observation)[0])
    count = sum(values.numel() for values in network.parameters())
    described = "proprioception, vision to proprioception, contact_force, frame_difference, latent 4"
    assert repr(copied) == f"<harness.networks.Network: {described}, {count:,} parameters>"
    assert network.to(torch.device("cpu")).state_dict()["scale_vision_mean"].dtype == torch.float32


def test_without_torch_one_line_says_what_to_install(results: Path) -> None:
    script = (
        "import sys; sys.modules['torch'] = None; import harness\n"
        f"try: harness.load_network('smoke/empty', {str(results)!r})\n"
        "except ImportError as error: print(error)"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert said.startswith("load_network needs PyTorch: pip install torch safetensors (") and said.count("\n") == 1


def test_the_command_exports_a_network_without_further_packages(results: Path, tmp_path: Path) -> None:
    """The package itself requires NumPy, Polars and MuJoCo only."""
    file = tmp_path / "network.onnx"
    words = ["harness", "export", "--format", "onnx", "smoke/empty", str(file), "--results", str(results)]
    script = (
        "import sys; sys.modules['tqdm'] = None\n"
        f"sys.argv = {words!r}\n"
        "from harness.__main__ import main\n"
        "main()"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, f"{file}\n", "")
    onnx.checker.check_model(onnx.load(file))


def code_in_the_documentation(library: str) -> dict[str, Any]:
    """Returns what the file of the documentation for a library defines, by name."""
    return runpy.run_path(str(ROOT / "docs" / "code" / f"network_{library}.py"))


def test_the_numpy_code_in_the_documentation_predicts(folder: Path) -> None:
    trained = Trained("single_to_multi", folder)
    description, tensors = read_file(trained.results / "runs" / "smoke" / trained.run / "prediction.safetensors")
    predict = code_in_the_documentation("numpy")["predict"]
    trained.assert_equal(predict(description, tensors, trained.observation, trained.action), trained.predicted)


DISTRIBUTIONS: Overrides = {
    "input": ["proprioception", "arm"],
    "output": ["proprioception", "contact_force"],
    "outputs": {
        "proprioception": {"predict": "change", "distribution": "gaussian"},
        "contact_force": {"distribution": "hurdle"},
    },
}


def test_every_program_gives_the_same_distributions(folder: Path, tmp_path: Path) -> None:
    trained = Trained("distributions", folder, DISTRIBUTIONS)
    description, tensors = read_file(trained.results / "runs" / "smoke" / trained.run / "prediction.safetensors")
    assert description["format"] == 4
    predict = code_in_the_documentation("numpy")["predict"]
    expected = predict(description, tensors, trained.observation, trained.action)
    trained.assert_equal({name: expected[name] for name in trained.predicted}, trained.predicted)
    parameters = {"proprioception.scale", *(f"contact_force.{part}" for part in ("scale", "touch", "location"))}
    assert expected.keys() == parameters | trained.predicted.keys()
    assert expected["contact_force.location"].min() >= 0.05 and 0 < expected["contact_force.touch"].min() < 1
    path = tmp_path / "network.onnx"
    harness.export_onnx(trained.run, path, results=trained.results)
    onnx.checker.check_model(onnx.load(path), full_check=True)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    outputs = [f"predicted.{name}" for name in expected]
    answers = session.run(outputs, {**trained.observation, "action": trained.action})
    found = [dict(zip(expected, answers, strict=True))]
    if importlib.util.find_spec("torch"):
        network = harness.load_network(trained.run, trained.results)
        predicted = network(trained.observation, trained.action)
        found.append({name: values.detach().numpy() for name, values in predicted.items()})
    for program in found:
        assert program.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_allclose(program[name], values, rtol=2e-5, atol=2e-5 * np.abs(values).max(), err_msg=name)


def test_the_documented_torch_code_computes_every_layer(folder: Path) -> None:
    torch = pytest.importorskip("torch", reason="`make interchange` tests with torch")
    names = code_in_the_documentation("torch")
    computed = set()
    for kind in ("averaged", "averaged, late, deep", "product"):
        trained = Trained(kind, folder)
        network = harness.load_network(trained.run, trained.results)
        tensors = dict(network.named_parameters())
        values = network._normalized(channels_first(trained.observation))
        for layer in network.description["encoder"]:
            values[layer["name"]] = names["compute"](layer, [values[name] for name in layer["inputs"]], tensors)
        mean, log_variance = values["posterior"].detach().numpy().reshape(-1, 2, trained.model.latent).swapaxes(0, 1)
        trained.assert_same_posterior(mean, log_variance)
        values |= {"latent": values["posterior"][:, : trained.model.latent], "action": torch.tensor(trained.action)}
        values["action"] = (values["action"] - network.scale_action_mean) / network.scale_action_deviation
        for layer in network.description["decoder"]:
            values[layer["name"]] = names["compute"](layer, [values[name] for name in layer["inputs"]], tensors)
        image = values["conv"].detach() * network.scale_frame_difference_deviation
        image += network.scale_frame_difference_mean.reshape(image.shape[1:])
        expected = channels_first({"frame_difference": trained.predicted["frame_difference"]})
        trained.assert_equal({"frame_difference": image.numpy()}, expected)
        computed |= {layer["kind"] for part in ("encoder", "decoder") for layer in network.description[part]}
    assert computed == {
        "columns",
        "concatenate",
        "flatten",
        "product_of_experts",
        "reshape",
        "average",
        "dense",
        "convolution",
        "transposed_convolution",
        "layer_normalization",
    }
