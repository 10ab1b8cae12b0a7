"""Exported runs, read with the packages of the trackers that they were exported to."""

import math
import shutil
import subprocess
import sys
import time
from pathlib import Path

import polars as pl
import pytest
from conftest import ROOT, SPEC, Harness

import harness as package

mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed: make interchange")
pytest.importorskip("tensorboard", reason="tensorboard is not installed: make interchange")

from mlflow import MlflowClient  # noqa: E402
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # noqa: E402
from tensorboard.plugins.hparams import metadata as hparams  # noqa: E402

EPOCHS = 3


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """Two runs that differ in their latent size, and one that failed because no image can be rendered."""
    harness = Harness(tmp_path_factory.mktemp("results"))
    settings = ["scenarios=[empty]", f"training.epochs={EPOCHS}", "training.patience=null"]
    answer = harness("run", SPEC, "latent=[3,4]", *settings)
    assert answer.returncode == 0, answer.stderr
    answer = harness("run", SPEC, "name=other", "training.learning_rate=1", "training.kl_weight=1000000", *settings)
    return harness.results


@pytest.fixture(params=["sqlite", "file"])
def store(request, tmp_path, monkeypatch) -> str:
    """An empty store of MLflow's on this machine."""
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.chdir(tmp_path)
    return f"sqlite:///{tmp_path}/mlflow.db" if request.param == "sqlite" else (tmp_path / "mlruns").as_uri()


def tracked(store: str, experiment: str = "smoke") -> dict:
    """The runs in a store, by the tag of their name."""
    client = MlflowClient(store)
    known = client.get_experiment_by_name(experiment)
    runs = client.search_runs([known.experiment_id]) if known else []
    return {run.data.tags["harness.run"]: run for run in runs}


def rows(results: Path, table: str, run: str) -> list[dict]:
    """A run's rows of a table."""
    experiment, run = run.split("/")
    file = results / "runs" / experiment / run / f"{table}.parquet"
    return pl.read_parquet(file).to_dicts()


def metric_name(row: dict) -> str:
    """The name of a row of the table `metrics` in a tracker."""
    name = "/".join(row[key] for key in ("model", "task", "modality", "metric"))
    return f"{name}.{row['direction']}" if row["direction"] else name


def test_mlflow_holds_every_setting_loss_metric_and_tag(results, store):
    assert package.export_mlflow("smoke", tracking_uri=store, results=results, progress=False) == (2, 0)
    found, client = tracked(store), MlflowClient(store)
    recorded = package.query("select * from runs where experiment = 'smoke' order by latent", results).to_dicts()
    assert sorted(found) == sorted(f"smoke/{row['run']}" for row in recorded)
    for row in recorded:
        run = found[f"smoke/{row['run']}"]
        assert run.info.run_name == row["run"] and run.info.status == "FINISHED"
        params, tags = run.data.params, run.data.tags
        assert params["latent"] == str(row["latent"]) and params["training.epochs"] == str(EPOCHS)
        assert params["input"] == '["proprioception", "vision"]' and params["network.preset"] == "multi_to_multi"
        assert params["simulation.episodes"] == "4" and params["training.patience"] == "null"
        for name in ("spec_hash", "dataset", "status", "mujoco_version", "git_commit", "command"):
            if row[name] is not None:
                assert tags[f"harness.{name}"] == row[name]
        assert tags["harness.seed"] == "0" and tags["harness.varies"] == "latent"
        epochs = [row for row in rows(results, "epochs", tags["harness.run"]) if row["value"] is not None]
        assert len(epochs) > 20
        for epoch in epochs:
            name = f"{epoch['task']}/{epoch['split']}/{epoch['term']}"
            history = client.get_metric_history(run.info.run_id, name)
            assert [point.step for point in history] == list(range(1, EPOCHS + 1))
            assert [point.timestamp for point in history] == sorted(point.timestamp for point in history)
            (point,) = (point for point in history if point.step == epoch["epoch"])
            assert point.value == epoch["value"]
        metrics = [
            row
            for row in rows(results, "metrics", tags["harness.run"])
            if row["index"] is None and row["value"] is not None
        ]
        assert len(metrics) > 50
        for metric in metrics:
            assert run.data.metrics[metric_name(metric)] == metric["value"]
        curves = {f"{row['task']}/{row['split']}/{row['term']}" for row in epochs}
        assert len(run.data.metrics) == len(metrics) + len(curves)


