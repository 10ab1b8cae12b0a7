"""Experiments, tables, datasets and networks, against independent readers of the same files."""

import ast
import inspect
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pyarrow
import pytest
from conftest import ROOT, SMOKE

import harness
from harness import _harness


def test_a_finished_experiment_is_skipped(results: Path) -> None:
    assert harness.run(SMOKE, results=results, progress=False) == harness.Summary(done=0, skipped=2)


def test_overrides_are_those_of_the_command_line(results: Path, tmp_path: Path) -> None:
    overrides = {"latent": np.arange(4, 6), "scenarios": "empty", "training.epochs": np.int64(1), "tasks": "prediction"}
    assert harness.run(SMOKE, overrides, results=tmp_path, progress=False, jobs=2) == (2, 0)
    runs = harness.query("select run from runs order by run", tmp_path)
    assert [run.split("-")[1] for run in runs["run"]] == ["z4", "z5"]


def test_an_answer_is_what_polars_reads_from_the_tables(results: Path) -> None:
    answer = harness.query("select * from metrics", results)
    files = sorted((results / "runs").rglob("metrics.parquet"))
    assert answer.equals(polars.concat([polars.read_parquet(file) for file in files]))
    text = harness.query("select run, started from runs", results)
    assert text.schema == {"run": polars.String, "started": polars.String}
    assert harness.query("select * from metrics where value > 1000000000", results).height == 0


def test_a_results_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    for ask in (lambda: harness.query("select run from runs", tmp_path), lambda: harness.load_model("run", tmp_path)):
        with pytest.raises(FileNotFoundError, match="there are no results in"):
            ask()


