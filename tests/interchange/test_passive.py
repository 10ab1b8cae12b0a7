"""Recordings without commands, and estimates of the present sample, from CSV files to networks of other programs."""

import json
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import polars as pl
import pytest
import torch
from sklearn.linear_model import Ridge
from sklearn.neighbors import KNeighborsRegressor

import harness
from harness.importing import import_dataset

STREAM = {"log": {"file": "*.csv", "rate_hz": 20}}
STRAIN = {"from": "log.gauge_*"}


def recorded(folder: Path, setpoint: object = "none", trials: int = 10) -> str:
    """Imports trials of a joint whose two angles follow from four strain gauges at the same sample."""
    for trial in range(trials):
        random = np.random.default_rng(trial)
        angles = np.sin(np.arange(120)[:, None] * [0.11, 0.07] + random.uniform(0, 6, 2))
        gauges = np.stack([angles[:, 0], angles[:, 1], angles.sum(1), angles.prod(1)], 1)
        gauges += random.normal(0, 0.01, gauges.shape)
        columns = {f"gauge_{index}": gauges[:, index] for index in range(4)}
        columns |= {"angle_x": angles[:, 0], "angle_y": angles[:, 1], "near_x": angles[:, 0] * 2 + 1}
        pl.DataFrame(columns).write_csv(folder / f"{trial}.csv")
    keys = {"name": "joint", "source": ".", "format": "csv", "sample_rate_hz": 20, "max_gap_s": 1, "streams": STREAM}
    modalities = {"setpoint": setpoint, "strain": STRAIN, "angles": {"from": "log.angle_*", "unit": "rad"}}
    (folder / "joint.yaml").write_text(json.dumps(keys | {"modalities": modalities}))
    return import_dataset(folder / "joint.yaml", folder / "results", progress=False)


def spec(folder: Path, dataset: str, **keys) -> Path:
    text = {"name": "joint", "scenarios": dataset, "input": "strain", "output": "angles", "latent": 4}
    text |= {"tasks": "prediction", "network": {"preset": "single_to_multi", "hidden": 32}}
    text |= {"training": {"epochs": 60, "batch_size": 64}} | keys
    (folder / "spec.yaml").write_text(json.dumps(text))
    return folder / "spec.yaml"


def r2(results: Path) -> dict[tuple[str, str], float]:
    sql = "select variant, model, value from metrics where metric = 'r2' and direction is null and index is null"
    return {(variant, model): value for variant, model, value in harness.query(sql, results).rows()}


@pytest.mark.parametrize("memory", ["none", "window", "gru", "rssm"])
def test_networks_without_action_predict_and_are_the_same_elsewhere(tmp_path, memory):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = recorded(tmp_path)
    results = tmp_path / "results"
    assert harness.Dataset(results / "datasets" / dataset).keys() == ["strain", "angles"]
    network = {"preset": "single_to_multi", "hidden": 32, "memory": memory}
    context = 1 if memory == "none" else 8
    keys = {"network": network, "window": {"context": context, "horizon": [0, 1]}}
    keys["tasks"] = ["prediction", "reconstruction"]
    harness.run(spec(tmp_path, dataset, **keys), results=results, progress=False)
    for horizon in (0, 1):
        assert r2(results)[f"horizon={horizon}", "network"] > 0.9
    data = harness.Dataset(results / "datasets" / dataset)
    runs = harness.query("select run, variant from runs", results).rows()
    episode = harness.query("select distinct episode from predictions", results).item()
    for run, variant in runs:
        path = tmp_path / f"{variant}.onnx"
        harness.export_onnx(run, path, results=results)
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        assert "action" not in {value.name for value in session.get_inputs()}
        loaded = harness.load_network(run, results)
        assert loaded.description.get("estimates_present", False) == (variant == "horizon=0")
        first, end = data.bounds[episode]
        state, before, found = None, None, []
        for sample in range(first, end - 1):
            strain = data["strain"][sample : sample + 1]
            given = {"strain": strain}
            with torch.no_grad():
                if memory == "none":
                    values = loaded({"strain": strain})
                    np.testing.assert_allclose(
                        harness.load_model(run, results).predict(given)["angles"], values["angles"], atol=1e-5
                    )
                else:
                    state = loaded.act(loaded.observe(state, {"strain": strain}))
                    values = loaded.predict(state)
                    zeros = np.zeros((1, session.get_inputs()[-2].shape[1]), np.float32)
                    given |= {"state": zeros if before is None else before, "seen": np.ones((1, 1), np.float32)}
            answer = dict(zip([each.name for each in session.get_outputs()], session.run(None, given), strict=True))
            before = answer.get("state.next")
            np.testing.assert_allclose(answer["predicted.angles"], values["angles"], atol=1e-5)
            found.append(values["angles"][0].numpy())
        # A network with memory is told of all samples here, and of the last 8 in the table.
        sql = f"select sample, index, predicted from predictions where run = '{run}' and task = 'prediction' \
            and modality = 'angles' order by sample, index"
        expected = harness.query(sql, results)["predicted"].to_numpy().reshape(-1, 2)
        ahead = int(variant[-1])
        samples = harness.query(sql, results)["sample"].to_numpy()[::2]
        if memory in ("none", "window"):
            chosen = [found[sample - ahead] for sample in samples if sample - ahead < len(found)]
            np.testing.assert_allclose(expected[: len(chosen)], chosen, atol=2e-5)