def test_exporting_to_mlflow_again_adds_only_what_changed(results, store, tmp_path):
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    (first, second) = sorted((copy / "runs" / "smoke").iterdir())
    kept = shutil.move(second, tmp_path / "kept")
    assert package.export_mlflow(tracking_uri=store, results=copy, progress=False) == (2, 0)
    before = tracked(store)
    shutil.move(kept, second)
    # An export that was interrupted: the run is there without its last tag.
    client, name = MlflowClient(store), f"smoke/{first.name}"
    client.delete_tag(before[name].info.run_id, "harness.version")
    assert package.export_mlflow("smoke", tracking_uri=store, results=copy, progress=False) == (2, 0)
    after = tracked(store)
    assert sorted(after) == [name, f"smoke/{second.name}"]
    assert after[name].info.run_id != before[name].info.run_id
    assert after[name].data.metrics == before[name].data.metrics
    assert package.export_mlflow(tracking_uri=store, results=copy, progress=False) == (0, 3)
    assert {run.info.run_id for run in tracked(store).values()} == {run.info.run_id for run in after.values()}


def test_a_failed_run_is_exported_as_one(results, store):
    assert package.export_mlflow("other", tracking_uri=store, results=results, progress=False) == (1, 0)
    (run,) = tracked(store, "other").values()
    assert run.info.status == "FAILED" and "no longer finite" in run.data.tags["harness.reason"]
    assert run.data.params["training.learning_rate"] == "1.0" and run.data.metrics == {}


def test_artifacts_are_the_runs_files(results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = f"sqlite:///{tmp_path}/mlflow.db"
    condition = "latent = 3"
    package.export_mlflow(
        "smoke", tracking_uri=store, condition=condition, artifacts=True, results=results, progress=False
    )
    (run,) = tracked(store).values()
    client = MlflowClient(store)
    (folder,) = (results / "runs" / "smoke").glob("empty-z3-*")
    files = sorted(file.name for file in folder.iterdir() if not file.name.startswith("."))
    assert [file.path for file in client.list_artifacts(run.info.run_id)] == files
    network = client.download_artifacts(run.info.run_id, "prediction.safetensors", str(tmp_path))
    assert Path(network).read_bytes() == (folder / "prediction.safetensors").read_bytes()


def events(folder: Path) -> EventAccumulator:
    accumulator = EventAccumulator(str(folder), size_guidance={"scalars": 0, "tensors": 0})
    accumulator.Reload()
    return accumulator


def test_tensorboard_reads_every_loss_metric_and_hyperparameter(results, tmp_path):
    logs = tmp_path / "logs"
    assert package.export_tensorboard("smoke", folder=logs, results=results, progress=False) == (2, 0)
    folders = sorted((logs / "smoke").iterdir())
    assert [folder.name for folder in folders] == sorted(path.name for path in (results / "runs" / "smoke").iterdir())
    for folder, latent in zip(folders, [3, 4], strict=True):
        found, run = events(folder), f"smoke/{folder.name}"
        tags = set(found.Tags()["scalars"])
        for epoch in rows(results, "epochs", run):
            name = f"{epoch['task']}/{epoch['split']}/{epoch['term']}"
            points = found.Scalars(name)
            assert [point.step for point in points] == list(range(1, EPOCHS + 1))
            value = points[epoch["epoch"] - 1].value
            assert value == pytest.approx(epoch["value"], rel=1e-6)
            tags.discard(name)
        for metric in rows(results, "metrics", run):
            name = metric_name(metric)
            if metric["index"] is None and metric["value"] is not None:
                (point,) = found.Scalars(name)
                assert point.step == EPOCHS and point.value == pytest.approx(metric["value"], rel=1e-6)
                tags.discard(name)
        assert not tags
        content = found.summary_metadata[hparams.SESSION_START_INFO_TAG].plugin_data.content
        begin = hparams.parse_session_start_info_plugin_data(content)
        assert {key: value.number_value for key, value in begin.hparams.items()} == {"latent": latent}
        assert hparams.SESSION_END_INFO_TAG in found.summary_metadata
        spec = found.Tensors("spec")[0].tensor_proto.string_val[0].decode()
        assert f"latent: {latent}\n" in spec


def test_exporting_to_tensorboard_again_adds_only_what_changed(results, tmp_path):
    copy, logs = tmp_path / "results", tmp_path / "logs"
    shutil.copytree(results, copy)
    assert package.export_tensorboard(folder=logs, results=copy, progress=False) == (3, 0)
    files = {path: path.read_bytes() for path in logs.rglob("*") if path.is_file()}
    assert len(files) == 6
    assert package.export_tensorboard(folder=logs, results=copy, progress=False) == (0, 3)
    assert files == {path: path.read_bytes() for path in logs.rglob("*") if path.is_file()}
    (changed,) = (logs / "smoke").glob("empty-z3-*")
    (changed / "harness-version").write_text("another")
    assert package.export_tensorboard(folder=logs, results=copy, progress=False) == (1, 2)
    assert len(list(changed.iterdir())) == 2
    assert all(math.isfinite(point.value) for point in events(changed).Scalars("prediction/train/total"))
    assert not [path for path in logs.iterdir() if path.name.startswith(".")]


def wait_for_epochs(results: Path, more_than: int) -> int:
    """Waits until the table has more than this many epochs, and returns their number."""
    for _ in range(500):
        time.sleep(0.2)
        if (results / "runs/smoke").is_dir():
            epochs = package.query("select count(distinct epoch) as epochs from epochs", results)["epochs"].item()
            if epochs > more_than:
                return epochs
    raise AssertionError("no epochs appear")


def test_a_running_training_with_more_epochs_is_exported_again(tmp_path):
    results, logs, store = tmp_path / "results", tmp_path / "logs", f"sqlite:///{tmp_path}/mlflow.db"
    settings = ["scenarios=[empty]", "tasks=[prediction]", "training.patience=null", "training.epochs=100000"]
    words = [sys.executable, "-m", "harness", "--results", str(results), "run", SPEC, *settings]
    training = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        epochs, exported = 0, 0
        for _ in range(2):
            epochs = wait_for_epochs(results, max(epochs, exported))
            assert package.export_tensorboard(folder=logs, results=results, progress=False) == (1, 0)
            (folder,) = (logs / "smoke").iterdir()
            exported = len(events(folder).Scalars("prediction/train/total"))
            assert exported >= epochs
            assert package.export_mlflow(tracking_uri=store, results=results, progress=False) == (1, 0)
            (run,) = tracked(store).values()
            assert run.info.status == "RUNNING"
            # MLflow may have got more epochs than TensorBoard before it.
            exported = max(exported, wait_for_epochs(results, 0))
    finally:
        training.kill()
        training.wait()
    assert package.export_tensorboard(folder=logs, results=results, progress=False) == (1, 0)
    assert package.export_tensorboard(folder=logs, results=results, progress=False) == (0, 1)


def test_what_cannot_be_exported_is_refused(results, tmp_path):
    logs = tmp_path / "logs"
    with pytest.raises(KeyError, match="'smok' has no runs; those that have: other, smoke"):
        package.export_tensorboard("smok", folder=logs, results=results)
    with pytest.raises(ValueError, match="color"):
        package.export_tensorboard("smoke", folder=logs, condition="color = 1", results=results)
    with pytest.raises(FileNotFoundError, match="there are no results in"):
        package.export_tensorboard("smoke", folder=logs, results=tmp_path)
    assert not logs.exists()
    with pytest.raises(RuntimeError, match="^MLflow refused it: [^\n]*$"):
        package.export_mlflow("smoke", tracking_uri="nowhere://server", results=results, progress=False)


def command(*words: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *options.pop("python", []), "-m", "harness", "export", *words],
        capture_output=True,
        text=True,
        check=False,
        **options,
    )


