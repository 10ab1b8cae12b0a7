"""Models of other programs: their windows and their metrics, compared with numpy, scikit-learn and our own networks."""

import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
from conftest import ROOT, SMOKE, check_example
from sklearn.metrics import mean_absolute_error, r2_score, root_mean_squared_error

import harness
from harness.prediction import Arrays, PredictionTask

AHEAD = {
    "input": ["proprioception", "arm"],
    "output": ["proprioception", "arm", "contact_force"],
    "window.context": 3,
    "window.horizon": 5,
}
"""Settings of the smoke experiment with longer windows, for networks that predict only vectors."""


def files(folder: Path) -> dict[Path, int]:
    """All files below a folder, with the time of their last change."""
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*")) if path.is_file()}


def last(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Repeats the last angles, and predicts forces that depend on them."""
    now = np.repeat(context["proprioception"][:, -1:], actions.shape[1], 1)
    return {"proprioception": now, "contact_force": np.abs(now)}


def vectors(results: Path) -> PredictionTask:
    """A task with vectors only."""
    changes = {"input": ["proprioception"], "output": ["proprioception", "contact_force"]}
    return harness.task(SMOKE, {**AHEAD, **changes}, cell="empty", results=results)


def test_windows_are_those_of_the_split(results: Path, folders: dict[str, Path]) -> None:
    task = harness.task(SMOKE, AHEAD, cell="empty", results=results)
    data = harness.Dataset(folders["empty"])
    assert (task.context, task.horizon, task.horizons) == (3, 5, (1, 2, 5))
    # Two episodes of 30 samples for training. The first two samples have no context, the last five no horizon.
    assert [len(part) for part in (task.train(), task.validation(), task.test_inputs())] == [46, 23, 23]
    windows = task.train()
    assert windows.samples.tolist() == [*range(2, 25), *range(32, 55)]
    context, actions, targets = windows[30]
    present = windows.samples[30]
    assert np.array_equal(context["proprioception"], data["proprioception"][present - 2 : present + 1])
    assert np.array_equal(targets["contact_force"], data["contact_force"][present + 1 : present + 6])
    steps = np.diff(data["setpoint"], axis=0)
    assert np.array_equal(actions, steps[present : present + 5])
    assert np.array_equal(context["action"], steps[present - 2 : present])
    everything, some = windows[:], windows[[40, 3, 3]]
    for batch, chosen in ((some, [40, 3, 3]), (windows[5:9], range(5, 9))):
        for name, array in batch.context.items():
            assert np.array_equal(array, everything.context[name][list(chosen)]), name
        assert np.array_equal(batch.actions, everything.actions[list(chosen)])
    blocks = list(windows.blocks())
    assert [len(block.actions) for block in blocks] == [23, 23]
    assert np.array_equal(np.concatenate([block.targets["arm"] for block in blocks]), everything.targets["arm"])
    assert task.test_inputs()[:].targets == {}


def test_consecutive_windows_are_views(results: Path) -> None:
    task = harness.task(SMOKE, AHEAD, cell="empty", results=results)
    for block in task.train().blocks():
        for name, array in (*block.context.items(), *block.targets.items()):
            if name != "action":
                assert np.shares_memory(array, task.array(name)) and not array.flags.writeable, name


def test_images_and_their_changes_are_in_windows(results: Path, folders: dict[str, Path]) -> None:
    task = harness.task(SMOKE, cell="empty", results=results)
    frames = harness.Dataset(folders["empty"])["vision"]
    context, _, targets = task.train()[[0, 29]]
    assert np.array_equal(context["vision"][:, 0], frames[[0, 30]])
    change = (frames[[1, 31]].astype(np.float32) - frames[[0, 30]].astype(np.float32)) / np.float32(255)
    assert np.array_equal(targets["frame_difference"][:, 0], change)


def judged(results: Path, architecture: str) -> dict[str, polars.DataFrame]:
    """The tables of the run of seed 7 of a model, without the columns that name it and its latent state."""
    tables = {}
    for table in ("all_metrics", "all_predictions", "frames", "forces"):
        condition = "task = 'prediction' and" if table != "forces" else ""
        # Only networks of the harness have a latent state.
        condition += " modality <> 'latent' and" if table == "all_metrics" else ""
        sql = f"select * from {table} where {condition} seed = 7 and architecture = '{architecture}'"
        rows = harness.query(sql, results).drop("run", "architecture", "latent", "variant")
        if table == "all_metrics":
            rows = rows.drop("trained_here").with_columns(polars.col("model").replace(architecture, "network"))
        keys = [name for name in rows.columns if name not in ("value", "reference", "predicted")]
        tables[table] = rows.sort(keys, nulls_last=True)
    return tables


def predictions_table(task: PredictionTask, predicted: dict[str, np.ndarray]) -> polars.DataFrame:
    """The rows of a file of predictions of the next sample, `[windows, ...]` for each output."""
    present = task.test_inputs().samples
    bounds = task.bounds()
    episode = np.searchsorted(bounds[:, 0], present, side="right") - 1
    sample = present + 1 - bounds[episode, 0]
    tables = []
    for name, values in predicted.items():
        windows, width = len(values), values[0].size
        columns = {"episode": np.repeat(episode, width), "sample": np.repeat(sample, width)}
        columns |= {"index": np.tile(np.arange(width), windows), "value": np.ascontiguousarray(values).ravel()}
        tables.append(polars.DataFrame(columns).with_columns(modality=polars.lit(name)))
    return polars.concat(tables)


IMAGES_OF_BOTH_KINDS = {"input": ["proprioception", "vision", "frame_difference"], "output": ["vision", "arm"]}
ONLY_VECTORS = {"input": ["proprioception", "arm"], "output": ["proprioception", "contact_force"]}


@pytest.mark.parametrize("changes", [{}, ONLY_VECTORS, IMAGES_OF_BOTH_KINDS], ids=["smoke", "vectors", "changes"])
def test_our_own_network_gets_its_own_metrics(changes: dict[str, Any], copy: Path, tmp_path: Path) -> None:
    """To the last digit, whether its predictions come from Python or from a file."""
    overrides = {**changes, "seeds": 7, "scenarios": "empty"}
    assert harness.run(SMOKE, overrides, results=copy, progress=False) == (1, 0)
    task = harness.task(SMOKE, overrides, results=copy)
    model = harness.load_model("smoke/empty-z4-seed7", results=copy)

    def predict(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
        found = model.predict({name: array[:, 0] for name, array in context.items()}, actions[:, 0])
        return {name: array[:, None] for name, array in found.items()}

    run, was_done = task.submit(predict, model="twin", seed=7, progress=False)
    assert run.startswith("smoke/empty-model=twin-seed7-") and not was_done
    assert task.submit(predict, model="twin", seed=7, progress=False) == (run, True)
    context, actions, _ = task.test_inputs()[:]
    predicted = {name: values[:, 0] for name, values in predict(context, actions).items()}
    file = tmp_path / "predictions.parquet"
    predictions_table(task, predicted).write_parquet(file)
    task.save(tmp_path / "task.yaml")
    words = ["judge", tmp_path / "task.yaml", file, "--model", "filed", "--seed", "7", "--task", task.hash]
    subprocess.run([sys.executable, "-m", "harness", "--results", copy, *words], check=True, capture_output=True)
    own = judged(copy, "multi_to_multi")
    assert own["all_metrics"].height > 50 and own["frames"].height == (0 if changes is ONLY_VECTORS else 5)
    for name in ("twin", "filed"):
        for table, rows in judged(copy, name).items():
            assert own[table].equals(rows), (name, table)
    assert harness.verify(copy) == []


def test_metrics_are_those_of_scikit_learn(copy: Path) -> None:
    task = vectors(copy)
    task.submit(last, model="last", seed=3, notes={"commit": "ab12cd3", "seconds": 1.5}, progress=False)
    data = harness.Dataset(copy / "datasets" / task.dataset)
    present = task.test_inputs().samples
    rows = harness.query("select * from all_metrics where model = 'last'", copy)
    assert rows["trained_here"].unique().to_list() == [False]
    for horizon in task.horizons:
        found = {"proprioception": data["proprioception"][present]}
        found["contact_force"] = np.abs(found["proprioception"])
        for name, values in found.items():
            wanted = data[name][present + horizon].astype(float)
            overall = rows.filter(polars.col("index").is_null(), polars.col("direction").is_null())
            overall = overall.filter(modality=name, horizon=horizon)
            metrics = dict(overall.select("metric", "value").iter_rows())
            assert metrics["mae"] == pytest.approx(mean_absolute_error(wanted, values), rel=1e-6)
            assert metrics["rmse"] == pytest.approx(root_mean_squared_error(wanted.ravel(), values.ravel()), rel=1e-6)
            by_joint = rows.filter(polars.col("index").is_not_null())
            by_joint = by_joint.filter(modality=name, horizon=horizon, metric="r2")
            own = dict(by_joint.select("index", "value").iter_rows())
            # A joint or link whose value never changes has none.
            assert any(value is not None for value in own.values())
            for index in (index for index, value in own.items() if value is not None):
                assert own[index] == pytest.approx(r2_score(wanted[:, index], values[:, index]), rel=1e-5)
    # Repeating the last sample is the baseline persistence.
    sql = "select value from all_metrics where architecture = 'last' and model = '{}' and modality = 'proprioception'"
    order = " order by horizon, metric, index"
    own, baseline = (harness.query(sql.format(name) + order, copy) for name in ("last", "persistence"))
    assert own.equals(baseline)


def test_a_task_of_a_dataset_is_saved_and_opened(copy: Path, tmp_path: Path, folders: dict[str, Path]) -> None:
    arguments: dict[str, Any] = {"inputs": ["proprioception", "vision"], "outputs": "contact_force", "context": 5}
    task = harness.task(dataset=folders["empty"].name, horizons=[1, 5, 20], **arguments, results=copy)
    assert (task.horizons, task.input, len(task.train())) == ((1, 2, 5, 10, 20), ["proprioception", "vision"], 12)
    task.save(tmp_path / "task.yaml")
    again = harness.task(tmp_path / "task.yaml", results=copy)
    assert (again.hash, again.experiment) == (task.hash, task.experiment)
    assert harness.task(dataset=folders["empty"], horizons=20, **arguments, results=copy).hash == task.hash
    other = harness.task(dataset=folders["empty"], horizons=20, **arguments, split={"test": 0.3}, results=copy)
    assert other.hash != task.hash
    table = task.to_arrow()
    assert table["proprioception"].to_numpy().shape == (12, 5, 20)
    with pytest.raises(ValueError, match="latent"):
        harness.run(tmp_path / "task.yaml", results=copy, progress=False)
    zero = lambda context, actions: {"contact_force": np.zeros((len(actions), 20, 20))}  # noqa: E731
    task.submit(zero, model="zero", progress=False)
    means = task.compare()
    assert set(means["model"]) == {"zero", "persistence", "ridge", "training_mean"}


def test_every_command_takes_the_run(copy: Path, tmp_path: Path) -> None:
    task = vectors(copy)
    for seed in range(3):
        noise = np.random.default_rng(seed)

        def predict(context: Arrays, actions: np.ndarray, noise: np.random.Generator = noise) -> dict[str, np.ndarray]:
            found = last(context, actions)
            return {name: values + noise.normal(0, 0.1, values.shape) for name, values in found.items()}

        task.submit(predict, model="noisy", seed=seed, notes={"commit": "ab12cd3"}, progress=False)
    own = task.compare().filter(variant="model=noisy", model="noisy", metric="r2")
    assert own["seeds"].to_list() == [3] * own.height and own["low"].is_not_null().all()
    plot: dict[str, Any] = {"x": "variant", "metrics": "r2", "by": "modality", "where": {"window.horizon": 5}}
    harness.plot("smoke", **plot, output=tmp_path / "r2.png", results=copy)
    # Further ahead, by the name of the model.
    harness.plot("smoke", **plot, horizon=5, models="noisy", output=tmp_path / "r2.csv", results=copy)
    drawn = polars.read_csv(tmp_path / "r2.csv")
    ahead = harness.compare("smoke", where=plot["where"], horizon=(1, 5), results=copy).filter(metric="r2")
    assert set(ahead["horizon"]) == {1, 5}
    wanted = ahead.filter(model="noisy", horizon=5).sort("modality", "direction")
    assert drawn.sort("modality", "direction")["mean"].to_list() == pytest.approx(wanted["mean"].to_list())
    for call in (harness.compare, lambda *names, **asked: harness.plot(*names, **plot, **asked)):
        with pytest.raises(ValueError, match="no run predicts 3 samples ahead; the runs predict 1, 2, 5"):
            call("smoke", horizon=3, results=copy)
    page = harness.report("smoke", output=tmp_path / "report.html", results=copy, progress=False)
    assert "model=noisy" in page.read_text()


CLAIMS = """
- id: networks_learn_the_force
  statement: Networks predict the force.
  measured: mean R2 of the force
  scenarios: [empty]
  experiments: [smoke]
  query: |
    select scenario, seed, avg(value) as value from metrics where experiment = 'smoke' and task = 'prediction'
      and model = 'network' and modality = 'contact_force' and metric = 'r2' and direction is null and index is null
    group by scenario, seed
  condition: above 0.5
- id: good_is_better
  statement: The model good is better than networks.
  measured: advantage in R2 of the force
  scenarios: [empty]
  experiments: [smoke]
  query: |
    select scenario, seed, max(case when variant = 'model=good' then value end)
        - max(case when variant = '' then value end) as value
      from metrics where experiment = 'smoke' and task = 'prediction' and model in ('network', 'good')
        and modality = 'contact_force' and metric = 'r2' and direction is null and index is null
    group by scenario, seed having count(value) = 2
  condition: above 0
"""


def test_claims_are_about_models_that_they_name(tmp_path: Path) -> None:
    own = tmp_path / "results"
    networks = {"seeds": [0, 1, 2], "output": "contact_force", "scenarios": "empty"}
    assert harness.run(SMOKE, networks, results=own, progress=False) == (3, 0)
    file = tmp_path / "claims.yaml"
    file.write_text(CLAIMS)
    before = harness.claims("networks_learn_the_force", file=file, results=own)
    task = harness.task(SMOKE, {"output": "contact_force"}, cell="empty", results=own)
    data = harness.Dataset(own / "datasets" / task.dataset)
    answers = data["contact_force"][task.test_inputs().samples + 1]
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0, 0.01, answers.shape)
        task.submit(lambda *given, noise=noise: {"contact_force": (answers + noise)[:, None]}, model="good", seed=seed,
                    batch_size=1000, progress=False)
    # A claim on networks does not see other models, whose R2 is nearly 1.
    assert harness.claims("networks_learn_the_force", file=file, results=own).equals(before)
    verdict = harness.claims("good_is_better", file=file, results=own)
    assert verdict["verdict"].to_list() == ["holds"], verdict


def refused(task: PredictionTask, predict: Callable[..., Any], error: type[Exception], words: str, **more: Any) -> None:
    """Checks that a submission is refused and leaves nothing behind."""
    before = files(task.results)
    with pytest.raises(error, match=words) as raised:
        task.submit(predict, **{"model": "hostile", "progress": False, **more})
    assert "\n" not in str(raised.value)
    assert files(task.results) == before


Change = Callable[[np.ndarray], Any]

CHANGES: list[tuple[Change, type[Exception], str]] = [
    (lambda values: values[:, :, :-1], ValueError, r"has the shape \[23, 5, 19\], must be \[23, 5, 20\]"),
    (lambda values: values[:-1], ValueError, r"has the shape \[22, 5, 20\]"),
    (lambda values: values[:, :4], ValueError, r"has the shape \[23, 4, 20\]"),
    (lambda values: values[:, 0], ValueError, "has the shape"),
    (lambda values: values[..., None], ValueError, "has the shape"),
    (lambda values: values.ravel(), ValueError, "has the shape"),
    (lambda values: values[:0], ValueError, "has the shape"),
    (lambda values: values[0, 0, 0], ValueError, "has the shape"),
    (lambda values: np.where(values == values.max(), np.nan, values), ValueError, "value nan at .*must be finite"),
    (lambda values: np.where(values == values.max(), np.inf, values), ValueError, "has the value inf"),
    (lambda values: np.where(values == values.max(), 1e39, values.astype(float)), ValueError, "finite"),
    (lambda values: values.astype(str), TypeError, "must be an array of numbers"),
    (lambda values: values.astype(complex), TypeError, "must be an array of numbers"),
    (lambda values: values.astype(bool), TypeError, "must be an array of numbers"),
    (lambda values: values.astype(object), TypeError, "must be an array of numbers"),
    (lambda values: values.astype("datetime64[s]"), TypeError, "must be an array of numbers"),
    (lambda values: None, TypeError, "must be an array of numbers"),
    (lambda values: "forces", TypeError, "must be an array of numbers"),
    (lambda values: [[1.0], [1.0, 2.0]], TypeError, "must be an array of numbers"),
    (lambda values: {"values": values}, TypeError, "must be an array of numbers"),
    (lambda values: iter(values), TypeError, "must be an array of numbers"),
]


@pytest.mark.parametrize("number", range(len(CHANGES)))
def test_wrong_arrays_are_refused(number: int, results: Path) -> None:
    change, error, words = CHANGES[number]

    def predict(context: Arrays, actions: np.ndarray) -> dict[str, Any]:
        found = last(context, actions)
        return {**found, "contact_force": change(found["contact_force"])}

    refused(vectors(results), predict, error, words)


async def late(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Returns after its caller."""
    return last(context, actions)


def test_wrong_submissions_are_refused(results: Path) -> None:
    task = vectors(results)
    refused(task, late, TypeError, "it returned a coroutine, must be a dictionary")
    refused(task, lambda *given: None, TypeError, "it returned a NoneType")
    refused(task, lambda *given: last(*given)["contact_force"], TypeError, "it returned a ndarray")
    refused(task, lambda *given: {}, ValueError, "it returned nothing, must be proprioception, contact_force")
    refused(task, lambda *given: {"contact_force": last(*given)["contact_force"]}, ValueError, "must be proprioception")
    refused(task, lambda *given: {**last(*given), "arm": 0}, ValueError, "must be proprioception, contact_force")
    refused(task, lambda *given: 1 / 0, ZeroDivisionError, "division by zero")
    refused(task, lambda context: context, TypeError, "positional argument")
    refused(task, "last", TypeError, "predict: it must be a function")  # type: ignore[arg-type]
    for model in ("", "my gru", "../gru", "a" * 65, "gru,seed=1", "-gru", "a\nb", "über"):
        refused(task, last, ValueError, "can't name a model", model=model)
    refused(task, last, TypeError, "model: 3 must be a text", model=3)
    refused(task, last, ValueError, "seed: -1 must not be negative", seed=-1)
    refused(task, last, ValueError, "is too large", seed=2**60)
    refused(task, last, ValueError, "must fit into 64 bits", seed=2**64)
    refused(task, last, TypeError, "must be an integer", seed=0.5)
    refused(task, last, ValueError, "batch_size: 0 must be at least 1", batch_size=0)
    refused(task, last, TypeError, "notes: .* must be a dictionary", notes=["commit"])
    refused(task, last, ValueError, "has no name", notes={"": "ab12cd3"})
    refused(task, last, ValueError, "more than 10000 bytes", notes={"log": "x" * 20_000})
    refused(task, last, ValueError, "at most 100 are allowed", notes=dict.fromkeys(map(str, range(101)), ""))


def test_other_predictions_of_the_same_model_are_refused(copy: Path) -> None:
    task = vectors(copy)
    run, _ = task.submit(last, model="last", progress=False)
    other = lambda *given: {name: values + 0.1 for name, values in last(*given).items()}  # noqa: E731
    refused(task, other, ValueError, "has other predictions of this model .*harness.*rm '?smoke/", model="last")
    assert task.submit(other, model="last", seed=1, progress=False).run != run


def test_a_model_never_gets_targets(results: Path) -> None:
    task = vectors(results)
    seen: list[np.ndarray] = []

    def predict(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
        seen.extend([*context.values(), actions])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        task.submit(predict, model="curious", progress=False)
    for array in seen:
        assert array.base is None or array.base.size == array.size


def test_tasks_that_do_not_exist_are_refused(copy: Path, folders: dict[str, Path]) -> None:
    name = folders["empty"].name
    forces: dict[str, Any] = {"inputs": "arm", "outputs": "contact_force", "results": copy}
    gone, seed = "empty-0123456789abcdef", {"simulation.seed": 7}
    for error, words, call in [
        (TypeError, "either a spec or a dataset", lambda: harness.task(results=copy)),
        (TypeError, "either a spec or a dataset", lambda: harness.task(SMOKE, dataset=name, results=copy)),
        (TypeError, "give the inputs and the outputs", lambda: harness.task(dataset=name, results=copy)),
        (ValueError, "choose one: empty, cluttered", lambda: harness.task(SMOKE, results=copy)),
        (ValueError, "allowed: empty, cluttered", lambda: harness.task(SMOKE, cell="full", results=copy)),
        (FileNotFoundError, f"there is no {gone}", lambda: harness.task(dataset=gone, **forces)),
        (ValueError, "did you mean 'arm'", lambda: harness.task(dataset=name, **{**forces, "inputs": "arms"})),
        (ValueError, "does not fit into an episode", lambda: harness.task(dataset=name, horizons=40, **forces)),
        (ValueError, "3 is not judged", lambda: harness.task(dataset=name, horizons=[3, 5], **forces)),
        (ValueError, "at least 1", lambda: harness.task(dataset=name, horizons=[], **forces)),
        (TypeError, "must be an integer", lambda: harness.task(dataset=name, horizons=[1.5], **forces)),
        (FileNotFoundError, "lacks 4 of its episodes", lambda: harness.task(SMOKE, seed, cell="empty", results=copy)),
    ]:
        with pytest.raises(error, match=words):
            call()


def test_predictions_that_return_late_are_refused(copy: Path) -> None:
    task = vectors(copy)
    runs: list[str] = []

    def predict(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
        # While the model computes, somebody submits other predictions of a model with its name.
        runs.append(task.submit(last, model="slow", progress=False).run)
        before.update(files(copy))
        return {name: values + 0.1 for name, values in last(context, actions).items()}

    before: dict[Path, int] = {}
    with pytest.raises(ValueError, match="has other predictions of this model .*harness.*rm '?smoke/"):
        task.submit(predict, model="slow", batch_size=1000, progress=False)
    assert files(copy) == before and len(runs) == 1
    assert harness.query("select count(*) from runs where architecture = 'slow'", copy).item() == 1
    # Predictions that are the same are no other ones.
    assert task.submit(last, model="slow", progress=False) == (runs[0], True)


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit, MemoryError, GeneratorExit, RecursionError])
def test_a_submission_that_ends_halfway_leaves_nothing(kind: type[BaseException], results: Path) -> None:
    task, batches, before = vectors(results), [], files(results)

    def predict(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
        batches.append(len(actions))
        if len(batches) == 3:
            raise kind
        return last(context, actions)

    with pytest.raises(kind):
        task.submit(predict, model="halfway", batch_size=7, progress=False)
    assert batches == [7, 7, 7] and files(results) == before


def test_a_killed_submission_leaves_nothing(copy: Path) -> None:
    before = files(copy)
    script = f"""
        import os, signal
        import harness
        task = harness.task({str(SMOKE)!r}, cell="empty", results={str(copy)!r})
        task.submit(lambda *given: os.kill(os.getpid(), signal.SIGKILL), model="killed", progress=False)
    """
    answer = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False)
    assert answer.returncode == -signal.SIGKILL and files(copy) == before


def test_the_example_for_scikit_learn_works(copy: Path) -> None:
    check_example("scikit_learn", ["proprioception", "arm", "vision"], copy)
    models = set(harness.query("select distinct architecture from runs", copy)["architecture"])
    assert models == {"multi_to_multi", "random_forest", "k_nearest_neighbors", "mlp"}


def within(reference: np.ndarray, predicted: np.ndarray) -> float:
    """The share of predictions that are wrong by less than 0.1, in %."""
    return 100 * float((np.abs(reference - predicted) < 0.1).mean())


def test_a_metric_of_ones_own_is_in_every_table(copy: Path, tmp_path: Path) -> None:
    task = vectors(copy)
    for seed in range(2):
        task.submit(last, model="last", seed=seed, progress=False)
    before = harness.query("select * from all_metrics order by all", copy)
    assert harness.add_metric(within, "smoke", name="within", unit="%", results=copy) == 4
    rows = harness.query("select * from all_metrics where metric = 'within'", copy)
    assert set(rows["unit"]) == {"%"} and set(rows["model"]) == {"network", "last"}
    assert {(row["architecture"], row["horizon"]) for row in rows.to_dicts()} == {
        ("multi_to_multi", 0), ("multi_to_multi", 1), ("last", 1), ("last", 2), ("last", 5)
    }
    # The values are those of the stored predictions, computed with SQL.
    sql = """
        select run, modality, task, horizon, 100 * avg(case when abs(reference - predicted) < 0.1 then 1.0 else 0.0 end)
          as value from all_predictions group by run, modality, task, horizon order by run, modality, task, horizon
    """
    wanted = harness.query(sql, copy)
    found = rows.select(wanted.columns).sort("run", "modality", "task", "horizon")
    assert found.drop("value").equals(wanted.drop("value"))
    assert found["value"].to_list() == pytest.approx(wanted["value"].to_list())
    # Nothing else changed, and the files are intact.
    assert harness.query("select * from all_metrics where metric <> 'within' order by all", copy).equals(before)
    assert harness.verify(copy) == []
    means = task.compare(metrics="within", of="proprioception").filter(variant="model=last")
    assert (means["seeds"].item(), means["unit"].item()) == (2, "%")
    harness.plot("smoke", x="variant", metrics="within", by=["modality"], where={"window.horizon": 5},
                 output=tmp_path / "within.csv", results=copy)
    assert "model=last" in (tmp_path / "within.csv").read_text()
    page = harness.report("smoke", output=tmp_path / "report.html", results=copy, progress=False)
    assert '"within"' in page.read_text()
    command = [sys.executable, "-m", "harness", "--results", copy, "compare", "smoke", "--metrics", "within,r2"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "within (%)" in answer.stdout and "within (%) ↓" not in answer.stdout
    # A metric of the same name replaces the first one, in the runs that are named.
    run = rows.filter(architecture="last")["run"][0]
    assert harness.add_metric(lambda *of: None, f"smoke/{run}", name="within", results=copy) == 1
    rows = harness.query("select * from all_metrics where metric = 'within'", copy)
    assert rows.filter(run=run)["value"].null_count() == rows.filter(run=run).height == 6
    assert rows.height == found.height and harness.verify(copy) == []
    # The runs are still done.
    assert harness.run(SMOKE, results=copy, progress=False) == (0, 2)


def test_runs_are_intact_when_adding_a_metric_is_killed(copy: Path) -> None:
    script = f"""
        import harness
        print("begin", flush=True)
        for value in range(1_000_000):
            harness.add_metric(lambda *of: value, "smoke", name="steps", results={str(copy)!r})
    """
    for delay in (0.3, 0.5, 0.7, 1.1):
        adding = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], stdout=subprocess.PIPE, text=True)
        assert adding.stdout is not None and adding.stdout.readline() == "begin\n"
        time.sleep(delay)
        adding.kill()
        adding.wait()
        adding.stdout.close()
        assert [problem for problem in harness.verify(copy) if ".unfinished" not in problem.path.name] == []
    values = harness.query("select distinct value from metrics where metric = 'steps'", copy)["value"]
    assert len(values) in (1, 2)
    assert harness.add_metric(lambda *of: -1, "smoke", name="steps", results=copy) == 2
    values = harness.query("select distinct value from metrics where metric = 'steps'", copy)["value"]
    assert values.to_list() == [-1]
    assert harness.run(SMOKE, results=copy, progress=False) == (0, 2)