def test_the_baselines_of_an_estimate_are_those_of_scikit_learn(tmp_path):
    dataset, results = recorded(tmp_path), tmp_path / "results"
    path = spec(tmp_path, dataset, window={"horizon": 0})
    harness.run(path, results=results, progress=False)
    task = harness.task(path, results=results)
    assert (task.horizon, task.horizons) == (0, (0,))
    train, test = task.train()[:], task.test_inputs()[:]
    assert train.actions.shape == (8 * 120, 0, 0) and train.targets["angles"].shape == (8 * 120, 1, 2)
    inputs, targets = train.context["strain"][:, 0], train.targets["angles"][:, 0]
    mean, deviation = inputs.mean(0), inputs.std(0)
    for name, model in (("ridge", Ridge(1.0)), ("nearest_neighbors", KNeighborsRegressor(5))):
        model.fit((inputs - mean) / deviation, targets)

        def predict(context, actions, model=model):
            return {"angles": model.predict((context["strain"][:, 0] - mean) / deviation)[:, None]}

        task.submit(predict, model=f"sk_{name}", progress=False)
    assert len(test.context["strain"]) == 120
    found = r2(results)
    models = {model: value for (_, model), value in found.items()}
    assert models.keys() == {"network", "ridge", "nearest_neighbors", "training_mean", "sk_ridge", "sk_nearest_neighbors"}
    for name in ("ridge", "nearest_neighbors"):
        assert models[name] == pytest.approx(models[f"sk_{name}"], abs=1e-5)


def test_an_input_that_is_estimated_is_refused(tmp_path):
    path = spec(tmp_path, recorded(tmp_path), input=["strain", "angles"], window={"horizon": 0})
    with pytest.raises(ValueError, match="the output 'angles' is estimated at the sample of the input 'angles'"):
        harness.run(path, results=tmp_path / "results", progress=False)


@pytest.mark.parametrize(
    ("setpoint", "message"),
    [
        (["log.angle_x"], r"the setpoint is an output: its values are those of angles\[angle_x\]"),
        ("log.near_x", "the setpoint alone tells the output angles: ridge regression has an R2 of 1.000"),
    ],
)
def test_a_setpoint_that_tells_an_output_is_warned_about(tmp_path, capfd, setpoint, message):
    with pytest.warns(UserWarning, match=message):
        dataset = recorded(tmp_path, setpoint)
    capfd.readouterr()
    harness.run(spec(tmp_path, dataset, training={"epochs": 1}), results=tmp_path / "results", progress=True)
    assert message.split("\\")[0] in capfd.readouterr().err