def test_the_command_exports_and_refuses_in_one_line(results, tmp_path):
    where = ["--results", str(results)]
    logs = str(tmp_path / "logs")
    for new, there in [(1, 0), (0, 1)]:
        answer = command("--format", "tensorboard", "smoke", logs, "--condition", "latent = 4", *where)
        assert answer.stdout == f"{new} runs exported to {logs}, {there} were there before\n", answer.stderr
    store = f"sqlite:///{tmp_path}/mlflow.db"
    answer = command("--format", "mlflow", "smoke", store, *where)
    assert answer.stdout == f"2 runs exported to {store}, 0 were there before\n", answer.stderr
    answer = command("--format", "mlflow", "smok", store, *where)
    assert (answer.returncode, answer.stderr) == (1, "error: 'smok' has no runs; those that have: other, smoke\n")
    answer = command("--format", "tensorboard", "smoke", logs, "--artifacts", *where)
    assert answer.returncode == 2
    assert answer.stderr.endswith("error: --artifacts can't be combined with --format tensorboard\n")


@pytest.mark.parametrize(("format", "missing"), [("mlflow", "mlflow-skinny"), ("tensorboard", "tensorboard")])
def test_a_missing_package_is_named_with_how_to_install_it(results, tmp_path, format, missing):
    # A module that can't be imported, in front of the installed one.
    (tmp_path / f"{format}.py").write_text(f"raise ModuleNotFoundError(\"No module named '{format}'\")")
    answer = command(
        "--format", format, "smoke", str(tmp_path / "out"), "--results", str(results), cwd=tmp_path
    )
    assert answer.returncode == 1
    assert f"pip install {missing} (No module named '{format}')" in answer.stderr
    assert answer.stderr.count("\n") == 1, answer.stderr