def test_metrics_that_can_not_be_added_are_refused(copy: Path) -> None:
    before = files(copy)
    good: dict[str, Any] = {"name": "within", "results": copy}
    for error, words, call in [
        (TypeError, "must be a function", lambda: harness.add_metric(3, "smoke", **good)),  # type: ignore[arg-type]
        (ValueError, "name: 'Within 1 N' must be", lambda: harness.add_metric(within, "smoke", name="Within 1 N")),
        (ValueError, "'r2' is a metric of the harness", lambda: harness.add_metric(within, "smoke", name="r2")),
        (ValueError, "'mae_ground' is a metric", lambda: harness.add_metric(within, "smoke", name="mae_ground")),
        (ValueError, "unit: '' must be", lambda: harness.add_metric(within, "smoke", unit="", **good)),
        (KeyError, "no finished run matches 'smok/'", lambda: harness.add_metric(within, "smok/", **good)),
        (KeyError, "no finished run matches ''", lambda: harness.add_metric(within, "", **good)),
        (ValueError, "no stored predictions of vision; those of images",
         lambda: harness.add_metric(within, "smoke", modality="vision", **good)),
        (TypeError, "returned a ndarray for smoke/", lambda: harness.add_metric(np.subtract, "smoke", **good)),
        (ValueError, "returned inf for smoke/", lambda: harness.add_metric(lambda *of: np.inf, "smoke", **good)),
        (ZeroDivisionError, "division", lambda: harness.add_metric(lambda *of: 1 / 0, "smoke", **good)),
    ]:
        with pytest.raises(error, match=words) as raised:
            call()
        assert "\n" not in str(raised.value)
    assert files(copy) == before