def test_what_a_query_leaves_out_is_a_warning(results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    shutil.copytree(copy / "runs" / "smoke", copy / "runs" / "backup")
    with pytest.warns(UserWarning, match="a run is left out") as warned:
        runs = harness.query("select run from runs", copy)
    assert runs.height == 2 and len(warned) == 2


def test_a_run_keeps_a_command_that_does_the_same(results: Path) -> None:
    commands = harness.query("select distinct command from runs", results)["command"]
    assert commands.to_list() == [f"harness --results {results} run {SMOKE}"]


def test_a_comparison_has_means_and_intervals_over_seeds_alone(tmp_path: Path) -> None:
    for overrides in ({"seeds": [0, 1]}, {"seeds": [2], "training.epochs": 3}):
        harness.run(SMOKE, overrides | {"scenarios": ["empty"]}, results=tmp_path, progress=False)
    means = harness.compare("smoke", results=tmp_path)
    network = means.filter(model="network", task="prediction", modality="contact_force", metric="r2").sort("settings")
    assert network["settings"].to_list() == ["training.epochs=2", "training.epochs=3"]
    assert network["seeds"].to_list() == [2, 1]
    values = harness.query(
        "select value from metrics where model = 'network' and task = 'prediction' and metric = 'r2' and index is null "
        "and modality = 'contact_force' and direction is null order by seed",
        tmp_path,
    )["value"].to_list()
    half = 12.706_204_736 * abs(values[0] - values[1]) / 2
    assert network["mean"].to_list() == pytest.approx([(values[0] + values[1]) / 2, values[2]])
    assert network["high"].to_list() == [pytest.approx(network["mean"][0] + half), None]
    assert harness.compare(where={"training.epochs": 3}, results=tmp_path)["settings"].unique().to_list() == [""]


def test_an_answer_is_handed_over_without_copying(results: Path) -> None:
    table = harness._harness.query("select value from metrics", results)

    def places(answer: pyarrow.Table) -> list[int]:
        return [buffer.address for chunk in answer["value"].chunks for buffer in chunk.buffers() if buffer]

    # Each takes the table's own memory, or they would lie in different places.
    assert places(polars.DataFrame(table).to_arrow()) == places(pyarrow.table(table)) != []


@pytest.mark.parametrize("scenario", ["empty", "cluttered"])
def test_a_dataset_is_what_polars_reads_from_its_files(folders: dict[str, Path], scenario: str) -> None:
    data = harness.Dataset(folders[scenario])
    files = sorted(folders[scenario].glob("episode_*.parquet"))
    table = polars.concat([polars.read_parquet(file) for file in files])
    assert (len(data), data.scenario, data.sample_rate_hz) == (table.height, scenario, 10.0)
    assert data.bounds.tolist() == [[30 * episode, 30 * episode + 30] for episode in range(4)]
    for name in ("proprioception", "arm", "setpoint", "contact_force", "contact_force_mean"):
        columns = [column for column in table.columns if column.rsplit("_", 1)[0] == name]
        assert np.array_equal(data[name], table.select(columns).to_numpy()), name
    frames = np.stack([np.frombuffer(frame, np.uint8) for frame in table["vision"]])
    assert np.array_equal(data["vision"], frames.reshape(-1, 64, 64, 3))


def test_a_datasets_arrays_are_its_own_memory_and_keep_it(folders: dict[str, Path]) -> None:
    data = harness.Dataset(folders["empty"])
    episode = data.episode(2)
    assert episode["vision"].shape == (30, 64, 64, 3)
    for name in data.keys():
        assert np.shares_memory(data[name], episode[name])
        assert not data[name].flags.writeable
    force = data["contact_force_mean"]
    before = force.sum()
    del data, episode
    assert force.sum() == before > 0
    assert "vision" not in harness.Dataset(folders["empty"], frames=False).keys()


def test_a_model_predicts_what_the_run_recorded(results: Path, folders: dict[str, Path]) -> None:
    model = harness.load_model("cluttered-z4", results)
    assert (model.input, model.action, model.latent) == (["proprioception", "vision"], "increment", 4)
    data = harness.Dataset(folders["cluttered"])
    # The last of four episodes is the test's.
    first, end = data.bounds[-1]
    at = np.arange(first, end - 1)
    observation = {name: data[name][at] for name in model.input}
    predicted = model.predict(observation, data["setpoint"][at + 1] - data["setpoint"][at])
    recorded = harness.query(
        "select modality, sample, index, predicted from predictions "
        f"where run = '{model.run}' and task = 'prediction' and sample is not null",
        results,
    )
    assert recorded.height > 0
    for modality, sample, index, value in recorded.iter_rows():
        assert predicted[modality][sample - 1, index] == pytest.approx(value, rel=1e-4, abs=1e-4)
    # Frames: the error of all test samples, relative to "no change".
    change = (data["vision"][at + 1].astype(float) - data["vision"][at]) / 255
    error = np.sum((predicted["frame_difference"] - change) ** 2) / np.sum(change**2)
    metric = harness.query(
        f"select value from metrics where run = '{model.run}' and task = 'prediction' and model = 'network' "
        "and modality = 'frame_difference' and metric = 'relative_error'",
        results,
    )
    assert error == pytest.approx(metric.item(), rel=1e-4)


@pytest.mark.parametrize("world", ["empty", "cluttered"])
def test_networks_of_the_package_predict_new_episodes(
    world: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder without results. The episodes are those of a seed that no experiment uses."""
    monkeypatch.chdir(tmp_path)
    model = harness.load_model(f"recommended/{world}")
    touch = ["contact_force", "contact_force_mean"]
    assert (model.input, model.latent, model.scenario) == (["proprioception", "arm", *touch], 64, world)
    assert not list(tmp_path.iterdir())
    size = {"simulation.episodes": 4, "simulation.actuations_per_episode": 10, "simulation.seed": 4711, "test.episodes": 1}
    collected = harness.collect("recommended", {"scenarios": world, **size}, results=tmp_path, progress=False)
    data = harness.Dataset(next(iter(collected)))
    now = np.concatenate([np.arange(first, end - 1) for first, end in data.bounds])
    setpoint = data["setpoint"]
    predicted = model.predict({name: data[name][now] for name in model.input}, setpoint[now + 1] - setpoint[now])

    def error(modality: str, values: Any) -> float:
        reference = data[modality].astype(float)
        return float(np.mean((values - reference[now + 1]) ** 2) / np.var(reference[now + 1]))

    for modality, share in (("proprioception", 0.6), ("contact_force", 0.8), ("contact_force_mean", 0.6)):
        own, persistence = (error(modality, values) for values in (predicted[modality], data[modality][now]))
        assert own < share * persistence, (modality, own, persistence)


def test_a_model_reconstructs_what_the_run_recorded(results: Path, folders: dict[str, Path]) -> None:
    model, data = harness.load_model("cluttered-z4", results), harness.Dataset(folders["cluttered"])
    episode = data.episode(3)
    mean, _ = model.encode({name: episode[name] for name in model.input})
    reconstructed = model.reconstruct(mean)
    assert {name: values.shape[1:] for name, values in reconstructed.items()} == {
        "proprioception": (20,),
        "vision": (64, 64, 3),
    }
    recorded = harness.query(
        "select sample, index, predicted from predictions where task = 'reconstruction' "
        f"and modality = 'proprioception' and run = '{model.run}' and sample is not null",
        results,
    )
    assert recorded.height > 0
    for sample, index, value in recorded.iter_rows():
        assert reconstructed["proprioception"][sample, index] == pytest.approx(value, rel=1e-4, abs=1e-4)


def test_a_model_takes_other_numbers_lists_and_single_samples(results: Path, folders: dict[str, Path]) -> None:
    model, data = harness.load_model("smoke/empty", results), harness.Dataset(folders["empty"])
    observation = {name: data[name][:3] for name in model.input}
    action = data["setpoint"][1:4] - data["setpoint"][:3]
    expected = model.predict(observation, action)
    angles = observation["proprioception"]
    others = (angles.astype(np.float64), angles.astype(">f4"), angles.astype("<f4"), np.asfortranarray(angles))
    for other in (*others, angles.tolist()):
        found = model.predict({**observation, "proprioception": other}, action.astype(">f8"))
        assert all(np.array_equal(found[name], expected[name]) for name in expected)
    listed = model.predict(observation, action.astype(np.float64).tolist())
    assert all(np.array_equal(listed[name], expected[name]) for name in expected)
    for kind in ("<f8", ">f8", ">f4"):
        in_unit = {**observation, "vision": (observation["vision"] / 255).astype(kind)}
        assert np.allclose(model.encode(in_unit)[0], model.encode(observation)[0], atol=1e-6)
    single = model.predict({name: values[1] for name, values in observation.items()}, action[1])
    assert {name: values.shape for name, values in single.items()} == {
        name: values.shape[1:] for name, values in expected.items()
    }
    assert all(np.allclose(single[name], expected[name][1], atol=1e-5) for name in expected)
    latent, _ = model.encode({name: values[1] for name, values in observation.items()})
    assert latent.shape == (4,) and model.reconstruct(latent)["vision"].shape == (64, 64, 3)


def test_simulations_take_setpoints_of_either_byte_order() -> None:
    batch = harness.SimulationBatch("empty")
    for kind in ("<f8", ">f8", ">f4"):
        target = (batch.setpoint + [0.05, -0.01, 0.02]).astype(kind)
        batch.step(target)
        assert np.array_equal(batch.setpoint, target)


def test_models_and_datasets_can_be_pickled_and_printed(results: Path, folders: dict[str, Path]) -> None:
    model, data = harness.load_model("smoke/empty", results), harness.Dataset(folders["empty"], frames=False)
    again, copied = pickle.loads(pickle.dumps(model)), pickle.loads(pickle.dumps(data))
    observation = {name: np.zeros((1, *shape)) for name, shape in (("proprioception", (20,)), ("vision", (64, 64, 3)))}
    assert np.array_equal(again.encode(observation)[0], model.encode(observation)[0])
    assert (type(copied), copied.name, copied.keys()) == (harness.Dataset, data.name, data.keys())
    assert repr(model) == (
        f"<harness.Model smoke/{model.run}: proprioception, vision to proprioception, contact_force, frame_difference, "
        "latent 4>"
    )
    assert repr(data) == f"<harness.Dataset {data.name}: 120 samples in 4 episodes>"
    assert repr(data.simulation(2)) == "<harness.SimulationBatch empty: 2 simulations>"


def test_what_was_pickled_is_found_from_another_folder(
    results: Path, folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(results)
    model, data = harness.load_model("smoke/empty", "."), harness.Dataset(f"datasets/{folders['empty'].name}", False)
    monkeypatch.chdir(tmp_path)
    again, copied = pickle.loads(pickle.dumps(model)), pickle.loads(pickle.dumps(data))
    assert (again.run, copied.name, len(copied)) == (model.run, data.name, len(data))


def test_a_split_is_that_of_a_run(results: Path, folders: dict[str, Path]) -> None:
    data = harness.Dataset(folders["empty"])
    parts = {part: data.split(part) for part in ("training", "validation", "test")}
    assert parts["test"].tolist() == list(range(90, 119))
    assert parts["validation"].tolist() == list(range(60, 89))
    assert parts["training"].tolist() == [*range(29), *range(30, 59)]
    tested = harness.query(
        "select distinct episode, sample from predictions where scenario = 'empty' and sample is not null "
        "and task = 'prediction'",
        results,
    )
    assert tested.height > 0
    first = dict(enumerate(data.bounds[:, 0]))
    # `sample` is the predicted one.
    assert {first[episode] + sample - 1 for episode, sample in tested.iter_rows()} <= set(parts["test"])
    assert len(data.split("test", by="sample", test=0.5)) == 58


def test_the_episodes_of_a_part_are_those_of_its_samples(folders: dict[str, Path]) -> None:
    data = harness.Dataset(folders["empty"], frames=False)
    parts = [data.episodes(part).tolist() for part in ("training", "validation", "test")]
    assert (parts, data.episodes().tolist()) == ([[0, 1], [2], [3]], [0, 1, 2, 3])
    assert data.episodes("test", test=0.5).tolist() == [2, 3]
    for index, (first, end) in enumerate(data.bounds):
        assert np.shares_memory(data.episode(index)["arm"], data["arm"][first:end])
    assert np.array_equal(data.episode(-1)["arm"], data.episode(3)["arm"])


def test_a_dataset_of_another_world_can_be_opened(tmp_path: Path) -> None:
    made = harness.collect(SMOKE, {"scenarios": ["tendon"]}, results=tmp_path, progress=False)
    ((folder, episodes),) = made.items()
    assert episodes == 4
    assert harness.collect(SMOKE, {"scenarios": ["tendon"]}, results=tmp_path, progress=False) == {folder: 0}
    assert len(harness.Dataset(folder)) == 120


def test_claims_figures_and_verify_are_those_of_the_commands(tmp_path: Path) -> None:
    reference = ROOT / "results" / "reference"
    command = [Path(sys.executable).parent / "harness", "--results", reference]
    subprocess.run([*command, "claims", "--output", tmp_path / "verdicts.parquet"], cwd=ROOT, check=True)
    written = polars.read_parquet(tmp_path / "verdicts.parquet")
    recommended = harness.claims(file=ROOT / "experiments/claims.yaml", reading="recommended", results=reference)
    of_reading = written.filter((polars.col("reading") == "recommended") & polars.col("mean").is_not_null())
    assert recommended.filter(polars.col("mean").is_not_null()).equals(of_reading.drop("reading"))
    assert of_reading.height > 10 and set(of_reading["datasets"]) == {4}
    with pytest.raises(ValueError, match="no reading is called 'best'; the readings are base, recommended"):
        harness.claims(file=ROOT / "experiments/claims.yaml", reading="best", results=reference)
    (name,) = of_reading["claim"][:1]
    one = harness.claims(name, file=ROOT / "experiments/claims.yaml", reading="base", results=reference)
    assert one["claim"].unique().to_list() == [name]
    of = {"experiment": "hidden_stiffness", "of": "contact_force", "folder": tmp_path, "formats": "csv"}
    (horizon,) = harness.figures("horizon", results=reference, **of)
    assert horizon.read_text().count("contact_force") > 50
    drawn = harness.figures("forces_dataset", folder=tmp_path, formats=["svg", "csv"], results=reference)
    assert drawn == [tmp_path / "forces_dataset.svg", tmp_path / "forces_dataset.csv"]
    subprocess.run([*command, "figures", "forces_dataset", "--output", tmp_path / "out"], cwd=ROOT, check=True)
    assert all(path.read_bytes() == (tmp_path / "out" / path.name).read_bytes() for path in drawn)


def test_plots_and_reports_are_those_of_the_commands(results: Path, tmp_path: Path) -> None:
    command = [Path(sys.executable).parent / "harness", "--results", results]
    output = tmp_path / "plot.svg"
    made = harness.plot("smoke", x="latent", metrics="r2", by=["modality"], facet="scenario", output=output, results=results)
    drawn = output.read_bytes()
    asked = ["--x", "latent", "--metrics", "r2", "--by", "modality", "--facet", "scenario"]
    subprocess.run([*command, "plot", "smoke", *asked, "--output", output], check=True)
    assert made == output
    assert output.read_bytes() == drawn and b"<svg" in drawn
    for question in ({}, {"metrics": "r2", "horizon": "0.1s", "models": "network"}, {"metrics": "rmse", "against": "ridge"}):
        options = [word for name, value in question.items() for word in (f"--{name}", value)]
        said = subprocess.run([*command, "compare", "--format", "csv", *options], check=True, capture_output=True)
        assert harness.answer(**question, results=results).write_csv().splitlines()[0].encode() == said.stdout.splitlines()[0]
        means = polars.read_csv(said.stdout)["mean"].to_list()
        assert harness.answer(**question, results=results)["mean"].to_list() == pytest.approx(means)
    numbers = harness.plot(x="scenario", metrics="wmape", by="experiment", output=tmp_path / "plot.csv", results=results)
    assert set(polars.read_csv(numbers)["modality"]) == {"contact_force"}

    output = tmp_path / "report.html"
    assert harness.report("smoke", output=output, results=results, progress=False) == output
    page = output.read_bytes()
    subprocess.run([*command, "report", "smoke", "--output", output], check=True)
    assert output.read_bytes() == page and b"id=\"training-chart\"" in page


def test_verification_names_what_is_broken(results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    assert [problem for problem in harness.verify(copy) if problem.broken] == []
    damaged = next((copy / "runs").rglob("metrics.parquet"))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    (problem,) = [problem for problem in harness.verify(copy) if problem.broken]
    assert problem.path == damaged and problem.problem and problem.repair


def methods(stub: ast.ClassDef) -> list[ast.FunctionDef]:
    """The methods and properties of a class that users call by name."""
    return [item for item in stub.body if isinstance(item, ast.FunctionDef) and not item.name.startswith("__")]


def test_everything_public_has_a_docstring_and_a_version() -> None:
    assert harness.__version__.count(".") == 2
    stub = ast.parse((ROOT / "python/harness/_harness.pyi").read_text())
    compared = 0
    for entry in stub.body:
        if not isinstance(entry, ast.ClassDef) or entry.name == "Table":
            continue
        found = getattr(harness._harness, entry.name)
        documented = [(found, entry), *((getattr(found, member.name), member) for member in methods(entry))]
        for item, definition in documented:
            if text := ast.get_docstring(definition):
                assert inspect.getdoc(item) == text, (entry.name, definition.name)
                compared += 1
    assert compared > 30
    for name in harness.__all__:
        assert inspect.getdoc(getattr(harness, name)), name


def test_a_run_without_a_reconstruction_says_so(tmp_path: Path) -> None:
    harness.run(SMOKE, {"scenarios": ["empty"], "tasks": ["prediction"]}, results=tmp_path, progress=False)
    model = harness.load_model("smoke", tmp_path)
    with pytest.raises(RuntimeError, match="no reconstruction.*prediction"):
        model.reconstruct(np.zeros((1, model.latent), np.float32))


def test_a_posterior_is_the_same_in_any_batch_and_form_of_frames(
    results: Path, folders: dict[str, Path]
) -> None:
    model, data = harness.load_model("smoke/empty", results), harness.Dataset(folders["empty"])
    observation = {name: data[name] for name in model.input}
    mean, log_variance = model.encode(observation)
    assert mean.shape == log_variance.shape == (120, 4)
    assert np.all(np.isfinite(log_variance)) and np.ptp(mean) > 0
    single, _ = model.encode({name: values[7:8] for name, values in observation.items()})
    assert np.allclose(single[0], mean[7], atol=1e-5)
    as_numbers, _ = model.encode({**observation, "vision": data["vision"].astype(np.float32) / np.float32(255)})
    assert np.allclose(as_numbers, mean, atol=1e-6)


def test_an_interrupted_run_raises_and_goes_on(tmp_path: Path) -> None:
    overrides = {"simulation.episodes": 100, "scenarios": ["empty"]}
    finished = threading.Event()

    def interrupt_at_the_first_episode() -> None:
        while not list(tmp_path.glob("datasets/*/episode_*.parquet")) and not finished.is_set():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    # A shell ignores this signal in programs that it starts in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # That it gets on at all shows that the interpreter's lock is free meanwhile.
    threading.Thread(target=interrupt_at_the_first_episode, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        harness.run(SMOKE, overrides, results=tmp_path, progress=False)
        finished.set()
    episodes = {file: file.stat().st_mtime_ns for file in tmp_path.glob("datasets/*/episode_*.parquet")}
    assert 0 < len(episodes) < 100
    assert harness.run(SMOKE, overrides, results=tmp_path, progress=False) == (1, 0)
    assert all(file.stat().st_mtime_ns == time for file, time in episodes.items())


def test_a_run_that_fails_says_why(tmp_path: Path) -> None:
    # f32 overflows at such steps.
    changes = {"training.learning_rate": 1.0, "training.kl_weight": 1e6, "training.epochs": 50}
    with pytest.raises(RuntimeError, match="2 runs failed: .*no longer finite.*learning_rate"):
        harness.run(SMOKE, {**changes, "training.patience": None}, results=tmp_path, progress=False)


def call_wrongly(name: str, results: Path, folder: Path) -> None:
    data, model = harness.Dataset(folder), harness.load_model("smoke/empty", results)
    observation = {key: data[key][:3] for key in model.input}
    action = np.zeros((3, 3), np.float32)
    {
        "spec": lambda: harness.run(results / "none.yaml", results=results),
        "override": lambda: harness.run(SMOKE, {"training.epochs": 0}, results=results),
        "key": lambda: harness.run(SMOKE, {"training.epoch": 1}, results=results),
        "jobs": lambda: harness.run(SMOKE, results=results, jobs=0),
        "sql": lambda: harness.query("selekt", results),
        "column": lambda: harness.query("select nothing from runs", results),
        "change": lambda: harness.query("drop table runs", results),
        "run": lambda: harness.load_model("nothing", results),
        "several runs": lambda: harness.load_model("smoke", results),
        "dataset": lambda: harness.Dataset(results / "datasets" / "none"),
        "no dataset": lambda: harness.Dataset(results),
        "iteration": lambda: list(data),
        "name": lambda: harness.compare(["smoke"], results=results),
        "assignment": lambda: harness.run(SMOKE, ["latent=4"], results=results),
        "where": lambda: harness.compare(where="training.epochs=2", results=results),
        "setting": lambda: harness.run(SMOKE, {"latent": {4}}, results=results),
        "jobs' type": lambda: harness.run(SMOKE, jobs=1.5, results=results),
        "memory": lambda: harness.run(SMOKE, memory=-1, results=results),
        "no format": lambda: harness.figures(formats=[], results=results),
        "episode's type": lambda: data.episode("first"),
        "episodes": lambda: data.episodes("tests"),
        "gap": lambda: data.split("test", by="time", gap_seconds=-1),
        "too much": lambda: data.split("test", validation=0.5, test=0.5),
        "torch": lambda: data.torch("arm", "touch"),
        "bytes as numbers": lambda: model.encode({**observation, "vision": observation["vision"].astype(float)}),
        "no number": lambda: model.encode({**observation, "proprioception": np.full((3, 20), np.nan)}),
        "no action": lambda: model.predict(observation, np.full((3, 3), np.inf)),
        "modality": lambda: data["touch"],
        "episode": lambda: data.episode(9),
        "lacking": lambda: model.encode({"vision": observation["vision"]}),
        "shape": lambda: model.encode({**observation, "proprioception": np.zeros((3, 19), np.float32)}),
        "batch": lambda: model.encode({**observation, "vision": data["vision"][:2]}),
        "type": lambda: model.encode({**observation, "vision": data["vision"][:3].astype(np.int64)}),
        "unknown": lambda: model.encode({**observation, "visoin": observation["vision"]}),
        "no array": lambda: model.encode({**observation, "proprioception": "1, 2, 3"}),
        "nothing": lambda: model.encode({}),
        "action": lambda: model.predict(observation, action[:, :2].copy()),
        "action type": lambda: model.predict(observation, action.astype(bool)),
        "part": lambda: data.split("all"),
        "division": lambda: data.split("test", by="link"),
        "shares": lambda: data.split("test", test=1.5),
        "starts": lambda: data.torch(["arm"], ["arm"], samples=np.array([29])),
        "claim": lambda: harness.claims("nothing", file=ROOT / "experiments/claims.yaml", results=results),
        "claims": lambda: harness.claims(file=results / "none.yaml", results=results),
        "no claims": lambda: harness.claims(file=ROOT / SMOKE, results=results),
        "figure": lambda: harness.figures("nothing", results=results),
        "format": lambda: harness.figures(formats=["gif"], results=results),
        "reading": lambda: harness.figures(reading="reproduction/nothing", results=results),
        "two sources": lambda: harness.figures(reading="reproduction/base", multi="smoke", results=results),
        "two scopes": lambda: harness.figures(experiment="smoke", quick=True, results=results),
        "runs": lambda: harness.figures("regression", folder=results / "none", results=results),
        "plot key": lambda: harness.plot(x="latents", metrics="r2", results=results),
        "plot metric": lambda: harness.plot(x="latent", metrics="R2", results=results),
        "plot ending": lambda: harness.plot(x="latent", metrics="r2", output="plot.eps", results=results),
        "plot series": lambda: harness.plot(
            x="latent", metrics="r2", facet="scenario", output=results / "none.svg", results=results
        ),
        "plot of nothing": lambda: harness.plot("smoke", x="latent", metrics="r2", of="vision", results=results),
        "horizon": lambda: harness.compare(horizon=0.15, results=results),
        "of nothing": lambda: harness.compare(of=None, results=results),
        "large index": lambda: data.episode(2**64),
        "plotted experiment": lambda: harness.plot("nothing", x="latent", metrics="r2", results=results),
        "reported experiment": lambda: harness.report("nothing", results=results, progress=False),
        "no results": lambda: harness.verify(results / "none"),
        "latent": lambda: model.reconstruct(np.zeros((3, 5), np.float32)),
        "no latent": lambda: model.reconstruct(np.zeros((0, 4), np.float32)),
        "number": lambda: model.reconstruct(1.0),
        "null": lambda: harness.query("select 1 as \"a\0b\"", results=results),
    }[name]()


@pytest.mark.parametrize(
    ("name", "exception", "message"),
    [
        ("spec", FileNotFoundError, "none.yaml"),
        ("override", ValueError, "training.epochs"),
        ("key", ValueError, "did you mean 'training.epochs'|unknown"),
        ("jobs", ValueError, "jobs"),
        ("sql", ValueError, "selekt|SELECT"),
        ("column", ValueError, "nothing"),
        ("change", ValueError, "not a query"),
        ("run", KeyError, "nothing"),
        ("several runs", KeyError, "several"),
        ("dataset", FileNotFoundError, "harness collect"),
        ("no dataset", FileNotFoundError, "a dataset is a folder with a dataset.json"),
        ("iteration", TypeError, "'Dataset' object is not iterable"),
        ("reading", ValueError, "reproduction has no reading 'nothing'; its readings are base, recommended"),
        ("two sources", ValueError, "reading: it replaces single and multi"),
        ("two scopes", ValueError, "experiment: it replaces quick, single, multi and reading"),
        ("name", TypeError, r"experiments: \['smoke'\] must be a text; give several names as several arguments"),
        ("assignment", TypeError, r"overrides: \['latent=4'\] must be a dictionary, such as"),
        ("where", TypeError, "where: 'training.epochs=2' must be a dictionary"),
        ("setting", TypeError, "overrides: 'latent' is a set; allowed: text, number, boolean"),
        ("horizon", ValueError, "horizon: '0.15': write a number of samples, or a time in seconds, such as 0.5s"),
        ("of nothing", TypeError, "None must be a name, or a list of names"),
        ("large index", ValueError, "index: 18446744073709551616 must fit into 64 bits"),
        ("jobs' type", TypeError, "jobs: 1.5 must be an integer"),
        ("memory", ValueError, "memory: -1 must be a number of gigabytes"),
        ("no format", ValueError, "allowed: svg, png, pdf, csv"),
        ("episode's type", TypeError, "index: 'first' must be an integer"),
        ("episodes", ValueError, "part: there is no 'tests'; allowed: training, validation, test"),
        ("gap", ValueError, r"gap_seconds: -1 must be in \[0, 3600\]"),
        ("too much", ValueError, "a part would have no transitions; the dataset has 4 episodes"),
        ("torch", (KeyError, ImportError), "touch|Dataset.torch needs PyTorch: pip install torch"),
        ("bytes as numbers", ValueError, r"'vision' has the value \d+, must be uint8, or float in \[0, 1\]"),
        ("no number", ValueError, "'proprioception' has the value NaN, must be finite"),
        ("no action", ValueError, "'action' has the value inf, must be finite"),
        ("modality", KeyError, "touch.*proprioception"),
        ("episode", IndexError, "there are episodes 0 to 3, not 9"),
        ("lacking", KeyError, "proprioception"),
        ("shape", ValueError, r"proprioception.*\[3, 19\].*\[3, 20\]"),
        ("batch", ValueError, "vision"),
        ("type", TypeError, r"'vision' must be uint8, or float in \[0, 1\]"),
        ("unknown", KeyError, "the observation has 'visoin'; the encoder of .* takes proprioception, vision"),
        ("no array", TypeError, "'proprioception' must be an array or a list of numbers"),
        ("nothing", KeyError, "proprioception, vision"),
        ("action", ValueError, "action"),
        ("action type", TypeError, "action"),
        ("part", ValueError, "allowed: training, validation, test"),
        ("division", ValueError, "allowed: episode, time, sample"),
        ("shares", ValueError, r"must be in \(0, 1\)"),
        ("starts", (ValueError, ImportError), "no transition starts from 29; .* the last sample of an episode|torch"),
        ("claim", ValueError, "no claim is called 'nothing'"),
        ("claims", FileNotFoundError, "none.yaml"),
        ("no claims", ValueError, "smoke.yaml:7:1: this is not a file of claims, which is a list"),
        ("figure", ValueError, "there is no figure 'nothing'; allowed: .*regression"),
        ("format", ValueError, "there is no format 'gif'; allowed: svg, png, pdf, csv"),
        ("runs", RuntimeError, "regression was not drawn: "),
        ("plot key", ValueError, "there is no key 'latents'; did you mean 'latent'"),
        ("plot metric", ValueError, "there is no metric 'R2'; did you mean 'r2'"),
        ("plot ending", ValueError, r"must end in \.svg, \.png, \.pdf or \.csv"),
        ("plot series", ValueError, "the means differ in modality"),
        ("plot of nothing", ValueError, "no run has these metrics for this task"),
        ("plotted experiment", KeyError, "'nothing' has no finished runs; those that have: smoke"),
        ("reported experiment", KeyError, "'nothing' has no finished runs; those that have: smoke"),
        ("no results", FileNotFoundError, "there are no results in .*; the argument `results` names the folder"),
        ("latent", ValueError, r"latent.*\[3, 5\].*\[3, 4\]"),
        ("no latent", ValueError, "latent has no samples"),
        ("number", ValueError, "latent is a single number, not a sample or a batch"),
        ("null", ValueError, "it has a null character"),
    ],
)
def test_a_wrong_call_raises_what_fits_and_names_what_is_wrong(
    results: Path, folders: dict[str, Path], name: str, exception: type[Exception], message: str
) -> None:
    with pytest.raises(exception, match=message):
        call_wrongly(name, results, folders["empty"])


def test_a_specs_mistake_is_named_with_its_place(tmp_path: Path) -> None:
    spec = tmp_path / "touch.yaml"
    spec.write_text(SMOKE.read_text().replace("[proprioception, vision]", "[proprioception, visoin]"))
    with pytest.raises(ValueError, match=r"touch.yaml:\d+:\d+: unknown modality 'visoin'"):
        harness.run(spec, results=tmp_path)


def test_a_damaged_network_is_named_with_what_trains_it_again(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(results, "results")
    [network] = Path("results").glob("runs/smoke/empty-*/prediction.safetensors")
    whole = network.read_bytes()
    network.write_bytes(whole[: len(whole) // 2])
    message = "prediction.safetensors is damaged .*; `harness verify` says how to repair it"
    with pytest.raises(RuntimeError, match=message):
        harness.load_model("smoke/empty")
    [problem] = [problem for problem in harness.verify() if problem.broken]
    assert problem.repair is not None
    words = shlex.split(problem.repair)
    assert words[:2] == ["harness", "run"]
    subprocess.run([Path(sys.executable).parent / "harness", *words[1:]], check=True, capture_output=True)
    assert network.read_bytes() == whole
    assert harness.load_model("smoke/empty").latent == 4


WORLDS = {
    "no camera": ("twelve.yaml", "camera: wrist", "camera: waist", r"twelve.yaml:\d+:\d+: .*waist"),
    "not a world": ("twelve.yaml", "step_rate_hz", "steps_hz", r"twelve.yaml:\d+:\d+: .*steps_hz"),
    "model": ("twelve.xml", "<worldbody>", "<worldbodies>", "twelve.xml does not compile with MuJoCo 3.17.0: "),
    "rate": (
        "twelve.yaml",
        "sample_rate_hz: 10",
        "sample_rate_hz: 9.9",
        "simulation.sample_rate_hz: |9.9 Hz does not divide",
    ),
}
"""Mistakes in a world: the file, what it has, what it gets instead, and the message."""


@pytest.mark.parametrize("mistake", WORLDS)
def test_a_mistake_in_a_world_file_is_a_wrong_value(tmp_path: Path, mistake: str) -> None:
    for name in ("twelve.yaml", "twelve.xml"):
        shutil.copy(ROOT / "models" / name, tmp_path / name)
    name, right, wrong, message = WORLDS[mistake]
    text = (tmp_path / name).read_text()
    assert right in text
    (tmp_path / name).write_text(text.replace(right, wrong))
    world = str(tmp_path / "twelve.yaml")
    with pytest.raises(ValueError, match=message):
        harness.SimulationBatch(world)
    for act in (harness.run, harness.collect):
        with pytest.raises(ValueError, match=message):
            act(SMOKE, {"scenarios": world}, results=tmp_path / "results", progress=False)


def test_after_a_fork_what_needs_threads_is_refused(results: Path) -> None:
    child = os.fork()
    if child == 0:
        try:
            harness.query("select * from runs", results)
        except RuntimeError as error:
            os._exit(0 if "forked" in str(error) else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_the_command_is_the_program(tmp_path: Path) -> None:
    command = Path(sys.executable).parent / "harness"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("LD_")}

    def answer(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([command, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True)

    assert answer("--version").stdout.startswith("harness ")
    listed = answer("validate", str(SMOKE))
    assert (listed.returncode, listed.stdout.count("\n")) == (0, 3)
    assert answer("validate", str(SMOKE), "training.epochs=0").returncode == 2
    assert answer("query", "select nothing from runs").returncode == 2


def test_the_command_records_and_submits_what_starts_it_again(tmp_path: Path) -> None:
    """The process's own words are those of the interpreter."""
    command = Path(sys.executable).parent / "harness"

    def answer(*arguments: str) -> str:
        ended = subprocess.run([command, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True)
        return ended.stdout

    answer("run", "smoke", "scenarios=[empty]")
    recorded = harness.query("select command from runs", tmp_path / "results")["command"]
    assert recorded.to_list() == ["harness run smoke 'scenarios=[empty]'"]
    script = answer("submit", "smoke", "--dry-run")
    assert f"\n{sys.executable} -m harness --results {tmp_path}/results --threads" in script


def test_closed_outputs_of_the_command_lead_nowhere(results: Path) -> None:
    """The next file to be opened would take their place, and what is printed would go into it."""
    check = (
        "import os; from harness import _harness\n"
        f"code = _harness.main(['harness', '--results', {str(results)!r}, 'ls'], [])\n"
        "nowhere = all(os.readlink(f'/proc/self/fd/{stream}') == '/dev/null' for stream in (1, 2))\n"
        "os._exit(code if nowhere else 3)\n"
    )
    closed = ["sh", "-c", 'exec "$@" >&- 2>&-', "sh", sys.executable, "-c", check]
    assert subprocess.run(closed).returncode == 0


def test_the_stubs_are_those_of_the_extension(tmp_path: Path) -> None:
    check = [sys.executable, "-m", "mypy.stubtest", "harness._harness", "--mypy-config-file", ROOT / "pyproject.toml"]
    ended = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def has_type(value: Any, annotation: ast.expr) -> bool:
    """Whether a value has exactly the type that an annotation of the stubs names."""
    match annotation:
        case ast.Name("Any"):
            return True
        case ast.Constant(None):
            return value is None
        case ast.Name(name):
            return type(value).__name__ == name or (name == "Path" and isinstance(value, Path))
        case ast.BinOp(left, ast.BitOr(), right):
            return has_type(value, left) or has_type(value, right)
        case ast.Subscript(ast.Name("list"), item):
            return type(value) is list and all(has_type(one, item) for one in value)
        case ast.Subscript(ast.Name("dict"), ast.Tuple([key, item])):
            items = value.items() if type(value) is dict else [(None, None)]
            return all(has_type(name, key) and has_type(one, item) for name, one in items)
        case ast.Subscript(ast.Name("tuple"), ast.Tuple([item, ast.Constant(end)])) if end is Ellipsis:
            return type(value) is tuple and all(has_type(one, item) for one in value)
        case ast.Subscript(ast.Name("tuple"), ast.Tuple(items)):
            return type(value) is tuple and len(value) == len(items) and all(map(has_type, value, items))
        case ast.Subscript(ast.Name("NDArray"), ast.Name("Any")):
            return type(value) is np.ndarray
        case ast.Subscript(ast.Name("NDArray"), ast.Attribute(_, kind)):
            return type(value) is np.ndarray and value.dtype == getattr(np, kind)
    raise AssertionError(f"the test does not know {ast.unparse(annotation)}")


def test_what_is_returned_has_the_types_of_the_stubs(
    results: Path, folders: dict[str, Path], tmp_path: Path
) -> None:
    dataset = _harness.Dataset(folders["cluttered"])
    [run] = harness.query("select run from runs where scenario = 'cluttered'", results)["run"]
    model, simulation = _harness.Model(run, results), dataset.simulation(2)
    observation = {name: dataset[name][:2] for name in model.input}
    latent, _ = model.encode(observation)
    action = np.zeros((2, 3), np.float32)
    replays = _harness.Replays(folders["cluttered"].parent, folders["cluttered"].name, "cluttered", ["arm"])
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text("{name: lab, source: lab, format: lerobot, modalities: {setpoint: action, x: x}}")
    calls = {
        "run": lambda: _harness.run(SMOKE, [], False, results, False, 1, None),
        "query": lambda: _harness.query("select run from runs", results),
        "reserved_names": _harness.reserved_names,
        "answer": lambda: _harness.answer(harness._question(["smoke"]), results),
        "claims": lambda: _harness.claims([], ROOT / "experiments/claims.yaml", None, False, [], results),
        "figures": lambda: _harness.figures(["task"], tmp_path, ["svg"], False, *[None] * 5, [], results),
        "plot": lambda: _harness.plot(
            harness._question(["smoke"], metrics="r2", by="modality"), "latent", "scenario", tmp_path / "plot.svg", results
        ),
        "report": lambda: _harness.report(
            ["smoke"], tmp_path / "report.html", Path("claims"), False, [], results, False
        ),
        "report_dataset": lambda: _harness.report_dataset("cluttered", tmp_path / "dataset.html", results, False),
        "verify": lambda: _harness.verify(results),
        "recorded": lambda: _harness.recorded("smoke", run, results),
        "Replays.ranges": replays.ranges,
        "Replays.errors": lambda: replays.errors({}),
        "collect": lambda: _harness.collect(SMOKE, [], False, results, False, None),
        "read_mapping": lambda: _harness.read_mapping(mapping),
        "networks": lambda: _harness.networks(run, results),
        "attached": lambda: _harness.attached(run, results),
        "may_have_network": lambda: _harness.may_have_network(run, results),
        "export_onnx": lambda: _harness.export_onnx(run, tmp_path / "network.onnx", "prediction", results),
        "Dataset.split": lambda: dataset.split("test", validation=0.25, test=0.25),
        "Dataset.__len__": lambda: len(dataset),
        "Dataset.__getitem__": lambda: dataset["vision"],
        "Dataset.keys": dataset.keys,
        "Dataset.simulation": dataset.simulation,
        "Model.encode": lambda: model.encode(observation),
        "Model.predict": lambda: model.predict(observation, action),
        "Model.reconstruct": lambda: model.reconstruct(latent),
        "SimulationBatch.reset": lambda: simulation.reset(0, 0, 0),
        "SimulationBatch.step": lambda: simulation.step(simulation.setpoint),
        "SimulationBatch.follow": simulation.follow,
        "SimulationBatch.sense": lambda: simulation.sense("vision"),
        "SimulationBatch.render": lambda: simulation.render(0, 16, 16),
    }
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    task = _harness.Task(SMOKE, None, ["output=[arm]", "tasks=[prediction]"], False, "cluttered", copy, False)
    predictions = [("arm", 1, np.zeros((len(task.windows("test")), 3), np.float32))]
    policy = ["scenarios=empty"], False, copy, "own@1", False
    [collected] = _harness.PolicyDataset.of(SMOKE, *policy)
    recorder = collected.recorder()

    def save() -> None:
        recorder.start(0)
        for _ in range(1, recorder.samples):
            recorder.step(recorder.setpoint_ranges[:, 0])
        recorder.save()

    calls |= {
        "PolicyDataset.of": lambda: _harness.PolicyDataset.of(SMOKE, *policy),
        "PolicyDataset.claim": collected.claim,
        "PolicyDataset.advance": lambda: collected.advance(1),
        "PolicyDataset.recorder": collected.recorder,
        "PolicyDataset.release": lambda: collected.release([]),
        "Recorder.start": lambda: recorder.start(0),
        "Recorder.step": lambda: recorder.step(recorder.setpoint_ranges[:, 0]),
        "Recorder.values": lambda: recorder.values("vision", 0),
        "Recorder.save": save,
        "Task.description": task.description,
        "Task.yaml": task.yaml,
        "Task.bounds": task.bounds,
        "Task.windows": lambda: task.windows("training"),
        "Task.array": lambda: task.array("vision"),
        "Task.judge": lambda: task.judge(predictions, "zero", 0, {}, None, ["python"], False),
        "add_metric": lambda: _harness.add_metric(run, "own", "1", [("arm", 1, None, 0.5)], copy),
    }
    objects = {"Dataset": dataset, "Model": model, "SimulationBatch": simulation}
    objects |= {"PolicyDataset": collected, "Recorder": recorder}
    stubs = ast.parse((ROOT / "python/harness/_harness.pyi").read_text()).body
    functions = {stub.name: stub for stub in stubs if isinstance(stub, ast.FunctionDef)}
    for stub in stubs:
        if isinstance(stub, ast.ClassDef):
            functions |= {f"{stub.name}.{part.name}": part for part in stub.body if isinstance(part, ast.FunctionDef)}
    # What makes an object returns one of its own class, `main` prints, pickling is tested elsewhere, and a table
    # returns a capsule.
    left_out = {"main", "Dataset.__new__", "Model.__new__", "SimulationBatch.__new__", "Table.__arrow_c_stream__"}
    left_out |= {"Dataset.__reduce__", "Model.__reduce__", "Task.__new__"}
    # They are of an imported dataset and of a published run; tests/interchange calls them.
    left_out |= {"recording_notes", "extract", "Replays.__new__"}
    for name in sorted(functions.keys() - left_out):
        stub = functions[name]
        if [ast.unparse(decorator) for decorator in stub.decorator_list] == ["property"]:
            owner, part = name.split(".")
            value = getattr(objects[owner], part)
        else:
            value = calls.pop(name)()
        assert stub.returns is not None and has_type(value, stub.returns), f"{name} returned {value!r}"
    assert not calls


def test_further_horizons_change_no_other_table(tmp_path: Path) -> None:
    vectors = {"input": "proprioception", "output": ["proprioception", "contact_force"], "scenarios": "empty"}
    near, far = tmp_path / "near", tmp_path / "far"
    harness.run(SMOKE, vectors, results=near, progress=False)
    harness.run(SMOKE, vectors | {"window.horizon": 3}, results=far, progress=False)
    count = "select task, model, metric, count(*) as rows from metrics group by all order by all"
    assert harness.query(count, near).equals(harness.query(count, far))
    assert harness.compare(results=near).shape == harness.compare(results=far).shape
    both = "select horizon, count(*) as rows from all_metrics where task = 'prediction' and modality <> 'latent'"
    both += " group by horizon order by horizon"
    rows = harness.query(both, far)
    assert rows["horizon"].to_list() == [1, 2, 3]
    assert rows["rows"].to_list() == harness.query(both, near)["rows"].to_list() * 3


def test_the_table_of_metrics_has_the_divergence_of_each_latent_dimension(results: Path, folders: dict[str, Path]) -> None:
    """Computed from the posterior over the test windows, by the formula for two Gaussians."""
    model, data = harness.load_model("smoke/empty", results=results), harness.Dataset(folders["empty"])
    at = data.split("test")
    mean, log_variance = model.encode({name: data[name][at] for name in model.input})
    nats = (0.5 * (mean.astype(float) ** 2 + np.exp(log_variance.astype(float)) - 1 - log_variance)).mean(axis=0)
    rows = harness.query(
        "select metric, index, value from metrics where scenario = 'empty' and modality = 'latent' "
        "order by metric, index nulls first",
        results,
    ).rows()
    expected = [("active", None, float((nats > 0.01).sum())), ("kl", None, nats.sum())]
    expected += [("kl", index, value) for index, value in enumerate(nats)]
    assert [row[:2] for row in rows] == [row[:2] for row in expected]
    assert np.allclose([row[2] for row in rows], [row[2] for row in expected], rtol=1e-5)


def test_paths_are_taken_as_they_are(results: Path, tmp_path: Path) -> None:
    """In a folder whose name is a pattern, beside another one that matches it."""
    folder = tmp_path / "it's [a]=*? #1 50% \"ü日\" $HOME"
    (tmp_path / folder.name.replace("[a]", "a") / "results").mkdir(parents=True)
    copy = folder / "results"
    shutil.copytree(results, copy)
    assert harness.query("select count(run) as runs from runs", copy)["runs"].to_list() == [2]
    model = harness.load_model("smoke/empty", results=copy)
    assert len(harness.Dataset(copy / "datasets" / model.dataset)) == 120
    assert harness.compare("smoke", results=copy).height > 0
    harness.plot("smoke", x="scenario", metrics="r2", by="modality", output=folder / "plot.svg", results=copy)
    harness.report("smoke", output=folder / "page.html", results=copy, progress=False)
    harness.export_onnx("smoke/empty", folder / "network.onnx", results=copy)
    assert harness.run(SMOKE, {"scenarios": "empty", "seeds": 1}, results=copy, progress=False) == (1, 0)
    assert [problem for problem in harness.verify(copy) if problem.broken] == []
    written = {path.name for path in folder.iterdir()}
    assert written == {"results", "plot.svg", "page.html", "network.onnx"}
