"""Labels of episodes, splits by them, and folds, compared with scikit-learn."""

import json
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from sklearn.model_selection import GroupKFold

import harness
from harness.importing import MappingError, import_dataset
from harness.prediction import PredictionTask

OBJECTS = {"3D-Printed Part": 3, "book": 2, "lotion": 1, "cup": 2, "can": 1}
"""The objects, and how many trials each has."""


def touched(folder: Path, **keys) -> str:
    """Imports trials of a gripper whose force on two pads follows from what it touches."""
    for place, (name, trials) in enumerate(OBJECTS.items()):
        for trial in range(1, trials + 1):
            random = np.random.default_rng([place, trial])
            grip = np.abs(np.sin(np.arange(60 + 10 * place) / 9 + random.uniform(0, 6)))
            columns = {"pad_left": grip * (1 + place), "pad_right": grip * 2, "grip": grip}
            pl.DataFrame(columns).write_csv(folder / f"{name}_{trial:03}.csv")
    mapping = {"name": "touch", "source": ".", "format": "csv", "sample_rate_hz": 20, "max_gap_s": 1}
    mapping |= {"streams": {"log": {"file": "*.csv", "rate_hz": 20}}, "trial": "{object}_{n:int}.csv"}
    mapping |= {"modalities": {"setpoint": "none", "pads": "log.pad_*", "grip": "log.grip"}} | keys
    (folder / "touch.yaml").write_text(json.dumps(mapping))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return import_dataset(folder / "touch.yaml", folder / "results", progress=False)


def spec(folder: Path, dataset: str, split: dict) -> Path:
    keys = {"name": "touch", "scenarios": dataset, "input": "grip", "output": "pads", "latent": 2, "split": split}
    keys |= {"tasks": "prediction", "network": {"preset": "single_to_multi", "hidden": 8}, "training": {"epochs": 1}}
    (folder / "spec.yaml").write_text(json.dumps(keys))
    return folder / "spec.yaml"


def objects_of(task: PredictionTask, labels: pl.DataFrame) -> list[set[str]]:
    """The objects in the training, the validation and the test."""
    first = [start for start, _ in task.bounds()]
    parts = (task.train(), task.validation(), task.test_inputs())
    return [{labels["object"][int(np.searchsorted(first, at, "right")) - 1] for at in part.samples} for part in parts]


def labels_of(results: Path) -> pl.DataFrame:
    return harness.query(
        "select episode, object, n, trial, count(*) as samples from episodes group by all order by all", results
    )


def test_names_of_files_and_a_table_give_labels(tmp_path):
    (tmp_path / "trials.csv").write_text("object,Mass (g)\n" + "".join(f"{name},{len(name)}.5\n" for name in OBJECTS))
    touched(tmp_path, episodes="trials.csv")
    labels = labels_of(tmp_path / "results")
    assert labels.height == 9
    assert labels.filter(object="3D-Printed Part")["n"].to_list() == [1, 2, 3]
    assert labels["trial"][0] == "3D-Printed Part_001"
    masses = harness.query("select distinct object, mass_g from episodes", tmp_path / "results")
    assert dict(masses.rows()) == {name: len(name) + 0.5 for name in OBJECTS}
    columns = harness.query("select * from episodes limit 1", tmp_path / "results").columns
    assert [name for name in columns if name.startswith("pads_")] == ["pads_pad_left", "pads_pad_right"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"trial": "{object}-{n:int}.csv"}, "trial: '3D-Printed Part_001.csv' does not match"),
        ({"trial": "{object}_{n:whole}.csv"}, r"trial: {n:whole} is not understood"),
        ({"episodes": "trials.csv"}, r"trials.csv: has 0 rows for the trial with object 3D-Printed Part; it needs one"),
        ({"split": {"by": "subject"}}, "split.by: there is no label 'subject'; the labels are trial, object, n"),
        ({"split": {"by": "object", "test": ["pen"]}}, "split.test: no episode has the object pen; there are 3D-"),
    ],
)
def test_wrong_labels_are_refused(tmp_path, keys, message):
    if "episodes" in keys:
        (tmp_path / "trials.csv").write_text("object\nbook\n")
    with pytest.raises(MappingError, match=message):
        touched(tmp_path, **keys)
    assert not (tmp_path / "results").exists()


def test_groups_are_in_one_part(tmp_path):
    dataset, results = touched(tmp_path), tmp_path / "results"
    labels = labels_of(results)
    task = harness.task(spec(tmp_path, dataset, {"by": "object", "test": ["book", "lotion"]}), results=results)
    training, validation, test = objects_of(task, labels)
    assert test == {"book", "lotion"} and len(validation) == 1 and not training & validation and len(training) == 2
    # By default, whole trials are divided at random, as the dataset says.
    stored = json.loads((results / "datasets" / dataset / "dataset.json").read_text())["imported"]["split"]
    assert stored == {"by": "trial", "seed": 0}
    assert task.labels()["object"].to_list() == labels["object"].to_list()
    parts = harness.task(spec(tmp_path, dataset, {}), results=results)
    last = parts.bounds()[-1][0]
    assert not {int(at) for at in parts.test_inputs().samples} & set(range(last, last + 200))
    for split, message in (
        ({"by": "subject"}, "there is no label 'subject'; the labels are n, object, trial"),
        ({"by": "object", "test": ["pen"]}, "no episode has the object 'pen'; there are 3D-Printed Part, book"),
        ({"by": "object", "folds": 6}, "6 folds need as many groups, and there are 5"),
    ):
        with pytest.raises(Exception, match=message):
            harness.run(spec(tmp_path, dataset, split), results=results, progress=False)


