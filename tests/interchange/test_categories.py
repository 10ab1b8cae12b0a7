"""Categories: labels and columns as inputs and outputs of networks, compared with scikit-learn and ONNX Runtime."""

import importlib.util
import json
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import polars as pl
import pytest
from sklearn.metrics import accuracy_score, balanced_accuracy_score, confusion_matrix, log_loss
from sklearn.model_selection import GroupKFold

import harness
from harness.importing import MappingError, import_dataset

OBJECTS = ["book", "cup", "toy ball"]
NAMES = ["book", "cup", "toy_ball"]
"""What the elements of the objects are called."""
STATES = ["open", "closing", "closed"]
NAMES_OF = {"object": NAMES, "state": STATES}


def touched(folder: Path, modalities: dict | None = None, objects: list[str] = OBJECTS, trials: int = 6, **keys) -> str:
    """Imports trials of a hand that closes around an object, whose stiffness tells the object."""
    for place, name in enumerate(objects):
        for trial in range(trials):
            random = np.random.default_rng([place, trial])
            grip = np.clip(np.sin(np.arange(80) / 12 + random.uniform(0, 6)), -0.5, 0.5) + 0.5
            touch = grip[:, None] * [1.0, 1 + place] + random.normal(0, 0.02, (80, 2))
            state = np.select([grip <= 0, grip < 1], STATES[:2], STATES[2])
            columns = {"left": touch[:, 0], "right": touch[:, 1], "state": state, "phase": np.arange(80) // 40}
            pl.DataFrame(columns).write_csv(folder / f"{name}_{trial}.csv")
    text = {"name": "hand", "source": ".", "format": "csv", "sample_rate_hz": 20, "max_gap_s": 1}
    text |= {"streams": {"log": {"file": "*.csv", "rate_hz": 20}}, "trial": "{object}_{n:int}.csv"}
    of_state = {"from": "log.state", "categories": STATES}
    text["modalities"] = {"setpoint": "none", "touch": ["log.left", "log.right"], "state": of_state}
    text["modalities"] |= {"object": {"label": "object"}} if modalities is None else modalities
    (folder / "hand.yaml").write_text(json.dumps(text | keys))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return import_dataset(folder / "hand.yaml", folder / "results", progress=False)


def spec(folder: Path, dataset: str, **keys) -> Path:
    text = {"name": "hand", "scenarios": dataset, "input": "touch", "output": "object", "latent": 4}
    text |= {"tasks": "prediction", "network": {"preset": "single_to_multi", "hidden": 32}, "window": {"horizon": 0}}
    text |= {"training": {"epochs": 40, "batch_size": 64, "learning_rate": 0.003}} | keys
    (folder / "spec.yaml").write_text(json.dumps(text))
    return folder / "spec.yaml"


def run(folder: Path, dataset: str, **keys) -> Path:
    harness.run(spec(folder, dataset, **keys), results=folder / "results", progress=False)
    return folder / "results"


def predicted(results: Path, modality: str = "object") -> tuple[np.ndarray, np.ndarray]:
    """The recorded categories of the test samples, and the predicted probabilities."""
    order = "from predictions where modality = '{}' order by run, episode, sample, index"
    rows = harness.query(f"select reference, predicted {order.format(modality)}", results)
    reference, values = (rows[name].to_numpy().reshape(-1, 3) for name in ("reference", "predicted"))
    assert (np.sort(reference, 1) == [0, 0, 1]).all()
    return reference.argmax(1), values.astype(np.float32)


def test_labels_and_columns_become_elements_named_by_their_categories(tmp_path):
    dataset = touched(tmp_path)
    results = tmp_path / "results"
    columns = [*(f"object_{name}" for name in NAMES), *(f"state_{name}" for name in STATES)]
    rows = harness.query(f"select object, trial, sample, {', '.join(columns)} from episodes", results)
    assert rows["object"].to_list() == [OBJECTS[place] for place in rows.select(columns[:3]).to_numpy().argmax(1)]
    assert (rows.select(columns).to_numpy().reshape(-1, 2, 3).sum(2) == 1).all()
    text = pl.read_csv(tmp_path / "cup_2.csv")["state"].to_list()
    of_trial = rows.filter(trial="cup_2").sort("sample")
    assert [STATES[place] for place in of_trial.select(columns[3:]).to_numpy().argmax(1)] == text
    layout = json.loads((results / "datasets" / dataset / "dataset.json").read_text())["imported"]["layout"]
    assert [each["name"] for each in layout["modalities"] if each.get("category")] == ["state", "object"]


@pytest.mark.parametrize(
    ("modalities", "message"),
    [
        ({"object": {"label": "thing"}}, "object: there is no label 'thing'; the labels are trial, object, n"),
        (
            {"object": {"label": "object", "categories": ["book", "cup"]}},
            "modalities.object: episode 12: 'toy ball' is none of the categories book, cup; add it to 'categories'",
        ),
        (
            {"now": {"from": "log.state", "categories": [*STATES, "lost"]}},
            "'log.state' has another 'categories' in modalities.state",
        ),
        ({"now": {"from": "log.phase", "categories": ["a!", "A"]}}, "the categories 'a!' and 'A' are called 'A' in"),
        ({"now": {"from": "log.phase", "categories": [0, 2]}}, r"line 42: '1' is none of the categories 0, 2; add it"),
        ({"now": {"from": ["log.phase", "log.left"], "categories": [0, 1]}}, "modalities.now"),
    ],
)
def test_wrong_categories_are_refused(tmp_path, modalities, message):
    with pytest.raises(MappingError, match=message):
        touched(tmp_path, modalities)
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("kind", ["rows", "streams", "arrays"])
def test_categories_are_texts_or_numbers_in_any_format_and_may_be_missing(tmp_path, kind):
    random = np.random.default_rng(0)
    number, x = random.choice([-1.0, 2.0, 7.0], (3, 30)), random.normal(size=(3, 30))
    text = np.where(number < 0, "open", np.where(number < 5, "closing", "closed"))
    now = {"state": {"categories": STATES}, "number": {"categories": [-1, 2, 7]}}
    mapping = {"name": "kinds", "source": ".", "sample_rate_hz": 10}
    if kind == "rows":
        trial, row = np.repeat([0, 1, 2], 30), np.tile(np.arange(30), 3)
        columns = {"trial": trial, "row": row, "x": x.ravel(), "state": text.ravel(), "number": number.ravel()}
        pl.DataFrame(columns).cast({"number": pl.Int32}).write_parquet(tmp_path / "all.parquet")
        mapping |= {"format": "parquet", "source": "all.parquet", "episode": "trial", "order": "row"}
    elif kind == "streams":
        for trial in range(3):
            columns = {"x": x[trial], "state": text[trial], "number": number[trial], "t": np.arange(30) / 10}
            table = pl.DataFrame(columns).cast({"state": pl.String, "number": pl.String})
            missing = pl.DataFrame({"x": [0.0] * 3, "state": ["?", "open", None], "number": ["2", "-9", "2"]})
            missing = missing.with_columns(t=pl.Series([0.01, 0.02, 0.03]))
            pl.concat([table[:1], missing, table[1:]]).write_csv(tmp_path / f"{trial}.csv")
        stream = {"file": "*.csv", "time": "t", "missing": "skip", "missing_values": ["?", -9]}
        mapping |= {"format": "csv", "max_gap_s": 1, "align": "mean", "streams": {"log": stream}}
    else:
        for trial in range(3):
            np.savez(tmp_path / f"{trial}.npz", x=x[trial], state=text[trial], number=number[trial])
        mapping |= {"format": "numpy", "max_gap_s": 1, "streams": {"log": {"data": "/", "rate_hz": 10}}}
    place = "" if kind == "rows" else "log."
    modalities = {name: {"from": f"{place}{name}"} | keys for name, keys in now.items()}
    mapping["modalities"] = {"setpoint": "none", "x": f"{place}x"} | modalities
    (tmp_path / "kinds.yaml").write_text(json.dumps(mapping))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import_dataset(tmp_path / "kinds.yaml", tmp_path / "results", progress=False)
    columns = [*(f"state_{name}" for name in STATES), "number_1", "number_2", "number_7"]
    rows = harness.query(f"select {', '.join(columns)} from episodes order by episode, sample", tmp_path / "results")
    elements = rows.to_numpy().reshape(3, 30, 2, 3)
    assert (elements.sum(3) == 1).all()
    assert (np.array(STATES)[elements[:, :, 0].argmax(2)] == text).all()
    assert (np.array([-1, 2, 7])[elements[:, :, 1].argmax(2)] == number).all()


def test_metrics_and_the_confusion_are_those_of_scikit_learn(tmp_path):
    results = run(tmp_path, touched(tmp_path), output=["object", "state"], split={"by": "trial", "folds": 3})
    rows = harness.query("select * from metrics where model = 'network' and modality = 'object'", results)
    category, values = predicted(results)
    np.testing.assert_allclose(values.sum(1), 1, atol=1e-5)
    assert (values >= 0).all()
    counted = "select run, count(*) as samples from predictions where modality = 'object' and index = 0"
    runs = harness.query(f"{counted} group by run order by run", results)
    first = 0
    for name, samples in runs.rows():
        own, first = slice(first, first + samples), first + samples
        true, chosen = category[own], values[own].argmax(1)
        of_run = rows.filter(pl.col("run") == name)
        whole = dict(of_run.filter(pl.col("index").is_null()).select("metric", "value").rows())
        assert whole["accuracy"] == pytest.approx(accuracy_score(true, chosen))
        assert whole["balanced_accuracy"] == pytest.approx(balanced_accuracy_score(true, chosen))
        assert whole["log_loss"] == pytest.approx(log_loss(true, values[own], labels=range(3)), rel=1e-5)
        pairs = of_run.filter(metric="confusion").select("direction", "value").rows()
        counts = {tuple(pair.split(" as ")): count for pair, count in pairs}
        expected = confusion_matrix(true, chosen, labels=range(3))
        assert counts == {(a, b): n for a, row in zip(NAMES, expected) for b, n in zip(NAMES, row) if n}
    # Every trial is tested once, and the touch tells the object while the hand is not open.
    table = harness.compare("hand", metrics=["accuracy", "log_loss"], of="object", results=results)
    found = {(row["model"], row["metric"]): row["mean"] for row in table.iter_rows(named=True)}
    assert found["network", "accuracy"] > found["training_mean", "accuracy"] + 0.2
    assert found["network", "log_loss"] < found["training_mean", "log_loss"] == pytest.approx(np.log(3), abs=0.1)
    assert {"ridge", "nearest_neighbors"} <= {model for model, _ in found}


def test_the_documented_queries_give_the_confusion_and_metrics_by_label(tmp_path):
    keys = {"input": "state", "output": ["object", "touch"], "split": {"by": "trial", "folds": 3}}
    results = run(tmp_path, touched(tmp_path), **keys)
    pages = {name: (Path(__file__).parents[2] / "docs" / name).read_text() for name in ("metrics.md", "tables.md")}
    queries = [query.split('"')[0] for page in pages.values() for query in page.split('harness query "')[1:]]
    (confusion,) = [query for query in queries if "metric = 'confusion'" in query]
    table = harness.query(confusion, results)
    category, values = predicted(results)
    expected = confusion_matrix(category, values.argmax(1), labels=range(3))
    counts = {(a, b): n for a, b, n in table.select("category", "predicted", "samples").rows()}
    assert counts == {(a, b): n for a, row in zip(NAMES, expected) for b, n in zip(NAMES, row) if n}
    (by_label,) = [query for query in queries if "from sums" in query and "group by object" in query]
    (name,) = harness.query("select distinct experiment from runs", results)["experiment"]
    for told, own in (("'force'", "'touch'"), ("'grasp'", f"'{name}'"), ("horizon = 1", "horizon = 0")):
        by_label = by_label.replace(told, own)
    table = harness.query(by_label, results)
    rows = harness.query("select * from predictions where modality = 'touch'", results)
    rows = rows.join(harness.query("select distinct episode, object from episodes", results), on="episode")
    # Deviations are those from the mean of each fold's test.
    mean = pl.col("reference").mean().over("run", "index")
    sums = rows.with_columns(d=(pl.col("reference") - mean) ** 2, e=(pl.col("reference") - pl.col("predicted")) ** 2)
    expected = dict(sums.group_by("object").agg(1 - pl.col("e").sum() / pl.col("d").sum()).rows())
    found = {row["object"]: row["r2"] for row in table.iter_rows(named=True) if row["model"] == "network"}
    assert found == pytest.approx(expected, abs=3e-3) and found.keys() == {*OBJECTS}


def test_the_figure_of_the_confusion_has_the_counts_of_the_table(tmp_path):
    results = run(tmp_path, touched(tmp_path), output=["object", "state"], training={"epochs": 2})
    command = [sys.executable, "-m", "harness", "--results", str(results), "figures", "confusion"]
    command += ["--experiment", "hand"]
    for of in NAMES_OF:
        subprocess.run([*command, "--of", of, "--output", of], cwd=tmp_path, capture_output=True, check=True)
        table = pl.read_csv(tmp_path / of / "confusion.csv")
        category, values = predicted(results, of)
        expected = confusion_matrix(category, values.argmax(1), labels=range(3))
        counts = {(a, b): n for a, b, n in table.select("category", "predicted", "samples").rows()}
        names = NAMES_OF[of]
        assert counts == {(a, b): n for a, row in zip(names, expected) for b, n in zip(names, row) if n}
        svg = (tmp_path / of / "confusion.svg").read_text()
        assert all(f'aria-label="{name.replace("_", " ")}"' in svg for name in names)
    told = subprocess.run([*command, "--of", "touch"], cwd=tmp_path, capture_output=True, text=True)
    assert told.returncode == 1 and "have no rows for the figure" in told.stderr


def test_a_category_that_the_training_lacks_is_told_and_folds_are_those_of_scikit_learn(tmp_path):
    dataset = touched(tmp_path, objects=[*OBJECTS, "can"], trials=2)
    path = spec(tmp_path, dataset, split={"by": "object", "folds": 4}, training={"epochs": 1})
    command = [sys.executable, "-m", "harness", "--results", str(tmp_path / "results"), "run", str(path)]
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    text = " ".join((told.stdout + told.stderr).split())
    for name in (*NAMES, "can"):
        assert f"the training has no {name} of object, which the test has, so no model can learn to predict it" in text
    assert "is not defined" not in text and "object is beyond" not in text
    results = tmp_path / "results"
    labels = harness.query("select episode, object, count(*) as n from episodes group by all order by episode", results)
    groups = np.repeat(labels["object"].to_list(), labels["n"].to_list())
    expected = [{*groups[test]} for _, test in GroupKFold(4).split(groups, groups=groups)]
    pairs = "select dataset_seed, direction from metrics join runs using (run) where metric = 'confusion' and model = "
    rows = harness.query(pairs + "'ridge'", results)
    true = [{pair.split(" as ")[0] for pair in rows.filter(dataset_seed=fold)["direction"]} for fold in range(4)]
    assert [{name.replace("_", " ") for name in names} for names in true] == expected
    of_baselines = "metric = 'accuracy' and index is null and model <> 'network'"
    values = harness.query(f"select value from metrics where {of_baselines}", results)["value"]
    assert values.to_list() == [0.0] * 12


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_exported_networks_give_the_same_probabilities(tmp_path, memory):
    network = {"preset": "single_to_multi", "hidden": 16, "memory": memory}
    context = {"none": 1, "gru": 6}[memory]
    keys = {"network": network, "input": ["touch", "object"], "output": ["state", "touch"]}
    window = {"context": context, "horizon": 1}
    results = run(tmp_path, touched(tmp_path), **keys, window=window, training={"epochs": 3, "batch_size": 64})
    (run_name,) = harness.query("select run from runs", results)["run"]
    harness.export_onnx(f"hand/{run_name}", tmp_path / "network.onnx", results=results)
    session = onnxruntime.InferenceSession(tmp_path / "network.onnx")
    stored = harness.Dataset(*(results / "datasets").iterdir())
    of_state = "select * from predictions where modality = 'state' order by episode, sample, index"
    rows = harness.query(of_state, results)
    predictions = rows["predicted"].to_numpy().reshape(-1, 3)
    expected = dict(zip(rows.select("episode", "sample").rows()[::3], predictions, strict=True))
    (episode, sample) = min(expected)
    values = harness.query(f"select * from episodes where episode = {episode} order by sample", results)
    state, seen = np.zeros((1, 0), np.float32), np.ones((1, 1), np.float32)
    if memory != "none":
        width = next(each.shape[1] for each in session.get_inputs() if each.name == "state")
        state = np.zeros((1, width), np.float32)
    names = [each.name for each in session.get_outputs()]
    has_torch = importlib.util.find_spec("torch")
    network = harness.load_network(f"hand/{run_name}", results) if has_torch else None
    of_network = None
    for row in range(sample - context, sample):
        at = values.slice(row, 1)
        columns = {"touch": ["touch_left", "touch_right"], "object": [f"object_{each}" for each in NAMES]}
        given = {name: at.select(own).to_numpy().astype(np.float32) for name, own in columns.items()}
        given |= {} if memory == "none" else {"state": state, "seen": seen}
        answer = dict(zip(names, session.run(names, given), strict=True))
        state = answer.get("state.next", state)
        if network is not None and memory != "none":
            seen_by_network = {name: given[name] for name in columns}
            of_network = network.act(network.observe(of_network, seen_by_network))
    if network is not None:
        found = network(given) if memory == "none" else network.predict(of_network)
        np.testing.assert_allclose(found["state"].detach().numpy(), answer["predicted.state"], atol=1e-5)
    np.testing.assert_allclose(answer["predicted.state"][0], expected[episode, sample], atol=1e-5)
    assert answer["predicted.state"].sum() == pytest.approx(1, abs=1e-5)
    assert stored.keys() == ["touch", "state", "object"]
