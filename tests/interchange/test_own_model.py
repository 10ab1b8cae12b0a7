"""A recurrent network of PyTorch, judged beside networks of the harness: its metrics, and whatever shows them."""

import json
import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import onnx
import polars
import pytest
import torch
from conftest import ROOT, SPEC
from sklearn.metrics import mean_absolute_error, r2_score, root_mean_squared_error

import harness
from harness.prediction import PredictionTask, Windows

WINDOW = {"inputs": ["proprioception", "vision"], "outputs": ["contact_force"], "context": 5, "horizons": [1, 5, 20]}
NETWORKS = {
    "name": "touch",
    "scenarios": "empty",
    "input": ["proprioception", "vision"],
    "output": ["contact_force"],
    "tasks": ["prediction"],
    "window.context": 5,
    "window.horizon": 20,
    "network.memory": "gru",
    "seeds": [0, 1, 2],
    "simulation.episodes": 6,
    "simulation.actuations_per_episode": 8,
}


class Gru(torch.nn.Module):
    """Reads angles and a small gray image at each sample, then the actions."""

    def __init__(self) -> None:
        super().__init__()
        self.read = torch.nn.GRU(20 + 64, 32, batch_first=True)
        self.unroll = torch.nn.GRU(3, 32, batch_first=True)
        self.head = torch.nn.Linear(32, 20)

    def forward(self, angles: torch.Tensor, frames: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        batch, samples = angles.shape[:2]
        gray = frames.to(torch.float32).mean(-1).reshape(batch, samples, 8, 8, 8, 8).mean((3, 5)) / 255
        _, state = self.read(torch.cat([angles, gray.flatten(2)], 2))
        return self.head(self.unroll(actions, state)[0])

    def answer(self, context: dict[str, np.ndarray], actions: np.ndarray) -> torch.Tensor:
        arrays = (context["proprioception"], context["vision"], actions)
        return self(*(torch.tensor(array) for array in arrays))


def fit_my_gru(train: Windows, validation: Windows, seed: int) -> Gru:
    torch.manual_seed(seed)
    net, (context, actions, targets) = Gru(), train[:]
    optimizer = torch.optim.Adam(net.parameters(), 0.01)
    for _ in range(60):
        optimizer.zero_grad()
        (net.answer(context, actions) - torch.tensor(targets["contact_force"])).square().mean().backward()
        optimizer.step()
    return net


def program(net: Gru) -> torch.export.ExportedProgram:
    batch = torch.export.Dim("batch", min=2)
    example = (torch.zeros(3, 5, 20), torch.zeros(3, 5, 64, 64, 3, dtype=torch.uint8), torch.zeros(3, 20, 3))
    return torch.export.export(net, example, dynamic_shapes=({0: batch},) * 3)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """Three networks of the harness, and three of PyTorch, on the same task."""
    results = tmp_path_factory.mktemp("own_model") / "results"
    assert harness.run(ROOT / SPEC, NETWORKS, results=results, progress=False) == (3, 0)
    (dataset,) = (path.name for path in (results / "datasets").iterdir())
    task = harness.task(dataset=dataset, **WINDOW, name="touch", results=results)
    for seed in range(3):
        net = fit_my_gru(task.train(), task.validation(), seed)

        def predict(context, actions, net=net):
            return {"contact_force": net.answer(context, actions)}

        attached = program(net) if seed == 0 else None
        task.submit(predict, model="my_gru", seed=seed, notes={"commit": "ab12cd3"}, network=attached, progress=False)
    return results


def task_of(results: Path) -> PredictionTask:
    (dataset,) = (path.name for path in (results / "datasets").iterdir())
    return harness.task(dataset=dataset, **WINDOW, name="touch", results=results)


def test_its_metrics_are_those_of_scikit_learn(results):
    task = task_of(results)
    net = fit_my_gru(task.train(), task.validation(), 1)
    context, actions, _ = task.test_inputs()[:]
    found = net.answer(context, actions).detach().numpy()
    forces = harness.Dataset(results / "datasets" / task.dataset)["contact_force"]
    sql = (
        "select horizon, metric, value from all_metrics where model = 'my_gru' and seed = 1 "
        "and index is null and direction is null"
    )
    judged = {(horizon, metric): value for horizon, metric, value in harness.query(sql, results).iter_rows()}
    assert task.horizons == (1, 2, 5, 10, 20)
    compared = 0
    for horizon in task.horizons:
        wanted, values = forces[task.test_inputs().samples + horizon].astype(float), found[:, horizon - 1]
        assert judged[horizon, "mae"] == pytest.approx(mean_absolute_error(wanted, values), rel=1e-4)
        assert judged[horizon, "rmse"] == pytest.approx(
            root_mean_squared_error(wanted.ravel(), values.ravel()), rel=1e-4
        )
        # Links whose force never changes have no R2.
        if (moving := wanted.std(0) > 0).any():
            r2 = r2_score(wanted[:, moving], values[:, moving], multioutput="variance_weighted")
            assert judged[horizon, "r2"] == pytest.approx(r2, rel=1e-4)
            compared += 1
    assert compared >= 3


def test_compare_and_query_have_it_beside_our_networks(results):
    own = polars.col("model").is_in(["network", "my_gru"])
    means = harness.compare("touch", results=results).filter(own, metric="r2")
    assert sorted(means["variant"]) == ["", "model=my_gru"] and means["seeds"].to_list() == [3, 3]
    assert means["low"].is_not_null().all()
    assert means.equals(task_of(results).compare().filter(own, metric="r2"))
    sql = "select architecture, count(*) as runs from runs group by architecture order by architecture"
    assert harness.query(sql, results).rows() == [("multi_to_multi", 3), ("my_gru", 3)]
    sql = "select count(distinct task_hash) as tasks from runs"
    assert harness.query(sql, results).item() == 1


def test_claims_can_be_about_it(results, tmp_path):
    (tmp_path / "claims.yaml").write_text("""
- id: gru_predicts
  statement: The recurrent network of PyTorch is wrong by less than 100 N.
  measured: RMSE of the force
  scenarios: [empty]
  experiments: [touch]
  query: |
    select scenario, seed, avg(value) as value from metrics where experiment = 'touch' and variant = 'model=my_gru'
      and model = 'my_gru' and metric = 'rmse' and index is null and direction is null group by scenario, seed
  condition: below 100
""")
    verdict = harness.claims(file=tmp_path / "claims.yaml", results=results)
    assert verdict["verdict"].to_list() == ["holds"], verdict


def test_plot_and_report_show_it(results, tmp_path):
    harness.plot("touch", x="variant", metrics="r2", output=tmp_path / "r2.csv", results=results)
    assert "model=my_gru" in (tmp_path / "r2.csv").read_text()
    page = harness.report("touch", output=tmp_path / "report.html", results=results, progress=False).read_text()
    assert "model=my_gru" in page


def test_serve_shows_its_metrics(results, tmp_path):
    command = [sys.executable, "-m", "harness", "--results", results, "serve", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as serving:
        try:
            (address,) = re.findall(r"http://127\.0\.0\.1:\d+", serving.stdout.readline())
            with urllib.request.urlopen(f"{address}/api/runs") as answer:
                columns = {column["name"]: column["values"] for column in json.load(answer)["columns"]}
        finally:
            serving.kill()
    own = [place for place, name in enumerate(columns["architecture"]) if name == "my_gru"]
    assert len(own) == 3 and all(columns["contact_force r2, 20 samples ahead"][place] is not None for place in own)


def test_trackers_take_its_runs(results, tmp_path):
    pytest.importorskip("mlflow")
    from mlflow import MlflowClient
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    store = f"sqlite:///{tmp_path}/mlflow.db"
    assert harness.export_mlflow("touch", tracking_uri=store, results=results, progress=False) == (6, 0)
    assert harness.export_tensorboard("touch", folder=tmp_path / "logs", results=results, progress=False) == (6, 0)
    client = MlflowClient(store)
    runs = client.search_runs([client.get_experiment_by_name("touch").experiment_id])
    own = [run for run in runs if run.data.params.get("model") == "my_gru"]
    sql = (
        "select run, value from metrics where model = 'my_gru' and metric = 'rmse' "
        "and index is null and direction is null"
    )
    values = dict(harness.query(sql, results).iter_rows())
    name = "network/prediction/contact_force/rmse"
    assert {run.info.run_name: run.data.metrics[name] for run in own} == values and len(own) == 3
    assert {json.loads(run.data.tags["harness.notes"])["commit"] for run in own} == {"ab12cd3"}
    for run, value in values.items():
        events = EventAccumulator(str(tmp_path / "logs" / "touch" / run)).Reload()
        assert events.Scalars(name)[0].value == pytest.approx(value, rel=1e-6)


def test_what_is_attached_comes_back(results):
    run = "touch/empty-model=my_gru-seed0"
    net = harness.load_network(run, results=results)
    task = task_of(results)
    own = fit_my_gru(task.train(), task.validation(), 0)
    context, actions, _ = task.test_inputs()[:]
    given = [torch.tensor(array) for array in (context["proprioception"], context["vision"], actions)]
    torch.testing.assert_close(net(*given), own(*given))
    with pytest.raises(RuntimeError, match="no file of its model was attached"):
        harness.load_network("touch/empty-model=my_gru-seed1", results=results)
    with pytest.raises(RuntimeError, match="come from another program"):
        harness.load_model(run, results=results)
    assert harness.verify(results) == []


def zeros(context, actions):
    return {"contact_force": np.zeros((*actions.shape[:2], 20))}


def test_torchscript_and_onnx_files_are_attached(results, tmp_path):
    task = task_of(results)
    traced = torch.jit.trace(torch.nn.Linear(3, 2), torch.zeros(1, 3))
    run = task.submit(zeros, model="traced", network=traced, progress=False).run
    torch.testing.assert_close(harness.load_network(run, results=results)(torch.ones(1, 3)), traced(torch.ones(1, 3)))
    value = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in ("x", "y")]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Neg", ["x"], ["y"])], "negative", value[:1], value[1:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, tmp_path / "negative.onnx")
    run = task.submit(zeros, model="negative", network=tmp_path / "negative.onnx", progress=False).run
    session = harness.load_network(run, results=results)
    assert session.run(None, {"x": np.ones(1, np.float32)})[0] == [-1]
    # The file belongs to the run, which is damaged without it.
    file = results / "runs" / run / "network.onnx"
    assert file.read_bytes() == (tmp_path / "negative.onnx").read_bytes()
    file.write_bytes(b"x" + file.read_bytes()[1:])
    with pytest.raises(RuntimeError, match=r"network\.onnx is damaged"):
        harness.load_network(run, results=results)
    assert [problem.path.name for problem in harness.verify(results)] == ["network.onnx"]
    file.write_bytes((tmp_path / "negative.onnx").read_bytes())


def test_what_cannot_be_attached_is_refused(results, tmp_path):
    task = task_of(results)
    before = sorted(results.rglob("*"))
    (tmp_path / "net.txt").write_text("layers")
    (tmp_path / "folder.onnx").mkdir()
    for network, error, words in [
        (torch.nn.Linear(3, 2), TypeError, "it is a Linear, must be the path of a file, torch.export"),
        (3, TypeError, "it is a int, must be the path"),
        (tmp_path / "net.txt", ValueError, r"must end in one of \.onnx, \.pt, \.pt2"),
        (tmp_path / "none.onnx", ValueError, "No such file"),
        (tmp_path / "folder.onnx", ValueError, "it is not a file"),
    ]:
        with pytest.raises(error, match=words):
            task.submit(zeros, model="refused", network=network, progress=False)
    assert sorted(results.rglob("*")) == before
    (tmp_path / "bad.pt").write_bytes(b"no program")
    run = task.submit(zeros, model="bad", network=tmp_path / "bad.pt", progress=False).run
    with pytest.raises(RuntimeError, match=r"torch can't load .*network\.pt"):
        harness.load_network(run, results=results)
    task.submit(zeros, model="late", progress=False)
    with pytest.raises(ValueError, match=r"without a file of its model; to attach one, first .*rm 'touch/"):
        task.submit(zeros, model="late", network=tmp_path / "bad.pt", progress=False)


def test_the_walk_of_the_page_works_as_typed(tmp_path):
    """The page leads from a bag to a score with at most 15 lines of one's own."""
    page = (ROOT / "docs/bag-to-score.md").read_text()
    blocks = re.findall(r"```(\w+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    program = next(text for language, text in blocks if language == "python")
    assert len([line for line in program.splitlines() if line.strip()]) <= 15
    commands = [text for language, text in blocks if language == "sh" and "pip install" not in text]
    functions = f"""
    python() {{ "{sys.executable}" "$@"; }}
    harness() {{ "{sys.executable}" -m harness "$@"; }}
    """
    (tmp_path / "judge.py").write_text(program)
    named = "sed -i s/ros2-[0-9a-f]*/$(ls results/datasets)/ judge.py"
    script = f"set -e\n{functions}\n" + "\n".join([*commands[:-1], named, commands[-1]])
    answer = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    (table,) = [text for language, text in blocks if language == "text"]
    printed = answer.stdout[answer.stdout.index("my_net") :]
    words = [re.sub(r"[-*]?\d+\.\d+", "#", text).split()[:17] for text in (table, printed)]
    assert words[0] == words[1], answer.stdout
    means = harness.compare(results=tmp_path / "results").filter(metric="r2")
    scores = dict(means.select("model", "mean").iter_rows())
    assert scores["my_net"] > 0.9 > scores["ridge"] > scores["persistence"] > 0.7