def test_folds_are_those_of_scikit_learn_and_replicates_of_one_cell(tmp_path):
    dataset, results = touched(tmp_path), tmp_path / "results"
    labels, path = labels_of(results), spec(tmp_path, dataset, {"by": "object", "folds": 3})
    groups = np.repeat(labels["object"].to_list(), labels["samples"].to_list())
    expected = [set(groups[test]) for _, test in GroupKFold(3).split(groups, groups=groups)]
    found = [objects_of(harness.task(path, {"split.fold": fold}, results=results), labels) for fold in range(3)]
    assert [test for _, _, test in found] == expected
    assert all(not training & test and not validation & test for training, validation, test in found)
    harness.run(path, results=results, progress=False)
    runs = harness.query("select run, dataset_seed, variant from runs order by dataset_seed", results)
    assert runs["dataset_seed"].to_list() == [0, 1, 2] and set(runs["variant"]) == {""}
    table = harness.compare("touch", results=results)
    assert set(table.filter(model="network", metric="r2")["datasets"]) == {3}


def test_the_import_tells_the_split_and_what_may_be_wrong(tmp_path):
    touched(tmp_path)
    command = [sys.executable, "-m", "harness.importing", "touch.yaml"]
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert "runs that ask for no other split divide by trial: 7 for training, " in told
    for trial in range(100):
        shutil.copy(tmp_path / "book_001.csv", tmp_path / f"book_{100 + trial}.csv")
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    (line,) = [line for line in told.splitlines() if line.startswith("runs that ask for no other split")]
    assert re.fullmatch(r".* for training, .* and \d+ more for validation, .* and \d+ more for the test", line), line
    one = tmp_path / "one"
    one.mkdir()
    columns = {"x": np.sin(np.arange(3000) / 30), "y": np.arange(3000)}
    pl.DataFrame(columns).write_csv(one / "log.csv")
    mapping = {"name": "long", "source": "log.csv", "format": "csv", "sample_rate_hz": 20, "max_gap_s": 1}
    mapping |= {"streams": {"log": {"rate_hz": 20}}, "max_episode_s": 70}
    mapping |= {"modalities": {"setpoint": "none", "x": "log.x", "y": "log.y"}}
    (one / "long.yaml").write_text(json.dumps(mapping))
    with pytest.warns(UserWarning) as told:
        dataset = import_dataset(one / "long.yaml", one / "results", progress=False)
    text = "\n".join(str(each.message) for each in told)
    assert "all episodes are of one trial" in text
    assert "in 50 % of the test samples, y is beyond its range in the training" in text
    # Two episodes of 70 s, and a rest of 10 s, in which two gaps of 5 s leave nothing.
    assert "1 episode with 200 samples are left out, because they are too short for a split by time" in text
    task = harness.task(dataset=dataset, inputs="x", outputs="y", results=one / "results")
    assert {int(at) // 1400 for at in task.test_inputs().samples} == {0, 1}


def pushed(folder: Path, name: str, first: int, objects: int) -> str:
    """Imports three trials with each of some objects. An object adds a force of its own. It also has its own
    temperature, which tells the object, and nothing of other objects."""
    place = folder / name
    place.mkdir()
    for number in range(first, first + objects):
        temperature, force = np.random.default_rng(number).normal(0, [3, 1])
        for trial in range(3):
            random = np.random.default_rng([number, trial])
            grip = random.uniform(0, 1, 40)
            columns = {"grip": grip, "temperature": temperature + random.normal(0, 0.001, 40), "force": grip + force}
            pl.DataFrame(columns).write_csv(place / f"o{number}_{trial}.csv")
    mapping = {"name": name, "source": name, "format": "csv", "sample_rate_hz": 20, "max_gap_s": 1}
    mapping |= {"streams": {"log": {"file": "*.csv", "rate_hz": 20}}, "trial": "{object}_{n:int}.csv"}
    mapping |= {"modalities": {"setpoint": "none", "touch": ["log.grip", "log.temperature"], "force": "log.force"}}
    (folder / f"{name}.yaml").write_text(json.dumps(mapping))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return import_dataset(folder / f"{name}.yaml", folder / "results", progress=False)


def test_grouped_folds_tell_the_error_on_new_objects_and_shuffled_trials_do_not(tmp_path):
    known, new = pushed(tmp_path, "known", 0, 16), pushed(tmp_path, "new", 100, 60)
    keys = {"scenarios": known, "input": "touch", "output": "force", "latent": 2, "tasks": "prediction"}
    keys |= {"window": {"horizon": 0}, "network": {"preset": "single_to_multi", "hidden": 4}, "training": {"epochs": 1}}
    errors = {}
    for name, more in {
        "objects": {"split": {"by": "object", "folds": 4}},
        "trials": {"split": {"by": "trial", "folds": 4}},
        "truth": {"test": {"dataset": new}},
    }.items():
        (tmp_path / f"{name}.yaml").write_text(json.dumps({"name": name} | keys | more))
        harness.run(tmp_path / f"{name}.yaml", results=tmp_path / "results", progress=False)
        table = harness.compare(name, metrics=["rmse"], results=tmp_path / "results")
        errors[name] = table.filter(model="nearest_neighbors").row(0, named=True)
    truth = errors["truth"]["mean"]
    assert errors["objects"]["low"] < truth < errors["objects"]["high"], errors
    assert errors["trials"]["high"] < truth / 2, errors