def test_windows_from_rest_have_all_samples_since_the_start(copy: Path, folders: dict[str, Path]) -> None:
    overrides = {**AHEAD, "network.memory": "gru", "window.start": "rest", "scenarios": "empty"}
    task = harness.task(SMOKE, overrides, results=copy)
    data = harness.Dataset(folders["empty"])
    assert task.start == "rest" and [len(part) for part in (task.train(), task.test_inputs())] == [50, 25]
    assert task.train().samples.tolist() == [*range(25), *range(30, 55)]
    context, actions, targets = task.train()[[3, 26, 24]]
    assert context["length"].tolist() == [4, 2, 25] and context["arm"].shape[:2] == (3, 25)
    steps = np.diff(data["setpoint"], axis=0)
    for row, present in enumerate((3, 31, 24)):
        first, length = 30 * (present // 30), int(context["length"][row])
        assert np.array_equal(context["proprioception"][row, -length:], data["proprioception"][first : present + 1])
        assert (context["proprioception"][row, : 25 - length] == data["proprioception"][first]).all()
        assert np.array_equal(context["action"][row, 25 - length :], steps[first:present])
        assert (context["action"][row, : 25 - length] == 0).all()
        assert np.array_equal(targets["arm"][row], data["arm"][present + 1 : present + 6])
        assert np.array_equal(actions[row], steps[present : present + 5])
    alone = task.train()[3]
    assert alone.context["arm"].shape[0] == 4 and alone.context["action"].shape == (3, 3)
    # A model that uses only the present sample gets the same metrics as in a window of one sample.
    short = harness.task(SMOKE, {**AHEAD, "window.context": 1, "scenarios": "empty"}, results=copy)
    values = []
    for each, seed in ((task, 1), (short, 2)):
        def predict(context: Arrays, actions: np.ndarray) -> dict[str, np.ndarray]:
            return {**last(context, actions), "arm": np.repeat(context["arm"][:, -1:], actions.shape[1], 1)}

        assert len(each.test_inputs()) == 25
        each.submit(predict, model="now", seed=seed, batch_size=7, progress=False)
        sql = "select horizon, modality, metric, index, value from all_metrics where model = 'now'"
        values.append(harness.query(f"{sql} and seed = {seed} order by all", copy))
    assert values[0].height > 100 and values[0].equals(values[1])


def test_the_file_of_a_model_goes_with_its_run(copy: Path, tmp_path: Path) -> None:
    """From Python and from the command line, and into a complete copy."""
    task = vectors(copy)
    (tmp_path / "net.onnx").write_bytes(b"layers and weights")
    (tmp_path / "net.txt").write_bytes(b"layers and weights")
    context, actions, _ = task.test_inputs()[:]
    task.save(tmp_path / "task.yaml")
    tables = []
    for step, horizon in enumerate(range(1, 6)):
        found = {name: values[:, step] for name, values in last(context, actions).items()}
        ahead = polars.lit(horizon).cast(polars.Int64)
        tables.append(predictions_table(task, found).with_columns(polars.col("sample") + step, horizon=ahead))
    polars.concat(tables).filter(polars.col("horizon").is_in(task.horizons)).write_parquet(tmp_path / "found.parquet")

    def call(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "harness", "--results", copy, *words]
        return subprocess.run(list(map(str, command)), cwd=tmp_path, capture_output=True, text=True)

    before = files(copy)
    judge = ("judge", "task.yaml", "found.parquet", "--model", "filed", "--network")
    refused = call(*judge, "net.txt")
    assert refused.returncode == 2 and "must end in one of .onnx, .pt, .pt2" in refused.stderr, refused.stderr
    assert files(copy) == before
    answer = call(*judge, "net.onnx")
    assert answer.returncode == 0, answer.stderr
    task.submit(last, model="called", network=tmp_path / "net.onnx", progress=False)
    answer = call("publish", task.experiment, "--complete", "--output", "copied")
    assert answer.returncode == 0, answer.stderr
    for results in (copy, tmp_path / "copied"):
        attached = sorted((results / "runs" / task.experiment).glob("*/network.onnx"))
        assert [path.read_bytes() for path in attached] == [b"layers and weights"] * 2
    assert harness.verify(copy) == []


def test_examples_have_less_than_60_lines() -> None:
    for path in (ROOT / "python/examples").glob("*.py"):
        assert len(path.read_text().splitlines()) < 60, path
